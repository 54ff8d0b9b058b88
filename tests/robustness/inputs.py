"""Readers are given files that are broken by chance, and files whose hashes agree all the same.

`inputs.py READER FOLDER MATERIAL SEED ROUNDS` prints counts. Everything is read or refused in one
printable line; any other exception, and a crash, is a finding, whose round stderr names.
"""

import hashlib
import json
import os
import resource
import sys
import warnings
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np

from qsgm import QsgmError, files, load_bundle, load_object, paths, read_frame
from qsgm.grasp.task import distractors_of, task_of
from qsgm.tuned_folder import DESCRIPTION

ADDRESS_SPACE = 8 * 2**30  # what numpy, OpenCV and torch reserve without using it is part of it
MOST_GROWTH_KB = 700_000  # of the largest size in memory, from one end of a campaign to the other
Rng = np.random.Generator
FRAME = np.random.default_rng(1).integers(0, 256, (200, 240, 3), np.uint8)
# What somebody might write into a description.
VALUES: list[Any] = [
    None, True, False, -1, 0, 1, 2**31, 2**63, 10**400, -0.0, 1e308, -1e308, float("nan"),
    float("inf"), "", "x", "../x", "/etc/passwd", "a\x1b[2J\nb", "\udcff", "y" * 100_000, [], [[]],
    [None] * 1000, {}, {"": {}}, [1, 2, 3, 4], [-1, -1, -1, -1], [2**40] * 4, "0" * 64,
]  # fmt: skip


def mutated(data: bytes, rng: Rng) -> bytes:
    """Bytes flipped, cut, doubled, exchanged; a few times."""
    found = bytearray(data)
    for _ in range(int(rng.choice([1, 1, 1, 2, 5]))):
        if not found:
            break
        first, last = sorted(int(at) for at in rng.integers(0, len(found) + 1, 2))
        last = min(last, first + int(rng.integers(1, 2000)))
        how = int(rng.integers(7))
        if how == 0:
            found[min(first, len(found) - 1)] ^= 1 << int(rng.integers(8))
        elif how == 1:
            del found[first:]
        elif how == 2:
            del found[first:last]
        elif how == 3:
            found[first:first] = found[first:last]
        elif how == 4:
            found[first:last] = rng.bytes(last - first)
        elif how == 5:
            found[first : first + 4] = rng.choice([b"\0\0\0\0", b"\xff\xff\xff\xff", b"\x7f\xff"])
        else:
            found[first : first + 1] = bytes([int(rng.integers(256))])
    return bytes(found)


def checked(png: bytes) -> bytes:
    """With right checksums, as far as its chunks can be followed."""
    found, position = bytearray(png), 8
    while position + 12 <= len(found):
        end = position + 8 + int.from_bytes(found[position : position + 4], "big")
        if end + 4 > len(found):
            break
        found[end : end + 4] = zlib.crc32(found[position + 4 : end]).to_bytes(4, "big")
        position = end + 4
    return bytes(found)


def places(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every place in nested JSON: a container and a key of it."""
    keys = value.keys() if isinstance(value, dict) else range(len(value))
    for key in list(keys):
        yield value, key
        if isinstance(value[key], dict | list) and value[key]:
            yield from places(value[key])


def altered(description: dict[str, Any], rng: Rng) -> dict[str, Any]:
    """A copy in which a value is another, or missing."""
    copy: dict[str, Any] = json.loads(json.dumps(description))
    for _ in range(int(rng.integers(1, 3))):
        there = list(places(copy))
        if not there:
            break
        container, key = there[int(rng.integers(len(there)))]
        if isinstance(container, dict) and rng.random() < 0.2:
            del container[key]
        else:
            container[key] = deepcopy(VALUES[int(rng.integers(len(VALUES)))])
    return copy


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def frame(folder: Path, material: Path, rng: Rng) -> None:
    pictures = sorted(material.glob("frame.*"))
    path = folder / "frame.png"
    data = mutated(pictures[int(rng.integers(len(pictures)))].read_bytes(), rng)
    if data.startswith(b"\x89PNG") and rng.random() < 0.8:
        data = checked(data)
    path.write_bytes(data)
    assert read_frame(path).dtype == np.uint8


def object_files(folder: Path, material: Path, rng: Rng) -> None:
    """One of an object's files broken; its hash is right in two of three."""
    names = ("network.onnx", "patch.png", DESCRIPTION)
    contents = {name: (material / "object" / name).read_bytes() for name in names}
    broken = names[int(rng.integers(3))]
    contents[broken] = mutated(contents[broken], rng)
    if broken == "patch.png":
        contents[broken] = checked(contents[broken])
    if broken != DESCRIPTION and rng.random() < 0.7:
        about = json.loads(contents[DESCRIPTION])
        about["sha256"] = sha256(contents["network.onnx"])
        about["views"][0]["sha256"] = sha256(contents["patch.png"])
        contents[DESCRIPTION] = json.dumps(about).encode()
    look(folder, contents)


def object_description(folder: Path, material: Path, rng: Rng) -> None:
    names = ("network.onnx", "patch.png", DESCRIPTION)
    contents = {name: (material / "object" / name).read_bytes() for name in names}
    about = altered(json.loads(contents[DESCRIPTION]), rng)
    contents[DESCRIPTION] = json.dumps(about).encode()
    look(folder, contents)


def look(folder: Path, contents: dict[str, bytes]) -> None:
    """What is found in a frame is in it."""
    for name, data in contents.items():
        (folder / name).write_bytes(data)
    tuned = load_object(folder)
    assert tuned.description.name.isprintable()
    detection, _ = tuned.locate(FRAME)
    assert 0 <= detection.quality <= 1
    assert np.isfinite(
        [*detection.center_px, *detection.displacement_px, detection.angle_deg]
    ).all()


def bundle(folder: Path, material: Path, rng: Rng) -> None:
    """A manifest altered, or a file broken whose hash is right; all that does not run is asked."""
    manifest = json.loads((material / "bundle" / "manifest.json").read_bytes())
    names = sorted(manifest["files"])
    for name in names:
        target = folder / name
        target.unlink(missing_ok=True)
        target.symlink_to(material / "bundle" / name)
    if rng.random() < 0.6:
        manifest = altered(manifest, rng)
    else:
        name = names[int(rng.integers(len(names)))]
        data = mutated((folder / name).read_bytes(), rng)
        (folder / name).unlink()
        (folder / name).write_bytes(data)
        manifest["files"][name]["sha256"] = sha256(data)
    (folder / "manifest.json").write_text(json.dumps(manifest))
    loaded = load_bundle(folder)
    task_of(loaded)
    distractors_of(loaded)
    tuned = loaded.network.last(loaded.manifest.most_layers)
    loaded.network_with(loaded.start_weights(tuned))
    for layer in loaded.manifest.sgms:
        loaded.float_sgm(layer)
    for name in names[:: 1 + int(rng.integers(len(names)))]:
        if name.endswith(".onnx") and loaded.has(name):
            loaded.session(name)


def checkpoint(folder: Path, material: Path, rng: Rng) -> None:
    from qsgm.train.checkpoint import load_checkpoint

    path = folder / "sgm.pt"
    path.write_bytes(mutated((material / "sgm.pt").read_bytes(), rng))
    load_checkpoint(path)


def partial(folder: Path, material: Path, rng: Rng) -> None:
    """Its digest is right; it is taken up or counts as none."""
    from qsgm.train.pretraining.resume import Partial

    body = mutated((material / "sgm.pt").read_bytes(), rng)
    (folder / "x.partial").write_bytes(hashlib.sha256(body).digest() + body)
    assert Partial.open(folder / "x", {}).seconds >= 0


def small_files(folder: Path, material: Path, rng: Rng) -> None:
    """The listing of a folder, the name of the last object, a calibration set's manifest."""
    from qsgm.train.grasp.calibration_set import CalibrationSet

    listing = mutated((material / "object" / files.LISTING).read_bytes(), rng)
    (folder / files.LISTING).write_bytes(listing)
    (folder / "object.json").write_bytes(b"{}")
    names = sorted(path.name for path in folder.iterdir())
    with suppress(QsgmError):
        files.check_replaceable(folder, "object.json")
    assert sorted(path.name for path in folder.iterdir()) == names
    os.environ["XDG_DATA_HOME"] = str(folder)
    (folder / "qsgm").mkdir(exist_ok=True)
    (folder / "qsgm" / "last").write_bytes(mutated(f"{folder}\n".encode(), rng))
    with suppress(QsgmError):
        paths.last_object_folder()
    manifest = json.loads((material / "frames.json").read_bytes())
    (folder / "manifest.json").write_text(json.dumps(altered(manifest, rng)))
    CalibrationSet(folder)[0]


def on_the_host(folder: Path, material: Path, rng: Rng) -> None:
    """In one process, since torch takes seconds to load."""
    (checkpoint, partial, small_files)[int(rng.integers(3))](folder, material, rng)


READERS: dict[str, Callable[[Path, Path, Rng], None]] = {
    "frame": frame,
    "object_files": object_files,
    "object_description": object_description,
    "bundle": bundle,
    "on_the_host": on_the_host,
}


def peak_kb() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def main() -> None:
    reader, folder, material, seed, rounds = sys.argv[1:]
    warnings.simplefilter("error")
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    Path(folder).mkdir(exist_ok=True)
    counts: Counter[str] = Counter(inputs=0, accepted=0, refused=0)
    before = 0
    for number in range(int(rounds)):
        sys.stderr.write(f"{reader}, seed {seed}, round {number}\n")
        try:
            READERS[reader](
                Path(folder), Path(material), np.random.default_rng([int(seed), number])
            )
            counts["accepted"] += 1
        except QsgmError as error:
            if not str(error).isprintable():
                raise AssertionError(repr(error)) from error
            counts["refused"] += 1
        counts["inputs"] += 1
        before = before or peak_kb()
    counts["MB more at the peak"] = (peak_kb() - before) // 1000
    assert peak_kb() - before < MOST_GROWTH_KB, counts
    sys.stdout.write(f"{json.dumps(counts)}\n")


if __name__ == "__main__":
    main()
