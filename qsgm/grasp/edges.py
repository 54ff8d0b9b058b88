"""Whether there are edges where the taught object has them, and which pose holds firmly by that.

A black thing that is larger than the taught black thing agrees with all of its pixels, but there is
no edge where the taught one ends.
"""

from dataclasses import dataclass
from functools import cached_property
from math import sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.alignment import slopes
from qsgm.grasp.cells import Cells, Look

Floats = NDArray[np.float32]

_GRADIENT_NOISE = np.float32(4.0)  # levels
_GREY = np.full(3, 1 / 3, np.float32)
_TINY = 1e-4
_RIM_PX = 5  # of the square that the mask grows by
# How much edges count beside the score when one pose of a place is preferred to another: fitted on
# drawn scenes, where right poses are the preferred ones in 87 of 100 instead of 83.
_EDGES_COUNT, _OUTLINE_COUNTS = 0.6, 1.75


@dataclass(frozen=True)
class Edges:
    """Whether there are edges where they belong."""

    agreement: float  # of the gradient's directions, sign ignored
    outline: float  # share of the gradient at the outline that stands across it

    def firmness(self, look: Look) -> float:
        """How firmly a pose holds, to prefer one to another: by its score, and by its edges."""
        return look.score + _EDGES_COUNT * self.agreement + _OUTLINE_COUNTS * self.outline


@dataclass(frozen=True)
class TaughtEdges:
    """The demonstration's side of that, at half of the resolution."""

    rim: Floats  # (64, 64), the mask with its surroundings, sums to 1
    normal: Floats  # (2, 4096), the outline's normal times its strength, which sums to 1
    gradient: Floats  # (2, 4096), see :func:`_directions`

    @staticmethod
    def of(cells: Cells) -> "TaughtEdges":
        """Everything about a demonstration's edges that does not depend on the scene."""
        rim = np.asarray(cv2.dilate(cells.solid, np.ones((_RIM_PX, _RIM_PX))), np.float32)
        right, down = slopes(cells.solid)
        normal = np.stack([right.ravel(), down.ravel()])
        return TaughtEdges(
            np.asarray(rim / max(float(rim.sum()), 1e-6), np.float32),
            normal / max(float(np.hypot(right, down).sum()), 1e-6),
            _directions(cells.image),
        )

    def met_by(self, seen: Floats) -> Edges:
        """Edges of what is seen (64, 64, 3), next to those of the demonstration."""
        right, down, length = _gradient(seen)
        shorter = 1 / (length + _GRADIENT_NOISE)
        across, along = self._rim_gradient, shorter * shorter
        together = (right * right - down * down) * across[0]
        together += (2 * right * down) * across[1]
        strength = (length * shorter) ** 2
        own = float((strength * strength) @ self.rim.ravel()) + _TINY
        over = np.abs(right * self.normal[0] + down * self.normal[1])
        return Edges(float(together @ along) / sqrt(own * self._edginess), float(over @ shorter))

    @cached_property
    def _rim_gradient(self) -> Floats:
        """The gradient (2, 4096) as the rim counts."""
        return self.gradient * self.rim.ravel()

    @cached_property
    def _edginess(self) -> float:
        """The gradient's mean square on the rim."""
        return float((self._rim_gradient * self.gradient).sum()) + _TINY


def _gradient(image: Floats) -> tuple[Floats, Floats, Floats]:
    """Of an image's brightness (64, 64, 3): to the right, down, and its length (4096,)."""
    grey = (image.reshape(-1, 3) @ _GREY).reshape(image.shape[:2])
    right, down = (one.ravel() for one in slopes(grey))
    return right, down, np.sqrt(right * right + down * down)


def _directions(image: Floats) -> Floats:
    """Twice the gradient's angle as (cosine, sine) (2, 4096), shorter where it is weak."""
    right, down, length = _gradient(image)
    double = np.stack([right * right - down * down, 2 * right * down])
    return np.asarray(double / (length + _GRADIENT_NOISE) ** 2, dtype=np.float32)
