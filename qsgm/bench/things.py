"""Other things in a scene: beside the object, touching it, or lying over a part of it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.bench.cutouts import CutOut, Mask, Point, Pose, footprint, pose_of

THING_SCALE = (0.85, 1.15)
# A thing that touches an object hides at most this share of it.
TOUCHING_SHARE = 0.02
CLOSE_PX = 8.0
HIDDEN_SHARE = (0.27, 0.33)
# Things or places that are tried before the nearest one has to do.
TRIES = 60
_STEP_PX = 2.0

LaidThing = tuple[CutOut, Pose]


@dataclass(frozen=True)
class LooseThing:
    """A thing, turned and scaled, that has no place yet."""

    cut: CutOut
    turn_rad: float
    scale: float
    points: NDArray[np.int64]  # (n, 2) pixels (x, y) that it takes up, from its middle

    @staticmethod
    def of(cut: CutOut, rng: np.random.Generator, larger: float = 1.0) -> "LooseThing":
        """A cut-out with a turn and a scale of its own."""
        turn = float(rng.uniform(-np.pi, np.pi))
        scale = float(rng.uniform(*THING_SCALE)) * larger
        half = int(np.ceil(scale * np.hypot(*cut.mask.shape))) + 2
        side = 2 * half + 1
        pose = pose_of(_middle(cut), (half, half), turn, scale)
        rows, cols = np.nonzero(footprint(cut, pose, (side, side)))
        return LooseThing(cut, turn, scale, np.stack([cols, rows], axis=1) - half)

    def at(self, center_px: Point) -> LaidThing:
        """The thing with its middle at a place."""
        return self.cut, pose_of(_middle(self.cut), center_px, self.turn_rad, self.scale)

    def share_of(self, covered: Mask, center_px: Point) -> float:
        """The share of `covered` (H, W) that the thing would hide."""
        x, y = np.rint(self.points + np.asarray(center_px)).astype(np.int64).T
        inside = (x >= 0) & (y >= 0) & (x < covered.shape[1]) & (y < covered.shape[0])
        return float(covered[y[inside], x[inside]].sum() / max(covered.sum(), 1))

    def clear_of(self, covered: Mask, rng: np.random.Generator) -> Point | None:
        """A place in view at which it hides nothing of `covered`; None: none was found."""
        height, width = covered.shape
        for _ in range(TRIES):
            place = float(rng.uniform(0.05, 0.95) * width), float(rng.uniform(0.05, 0.95) * height)
            if self.share_of(covered, place) == 0:
                return place
        return None

    def touching(self, covered: Mask, center_px: Point, rng: np.random.Generator) -> Point:
        """A place at which it touches `covered`, or lies very close to it."""
        direction, gap = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0.0, CLOSE_PX))
        places = _ray(center_px, direction, covered.shape)
        x, y = next(p for p in places if self.share_of(covered, p) <= TOUCHING_SHARE)
        return x + gap * float(np.cos(direction)), y + gap * float(np.sin(direction))


def cover(
    covered: Mask, things: Iterable[LooseThing], center_px: Point, rng: np.random.Generator
) -> LaidThing:
    """The first thing that hides about 30 % of `covered`, laid there; else the one nearest to it.

    Args:
        covered: (H, W) the object's pixels.
        things: to try, at least one.
        center_px: a point on the object.
        rng: decides from which side, and how deep.
    """
    middle, nearest, best = sum(HIDDEN_SHARE) / 2, None, np.inf
    for thing in things:
        places = list(_ray(center_px, float(rng.uniform(-np.pi, np.pi)), covered.shape))
        shares = np.array([thing.share_of(covered, place) for place in places])
        fitting = np.flatnonzero((shares > HIDDEN_SHARE[0]) & (shares < HIDDEN_SHARE[1]))
        if len(fitting):
            return thing.at(places[int(rng.choice(fitting))])
        k = int(np.abs(shares - middle).argmin())
        if abs(shares[k] - middle) < best:
            best, nearest = abs(shares[k] - middle), thing.at(places[k])
    if nearest is None:
        raise ValueError("`things` must hold at least one thing, got none")
    return nearest


def _middle(cut: CutOut) -> Point:
    """Middle of the object's pixels, in its demonstration."""
    rows, cols = np.nonzero(cut.mask)
    return float(cols.mean()) + cut.corner_px[0], float(rows.mean()) + cut.corner_px[1]


def _ray(start_px: Point, direction_rad: float, shape_hw: tuple[int, ...]) -> Iterator[Point]:
    """Places from a point outwards, until nothing near the frame is reached any more."""
    right, down = float(np.cos(direction_rad)), float(np.sin(direction_rad))
    for reach in np.arange(0.0, 2 * np.hypot(*shape_hw), _STEP_PX):
        yield start_px[0] + float(reach) * right, start_px[1] + float(reach) * down
