"""Which colours an object has, whatever the light: hue and saturation, not brightness."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# Added to every level: the hue of what is dark is noise.
DARK = 12.0
_LARGEST = 1.2
_BINS = 12


@dataclass(frozen=True)
class Colours:
    """Colours of one object's pixels, as logarithms of red over green and blue over green."""

    middle: Floats  # (2,), medians
    histogram: Floats  # (12, 12), sums to 1
    mean: Floats  # (3,), logarithm of the mean level of each channel

    @staticmethod
    def of(pixels: Floats) -> "Colours":
        """Colours of pixels (N, 3) BGR, at least one."""
        planes = np.ascontiguousarray(pixels.T)
        blue, green, red = np.log(planes + np.float32(DARK))
        ratios = np.stack([red - green, blue - green])
        bins = ((ratios + _LARGEST) * (_BINS / (2 * _LARGEST))).astype(np.int64)
        rows, columns = np.clip(bins, 0, _BINS - 1)
        counts = np.bincount(rows * _BINS + columns, minlength=_BINS * _BINS)
        smooth = cv2.GaussianBlur(counts.reshape(_BINS, _BINS).astype(np.float32), (3, 3), 0)
        mean = np.log(planes.mean(axis=1) + np.float32(DARK)).astype(np.float32)
        return Colours(medians(ratios), np.asarray(smooth / smooth.sum(), dtype=np.float32), mean)

    def shift(self, other: "Colours") -> float:
        """How far the median hue is from another's."""
        return float(np.hypot(*(self.middle - other.middle)))

    def overlap(self, other: "Colours") -> float:
        """What the histograms share, 0 to 1."""
        return float(np.minimum(self.histogram, other.histogram).sum())

    def tint(self, other: "Colours") -> float:
        """The largest difference of a channel's gain from the three gains' mean."""
        gains = self.mean - other.mean
        return float(np.abs(gains - gains.mean()).max())


def medians(rows: Floats) -> Floats:
    """Medians (M,) of rows of numbers (M, N), none of them NaN."""
    upper = rows.shape[1] // 2
    lower = (rows.shape[1] - 1) // 2
    ordered = np.partition(rows, sorted({lower, upper}), axis=1)
    return np.asarray((ordered[:, lower] + ordered[:, upper]) / 2, dtype=np.float32)
