"""What tests of deploy/web share: node, onnxruntime-web, the built page."""

import json
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm import load_bundle
from qsgm.blocks import parse_blocks
from qsgm.grasp.tuned import ObjectDescription, TunedObject
from qsgm.train.slim import slim_bundle

ROOT = Path(__file__).parents[2]
WEB, EXPORT, CALIB = ROOT / "deploy" / "web", ROOT / "export", ROOT / "calib"
JOB = Path(__file__).with_name("web_job.js")
RUNTIME = Path(os.environ.get("ONNXRUNTIME_WEB", WEB / "node_modules" / "onnxruntime-web"))
ORT = RUNTIME / "dist" / "ort.wasm.bundle.min.mjs"
Frame = NDArray[np.uint8]

needs_node = pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
needs_ort = pytest.mark.skipif(
    shutil.which("node") is None or not ORT.exists(),
    reason=f"node or onnxruntime-web ({RUNTIME}) is not installed",
)


def run_job(folder: Path, *, runtime: bool = True, **job: Any) -> dict[str, Any]:
    """What node answers; frames among the arguments are written for it."""

    def written(name: str, value: Any) -> Any:
        if isinstance(value, list):
            return [written(f"{name}_{i}", one) for i, one in enumerate(value)]
        if not isinstance(value, np.ndarray):
            return value
        cv2.cvtColor(value, cv2.COLOR_BGR2BGRA).tofile(folder / f"{name}.bin")
        height, width = value.shape[:2]
        return {"file": str(folder / f"{name}.bin"), "width": width, "height": height}

    values = {name: written(name, value) for name, value in job.items()}
    values |= {"web": str(WEB), "out": str(folder), "ort": str(ORT) if runtime else None}
    (folder / "job.json").write_text(json.dumps(values, default=str))
    done = subprocess.run(
        ["node", str(JOB), str(folder / "job.json")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    answers: dict[str, Any] = json.loads((folder / "answers.json").read_text())
    return answers


def alone(about: ObjectDescription, network: bytes) -> TunedObject:
    """An object as its network alone sees it."""
    return TunedObject(replace(about, views=(), decision=None), network, 1)


def built(folder: Path) -> Path:
    """The page with what tunes three layers, as a server serves it."""
    slim_bundle(load_bundle(EXPORT), parse_blocks("4,5,6"), folder / "bundle")
    dist = folder / "dist"
    command = ["node", str(WEB / "build.js"), str(folder / "bundle"), str(dist)]
    environment = os.environ | {"ONNXRUNTIME_WEB": str(RUNTIME)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dist
