"""Whether the object ends where it should: colours on both sides of its outline.

A black thing that is larger than the taught black thing agrees with all of its pixels, but there is
no edge where the taught one ends.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.correlation import NOISE_VARIANCE

Floats = NDArray[np.float32]

STRETCHES = 24  # of equal length
_POINTS = 4  # in each
_NEAR_PX, _FAR_PX = 1.5, 3.0  # of the level, from the outline, on either side
_SMOOTHED_PX = 2.0


@dataclass(frozen=True)
class Outline:
    """Points along a mask's outline, N of them, and where both sides are."""

    points: Floats  # (N, 2) x, y
    inward: Floats  # (N, 2), of length 1, across the outline
    inner: Floats  # (2 N, 2), near ones first
    outer: Floats  # (2 N, 2)

    @staticmethod
    def of(solid: Floats) -> "Outline":
        """Outline of the largest part of a mask (h, w), 0 to 1."""
        high = (solid >= min(0.5, float(solid.max()))).astype(np.uint8)
        found, _ = cv2.findContours(high, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        points = _evenly(max(found, key=len)[:, 0].astype(np.float64), STRETCHES * _POINTS)
        inward = _inward(solid, points)
        near, far = _NEAR_PX * inward, _FAR_PX * inward
        inner = np.concatenate([points + near, points + far])
        outer = np.concatenate([points - near, points - far])
        return Outline(*(one.astype(np.float32) for one in (points, inward, inner, outer)))

    def lines(self, offsets: Floats) -> tuple[Floats, Floats]:
        """Where (x, y), each (N, M), lines across the outline are, M offsets [px], inside < 0."""
        at = self.points[:, None] - offsets[:, None] * self.inward[:, None]
        return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])

    def sides(self, image: Floats) -> tuple[Floats, Floats]:
        """Colours (N, 3) just inside and just outside, in an image (h, w, 3)."""
        near_in, far_in, near_out, far_out = sampled(image, *self._sides).reshape(4, -1, 3)
        return _middle(near_in, far_in), _middle(near_out, far_out)

    @cached_property
    def _sides(self) -> tuple[Floats, Floats]:
        """Where (x, y) both sides are, each (1, 4 N)."""
        x, y = np.concatenate([self.inner, self.outer]).T
        return np.ascontiguousarray(x[None]), np.ascontiguousarray(y[None])


def contrasts(inside: Floats, outside: Floats) -> Floats:
    """How far apart the colours (N, 3) on both sides are, the mean of each stretch."""
    apart = np.sqrt(((inside - outside) ** 2).sum(axis=1))
    return np.asarray(apart.reshape(STRETCHES, _POINTS).mean(axis=1), dtype=np.float32)


def likeness(one: Floats, other: Floats) -> float:
    """Correlation of colours (N, 3) along the outline, each channel around its mean."""
    a, b = one - one.mean(axis=0), other - other.mean(axis=0)
    noise = NOISE_VARIANCE * len(a)
    return float((a * b).sum() / np.sqrt(((a * a).sum() + noise) * ((b * b).sum() + noise)))


def _evenly(contour: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Points (count, 2) at equal distances along a closed contour (M, 2)."""
    closed = np.concatenate([contour, contour[:1]])
    moved = np.diff(closed, axis=0)
    steps = np.hypot(moved[:, 0], moved[:, 1])
    along = np.concatenate([[0.0], np.cumsum(steps)])
    at = np.linspace(0.0, along[-1], count, endpoint=False)
    return np.stack([np.interp(at, along, closed[:, axis]) for axis in (0, 1)], axis=1)


def _inward(solid: Floats, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit vectors (N, 2) across the outline, towards the object."""
    smooth = np.asarray(cv2.GaussianBlur(solid, (0, 0), _SMOOTHED_PX), np.float64)
    down, right = np.gradient(smooth, axis=0), np.gradient(smooth, axis=1)
    x, y = np.clip(np.round(points).astype(int), 0, np.array(solid.shape[::-1]) - 1).T
    across = np.stack([right[y, x], down[y, x]], axis=1)
    length = np.hypot(across[:, 0], across[:, 1])
    return np.asarray(across / np.maximum(length, 1e-9)[:, None])


def _middle(one: Floats, other: Floats) -> Floats:
    return np.asarray((one + other) / 2, dtype=np.float32)


def sampled(image: Floats, x: Floats, y: Floats) -> Floats:
    """Colours (N, M, 3) of an image between its pixels, at places (N, M)."""
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)
