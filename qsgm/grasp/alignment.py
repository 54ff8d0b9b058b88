"""Lay the patch over a scene between pixels, turns and scales: Gauss-Newton on the difference.

The scene is moved so that the object lies as it was taught. What is left of the difference, once
the light is made the same, says by the patch's own slopes how far off that is (inverse
compositional, Baker and Matthews 2004). Cells that disagree have little say, so that what hides a
part of the object does not pull the rest along (iteratively reweighted least squares).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import cos, exp, log, sin

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.cells import ACROSS, CELL, SIDE, Cells, Look, sums_by_cell
from qsgm.grasp.correlation import FINE, NOISE_VARIANCE, Fit, Pyramid, Template

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_STEPS = 5
# What a fit is off by before: right and down [px of the level], turn [rad], log of the scale.
_EXPECTED_ERROR = np.array([1.0, 1.0, 0.05, 0.05])
# Further from where it began, a fit has slid onto something else.
_FURTHEST = 4.0, 4.0, 0.2, 0.15
# A step smaller than that is not worth another look.
_NOTHING = 0.03, 0.03, 0.001, 0.001
# A step's logarithm of the scale beyond that is of nothing that can be found.
_MOST_GROWTH = 10.0
# Of the taught contrast, so much has to be there.
_LEAST_GAIN = 0.2

# From a number of each channel to a row of the image.
_IN_A_ROW = np.tile(np.eye(3, dtype=np.float32), SIDE)


@dataclass(frozen=True)
class Aligner:
    """A patch's cells and slopes at half of the resolution; D numbers, all channels together."""

    cells: Cells
    slopes: Floats  # (4, D) by right, down, turn and log of the scale, times the mask
    slope_means: Floats  # (C, 3 * 4), of each cell
    slope_products: Floats  # (C, 4 * 4)
    prior: Doubles  # (4, 4), keeps a step small where nothing says how far to go
    middle_px: tuple[float, float]  # of the mask (x, y) [px of the frame] from the patch's middle

    @staticmethod
    def of(template: Template) -> "Aligner":
        """What alignment keeps of a demonstration's patch."""
        cells = Cells.of(template)
        right, down = (one / 2 for one in slopes(cells.image))
        at = np.arange(SIDE, dtype=np.float32) - (SIDE - 1) / 2
        x, y = at[None, :, None], at[:, None, None]
        columns = (right, down, y * right - x * down, x * right + y * down)
        each = np.stack(columns, axis=-1).astype(np.float32)  # (64, 64, 3, 4)
        inside = cells.solid[..., None, None] * each
        products = np.einsum("ijcd,ijce->ijde", inside, each)
        total = float(cells.solid.sum())
        prior = np.diag(NOISE_VARIANCE / (max(total, 1.0) * _EXPECTED_ERROR**2))
        along = (cells.solid * x[..., 0]).sum(), (cells.solid * y[..., 0]).sum()
        across, below = ((1 << FINE) * float(one) / max(total, 1e-6) for one in along)
        return Aligner(
            cells,
            np.ascontiguousarray(inside.reshape(-1, 4).T),
            _means(inside, cells),
            _means(products, cells),
            prior,
            (across, below),
        )

    def look(self, scene: Pyramid, fit: Fit) -> Look:
        """Compare the patch with the scene where a fit lays it."""
        return self.cells.look(as_taught(scene, fit))

    def aligned(self, scene: Pyramid, fit: Fit) -> tuple[Fit, Look]:
        """The best fit met on the way to where the patch seems to be off by nothing."""
        here, look = fit, self.look(scene, fit)
        best = replace(fit, score=look.score), look
        for _ in range(_STEPS):
            step = self._step(look)
            here = stepped(here, step)
            if _any_beyond(_distances(here, fit), _FURTHEST):
                break
            look = self.look(scene, here)
            if look.score > best[0].score:
                best = replace(here, score=look.score), look
            if not _any_beyond(step.tolist(), _NOTHING):
                break
        return best

    def _step(self, look: Look) -> Doubles:
        """By how much (4,) the patch seems to be off."""
        trust, whole = look.trust, look.trusted
        if whole.gain < _LEAST_GAIN:
            return np.zeros(4)
        means = (trust @ self.slope_means).reshape(3, 4)
        normal = (trust @ self.slope_products).reshape(4, 4) - means.T @ means + self.prior
        light = np.float32(1 / whole.gain)
        level = whole.taught_mean - whole.mean * light
        # In rows of the image, and not broadcast over three channels, which numpy does in steps of
        # three numbers.
        left = look.seen.reshape(SIDE, -1) * light
        left -= self.cells.image.reshape(SIDE, -1)
        left += level @ _IN_A_ROW
        by_cell = (trust / self.cells.size).reshape(ACROSS, 1, ACROSS)
        in_cells = left.reshape(ACROSS, CELL, -1)
        in_cells *= np.repeat(by_cell, 3 * CELL, axis=2)
        return np.asarray(np.linalg.solve(normal, (self.slopes @ left.ravel()).astype(np.float64)))


def as_taught(scene: Pyramid, fit: Fit) -> Floats:
    """The scene (64, 64, 3) moved so that the fitted object lies as in the demonstration."""
    level = scene.level(FINE)
    c, s = fit.scale * cos(fit.turn_rad), fit.scale * sin(fit.turn_rad)
    x, y = ((value + 0.5) / (1 << FINE) - 0.5 for value in fit.center_px)
    middle = (SIDE - 1) / 2
    # From the upright window to the scene.
    motion = np.array([[c, s, x - (c + s) * middle], [-s, c, y - (c - s) * middle]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(level, motion, (SIDE, SIDE), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen, dtype=np.float32)


def slopes(image: Floats) -> tuple[Floats, Floats]:
    """Derivatives to the right and down (h, w, ...), central differences, 0 at the border."""
    right, down = np.zeros_like(image), np.zeros_like(image)
    right[:, 1:-1] = image[:, 2:] - image[:, :-2]
    down[1:-1] = image[2:] - image[:-2]
    return right, down


def _means(image: Floats, cells: Cells) -> Floats:
    """Mean (C, K) of every cell of an image (64, 64, ...) with K numbers a pixel."""
    sums = sums_by_cell(image.reshape(SIDE, SIDE, -1))
    return np.asarray(sums / cells.size[:, None], dtype=np.float32)


def stepped(fit: Fit, step: Doubles) -> Fit:
    """The fit from which the patch is off by nothing, if it was off by `step` (4,)."""
    right, down, turn, growth = step.tolist()
    growth = min(max(growth, -_MOST_GROWTH), _MOST_GROWTH)
    angle, scale = fit.turn_rad - turn, fit.scale * exp(-growth)
    c, s = scale * cos(angle), scale * sin(angle)
    (x, y), halved = fit.center_px, 1 << FINE
    center = x - halved * (c * right + s * down), y - halved * (c * down - s * right)
    return Fit(fit.score, angle, scale, center)


def _distances(one: Fit, other: Fit) -> tuple[float, ...]:
    """How far apart two fits are: right, down [px of the level], turn and log of the scale."""
    (x, y), (other_x, other_y) = one.center_px, other.center_px
    halved = 1 << FINE
    turn, growth = one.turn_rad - other.turn_rad, log(one.scale / other.scale)
    return (x - other_x) / halved, (y - other_y) / halved, turn, growth


def _any_beyond(values: Sequence[float], bounds: Sequence[float]) -> bool:
    return any(abs(value) > bound for value, bound in zip(values, bounds, strict=True))
