"""A mask's outline: points along it, which way is inwards, and colours just inside."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

_POINTS = 96
_NEAR_PX, _FAR_PX = 1.5, 3.0  # of the level, from the outline
_SMOOTHED_PX = 2.0


@dataclass(frozen=True)
class Outline:
    """N points at equal distances along a mask's outline."""

    points: Floats  # (N, 2) x, y
    inward: Floats  # (N, 2), of length 1, across the outline

    @staticmethod
    def of(solid: Floats) -> "Outline":
        """Outline of the largest part of a mask (h, w), 0 to 1."""
        high = (solid >= min(0.5, float(solid.max()))).astype(np.uint8)
        found, _ = cv2.findContours(high, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        points = _evenly(max(found, key=len)[:, 0].astype(np.float64), _POINTS)
        return Outline(points.astype(np.float32), _inward(solid, points).astype(np.float32))

    def lines(self, offsets: Floats) -> tuple[Floats, Floats]:
        """Where (x, y), each (N, M), lines across the outline are, M offsets [px], inside < 0."""
        at = self.points[:, None] - offsets[:, None] * self.inward[:, None]
        return np.ascontiguousarray(at[..., 0]), np.ascontiguousarray(at[..., 1])

    def colours_inside(self, image: Floats) -> Floats:
        """Colours (N, 3) just inside, in an image (h, w, 3)."""
        two = sampled(image, *self.lines(np.array([-_NEAR_PX, -_FAR_PX], np.float32)))
        return np.asarray(two.mean(axis=1), dtype=np.float32)


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


def sampled(image: Floats, x: Floats, y: Floats) -> Floats:
    """Colours (N, M, 3) of an image between its pixels, at places (N, M)."""
    found = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.float32)
