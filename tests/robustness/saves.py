"""An object is saved over another one, and something happens: a kill, a power loss, a full disk.

`saves.py CAMPAIGN FOLDER OLD.onnx NEW.onnx SEED ROUNDS` prints counts, and fails where what is left
is neither the old object nor the new one.
"""

import hashlib
import json
import os
import resource
import shutil
import signal
import stat
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from qsgm import QsgmError, files
from qsgm.grasp.patch import Patch
from qsgm.grasp.shown import View
from qsgm.grasp.tuned import ObjectDescription, load_object, save_object
from robustness import file_events

RNG = np.random.default_rng(0)
PATCH = Patch(
    RNG.integers(0, 256, (160, 160, 3), np.uint8),
    np.full((160, 160), 255, np.uint8),
    (80, 80),
    True,
)
VIEWS = (View(PATCH, 0.0, whole=True),)


def save(folder: Path, name: str, network: bytes) -> None:
    save_object(folder, ObjectDescription(name, "double", 0.0, views=VIEWS), network, {"of": name})


def name_in(folder: Path, networks: dict[str, bytes]) -> str | None:
    """Of the object there, which has to be whole; None without one."""
    if not folder.exists():
        with suppress(QsgmError):  # a replacement in two steps may have been cut short
            load_object(folder)
        if not folder.exists():
            return None
    tuned = load_object(folder)
    name = tuned.description.name
    assert tuned._remade_from[1] == networks[name], f"{name} has another's network"
    report = json.loads((folder / "report.json").read_text())
    assert report == {"of": name}
    for line in (folder / files.LISTING).read_text().splitlines():
        digest, _, file = line.partition("  ")
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest, file
    return name


def start(job: Callable[[], None]) -> int:
    """A child that does a job."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            job()
            code = 0
        except KeyboardInterrupt:
            code = 130
        except QsgmError as error:
            code = 3
            sys.stderr.write(f"{error}\n")
        finally:
            sys.stderr.flush()
            os._exit(code)
    return child


def code_of(child: int) -> int:
    """Its exit code; negative: the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def in_a_child(job: Callable[[], None]) -> int:
    return code_of(start(job))


def at_event(number: int, act: Callable[[], None], job: Callable[[], None]) -> None:
    """Do a job, and `act` before its file event of that number."""
    left = number

    def count() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            act()

    with file_events.heard_by(count):
        job()


def ended_at(number: int, with_signal: int, job: Callable[[], None]) -> int:
    """The exit code of a child that a signal comes to before a file event of its job."""
    return in_a_child(lambda: at_event(number, lambda: os.kill(os.getpid(), with_signal), job))


def ways(folder: Path, networks: dict[str, bytes], act_with: int, stride: int) -> Counter[str]:
    """A signal before file events of a save: over nothing, over an old object."""
    counts: Counter[str] = Counter()
    for there in (False, True):
        number, code = 1, act_with
        while code:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            mug = folder / "mug"
            if there:
                save(mug, "old", networks["old"])
            code = ended_at(number, act_with, partial(save, mug, "new", networks["new"]))
            assert code in (0, -act_with, 128 + act_with), code
            found = name_in(mug, networks)
            assert found in (("old", "new") if there else (None, "new")), found
            assert code or found == "new"
            counts["signals"] += code != 0
            counts["left the new"] += found == "new"
            counts["left files behind"] += len(list(folder.iterdir())) != (found is not None)
            save(mug, "new", networks["new"])
            assert [path.name for path in folder.iterdir()] == ["mug"], "stale files were not swept"
            number += stride
    return counts


def kills(folder: Path, networks: dict[str, bytes], _: int, rounds: int) -> Counter[str]:
    return ways(folder, networks, signal.SIGKILL, stride_of(rounds))


def kills_between_two_steps(
    folder: Path, networks: dict[str, bytes], _: int, rounds: int
) -> Counter[str]:
    """Where the system cannot exchange two names."""
    files._exchange = lambda *_: False
    return ways(folder, networks, signal.SIGKILL, stride_of(rounds))


def interrupts(folder: Path, networks: dict[str, bytes], _: int, rounds: int) -> Counter[str]:
    counts = ways(folder, networks, signal.SIGINT, stride_of(rounds))
    files._exchange = lambda *_: False
    return counts + ways(folder, networks, signal.SIGINT, stride_of(rounds))


def stride_of(rounds: int) -> int:
    """Every event, or in the small campaign some."""
    return 1 if rounds > 1 else 5


class Disk:
    """What is certain to be on the disk: content and names as they were last synced."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.pinned: dict[int, int] = {}  # an inode's number is not used again while it is open
        self.content: dict[int, bytes] = {}
        self.names: dict[int, dict[str, int]] = {}
        for path in (root, *root.rglob("*")):
            self.synced(path)

    def synced(self, path: Path) -> None:
        status = path.stat()
        self.pin(path)
        if path.is_dir():
            self.names[status.st_ino] = {one.name: one.stat().st_ino for one in path.iterdir()}
        else:
            self.content[status.st_ino] = path.read_bytes()

    def pin(self, path: Path) -> None:
        inode = path.stat().st_ino
        if inode not in self.pinned:
            self.pinned[inode] = os.open(path, os.O_RDONLY)

    def after_power_loss(self, to: Path, *, metadata: bool) -> None:
        """What may be left now: unsynced content is lost; unsynced names are there or not."""
        live: dict[int, dict[str, int]] = {}
        for path in (self.root, *self.root.rglob("*")):
            self.pin(path)
            inode = path.stat().st_ino
            if path.is_dir():
                live[inode] = {one.name: one.stat().st_ino for one in path.iterdir()}
        folders = live if metadata else self.names
        self._write(self.root.stat().st_ino, to, folders)

    def _write(self, inode: int, to: Path, folders: dict[int, dict[str, int]]) -> None:
        to.mkdir()
        for name, inside in folders.get(inode, {}).items():
            descriptor = self.pinned[inside]
            if stat.S_ISDIR(os.fstat(descriptor).st_mode):
                self._write(inside, to / name, folders)
            else:
                (to / name).write_bytes(self.content.get(inside, b""))


def power_loss(folder: Path, networks: dict[str, bytes], _: int, rounds: int) -> Counter[str]:
    """Before file events of a save the power goes: with all names written, with none."""
    counts: Counter[str] = Counter()
    for two_steps, there in ((False, False), (False, True), (True, True)):
        if two_steps:
            files._exchange = lambda *_: False
        shutil.rmtree(folder, ignore_errors=True)
        root = folder / "root"
        root.mkdir(parents=True)
        if there:
            save(root / "mug", "old", networks["old"])
        counts["power losses"] += losses(root, folder / "after", networks, stride_of(rounds))
    return counts


def losses(root: Path, after: Path, networks: dict[str, bytes], stride: int) -> int:
    """How often the power went; what was left every time was whole."""
    disk, events, times = Disk(root), 0, 0
    before = name_in(root / "mug", networks)

    def lose(*allowed: str | None) -> None:
        nonlocal times
        for metadata in (True, False):
            shutil.rmtree(after, ignore_errors=True)
            disk.after_power_loss(after, metadata=metadata)
            found = name_in(after / "mug", networks)
            assert found in allowed, (found, metadata, allowed)
            times += 1

    def event() -> None:
        nonlocal events
        events += 1
        if events % stride == 0:
            lose(before, "new")

    fsync = os.fsync

    def synced(descriptor: int) -> None:
        fsync(descriptor)
        disk.synced(Path(f"/proc/self/fd/{descriptor}").readlink())

    os.fsync = synced
    try:
        with file_events.heard_by(event):
            save(root / "mug", "new", networks["new"])
    finally:
        os.fsync = fsync
    lose("new")
    return times


def full_disk(folder: Path, networks: dict[str, bytes], seed: int, rounds: int) -> Counter[str]:
    """No file may grow beyond a limit, as on a disk that fills up while an object is written."""
    counts: Counter[str] = Counter()
    rng = np.random.default_rng(seed)
    save(folder / "mug", "old", networks["old"])
    for _ in range(rounds):
        limit = int(rng.integers(1, 100_000))

        def job(limit: int = limit) -> None:
            signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
            save(folder / "mug", "new", networks["new"])

        code = in_a_child(job)
        assert code in (0, 3), code
        assert name_in(folder / "mug", networks) == ("new" if code == 0 else "old")
        assert [path.name for path in folder.iterdir()] == ["mug"]
        save(folder / "mug", "old", networks["old"])
        counts["written whole" if code == 0 else "refused"] += 1
    return counts


def eight(folder: Path, networks: dict[str, bytes], _: int, rounds: int) -> dict[str, int]:
    """Eight processes save to one folder and load from it."""
    save(folder / "mug", "old", networks["old"])

    def job(number: int) -> None:
        for turn in range(rounds):
            name = ("old", "new")[(number + turn) % 2]
            save(folder / "mug", name, networks[name])
            tuned = load_object(folder / "mug")
            assert tuned._remade_from[1] == networks[tuned.description.name]

    for two_steps in (False, True):
        if two_steps:
            files._exchange = lambda *_: False
        children = [start(partial(job, number)) for number in range(8)]
        assert [code_of(child) for child in children] == [0] * 8
        assert name_in(folder / "mug", networks) is not None
        assert [path.name for path in folder.iterdir()] == ["mug"]
    return {"processes": 16, "saves and loads": 16 * rounds}


def main() -> None:
    name, folder, old, new, seed, rounds = sys.argv[1:]
    networks = {"old": Path(old).read_bytes(), "new": Path(new).read_bytes()}
    campaign = globals()[name]
    file_events.watch()
    counts = campaign(Path(folder), networks, int(seed), int(rounds))
    sys.stdout.write(f"{json.dumps(counts)}\n")


if __name__ == "__main__":
    main()
