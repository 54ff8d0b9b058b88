"""An object is renamed, removed, or its graph copied out, and the process is killed meanwhile.

`objects.py CAMPAIGN FOLDER NETWORK.onnx SEED ROUNDS` prints counts, and fails where what is left is
torn or lost.
"""

import hashlib
import json
import os
import shutil
import signal
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

from qsgm import QsgmError, files, load_object, paths
from qsgm.files import write_bytes_atomic
from qsgm.store import graph_of, remove_object, rename_object
from robustness import file_events
from robustness.saves import ended_at, save, stride_of

Counts = Counter[str]


def name_in(folder: Path, network: bytes) -> str | None:
    """Of the object there, which has to be whole; None without one."""
    if not folder.exists():
        return None
    tuned = load_object(folder)
    assert tuned._remade_from[1] == network
    assert json.loads((folder / "report.json").read_text()) == {"of": "mug"}
    for line in (folder / files.LISTING).read_text().splitlines():
        digest, _, file = line.partition("  ")
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest, file
    return tuned.description.name


def last() -> Path | None:
    """What `predict` looks for by itself."""
    with suppress(QsgmError):
        return paths.last_object_folder()
    return None


def campaign(
    network: bytes, stride: int, job: Callable[[Path], object], check: Callable[[Path, bool], str]
) -> Counts:
    """Every signal before file events of a job on the last object, to the event that never comes.

    `check` gets the object's folder and whether the job came to its end; it says what was left.
    """
    counts: Counts = Counter()
    for with_signal in (signal.SIGKILL, signal.SIGINT):
        number, code = 1, -1
        while code:
            shutil.rmtree(paths.objects_folder(), ignore_errors=True)
            mug = paths.folder_named("mug")
            save(mug, "mug", network)
            paths.remember_object(mug)
            code = ended_at(number, with_signal, partial(job, mug))
            assert code in (0, -with_signal, 128 + with_signal), code
            counts["signals"] += code != 0
            counts[check(mug, code == 0)] += 1
            save(paths.folder_named("next"), "mug", network)
            hidden = [one.name for one in mug.parent.iterdir() if one.name.startswith(".qsgm")]
            assert hidden == [], "stale files were not swept"
            number += stride
    return counts


def rename(network: bytes, _: Path, stride: int) -> Counts:
    """It is there under the old name, the new one, or both; `predict` finds one of them."""

    def check(mug: Path, done: bool) -> str:
        cup = paths.folder_named("cup")
        found = name_in(mug, network), name_in(cup, network)
        assert found in (("mug", None), ("mug", "cup"), (None, "cup")), found
        assert last() in [one for one in (mug, cup) if one.exists()]
        assert not done or (found == (None, "cup") and last() == cup)
        return f"left {' and '.join(name for name in found if name)}"

    return campaign(network, stride, lambda mug: rename_object(mug, "cup"), check)


def remove(network: bytes, _: Path, stride: int) -> Counts:
    """It is there whole, or gone."""

    def check(mug: Path, done: bool) -> str:
        found = name_in(mug, network)
        assert found in (None, "mug")
        assert found == "mug" or not any(mug.parent.glob("mug*"))
        assert last() == (mug if found else None)
        assert not done or found is None
        return "left it" if found else "removed it"

    return campaign(network, stride, remove_object, check)


def export(network: bytes, folder: Path, stride: int) -> Counts:
    """The file is the old one or the graph; the object stays."""
    copy = folder / "copy.onnx"

    def job(mug: Path) -> None:
        write_bytes_atomic(copy, graph_of(mug)[0])

    def check(mug: Path, done: bool) -> str:
        assert name_in(mug, network) == "mug"
        assert last() == mug
        content = copy.read_bytes()
        assert content == network or (content == b"old" and not done)
        copy.write_bytes(b"old")
        return "left the old file" if content == b"old" else "left the graph"

    copy.write_bytes(b"old")
    return campaign(network, stride, job, check)


def main() -> None:
    name, folder, network, _, rounds = sys.argv[1:]
    os.environ["XDG_DATA_HOME"] = folder
    Path(folder).mkdir(exist_ok=True)
    file_events.watch()
    run = {"rename": rename, "remove": remove, "export": export}[name]
    counts = run(Path(network).read_bytes(), Path(folder), stride_of(int(rounds)))
    sys.stdout.write(f"{json.dumps(counts)}\n")


if __name__ == "__main__":
    main()
