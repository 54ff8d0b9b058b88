"""Look closer at a heatmap's candidates and judge each: the second opinion of the patch.

The network proposes places. The demonstration's patch is laid over each, coarse to fine: cheap
looks for all, closer ones for the few that fit best. Of these the two ways round are compared.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.alignment import Aligner
from qsgm.grasp.candidates import candidate_cells
from qsgm.grasp.cells import Look
from qsgm.grasp.correlation import (
    Fit,
    Pyramid,
    Template,
    coarse_fits,
    middle_fit,
    pyramid_of,
)
from qsgm.grasp.crops import HALF_CROP_PX
from qsgm.grasp.evidence import Reference, evidence, reference_of
from qsgm.grasp.patch import PATCH_PX, Patch

CELL_PX = 16
# Cells of the heatmap that the patch is laid over, and how many of these it is laid over finely.
PROPOSED, JUDGED = 12, 4
# What the network's log odds count beside a correlation when the few are chosen.
_QUALITY_WEIGHT = 0.02
# Of each of the few, so many turns are tried at a quarter of the resolution, if they fit nearly as
# well as the best one.
_TURNS, _NEARLY = 2, 0.2
# Closer than that, two candidates are the same.
_SAME_PX = 24.0
# Turns that differ from a half turn by less are the opposite way round.
_OPPOSITE_RAD = np.deg2rad(30)
# With such a lead at a quarter of the resolution the other way round need not be looked at closer.
_CLEAR_LEAD = 0.2


@dataclass(frozen=True)
class Appearance:
    """What the taught object looks like, made ready for comparison."""

    template: Template
    reference: Reference
    aligner: Aligner

    @staticmethod
    def of(patch: Patch) -> "Appearance":
        template = Template(patch)
        aligner = Aligner.of(template)
        return Appearance(template, reference_of(aligner.cells), aligner)

    def center_of(self, fit: Fit) -> tuple[float, float]:
        """Where the object's centre (x, y) is in the frame that a fit lies over."""
        x, y = (value - (PATCH_PX - 1) / 2 for value in self.template.patch.center_px)
        return _laid(fit, x, y)


@dataclass(frozen=True)
class Candidate:
    """A place where the object may be, and what speaks for and against it."""

    fit: Fit
    evidence: NDArray[np.float32]  # (F,)
    center_px: tuple[float, float]  # of the object, by the fit
    cell_px: tuple[float, float]  # of the window by which the network proposed it
    lead: float  # of the fit's score over that of the opposite way round
    quality: float  # of the network, in [0, 1]


@dataclass(frozen=True)
class _Start:
    fits: tuple[Fit, ...]  # best first, at different turns
    cell: tuple[int, int]
    quality: float

    @property
    def promise(self) -> float:
        odds = np.log(max(self.quality, 1e-6) / max(1 - self.quality, 1e-6))
        return self.fits[0].score + _QUALITY_WEIGHT * float(np.clip(odds, -8, 8))


def judge(
    appearance: Appearance,
    frame: NDArray[np.uint8],
    heatmap: NDArray[np.float32],
    count: int = JUDGED,
) -> list[Candidate]:
    """The most promising candidates of a frame.

    Args:
        appearance: of the taught object.
        frame: (H, W, 3) BGR.
        heatmap: (3, rows, cols) of that frame.
        count: how many to judge at most.
    """
    scene = pyramid_of(frame)
    cells = candidate_cells(heatmap[0], max(PROPOSED, 2 * count))
    fits = coarse_fits(appearance.template, scene, [cell_center(cell) for cell in cells])
    starts = [
        _Start(tuple(some), cell, float(heatmap[0][cell]))
        for some, cell in zip(fits, cells, strict=True)
    ]
    few = _apart(sorted(starts, key=lambda start: -start.promise), 2 * count)
    closer = [_closer(appearance.template, scene, start) for start in few]
    best = _apart(sorted(closer, key=lambda start: -start.promise), count)
    return [_candidate(appearance, scene, start) for start in best]


def best_fit(
    appearance: Appearance, frame: NDArray[np.uint8], near_px: tuple[float, float]
) -> tuple[Fit, float]:
    """How the patch lies best over a frame (H, W, 3) within 16 px of a point (x, y).

    Returns:
        The fit, and its lead over that of the opposite way round.
    """
    scene = pyramid_of(frame)
    start = _Start(tuple(coarse_fits(appearance.template, scene, [near_px])[0]), (0, 0), 0.5)
    fit, _, lead = _better_way_round(appearance, scene, _closer(appearance.template, scene, start))
    return fit, lead


def cell_center(cell: tuple[int, int]) -> tuple[float, float]:
    """Centre (x, y) [px] of the window that a cell (row, column) of a heatmap looks at."""
    row, col = cell
    return float(HALF_CROP_PX + CELL_PX * col), float(HALF_CROP_PX + CELL_PX * row)


def _closer(template: Template, scene: Pyramid, start: _Start) -> _Start:
    least = start.fits[0].score - _NEARLY
    some = [fit for fit in start.fits[:_TURNS] if fit.score >= least]
    fits = [middle_fit(template, scene, fit) for fit in some]
    return replace(start, fits=tuple(sorted(fits, key=lambda fit: -fit.score)))


def _candidate(appearance: Appearance, scene: Pyramid, start: _Start) -> Candidate:
    fit, look, lead = _better_way_round(appearance, scene, start)
    facts = evidence(appearance.reference, look, fit.scale, start.quality, lead)
    center = appearance.center_of(fit)
    return Candidate(fit, facts, center, cell_center(start.cell), lead, start.quality)


def _better_way_round(
    appearance: Appearance, scene: Pyramid, start: _Start
) -> tuple[Fit, Look, float]:
    """The better of the fit and its opposite, laid exactly, and its lead over the other."""
    first = start.fits[0]
    found = [other for other in start.fits[1:] if _is_opposite(first, other)]
    other = found[0] if found else _opposite(appearance, scene, first)
    fit, look = appearance.aligner.aligned(scene, first)
    if first.score - other.score > _CLEAR_LEAD:
        return fit, look, first.score - other.score
    opposite, its_look = appearance.aligner.aligned(scene, other)
    if opposite.score > fit.score:
        return opposite, its_look, opposite.score - fit.score
    return fit, look, fit.score - opposite.score


def _is_opposite(one: Fit, other: Fit) -> bool:
    return bool(np.cos(one.turn_rad - other.turn_rad) < -np.cos(_OPPOSITE_RAD))


def _opposite(appearance: Appearance, scene: Pyramid, fit: Fit) -> Fit:
    """The fit turned by half a turn about the middle of the object's pixels."""
    x, y = appearance.aligner.middle_px
    middle = _laid(fit, 2 * x, 2 * y)
    turned = replace(fit, turn_rad=fit.turn_rad + np.pi, center_px=middle)
    return middle_fit(appearance.template, scene, turned)


def _laid(fit: Fit, x: float, y: float) -> tuple[float, float]:
    """Where a point (x, y) [px] from the patch's middle lies in the frame."""
    cos, sin = fit.scale * np.cos(fit.turn_rad), fit.scale * np.sin(fit.turn_rad)
    center_x, center_y = fit.center_px
    return float(center_x + cos * x + sin * y), float(center_y - sin * x + cos * y)


def _apart(starts: Sequence[_Start], count: int) -> list[_Start]:
    """The first `count` of some starts that are not the same place."""
    kept: list[_Start] = []
    for start in starts:
        x, y = start.fits[0].center_px
        places = [other.fits[0].center_px for other in kept]
        if all(np.hypot(x - a, y - b) > _SAME_PX for a, b in places):
            kept.append(start)
        if len(kept) == count:
            break
    return kept
