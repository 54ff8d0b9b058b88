"""A tuned folder, whatever its task: a network, what is to be known of it, the run's report."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from qsgm.errors import QsgmError
from qsgm.files import is_plain, new_folder, read_file, sha256
from qsgm.manifest import MANIFEST_BYTES, NETWORK, parse_description

FORMAT = "qsgm-object"
VERSION = 2
DESCRIPTION = "object.json"
REPORT = "report.json"
COMMAND = "qsgm finetune -o DIR"
# Up to here a float64 tells whole numbers apart.
LARGEST_WHOLE = 2**53
_NO_FILES: Mapping[str, bytes] = MappingProxyType({})


def write_tuned(
    folder: Path,
    network: bytes,
    description: Mapping[str, Any],
    report: Mapping[str, Any],
    others: Mapping[str, bytes] = _NO_FILES,
) -> None:
    """Write a tuned folder; it appears complete or not at all.

    Args:
        folder: where; an earlier one is replaced.
        network: an ONNX file.
        description: without format, version and the network's hash.
        report: on how it was tuned.
        others: files by name.

    Raises:
        QsgmError: the folder cannot be written, or holds something else.
    """
    head = {"format": FORMAT, "version": VERSION, "sha256": sha256(network)}
    texts = {DESCRIPTION: head | dict(description), REPORT: dict(report)}
    with new_folder(folder, DESCRIPTION) as new:
        for name, data in {NETWORK: network, **others}.items():
            (new / name).write_bytes(data)
        for name, values in texts.items():
            text = json.dumps(values, indent=1, allow_nan=False)
            (new / name).write_text(f"{text}\n", encoding="utf-8")


def read_description(folder: Path, versions: Sequence[int], expected: str) -> dict[str, Any]:
    """What a tuned folder says of itself, if it is of one of these versions.

    `expected` is what should be there, for the message.

    Raises:
        QsgmError: it is missing, no JSON, or of something else.
    """
    path = folder / DESCRIPTION
    data = read_file(path, MANIFEST_BYTES, expected)
    return parse_description(data, path, FORMAT, versions, COMMAND)


def require_keys(path: Path, values: Mapping[str, Any], keys: Mapping[str, type]) -> None:
    """Refuse a description that lacks a key, or has a value of another type under it.

    Raises:
        QsgmError: names the first such key.
    """
    for key, kind in keys.items():
        value = values.get(key)
        if not _is_of(value, kind):
            got = "nothing" if key not in values else type(value).__name__
            raise QsgmError(
                f"{path}: {key!r} holds {got}, expected {kind.__name__}; make it with `{COMMAND}`"
            )


def _is_of(value: object, kind: type) -> bool:
    """Whether JSON's value is of a kind; it may write a float as a whole number."""
    if isinstance(value, bool):
        return False
    if kind is float and isinstance(value, int):
        return abs(value) <= LARGEST_WHOLE
    return isinstance(value, kind)


def unaltered(folder: Path, name: object, digest: object, most_bytes: int, advice: str) -> bytes:
    """A file of a tuned folder, if it is the one that the description means.

    Raises:
        QsgmError: it is missing, altered, too large or elsewhere; ends with `advice`.
    """
    if not is_plain(name):
        raise QsgmError(f"{folder / DESCRIPTION} names the file {name!r}, no plain name; {advice}")
    data = read_file(folder / name, most_bytes, f"a file that `{COMMAND}` wrote")
    if sha256(data) != digest:
        raise QsgmError(f"{folder / name} is altered: its sha256 differs; {advice}")
    return data
