"""Two objects as `qsgm finetune` leaves them, but not tuned: by the shipped network."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from toys import SIDE, by_correlation, lay, table, toy

from qsgm import load_bundle, paths
from qsgm.grasp.decision import Decision
from qsgm.grasp.patch import cut_patch
from qsgm.grasp.shown import View
from qsgm.grasp.tuned import ObjectDescription, save_object

MADE = {
    "qsgm": "0.1.0",
    "onnxruntime": "1",
    "opencv": "5",
    "numpy": "2",
    "bundle_sha256": "c0ffee" * 8,
    "seed": 0,
    "frames_sha256": ["a", "b"],
    "others_sha256": [],
}
TOY_AT, HOOK_AT = (170.0, 150.0), (450.0, 320.0)
TURN_DEG = 40.0
MUG = ObjectDescription("mug", "double", 0.25)


def hook() -> NDArray[np.float32]:
    """An angle of two bars (480, 480, 4), BGR and opacity, that lies along nothing of the toy."""
    picture = np.zeros((SIDE, SIDE, 4), np.float32)
    cv2.rectangle(picture, (120, 100), (200, 380), (190, 120, 40, 255), cv2.FILLED)
    cv2.rectangle(picture, (120, 300), (380, 380), (60, 190, 220, 255), cv2.FILLED)
    cv2.circle(picture, (340, 340), 24, (20, 20, 20, 255), cv2.FILLED)
    return picture


def described(
    picture: NDArray[np.float32] | None = None, decision: Decision | None = None, scale: float = 1.0
) -> ObjectDescription:
    """A toy as it is kept, by default with a decision by correlation alone."""
    center = (320.0, 240.0)
    frame = lay(toy() if picture is None else picture, table(), center)
    view = View(cut_patch(frame, center), 0.0, whole=True)
    chosen = by_correlation() if decision is None else decision
    return ObjectDescription("toy", "double", 0.0, scale, (view,), chosen, {"seed": 4})


def teach(folder: Path, name: str, picture: NDArray[np.float32], threshold: float = 0.8) -> Path:
    """Keep an object in a folder; it is found where its patch correlates as well as that."""
    about = replace(described(picture, by_correlation(threshold)), name=name, made=MADE)
    save_object(folder, about, load_bundle(paths.bundle_folder()).network_with({}), {"seed": 0})
    return folder


def both_on_a_table(shift: float = 0.0) -> NDArray[np.uint8]:
    """A scene with the toy, moved to the right, and the hook, both turned."""
    scene = lay(toy(), table(3), (TOY_AT[0] + shift, TOY_AT[1]), TURN_DEG)
    return lay(hook(), scene, HOOK_AT, -TURN_DEG)
