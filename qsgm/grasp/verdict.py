"""Whether a tuned object will be found and told apart, in words, and what to do if not.

The crops that took no part in training say how well the network does with other things on them;
what the object looks like says what the second opinion is worth.
"""

import math
from dataclasses import dataclass
from typing import Any

from qsgm.grasp.likeness import Likeness
from qsgm.task import Scores

LEAST_DETECTION = 0.9
# Of other things; those that the network proposes in spite of that, the patch has to refuse.
LEAST_TOLD_APART = 0.75
# From here on there was hardly anything left to be made better.
NEARLY_ALL = 0.98
LARGEST_ANGLE_DEG = 10.0
# Where crops agree less on how an object lies, it has no angle worth the name.
LEAST_STRENGTH = 0.5


@dataclass(frozen=True)
class Verdict:
    """What to expect of a tuned object."""

    reasons: tuple[str, ...]  # why it may be missed or confused, and what to do about it
    notes: tuple[str, ...]  # what else there is to know

    @property
    def good(self) -> bool:
        """Whether it will be found and told apart, as far as one frame can tell."""
        return not self.reasons

    @property
    def headline(self) -> str:
        """In a few words."""
        return "will be found and told apart" if self.good else "may be missed or confused"

    def to_json(self) -> dict[str, Any]:
        """Stable keys."""
        return {"good": self.good, "reasons": list(self.reasons), "notes": list(self.notes)}


def verdict_on(
    tuned: Scores, untouched: Scores, strength: float, like: Likeness, *, trained: bool = True
) -> Verdict:
    """Judge a run.

    Args:
        tuned: the network on the validation crops.
        untouched: the same before.
        strength: how much crops agree on how the object lies, 0 to 1.
        like: what the patch could be taken for.
        trained: whether there was a run at all.
    """
    detection, before = _score(tuned, "detection_accuracy"), _score(untouched, "detection_accuracy")
    reasons = [*_of_crops(tuned), *_of_angle(tuned, strength, like), *_of_patch(like)]
    if trained and detection <= before < NEARLY_ALL:
        reasons.append(
            f"tuning made it no better than untouched (detection {detection:.3f}, "
            f"before {before:.3f}): check that the object is at the frame's "
            "centre, or pass --center"
        )
    return Verdict(tuple(reasons), tuple(_notes(tuned, like)))


def _of_crops(tuned: Scores) -> list[str]:
    """What detection on held-out crops says against it."""
    found, detection = [], _score(tuned, "detection_accuracy")
    if detection < LEAST_DETECTION:
        found.append(
            f"only {_percent(detection)} of the held-out crops are told right: tune "
            "longer with --epochs, show the object on another table, or from more sides in several "
            "frames"
        )
    told = tuned["told_apart"]
    if told is not None and told < LEAST_TOLD_APART:
        found.append(
            f"{_percent(1 - told)} of other things are taken for it: name those that lie beside it "
            "with --not, or tune longer with --epochs"
        )
    return found


def _of_angle(tuned: Scores, strength: float, like: Likeness) -> list[str]:
    has_angle = strength >= LEAST_STRENGTH and not like.round
    error = _score(tuned, "angle_mae_deg")
    if not has_angle or error <= LARGEST_ANGLE_DEG:
        return []
    return [f"its turn is off by {error:.0f} degrees on average: tune longer with --epochs"]


def _of_patch(like: Likeness) -> list[str]:
    if like.cut_out:
        return []
    return [
        "it could not be told from its table, which will be looked for as if it were part of it: "
        "show it on a table of another colour"
    ]


def _notes(tuned: Scores, like: Likeness) -> list[str]:
    notes = []
    if like.featureless:
        notes.append("it has hardly any markings, so things of its shape may be taken for it")
    if like.round:
        notes.append("it looks the same at every turn, so its turn means nothing")
    elif like.same_both_ways:
        notes.append("it looks the same both ways round, so turns are told modulo 180 degrees")
    if tuned["told_apart"] is None:
        notes.append("the bundle has no other things, so nothing is known of telling it apart")
    return notes


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def _score(scores: Scores, name: str) -> float:
    """A score that there always is."""
    value = scores[name]
    return math.nan if value is None else value
