"""One whole job by deploy/web, run by node, beside Python's: CPU seconds, and how far they part.

    python benchmarks/browser.py [--epochs 20] [--runtime deploy/web/node_modules/onnxruntime-web]

On calib's object and scene. "Nudged" is Python against itself with labels that differ by 1e-6, less
than a float32's last bits after the frozen layers: how much of a difference is rounding's alone.
"""

import argparse
import json
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from qsgm import Bundle, Settings, load_bundle, read_frame, resolve
from qsgm.grasp.teach import prepare_object, train_object, tune_object
from qsgm.grasp.tuned import TunedObject
from qsgm.tune.prepare import in_step_layout
from qsgm.tune.result import Result

ROOT = Path(__file__).parents[1]
OBJECT, SCENE = ROOT / "calib/demo_object.png", ROOT / "calib/demo_scene.png"


def main() -> None:
    """Compare both ways on three kinds of runs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--epochs", type=int, default=20)
    default = ROOT / "deploy/web/node_modules/onnxruntime-web"
    parser.add_argument("--runtime", type=Path, default=default)
    arguments = parser.parse_args()
    bundle = load_bundle(ROOT / "export")
    many = arguments.epochs
    few = min(many, 3)  # a step of four layers takes ten times as long
    for layers, precision, epochs in ((3, "int8", many), (3, "float", many), (4, "int8", few)):
        settings = Settings(precision=precision, epochs=epochs, layers=layers)
        compare(bundle, settings, arguments.runtime)


def compare(bundle: Bundle, settings: Settings, runtime: Path) -> None:
    """Print one line for each way."""
    plan = resolve(settings, bundle)
    began = time.process_time()
    prepared = prepare_object(read_frame(OBJECT), bundle, plan, span_px=90.0)
    python = tune_object(prepared, plan)
    seconds = time.process_time() - began
    with tempfile.TemporaryDirectory() as folder:
        answers = by_node(Path(folder), settings, runtime)
        features = np.fromfile(Path(folder) / "features.bin", prepared.features.dtype)
    job, found = answers["tuned"], answers["found"][0]
    theirs = located(python)
    labels = prepared.labelled.labels + np.float32(1e-6)
    nudged = train_object(
        replace(prepared, labelled=replace(prepared.labelled, labels=labels)), plan
    )
    others = located(nudged)
    weights = in_step_layout(python.weights)
    what = f"{settings.layers} layers, {settings.precision}, {settings.epochs} epochs"
    print(f"{what}: CPU seconds Python {seconds:.2f}, node {job['cpu']:.2f}")
    print(f"  codes that differ: {np.mean(features != prepared.features.ravel()):.1e}")
    for name, losses, values, center, turn in (
        ("node", job["losses"], job["weights"], found["center"], found["turnDeg"]),
        ("nudged", nudged.losses, in_step_layout(nudged.weights), *others),
    ):
        apart = max(
            float(np.abs(np.ravel(values[key]) - value.ravel()).max())
            for key, value in weights.items()
        )
        print(
            f"  {name}: losses {np.abs(np.subtract(losses, python.losses)).max():.1e}, weights "
            f"{apart:.1e}, centre {np.hypot(*np.subtract(center, theirs[0])):.3f} px, turn "
            f"{abs(turn - theirs[1]):.3f}°"
        )


def located(result: Result) -> tuple[tuple[float, float], float]:
    """Centre and turn in the scene, as the network alone says."""
    about = result.tuned_object().description  # type: ignore[attr-defined]
    alone = TunedObject(replace(about, views=(), decision=None), result.network(), 1)
    found, _ = alone.locate(read_frame(SCENE))
    return found.center_px, found.angle_deg


def by_node(folder: Path, settings: Settings, runtime: Path) -> dict[str, Any]:
    """What node makes of the same."""

    def written(path: Path) -> dict[str, Any]:
        frame = read_frame(path)
        cv2.cvtColor(frame, cv2.COLOR_BGR2BGRA).tofile(folder / f"{path.stem}.bin")
        height, width = frame.shape[:2]
        return {"file": str(folder / f"{path.stem}.bin"), "width": width, "height": height}

    job = {
        "web": str(ROOT / "deploy/web"),
        "out": str(folder),
        "ort": str((runtime / "dist/ort.wasm.bundle.min.mjs").resolve()),
        "bundle": str(ROOT / "export"),
        "layers": settings.layers,
        "frame": written(OBJECT),
        "center": [320, 240],
        "tune": {"seed": 0, "precision": settings.precision, "epochs": settings.epochs},
        "scenes": [written(SCENE)],
    }
    (folder / "job.json").write_text(json.dumps(job))
    script = ROOT / "tests/deploy/web_job.js"
    subprocess.run(["node", str(script), str(folder / "job.json")], check=True)
    answers: dict[str, Any] = json.loads((folder / "answers.json").read_text())
    return answers


if __name__ == "__main__":
    main()
