"""What one lesson on this machine gives, as arrays in a file, or how two such files differ.

`one_lesson.py out.npz [EPOCHS]` teaches the demonstration frame in float and in int8;
`one_lesson.py one.npz other.npz` compares.
"""

import platform
import sys
from pathlib import Path

import numpy as np

from qsgm import finetune, load_bundle, read_frame
from qsgm.grasp.pixels import OPENCV, arithmetic
from qsgm.tune.settings import Settings

HERE = Path(__file__).resolve().parents[1]


def teach(out: Path, epochs: int) -> None:
    """Teach in both precisions and keep crops, features, weights and losses."""
    frame = read_frame(HERE / "calib" / "demo_object.png")
    bundle, arrays = load_bundle(HERE / "export"), {}
    for precision in ("float", "int8"):
        result = finetune(frame, bundle, Settings(precision=precision, epochs=epochs))
        every = np.arange(len(result.prepared.lesson))
        arrays |= {f"{precision} weights: {name}": one for name, one in result.weights.items()}
        arrays[f"{precision} losses"] = np.array(result.losses)
        print(precision, result.scores, flush=True)
        if precision == "float":
            arrays["crops"] = result.prepared.lesson.cut(every)
            arrays["features"] = np.asarray(result.prepared.source.of(every))
    np.savez(out, **arrays)
    ours = {name: one is getattr(OPENCV, name) for name, one in vars(arithmetic()).items()}
    print(platform.machine(), "OpenCV's own arithmetic:", ours)


def compare(one: Path, other: Path) -> None:
    """Print how many numbers of each array differ, and by how much."""
    with np.load(one) as a, np.load(other) as b:
        for name in a:
            off = np.abs(a[name].astype(np.float64) - b[name])
            print(f"{name}: {(off > 0).sum()} of {off.size} differ, by {off.max():.2g} at most")


if __name__ == "__main__":
    first, second = Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else "20"
    if second.isdecimal():
        teach(first, int(second))
    else:
        compare(first, Path(second))
