"""The worst input that each reader accepts: peak memory and CPU seconds of reading it.

    python benchmarks/budgets.py [--json FILE] [READER ...]

Every input is made here, as large as its budget (README's Limits), and read in a process of its
own. Beside each stands what the process takes without it, libraries loaded.
"""

import argparse
import hashlib
import json
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.lib import format as npy
from rich.console import Console

from qsgm import images, paths, tuned_folder
from qsgm.bundle import MOST_BYTES as BUNDLE_BYTES
from qsgm.grasp import tuned
from qsgm.manifest import MANIFEST
from qsgm.samples import arrays
from qsgm.tables import number, table

SIDE = images.MAX_SIDE_PX
RNG = np.random.default_rng(0)
READ = "import sys; from pathlib import Path; path = Path(sys.argv[1]); "
# The peak of this program alone: getrusage's is also that of the one that started it.
TELL = """
import re, time
status = Path("/proc/self/status").read_text()
print(re.search(r"VmHWM:\\s*(\\d+) kB", status)[1], time.process_time())
"""


def noise(channels: int, dtype: type = np.uint8) -> Any:
    """Pixels that nothing can pack."""
    most = np.iinfo(dtype).max
    return RNG.integers(0, most, (SIDE, SIDE, channels), dtype, endpoint=True)


def picture(folder: Path) -> Path:
    """Sixteen bits and opacity, of which the reader makes eight and three channels."""
    path = folder / "noise.png"
    cv2.imwrite(str(path), noise(4, np.uint16), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return path


def photograph(folder: Path) -> Path:
    """A progressive JPEG, which is decoded scan by scan."""
    path = folder / "noise.jpg"
    cv2.imwrite(
        str(path), noise(3), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 95]
    )
    return path


def padded_png(data: bytes, size: int) -> bytes:
    """A PNG as long as that, by a chunk that says nothing."""
    body = b"juNk" + bytes(size - len(data) - 12)
    chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    return data[:-12] + chunk + data[-12:]


def described(folder: Path, name: str, content: bytes) -> str:
    """Write a file; its hash."""
    (folder / name).write_bytes(content)
    return hashlib.sha256(content).hexdigest()


def tuned_object(folder: Path) -> Path:
    """The most views, each with a patch's file of the most bytes, and a network of as many."""
    path = folder / "object"
    frame = str(paths.calibration_folder() / "demo_object.png")
    command = [
        sys.executable,
        "-m",
        "qsgm.cli",
        "finetune",
        "--epochs",
        "0",
        "-o",
        str(path),
        frame,
    ]
    subprocess.run(command, check=True, capture_output=True)
    about = json.loads((path / tuned_folder.DESCRIPTION).read_text())
    patch = padded_png((path / "patch.png").read_bytes(), tuned.MOST_BYTES)
    view = about["views"][0] | {"sha256": described(path, "patch.png", patch)}
    about["views"] = [view] * tuned.MOST_VIEWS
    network = (path / "network.onnx").read_bytes()
    left = tuned.MOST_BYTES - len(network) - 10
    # A field of the model that says who made it, in the protobuf's own encoding.
    network += b"\x12" + varint(left) + b" " * left
    about["sha256"] = described(path, "network.onnx", network)
    (path / tuned_folder.DESCRIPTION).write_text(json.dumps(about))
    return path


def varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first."""
    low, rest = value & 127, value >> 7
    return bytes([low | 128]) + varint(rest) if rest else bytes([low])


def bundle(folder: Path) -> Path:
    """The shipped one with a file that fills it up."""
    path = Path(shutil.copytree(paths.bundle_folder(), folder / "bundle"))
    manifest = json.loads((path / MANIFEST).read_text())
    size = BUNDLE_BYTES - sum((path / name).stat().st_size for name in manifest["files"])
    manifest["files"]["filler.bin"] = {"sha256": described(path, "filler.bin", bytes(size))}
    (path / MANIFEST).write_text(json.dumps(manifest))
    return path


def checkpoint(folder: Path) -> Path:
    """The shipped one with a tensor that fills it up."""
    import torch

    from qsgm.train.checkpoint import LARGEST_BYTES

    shipped = Path(__file__).parents[1] / "sgm.pt"
    data = torch.load(shipped, weights_only=True)
    size = LARGEST_BYTES - shipped.stat().st_size - 10_000
    data["filler"] = torch.zeros(size // 4)
    torch.save(data, folder / "sgm.pt")
    return folder / "sgm.pt"


def samples(folder: Path) -> Path:
    """Numbers that have to be turned round, in bytes and in axes."""
    path, count = folder / "samples.npz", (arrays.MOST_BYTES - 1000) // 4
    with zipfile.ZipFile(path, "w") as archive, archive.open("samples.npy", "w") as file:
        about = {"descr": ">f4", "fortran_order": True, "shape": (2, count // 2)}
        npy.write_array_header_1_0(file, about)
        file.write(bytes(8 * (count // 2)))
    return path


def video(folder: Path) -> Path:
    """A frame of the largest sides."""
    path = folder / "noise.avi"
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, codec, 10.0, (SIDE, SIDE))
    writer.write(noise(3))
    writer.release()
    return path


# How an input is made, what its process imports, and what it does.
READERS: dict[str, tuple[Callable[[Path], Path], str, str]] = {
    "picture, PNG": (picture, "from qsgm.images import read_frame", "read_frame(path)"),
    "picture, JPEG": (photograph, "from qsgm.images import read_frame", "read_frame(path)"),
    "video frame": (
        video,
        "from qsgm.grasp.watch import open_stream",
        "assert len(list(open_stream(path).frames)) == 1",
    ),
    "object": (tuned_object, "from qsgm.grasp.tuned import load_object", "load_object(path)"),
    "bundle": (bundle, "from qsgm.bundle import load_bundle", "load_bundle(path)"),
    "samples": (
        samples,
        "from qsgm.samples.arrays import read_npz",
        "assert read_npz(path, ('samples',))",
    ),
    "checkpoint": (
        checkpoint,
        "from qsgm.train.checkpoint import load_checkpoint",
        "load_checkpoint(path)",
    ),
}


def cost(code: str, path: Path) -> tuple[float, float]:
    """Peak memory [MB] and CPU seconds of a process."""
    command = [sys.executable, "-c", f"{READ}{code}\n{TELL}", str(path)]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    memory, seconds = map(float, told.split())
    return memory / 1000, seconds


def measured(name: str, folder: Path) -> dict[str, Any]:
    """One reader on its worst input."""
    make, imports, read = READERS[name]
    path = make(folder)
    files = [path] if path.is_file() else [one for one in path.iterdir() if one.is_file()]
    (memory, seconds), (bare_memory, bare_seconds) = (
        cost(code, path) for code in (f"{imports}; {read}", imports)
    )
    return {
        "input": name,
        "file_mb": number(sum(one.stat().st_size for one in files) / 1e6, 1),
        "peak_mb": number(memory, 0),
        "without_mb": number(bare_memory, 0),
        "cpu_seconds": number(seconds - bare_seconds, 2),
    }


def main() -> None:
    """Parse arguments, measure, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("readers", nargs="*", metavar="READER", help=", ".join(READERS))
    parser.add_argument("--json", type=Path, metavar="FILE")
    given = parser.parse_args()
    rows = []
    for name in given.readers or READERS:
        with tempfile.TemporaryDirectory() as folder:
            rows.append(measured(name, Path(folder)))
    columns = ("input", "file [MB]", "peak [MB]", "without it [MB]", "CPU [s]")
    Console().print(table(None, columns, [tuple(row.values()) for row in rows]))
    if given.json is not None:
        given.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
