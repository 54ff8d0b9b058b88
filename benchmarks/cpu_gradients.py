"""The shipped int8 SGMs' gradients on this CPU, to be compared with those of another.

    python benchmarks/cpu_gradients.py native.npz
    python benchmarks/cpu_gradients.py --compare native.npz other.npz

Each file holds the gradients with this project's session settings, and with ONNX Runtime's own.
Inputs are random, from a fixed seed.
"""

import sys
from pathlib import Path

import numpy as np

from qsgm.blocks import single_layers
from qsgm.bundle import load_bundle
from qsgm.fidelity import cosine
from qsgm.manifest import probe_file
from qsgm.paths import bundle_folder
from qsgm.runtime import session_options
from qsgm.tune.prepare import in_step_layout

# isort: split
import onnxruntime as ort  # behind qsgm, which keeps it from reporting home

CROPS, TUNED = 64, 3


def gradients(kind: str, options: ort.SessionOptions) -> dict[str, np.ndarray]:
    """Gradients by SGM layer in a session with these options, called so."""
    bundle = load_bundle(bundle_folder())
    session = ort.InferenceSession(
        str(bundle.folder / probe_file(TUNED)), options, providers=["CPUExecutionProvider"]
    )
    rng = np.random.default_rng(0)
    labels = np.zeros((CROPS, 3), np.float32)
    labels[::2] = 1.0, 0.6, 0.8
    feeds = {
        "features": rng.integers(0, 256, (CROPS, 169, 16), dtype=np.uint8),
        "labels": labels,
        "rows": np.arange(CROPS),
    }
    layers = bundle.network.last(TUNED)
    feeds |= in_step_layout(bundle.start_weights(layers))
    names = [f"int8{layer}" for layer in single_layers(layers).sgm_layers]
    return {
        f"{name} {kind}": value
        for name, value in zip(names, session.run(names, feeds), strict=True)
    }


def compare(one: Path, other: Path) -> None:
    """Print, for every gradient, whether both files agree to the bit, and the cosine."""
    with np.load(one) as first, np.load(other) as second:
        for name in first.files:
            same = np.array_equal(first[name], second[name])
            print(f"{name}: bit-equal {same}, cosine {cosine(first[name], second[name]):.5f}")


if __name__ == "__main__":
    if sys.argv[1] == "--compare":
        compare(Path(sys.argv[2]), Path(sys.argv[3]))
    else:
        sessions = {"own": session_options(), "stock": ort.SessionOptions()}
        found = [gradients(kind, options) for kind, options in sessions.items()]
        np.savez(sys.argv[1], **found[0], **found[1])
