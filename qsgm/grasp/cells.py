"""Compare the object as taught with what is seen, cell by cell.

One correlation over the whole object is ruled by whatever is wrong with it: a thing that hides a
third of it takes the mean, the variance and the fit along. Cells of 16x16 px of the frame are
judged each by itself instead; those that agree say where the object is, and how many do says
whether it is the object at all.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.correlation import FINE, NOISE_VARIANCE, WINDOW_PX, Template

Floats = NDArray[np.float32]

SIDE = WINDOW_PX >> FINE
CELL = 8  # px of the level
ACROSS = SIDE // CELL
_CHANNELS = 3
_TINY = 1e-6


@dataclass(frozen=True)
class Cells:
    """The demonstration's patch at half of the resolution; C = 64 cells, row by row."""

    image: Floats  # (64, 64, 3)
    solid: Floats  # (64, 64), 0 to 1
    solid_of_each: Floats  # (64, 64, 3), the same for every channel
    covered: Floats  # (64, 64, 3), the image times `solid`
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
        square = _summed_all(covered * image) / size
        spread = square - (mean * mean).sum(axis=1)
        variance = np.clip(spread, 0, None).astype(np.float32)
        return Cells(image, solid, each, covered, size, size / size.sum(), mean, variance)

    def look(self, seen: Floats) -> "Look":
        """Compare what is seen (64, 64, 3) where the object should be."""
        covered = seen * self.solid_of_each
        size = self.size
        mean = sums_by_cell(covered) / size[:, None]
        square = _summed_all(covered * seen) / size
        product = _summed_all(covered * self.image) / size
        variance = np.maximum(square - (mean * mean).sum(axis=1), 0.0)
        product = product - (mean * self.mean).sum(axis=1)
        noisy = (variance + NOISE_VARIANCE) * (self.variance + NOISE_VARIANCE)
        return Look(self, seen, mean, variance, product, product / np.sqrt(noisy))

    @property
    def texture(self) -> Floats:
        """How much there is to agree on in each cell (C,), 0 to 1."""
        return np.asarray(self.variance / (self.variance + NOISE_VARIANCE), dtype=np.float32)


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
    mean: Floats  # (C, 3)
    variance: Floats  # (C,)
    product: Floats  # (C,), covariance
    agreement: Floats  # (C,), correlation of each cell by itself

    @property
    def picture(self) -> NDArray[np.uint8]:
        """What is seen, rounded: (64, 64, 3)."""
        return np.clip(np.rint(self.seen), 0, 255).astype(np.uint8)

    @property
    def score(self) -> float:
        """How well the object fits, at most 1: all of it at once, and cell by cell.

        A cell that disagrees counts nothing, however much it disagrees.
        """
        apart = float(self.cells.share @ np.maximum(self.agreement, 0.0))
        return (apart + self.whole(self.cells.share).correlation) / 2

    def trust(self) -> Floats:
        """What each cell counts (C,), sums to 1: little where it disagrees."""
        weight = self.cells.share * np.maximum(self.agreement, np.float32(0.05)) ** 2
        return np.asarray(weight / weight.sum(), dtype=np.float32)

    def whole(self, weight: Floats) -> Whole:
        """All cells as one image, each counting as `weight` (C,) says, which sums to 1."""
        cells = self.cells
        mean, taught_mean = weight @ self.mean, weight @ cells.mean
        seen = weight @ (self.variance + (self.mean**2).sum(axis=1)) - mean @ mean
        taught = weight @ (cells.variance + (cells.mean**2).sum(axis=1)) - taught_mean @ taught_mean
        together = weight @ (self.product + (self.mean * cells.mean).sum(axis=1))
        product = together - mean @ taught_mean
        noisy = (max(float(seen), 0.0) + NOISE_VARIANCE) * (float(taught) + NOISE_VARIANCE)
        gain = float(product) / max(float(taught), _TINY)
        return Whole(float(product) / float(np.sqrt(noisy)), gain, mean, taught_mean)


def upright(template: Template) -> tuple[Floats, Floats]:
    """Image (64, 64, 3) and mask (64, 64) in 0 to 1 of the patch's middle."""
    layer = template.layer(FINE)
    margin = (len(layer) - SIDE) // 2
    middle = layer[margin : margin + SIDE, margin : margin + SIDE]
    mask = middle[..., 3] / np.float32(255)
    return np.ascontiguousarray(middle[..., :3]), np.ascontiguousarray(mask, dtype=np.float32)


def spread_out(of_cells: Floats) -> Floats:
    """A number for each cell (C,) as one for each pixel (64, 64)."""
    square = of_cells.reshape(ACROSS, 1, ACROSS, 1)
    whole = np.broadcast_to(square, (ACROSS, CELL, ACROSS, CELL))
    return np.ascontiguousarray(whole).reshape(SIDE, SIDE)


def sums_by_cell(image: Floats) -> Floats:
    """Sums over every cell (C, K) of an image (64, 64, K)."""
    rows = image.reshape(ACROSS, CELL, -1).sum(axis=1)
    return np.asarray(rows.reshape(ACROSS * ACROSS, CELL, -1).sum(axis=1), dtype=np.float32)


def _summed_all(image: Floats) -> Floats:
    """Sums over every cell and all channels (C,) of an image (64, 64, 3)."""
    rows = image.reshape(ACROSS, CELL, -1).sum(axis=1)
    return np.asarray(rows.reshape(-1, CELL * _CHANNELS).sum(axis=1), dtype=np.float32)
