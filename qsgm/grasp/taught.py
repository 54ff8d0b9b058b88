"""A taught object: what it was taught by, what came of it, and that as JSON.

The keys of the JSON objects are stable: more may be added, none goes or changes its meaning.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort

from qsgm import __version__
from qsgm.grasp.angles import rounded_angle, rounded_turn
from qsgm.grasp.lesson import GraspLabels, Orientation
from qsgm.grasp.likeness import likeness_of
from qsgm.grasp.shown import Shown
from qsgm.grasp.task import task_of
from qsgm.grasp.tuned import ObjectDescription, TunedObject, save_object
from qsgm.grasp.verdict import Verdict, verdict_on
from qsgm.tables import number
from qsgm.tune.prepare import Prepared
from qsgm.tune.report import course_json, result_json
from qsgm.tune.result import Result


@dataclass(frozen=True)
class PreparedObject(Prepared):
    """A taught object, before any step."""

    labelled: GraspLabels
    shown: Shown
    others_sha256: tuple[str, ...]  # of the things that it is to be told apart from

    @property
    def orientation(self) -> Orientation:
        """How the demonstrations lie as the untouched network sees them."""
        return self.labelled.orientation


@dataclass(frozen=True)
class FinetuneResult(Result):
    """A tuned object and everything that was measured on the way."""

    prepared: PreparedObject

    def save(self, folder: Path, name: str) -> None:
        """Write the tuned object for `qsgm predict`; it appears complete or not at all.

        Args:
            folder: absent, empty or an earlier tuned object.
            name: what the object is called.

        Raises:
            QsgmError: the folder cannot be written, or holds something else.
        """
        report = run_json(self, name, folder)
        save_object(folder, self._description(name), self.network(), report)

    def tuned_object(self, name: str = "object") -> TunedObject:
        """The tuned object without a detour over the disk."""
        return TunedObject(self._description(name), self.network(), self.plan.settings.threads)

    @cached_property
    def verdict(self) -> Verdict:
        """Whether the object will be found and told apart."""
        like = likeness_of(self.prepared.shown.patches[0])
        strength = self.prepared.orientation.strength
        return verdict_on(self.scores, self.untouched, strength, like, trained=self.plan.epochs > 0)

    def _description(self, name: str) -> ObjectDescription:
        prepared, task = self.prepared, task_of(self.prepared.bundle)
        return ObjectDescription(
            name,
            task.encoding,
            prepared.orientation.offset_rad,
            prepared.shown.scale,
            prepared.shown.views(prepared.orientation.of_each_rad),
            task.decision,
            self._made(),
        )

    def _made(self) -> dict[str, Any]:
        """From what, by what: with the same of all this the same object comes out."""
        return {
            "qsgm": __version__,
            "onnxruntime": ort.__version__,
            "opencv": cv2.__version__,
            "numpy": np.__version__,
            "bundle_sha256": self.prepared.bundle.sha256(),
            "seed": self.prepared.plan.settings.seed,
            "frames_sha256": list(self.prepared.shown.sha256),
            "others_sha256": list(self.prepared.others_sha256),
        }


def finetune_json(result: FinetuneResult, name: str, output: Path) -> dict[str, Any]:
    """The stable keys of `qsgm finetune`, then the others."""
    values, verdict = result_json(result, name, output), result.verdict
    orientation = result.prepared.orientation
    return values | {
        "orientation_deg": rounded_angle(math.degrees(orientation.offset_rad), 2),
        "orientation_strength": number(orientation.strength, 3),
        **shown_json(result),
        "verdict": verdict.to_json(),
        "warnings": [*result.warnings, *verdict.reasons],
    }


def run_json(result: FinetuneResult, name: str, output: Path) -> dict[str, Any]:
    """What is kept with the tuned object: :func:`finetune_json` and how the run went."""
    return finetune_json(result, name, output) | course_json(result)


def shown_json(result: FinetuneResult) -> dict[str, Any]:
    """What was shown of the object."""
    shown, others = result.prepared.shown, result.prepared.others_sha256
    turns = [None if turn is None else rounded_turn(turn) for turn in shown.turns_rad]
    return {
        "scale": number(shown.scale, 5),
        "span_px": None if shown.span_px is None else number(shown.span_px, 1),
        "demonstrations": [{"turn_deg": turn} for turn in turns],
        "others": len(others),
    }
