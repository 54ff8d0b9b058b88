"""Look closer at a heatmap's candidates and judge each: the second opinion of the patch.

The network proposes places. The demonstration's patch is laid over each, coarse to fine: cheap
looks for all, closer ones for the few that fit best.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.angles import AngleEncoding, decode_angle
from qsgm.crops import HALF_CROP_PX
from qsgm.grasp.candidates import candidate_cells
from qsgm.grasp.correlation import (
    Fit,
    Pyramid,
    Template,
    coarse_fits,
    middle_fit,
    pyramid_of,
    refine_fit,
)
from qsgm.grasp.evidence import Reference, evidence, reference_of
from qsgm.grasp.patch import Patch

CELL_PX = 16
# Cells of the heatmap that the patch is laid over, and how many of these it is laid over finely.
PROPOSED, JUDGED = 12, 3
# What the network's log odds count beside a correlation when the few are chosen.
_QUALITY_WEIGHT = 0.03
# Of each of the few, so many turns are tried at a quarter of the resolution.
_TURNS = 2
# Closer than that, two candidates are the same.
_SAME_PX = 24.0


@dataclass(frozen=True)
class Appearance:
    """What the taught object looks like, made ready for comparison."""

    template: Template
    reference: Reference

    @staticmethod
    def of(patch: Patch) -> "Appearance":
        template = Template(patch)
        return Appearance(template, reference_of(template))


@dataclass(frozen=True)
class Candidate:
    """A place where the object may be, and what speaks for and against it."""

    fit: Fit
    evidence: NDArray[np.float32]  # (F,)


@dataclass(frozen=True)
class _Start:
    fits: tuple[Fit, ...]  # best first, at different turns
    quality: float
    angle_rad: float

    @property
    def promise(self) -> float:
        odds = np.log(max(self.quality, 1e-6) / max(1 - self.quality, 1e-6))
        return self.fits[0].score + _QUALITY_WEIGHT * float(np.clip(odds, -8, 8))


def judge(
    appearance: Appearance,
    frame: NDArray[np.uint8],
    heatmap: NDArray[np.float32],
    offset_rad: float,
    encoding: AngleEncoding,
    count: int = JUDGED,
) -> list[Candidate]:
    """The most promising candidates of a frame.

    Args:
        appearance: of the taught object.
        frame: (H, W, 3) BGR.
        heatmap: (3, rows, cols) of that frame.
        offset_rad: the demonstration's own orientation as the network sees it.
        encoding: of the heatmap's angle.
        count: how many to judge at most.
    """
    scene = pyramid_of(frame)
    cells = candidate_cells(heatmap[0], PROPOSED)
    centers = [(HALF_CROP_PX + CELL_PX * col, HALF_CROP_PX + CELL_PX * row) for row, col in cells]
    fits = coarse_fits(appearance.template, scene, centers)
    angles = [
        float(decode_angle(heatmap[1, row, col], heatmap[2, row, col], encoding)) - offset_rad
        for row, col in cells
    ]
    starts = [
        _Start(tuple(some), float(heatmap[0, row, col]), angle)
        for some, (row, col), angle in zip(fits, cells, angles, strict=True)
    ]
    few = _apart(sorted(starts, key=lambda start: -start.promise), 2 * count)
    closer = [_closer(appearance.template, scene, start) for start in few]
    best = _apart(sorted(closer, key=lambda start: -start.promise), count)
    return [_candidate(appearance, scene, start) for start in best]


def _closer(template: Template, scene: Pyramid, start: _Start) -> _Start:
    fits = [middle_fit(template, scene, fit) for fit in start.fits[:_TURNS]]
    fits.sort(key=lambda fit: -fit.score)
    return _Start(tuple(fits), start.quality, start.angle_rad)


def _candidate(appearance: Appearance, scene: Pyramid, start: _Start) -> Candidate:
    fit = refine_fit(appearance.template, scene, start.fits[0])
    lead = start.fits[0].score - (start.fits[1].score if len(start.fits) > 1 else 0.0)
    facts = evidence(appearance.reference, scene, fit, start.quality, start.angle_rad, lead)
    return Candidate(fit, facts)


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
