"""The grasping task: whether a crop shows the object at its middle, and how it lies."""

from dataclasses import dataclass
from math import nan
from typing import Any

import numpy as np

from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.grasp.angles import ENCODINGS, AngleEncoding, angle_error, decode_angle
from qsgm.grasp.decision import Decision
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.grasp.distractors import Distractors, load_distractors
from qsgm.grasp.network import GRASPNET
from qsgm.manifest import MANIFEST
from qsgm.network import Network
from qsgm.task import Array, Described, Head, Heads

NAME = "grasp"
DETECTION_THRESHOLD = 0.5
# Keeps logits bounded, and with them the gradients' tails.
LABEL_SMOOTHING = 0.05
QUALITY = 0  # number of the label that says whether the object is there
ADVICE = "export the bundle again with `qsgm fold-and-quantize`"


@dataclass(frozen=True)
class GraspTask:
    """Log loss on quality plus l2 on both angle channels of the positives (paper section 3.1)."""

    encoding: AngleEncoding = "double"
    label_smoothing: float = LABEL_SMOOTHING
    decision: Decision | None = None  # whether a candidate is the object; older bundles have none

    @property
    def name(self) -> str:
        return NAME

    @property
    def network(self) -> Network:
        return GRASPNET

    @property
    def heads(self) -> Heads:
        quality = Head("quality", "log_loss", 1, "sigmoid", smoothing=self.label_smoothing)
        if self.encoding == "double":
            return quality, Head("direction", "squared", 2, "tanh", where=QUALITY)
        return (
            quality,
            Head("sine", "squared", 1, "tanh", where=QUALITY),
            Head("cosine", "squared", 1, "sigmoid", where=QUALITY),
        )

    def scores(self, outputs: Array, labels: Array) -> dict[str, float]:
        """Detection accuracy, and the angle's mean error over positives, modulo 180 degrees.

        Without a positive there is no error: NaN.
        """
        positive = labels[:, QUALITY] > 0
        detected = outputs[:, QUALITY] > DETECTION_THRESHOLD
        seen, true = (
            decode_angle(one[positive, 1], one[positive, 2], self.encoding)
            for one in (outputs, labels)
        )
        error = np.degrees(angle_error(seen, true))
        return {
            "detection_accuracy": float(np.mean(detected == positive)),
            "angle_mae_deg": float(np.mean(error)) if positive.any() else nan,
        }

    def to_json(self) -> dict[str, Any]:
        decision = {} if self.decision is None else {"decision": self.decision.to_json()}
        return {"encoding": self.encoding, **decision}


def grasp_task(kept: Described, where: str) -> GraspTask:
    """What a bundle's or checkpoint's network was taught to do.

    Raises:
        QsgmError: it is another task, or a damaged one.
    """
    if kept.name != NAME:
        raise QsgmError(
            f"{where} is of the task {kept.name!r}, expected {NAME!r}; pass another, or --task "
            "FILE.py to a command that takes it"
        )
    settings = kept.to_json()
    encoding, weighed = settings.get("encoding"), settings.get("decision")
    if encoding not in ENCODINGS:
        raise QsgmError(
            f"{where}: 'encoding' is damaged: expected {' or '.join(ENCODINGS)}; {ADVICE}"
        )
    decision = None if weighed is None else Decision.from_json(weighed, where)
    return GraspTask(encoding, kept.heads[0].smoothing, decision)


def task_of(bundle: Bundle) -> GraspTask:
    """What a bundle's network was taught to do; see :func:`grasp_task`."""
    return grasp_task(bundle.manifest.task, str(bundle.folder / MANIFEST))


def distractors_of(bundle: Bundle) -> Distractors | None:
    """The things to tell an object apart from; None in a bundle that was made without them."""
    return load_distractors(bundle.read(DISTRACTORS)) if bundle.has(DISTRACTORS) else None
