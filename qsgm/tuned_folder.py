"""A tuned folder, whatever its task: a network, what is to be known of it, the run's report."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

from qsgm.errors import QsgmError
from qsgm.files import is_plain, new_folder, read_file, sha256
from qsgm.manifest import NETWORK

FORMAT = "qsgm-object"
VERSION = 2
DESCRIPTION = "object.json"
REPORT = "report.json"
COMMAND = "qsgm finetune -o DIR"
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
