"""Compare the object as taught with what is seen, cell by cell.

One correlation over the whole object is ruled by whatever is wrong with it: a thing that hides a
third of it takes the mean, the variance and the fit along. Cells of 16x16 px of the frame are
judged each by itself instead; those that agree say where the object is, and how many do says
whether it is the object at all.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.correlation import FINE, NOISE_VARIANCE, WINDOW_PX, Template

Floats = NDArray[np.float32]

SIDE = WINDOW_PX >> FINE
CELL = 8  # px of the level
ACROSS = SIDE // CELL
_CHANNELS = 3
_TINY = 1e-6
_LEAST_AGREEMENT = np.float32(0.05)
# From a row of a cell's pixels to the sum of each channel, and of all.
_BY_CHANNEL = np.tile(np.eye(_CHANNELS, _CHANNELS + 1, dtype=np.float32), (CELL, 1))
_BY_CHANNEL[:, _CHANNELS] = 1


@dataclass(frozen=True)
class Cells:
    """The demonstration's patch at half of the resolution; C = 64 cells, row by row."""

    image: Floats  # (64, 64, 3)
    solid: Floats  # (64, 64), 0 to 1
    solid_of_each: Floats  # (64, 64, 3), the same for every channel
    size: Floats  # (C,), pixels of the object in each cell, at least a tiny number
    share: Floats  # (C,), of the object, sums to 1
    mean: Floats  # (C, 3)
    variance: Floats  # (C,), all channels together

    @staticmethod
    def of(template: Template) -> "Cells":
        """What comparison by cells keeps of a demonstration's patch."""
        image, solid = upright(template)
        each = np.repeat(solid[..., None], _CHANNELS, axis=2)
        covered = image * each
        size = np.maximum(sums_by_cell(solid[..., None])[:, 0], np.float32(_TINY))
        mean = np.asarray(sums_by_cell(covered) / size[:, None], dtype=np.float32)
        square = sums_by_cell(covered * image).sum(axis=1) / size
        spread = square - (mean * mean).sum(axis=1)
        variance = np.clip(spread, 0, None).astype(np.float32)
        return Cells(image, solid, each, size, size / size.sum(), mean, variance)

    def look(self, seen: Floats) -> "Look":
        """Compare what is seen (64, 64, 3) where the object should be."""
        covered = np.empty((3, SIDE, SIDE, _CHANNELS), np.float32)
        np.multiply(seen, self.solid_of_each, out=covered[0])
        np.multiply(covered[0], seen, out=covered[1])
        np.multiply(covered[0], self.image, out=covered[2])
        # Rows of each cell first, then its columns, by channel and of all channels together.
        rows = covered.reshape(3 * ACROSS, CELL, -1).sum(axis=1)
        sums = (rows.reshape(-1, CELL * _CHANNELS) @ _BY_CHANNEL).reshape(3, -1, _CHANNELS + 1)
        moments = np.empty((len(self.size), _CHANNELS + 2), np.float32)
        moments[:, :_CHANNELS] = sums[0, :, :_CHANNELS]
        moments[:, _CHANNELS:] = sums[1:, :, _CHANNELS].T
        moments /= self.size[:, None]
        return Look(self, seen, moments)

    @cached_property
    def noisy(self) -> Floats:
        """Variance (C,) with that of a flat surface's noise."""
        return np.asarray(self.variance + NOISE_VARIANCE, dtype=np.float32)

    @cached_property
    def moments(self) -> Floats:
        """Mean of each channel and of all channels' squares together (C, 4)."""
        return np.column_stack([self.mean, self.variance + _dots(self.mean, self.mean)])


@dataclass(frozen=True)
class Whole:
    """Some cells' pixels compared as one image."""

    correlation: float
    gain: float  # of the contrast, seen over taught
    mean: Floats  # (3,) of what is seen
    taught_mean: Floats  # (3,)


@dataclass(frozen=True)
class Look:
    """One comparison of all cells."""

    cells: Cells
    seen: Floats  # (64, 64, 3)
    moments: Floats  # (C, 5), means of each channel, of all squares together, of products

    @property
    def mean(self) -> Floats:
        """Of each cell (C, 3)."""
        return self.moments[:, :_CHANNELS]

    @cached_property
    def variance(self) -> Floats:
        """Of each cell, all channels together (C,)."""
        spread = self.moments[:, _CHANNELS] - _dots(self.mean, self.mean)
        return np.asarray(np.maximum(spread, 0), dtype=np.float32)

    @cached_property
    def agreement(self) -> Floats:
        """Correlation of each cell by itself (C,)."""
        cells, noisy = self.cells, self.variance + NOISE_VARIANCE
        noisy *= cells.noisy
        product = self.moments[:, _CHANNELS + 1] - _dots(self.mean, cells.mean)
        return np.asarray(product / np.sqrt(noisy, out=noisy), dtype=np.float32)

    @property
    def picture(self) -> NDArray[np.uint8]:
        """What is seen, rounded: (64, 64, 3)."""
        return np.clip(np.rint(self.seen), 0, 255).astype(np.uint8)

    @cached_property
    def score(self) -> float:
        """How well the object fits, at most 1: all of it at once, and cell by cell.

        A cell that disagrees counts nothing, however much it disagrees.
        """
        apart = float(self.cells.share @ np.maximum(self.agreement, 0))
        return (apart + self.whole(self.cells.share).correlation) / 2

    @cached_property
    def trust(self) -> Floats:
        """What each cell counts (C,), sums to 1: little where it disagrees."""
        weight = self.cells.share * np.maximum(self.agreement, _LEAST_AGREEMENT) ** 2
        return np.asarray(weight / weight.sum(), dtype=np.float32)

    @cached_property
    def trusted(self) -> Whole:
        """The whole, each cell as it is trusted."""
        return self.whole(self.trust)

    def whole(self, weight: Floats) -> Whole:
        """All cells as one image, each counting as `weight` (C,) says, which sums to 1."""
        *mean, square, both = (weight @ self.moments).tolist()
        *taught_mean, taught_square = (weight @ self.cells.moments).tolist()
        seen = max(square - _dot(mean, mean), 0.0)
        taught = taught_square - _dot(taught_mean, taught_mean)
        product = both - _dot(mean, taught_mean)
        noisy = (seen + NOISE_VARIANCE) * (taught + NOISE_VARIANCE)
        means = np.array([mean, taught_mean], np.float32)
        return Whole(product / sqrt(noisy), product / max(taught, _TINY), *means)


def upright(template: Template) -> tuple[Floats, Floats]:
    """Image (64, 64, 3) and mask (64, 64) in 0 to 1 of the patch's middle."""
    layer = template.layer(FINE)
    margin = (len(layer) - SIDE) // 2
    middle = layer[margin : margin + SIDE, margin : margin + SIDE]
    mask = middle[..., 3] / np.float32(255)
    return np.ascontiguousarray(middle[..., :3]), np.ascontiguousarray(mask, dtype=np.float32)


def sums_by_cell(image: Floats) -> Floats:
    """Sums over every cell (C, K) of an image (64, 64, K)."""
    rows = image.reshape(ACROSS, CELL, -1).sum(axis=1)
    return np.asarray(rows.reshape(ACROSS * ACROSS, CELL, -1).sum(axis=1), dtype=np.float32)


def _dots(one: Floats, other: Floats) -> Floats:
    """Products (C,) of each row of two (C, 3)."""
    return np.asarray(np.einsum("ck,ck->c", one, other))


def _dot(one: Sequence[float], other: Sequence[float]) -> float:
    return sum(a * b for a, b in zip(one, other, strict=True))
