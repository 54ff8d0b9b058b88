"""Other things in a scene: beside the object, touching it, or lying over a part of it."""

import math
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
TRIES = 24
MOST_PIXELS = 5000
_STEP_PX = 2.0

LaidThing = tuple[CutOut, Pose]


@dataclass(frozen=True)
class Target:
    """The object that things are laid around."""

    pixels: NDArray[np.int64]  # (n, 2) pixels (x, y) that it takes up
    center_px: Point
    frame_hw: tuple[int, int]

    @staticmethod
    def of(covered: Mask, center_px: Point) -> "Target":
        """The object that takes up `covered` (H, W); of many pixels, evenly spread ones count."""
        rows, cols = np.nonzero(covered)
        some = slice(None, None, max(1, len(rows) // MOST_PIXELS))
        height, width = covered.shape
        return Target(np.stack([cols[some], rows[some]], axis=1), center_px, (height, width))

    @property
    def radius_px(self) -> float:
        """Reach of its pixels from its centre."""
        away = self.pixels - np.asarray(self.center_px)
        return float(np.hypot(away[:, 0], away[:, 1]).max(initial=0.0))


@dataclass(frozen=True)
class LooseThing:
    """A thing, turned and scaled, that has no place yet."""

    cut: CutOut
    turn_rad: float
    scale: float
    mask: Mask  # (2 half + 1, 2 half + 1), its middle in the middle
    half: int

    @staticmethod
    def of(cut: CutOut, rng: np.random.Generator, larger: float = 1.0) -> "LooseThing":
        """A cut-out with a turn and a scale of its own."""
        turn = float(rng.uniform(-np.pi, np.pi))
        scale = float(rng.uniform(*THING_SCALE)) * larger
        half = int(np.ceil(scale * np.hypot(*cut.mask.shape))) + 2
        side = 2 * half + 1
        pose = pose_of(_middle(cut), (half, half), turn, scale)
        return LooseThing(cut, turn, scale, footprint(cut, pose, (side, side)), half)

    def at(self, center_px: Point) -> LaidThing:
        """The thing with its middle at a place."""
        return self.cut, pose_of(_middle(self.cut), center_px, self.turn_rad, self.scale)

    def share_of(self, target: Target, center_px: Point) -> float:
        """The share of the target that the thing would hide."""
        corner = np.rint(center_px).astype(np.int64) - self.half
        x, y = (target.pixels - corner).T
        inside = (x >= 0) & (y >= 0) & (x < len(self.mask)) & (y < len(self.mask))
        return float(self.mask[y[inside], x[inside]].sum() / max(len(target.pixels), 1))

    def clear_of(self, target: Target, rng: np.random.Generator) -> Point | None:
        """A place in view at which it hides nothing of the target; None: none was found."""
        height, width = target.frame_hw
        for _ in range(TRIES):
            place = float(rng.uniform(0.05, 0.95) * width), float(rng.uniform(0.05, 0.95) * height)
            if self.share_of(target, place) == 0:
                return place
        return None

    def touching(self, target: Target, rng: np.random.Generator) -> Point:
        """A place at which it touches the target, or lies very close to it."""
        direction, gap = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(0.0, CLOSE_PX))
        places = self._places(target, direction)
        x, y = next(p for p in places if self.share_of(target, p) <= TOUCHING_SHARE)
        return x + gap * float(np.cos(direction)), y + gap * float(np.sin(direction))

    def over(self, target: Target, rng: np.random.Generator) -> tuple[Point, float]:
        """A place at which it hides about 30 % of the target, or comes nearest to that; the share.

        The side is drawn at random, and which of the places that fit.
        """
        places = list(self._places(target, float(rng.uniform(-np.pi, np.pi))))
        shares = np.array([self.share_of(target, place) for place in places])
        fitting = np.flatnonzero((shares > HIDDEN_SHARE[0]) & (shares < HIDDEN_SHARE[1]))
        nearest = np.abs(shares - sum(HIDDEN_SHARE) / 2).argmin()
        k = int(rng.choice(fitting) if len(fitting) else nearest)
        return places[k], float(shares[k])

    def _places(self, target: Target, direction_rad: float) -> Iterator[Point]:
        """Places from the target's centre outwards, until nothing of it is reached any more."""
        right, down = float(np.cos(direction_rad)), float(np.sin(direction_rad))
        end = target.radius_px + math.sqrt(2) * self.half + 2 * _STEP_PX
        for reach in np.arange(0.0, end, _STEP_PX):
            x, y = target.center_px
            yield x + float(reach) * right, y + float(reach) * down


def cover(target: Target, things: Iterable[LooseThing], rng: np.random.Generator) -> LaidThing:
    """The first thing that hides about 30 % of the target, laid there; else the one nearest to it.

    Args:
        target: the object.
        things: to try, at least one.
        rng: decides from which side, and how deep.
    """
    nearest, best = None, math.inf
    for thing in things:
        place, share = thing.over(target, rng)
        error = abs(share - sum(HIDDEN_SHARE) / 2)
        if error < best:
            nearest, best = thing.at(place), error
        if HIDDEN_SHARE[0] < share < HIDDEN_SHARE[1]:
            break
    if nearest is None:
        raise ValueError("`things` must hold at least one thing, got none")
    return nearest


def _middle(cut: CutOut) -> Point:
    """Middle of the object's pixels, in its demonstration."""
    rows, cols = np.nonzero(cut.mask)
    return float(cols.mean()) + cut.corner_px[0], float(rows.mean()) + cut.corner_px[1]
