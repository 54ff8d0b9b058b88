"""Look closer at a heatmap's candidates and judge each: the second opinion of the patch.

The network proposes places. The demonstration's patch is laid over each, coarse to fine: cheap
looks for all, closer ones for the few poses that fit best, at every place several turns, since the
best of a coarse look is often not the right one. Of the best the two ways round are compared.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

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
from qsgm.grasp.edges import Edges, TaughtEdges
from qsgm.grasp.evidence import evidence
from qsgm.grasp.patch import PATCH_PX, Patch
from qsgm.grasp.snapping import Snapper

CELL_PX = 16
# A look proposes at least so many cells.
PROPOSED = 12
# Where every turn is tried, so many are.
_TURNS = 12
# What the network's log odds count beside a correlation when poses are chosen.
_QUALITY_WEIGHT = 0.02
# Poses closer than that [px, rad] are the same one, by coarse looks and by closer ones.
_SAME_POSE = (20.0, math.radians(25)), (10.0, math.radians(17))
# Closer than that, two candidates are the same place.
_SAME_PX = 24.0
# Where a pose fits so well, the object is there, and no other place is looked at closer by edges.
_FITS_WELL = 0.8
# What alignment by pixels has to gain over the pose that edges gave.
_LEAST_GAIN = 0.02
# Turns that differ from a half turn by less are the opposite way round.
_OPPOSITE_RAD = math.radians(30)
# With such a lead at a quarter of the resolution the other way round need not be looked at closer.
_CLEAR_LEAD = 0.2


@dataclass(frozen=True)
class Effort:
    """How many of the ways in which an object may lie a look follows."""

    proposed: int  # cells of the heatmap that the patch is laid over
    turned: int  # the first of them, in which every turn is tried
    closer: int  # poses that are looked at closer
    aligned: int
    snapped: int  # at most, of these, moved to their edges
    judged: int
    apart_px: float  # between what is judged

    @staticmethod
    def for_places(count: int) -> "Effort":
        """A quick look that judges up to so many places."""
        closer, aligned = round(2.5 * count), round(1.5 * count)
        return Effort(max(PROPOSED, 2 * count), 0, closer, aligned, 2, count, _SAME_PX)


QUICK = Effort.for_places(4)
# Half of what a quick look misses was laid wrongly: partly hidden, or other things beside it.
# All poses of a place are judged: the firmest one may be the wrong one.
THOROUGH = Effort(24, 4, 40, 20, 4, 20, apart_px=0.0)


@dataclass(frozen=True)
class Appearance:
    """What the taught object looks like, made ready for comparison."""

    template: Template
    aligner: Aligner
    edges: TaughtEdges

    @staticmethod
    def of(patch: Patch) -> "Appearance":
        template = Template(patch)
        aligner = Aligner.of(template)
        return Appearance(template, aligner, TaughtEdges.of(aligner.cells))

    @cached_property
    def snapper(self) -> Snapper:
        """Made when it is first needed."""
        return Snapper.of(self.aligner.cells)

    def center_of(self, fit: Fit) -> tuple[float, float]:
        """Where the object's centre (x, y) is in the frame that a fit lies over."""
        x, y = (value - (PATCH_PX - 1) / 2 for value in self.template.patch.center_px)
        return _laid(fit, x, y)


@dataclass(frozen=True)
class Candidate:
    """A place where the object may be, and what speaks for and against it."""

    fit: Fit
    evidence: NDArray[np.float32]  # (F,)
    seen: NDArray[np.uint8]  # (64, 64, 3), what lies there, moved and turned as it was taught
    center_px: tuple[float, float]  # of the object, by the fit
    cell_px: tuple[float, float]  # of the window by which the network proposed it
    lead: float  # of the fit's score over that of the opposite way round
    quality: float  # of the network, in [0, 1]


@dataclass(frozen=True)
class _Pose:
    """A way in which the object may lie."""

    fit: Fit
    cell: tuple[int, int]
    quality: float  # of the network

    @property
    def promise(self) -> float:
        odds = math.log(max(self.quality, 1e-6) / max(1 - self.quality, 1e-6))
        return self.fit.score + _QUALITY_WEIGHT * min(max(odds, -8.0), 8.0)


@dataclass(frozen=True)
class _Laid:
    """A pose after it was aligned exactly."""

    taught: TaughtEdges
    pose: _Pose  # before
    fit: Fit
    look: Look

    @cached_property
    def edges(self) -> Edges:
        """What the demonstration's edges find there."""
        return self.taught.met_by(self.look.seen)

    @cached_property
    def firmness(self) -> float:
        """How firmly it holds there."""
        return self.edges.firmness(self.look)


def judge(
    appearance: Appearance,
    frame: NDArray[np.uint8],
    heatmap: NDArray[np.float32],
    effort: Effort = QUICK,
) -> list[Candidate]:
    """The most promising candidates of a frame.

    Args:
        appearance: of the taught object.
        frame: (H, W, 3) BGR.
        heatmap: (3, rows, cols) of that frame.
        effort: how many to follow.
    """
    scene, template = pyramid_of(frame), appearance.template
    cells = candidate_cells(heatmap[0], effort.proposed)
    fits = coarse_fits(template, scene, [cell_center(cell) for cell in cells])
    coarse, close = _SAME_POSE
    poses = [
        _Pose(fit, cell, float(heatmap[0][cell]))
        for cell, some in zip(cells, fits, strict=True)
        for fit in some
    ]
    starts = _different(poses, effort.closer, *coarse)
    starts += [turned for cell in cells[: effort.turned] for turned in _turned(heatmap, cell)]
    some = [_closer(template, scene, one) for one in starts]
    laid = _all_aligned(appearance, scene, _different(some, effort.aligned, *close), effort.snapped)
    kept = _apart(appearance, laid, effort)
    return [_candidate(appearance, scene, one, laid) for one in kept]


def best_fit(
    appearance: Appearance, frame: NDArray[np.uint8], near_px: tuple[float, float]
) -> tuple[Fit, float]:
    """How the patch lies best over a frame (H, W, 3) within 16 px of a point (x, y).

    Returns:
        The fit, and its lead over that of the opposite way round.
    """
    scene = pyramid_of(frame)
    (fits,) = coarse_fits(appearance.template, scene, [near_px])
    poses = [_closer(appearance.template, scene, _Pose(fit, (0, 0), 0.5)) for fit in fits]
    laid = _all_aligned(appearance, scene, poses, QUICK.snapped)
    best = max(laid, key=lambda one: one.firmness)
    better, lead = _better_way_round(appearance, scene, best, laid)
    return better.fit, lead


def cell_center(cell: tuple[int, int]) -> tuple[float, float]:
    """Centre (x, y) [px] of the window that a cell (row, column) of a heatmap looks at."""
    row, col = cell
    return float(HALF_CROP_PX + CELL_PX * col), float(HALF_CROP_PX + CELL_PX * row)


def _turned(heatmap: NDArray[np.float32], cell: tuple[int, int]) -> list[_Pose]:
    """The object in the middle of a cell's window, turned in every way."""
    quality, middle = float(heatmap[0][cell]), cell_center(cell)
    turns = (2 * math.pi * k / _TURNS for k in range(_TURNS))
    return [_Pose(Fit(0.0, turn, 1.0, middle), cell, quality) for turn in turns]


def _closer(template: Template, scene: Pyramid, pose: _Pose) -> _Pose:
    return replace(pose, fit=middle_fit(template, scene, pose.fit))


def _all_aligned(
    appearance: Appearance, scene: Pyramid, poses: Sequence[_Pose], snapped: int
) -> list[_Laid]:
    """Poses aligned by pixels; the firmest few by edges, too, if none fits well."""
    laid = [_aligned(appearance, scene, pose, pose.fit) for pose in poses]
    laid.sort(key=lambda one: -one.firmness)
    if max(one.fit.score for one in laid) >= _FITS_WELL:
        return laid
    return [_by_edges(appearance, scene, one) for one in laid[:snapped]] + laid[snapped:]


def _aligned(appearance: Appearance, scene: Pyramid, pose: _Pose, start: Fit) -> _Laid:
    return _Laid(appearance.edges, pose, *appearance.aligner.aligned(scene, start))


def _by_edges(appearance: Appearance, scene: Pyramid, laid: _Laid) -> _Laid:
    """The same pose moved to where its edges are, if it holds more firmly there."""
    moved = appearance.snapper.snapped(scene, laid.fit)
    look = appearance.aligner.look(scene, moved)
    ways = [laid, replace(laid, fit=replace(moved, score=look.score), look=look)]
    again = _aligned(appearance, scene, laid.pose, moved)
    if again.fit.score > look.score + _LEAST_GAIN:
        ways.append(again)
    return max(ways, key=lambda one: one.firmness)


def _candidate(
    appearance: Appearance, scene: Pyramid, laid: _Laid, others: Sequence[_Laid]
) -> Candidate:
    pose = laid.pose
    better, lead = _better_way_round(appearance, scene, laid, others)
    fit = better.fit
    facts = evidence(better.look.trusted.correlation, fit.scale, pose.quality, lead)
    center = appearance.center_of(fit)
    cell = cell_center(pose.cell)
    return Candidate(fit, facts, better.look.picture, center, cell, lead, pose.quality)


def _better_way_round(
    appearance: Appearance, scene: Pyramid, laid: _Laid, others: Sequence[_Laid]
) -> tuple[_Laid, float]:
    """The better of a pose and its opposite, laid exactly, and its lead over the other."""
    found = [one for one in others if _is_opposite(appearance, laid.fit, one.fit)]
    if found:
        opposite = max(found, key=lambda one: one.firmness)
    else:
        start = laid.pose.fit
        other = _opposite(appearance, scene, start)
        if start.score - other.score > _CLEAR_LEAD:
            return laid, start.score - other.score
        opposite = _aligned(appearance, scene, laid.pose, other)
    lead = laid.fit.score - opposite.fit.score
    return (opposite, -lead) if lead < 0 else (laid, lead)


def _is_opposite(appearance: Appearance, one: Fit, other: Fit) -> bool:
    """Whether two fits lie on the same place, the ways round about opposite."""
    apart = math.dist(appearance.center_of(one), appearance.center_of(other))
    turned = math.cos(one.turn_rad - other.turn_rad) < -math.cos(_OPPOSITE_RAD)
    return apart < _SAME_PX and turned


def _opposite(appearance: Appearance, scene: Pyramid, fit: Fit) -> Fit:
    """The fit turned by half a turn about the middle of the object's pixels."""
    x, y = appearance.aligner.middle_px
    middle = _laid(fit, 2 * x, 2 * y)
    turned = replace(fit, turn_rad=fit.turn_rad + np.pi, center_px=middle)
    return middle_fit(appearance.template, scene, turned)


def _laid(fit: Fit, x: float, y: float) -> tuple[float, float]:
    """Where a point (x, y) [px] from the patch's middle lies in the frame."""
    cos, sin = fit.scale * math.cos(fit.turn_rad), fit.scale * math.sin(fit.turn_rad)
    center_x, center_y = fit.center_px
    return center_x + cos * x + sin * y, center_y - sin * x + cos * y


def _different(poses: Sequence[_Pose], count: int, near_px: float, near_rad: float) -> list[_Pose]:
    """The `count` most promising poses, none nearly the same as another."""
    kept: list[_Pose] = []
    for pose in sorted(poses, key=lambda one: -one.promise):
        if not any(_nearly_same(pose.fit, other.fit, near_px, near_rad) for other in kept):
            kept.append(pose)
        if len(kept) == count:
            break
    return kept


def _nearly_same(one: Fit, other: Fit, near_px: float, near_rad: float) -> bool:
    if math.dist(one.center_px, other.center_px) >= near_px:
        return False
    return math.cos(one.turn_rad - other.turn_rad) > math.cos(near_rad)


def _apart(appearance: Appearance, laid: Sequence[_Laid], effort: Effort) -> list[_Laid]:
    """The firmest, no two of them closer than they may be."""
    kept: list[_Laid] = []
    for one in sorted(laid, key=lambda one: -one.firmness):
        center = appearance.center_of(one.fit)
        others = (appearance.center_of(other.fit) for other in kept)
        if not any(math.dist(center, other) < effort.apart_px for other in others):
            kept.append(one)
        if len(kept) == effort.judged:
            break
    return kept
