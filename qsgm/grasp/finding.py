"""From a heatmap's candidates to places of the object, judged by what it looked like when taught.

The network says where to look, the patch says how well it fits there, a decision says whether that
is the object. Where the patch fits weakly though the object is found (in other light, half hidden),
the network has the last word on centre and turn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.angles import full_degrees, wrap_half_turn
from qsgm.grasp.correlation import Fit
from qsgm.grasp.decision import Decision
from qsgm.grasp.judge import QUICK, Appearance, Effort, best_fit, judge
from qsgm.grasp.shown import View

Frame = NDArray[np.uint8]

# Below, a fit says less about centre and turn than the network does: on drawn scenes a half of
# such fits are off by more than 6 px.
WEAK_CORRELATION = 0.55
# How sure one way round is by its lead over the opposite: on drawn scenes it was right in seven of
# ten cases at leads below 0.05, in 95 of 100 up to 0.08 and in 98 of 100 from there on.
_LEAD_SLOPE = 20.0
# From this confidence on the full turn is told.
LEAST_CONFIDENCE = 0.75
# Of all instances, at most so many are looked for.
MOST_INSTANCES = 12
# Of two places whose objects cover a larger share of the smaller one, the surer one counts.
_SAME_OVERLAP = 0.3
_MASK_SHRINK = 4


@dataclass(frozen=True)
class Sighting:
    """How one look of the object lies over a frame, in pixels of what the network saw."""

    view: View
    fit: Fit
    lead: float  # of the fit's correlation over that of the opposite way round
    center_px: tuple[float, float]  # of the object (x, y)
    quality: float = 0.0  # in [0, 1], where there is a decision
    cell_px: tuple[float, float] = (0.0, 0.0)  # of the window by which the network proposed it

    @property
    def weak(self) -> bool:
        """Whether centre and turn are better asked of the network."""
        return self.fit.score < WEAK_CORRELATION

    @property
    def turn_rad(self) -> float:
        """Since the first demonstration, counter-clockwise."""
        return self.fit.turn_rad + self.view.turn_rad

    @property
    def angle_deg(self) -> float:
        """The turn in (-90, 90]."""
        return float(np.degrees(wrap_half_turn(np.asarray(self.turn_rad))))

    @property
    def confidence(self) -> float | None:
        """Confidence that the turn is not the opposite one; None where that is not known."""
        return confidence_of(self.lead) if self.view.whole else None

    @property
    def full_angle_deg(self) -> float | None:
        """The turn in (-180, 180], None where it might as well be the opposite one."""
        if self.confidence is None or self.confidence < LEAST_CONFIDENCE:
            return None
        return full_degrees(self.turn_rad)


@dataclass(frozen=True)
class Finder:
    """What a taught object looks like, and what tells it from others."""

    views: tuple[View, ...]

    @cached_property
    def appearances(self) -> tuple[Appearance, ...]:
        """Looks of all views, made when they are first needed."""
        return tuple(Appearance.of(view.patch) for view in self.views)

    def find(
        self,
        frame: Frame,
        heatmap: NDArray[np.float32],
        decision: Decision,
        effort: Effort = QUICK,
    ) -> list[Sighting]:
        """The best places, best first, no two of the same object; at least one.

        Args:
            frame: (H, W, 3) BGR at the object's scale.
            heatmap: (3, rows, cols) of that frame.
            decision: how sure a place is.
            effort: how many ways to follow, for every view.
        """
        sightings = []
        for view, appearance in zip(self.views, self.appearances, strict=True):
            found = judge(appearance, frame, heatmap, effort)
            evidence = np.stack([one.evidence for one in found])
            seen = np.stack([one.seen for one in found])
            judged = decision.judged(appearance.aligner.cells, evidence, seen)
            for one, quality in zip(found, judged.tolist(), strict=True):
                sightings.append(
                    Sighting(view, one.fit, one.lead, one.center_px, quality, one.cell_px)
                )
        return _distinct(sorted(sightings, key=lambda one: -one.quality), frame.shape[:2])

    def lay(self, frame: Frame, near_px: tuple[float, float]) -> Sighting:
        """The look that fits best near a point of a frame."""
        laid = []
        for view, appearance in zip(self.views, self.appearances, strict=True):
            fit, lead = best_fit(appearance, frame, near_px)
            laid.append(Sighting(view, fit, lead, appearance.center_of(fit)))
        return max(laid, key=lambda one: one.fit.score)


def confidence_of(lead: float) -> float:
    """Confidence that a fit's way round is right, by its lead over the opposite one."""
    return float(1 / (1 + np.exp(-_LEAD_SLOPE * lead)))


def _distinct(sightings: Sequence[Sighting], frame_hw: tuple[int, int]) -> list[Sighting]:
    """Sightings that do not lie over a better one."""
    kept: list[tuple[Sighting, NDArray[np.bool_]]] = []
    for one in sightings:
        footprint = _footprint(one, frame_hw)
        if all(_overlap(footprint, other) <= _SAME_OVERLAP for _, other in kept):
            kept.append((one, footprint))
    return [one for one, _ in kept]


def _footprint(sighting: Sighting, frame_hw: tuple[int, int]) -> NDArray[np.bool_]:
    """The object's pixels in the frame, at a quarter of its resolution."""
    mask, fit = sighting.view.patch.mask, sighting.fit
    growth = fit.scale / _MASK_SHRINK
    cos, sin = growth * np.cos(fit.turn_rad), growth * np.sin(fit.turn_rad)
    turn = np.array([[cos, sin], [-sin, cos]])
    center = (np.array(fit.center_px) + 0.5) / _MASK_SHRINK - 0.5
    shift = center - turn @ np.full(2, (len(mask) - 1) / 2)
    motion = np.concatenate([turn, shift[:, None]], axis=1)
    height, width = (side // _MASK_SHRINK for side in frame_hw)
    laid = cv2.warpAffine(mask, motion, (width, height), flags=cv2.INTER_LINEAR)
    return np.asarray(np.asarray(laid) > 127)


def _overlap(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> float:
    """Share of the smaller one that both cover."""
    return float((one & other).sum() / max(min(one.sum(), other.sum()), 1))
