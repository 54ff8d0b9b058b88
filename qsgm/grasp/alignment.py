"""Lay the patch over a scene between pixels, turns and scales: Gauss-Newton on the difference.

The scene is moved so that the object lies as it was taught. What is left of the difference, once
the light is made the same, says by the patch's own slopes how far off that is (inverse
compositional, Baker and Matthews 2004). Cells that disagree have little say, so that what hides a
part of the object does not pull the rest along (iteratively reweighted least squares).
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.cells import SIDE, Cells, Look, spread_out, sums_by_cell
from qsgm.grasp.correlation import FINE, NOISE_VARIANCE, Fit, Pyramid, Template

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]

_STEPS = 5
# What a fit is off by before: right and down [px of the level], turn [rad], log of the scale.
_EXPECTED_ERROR = np.array([1.0, 1.0, 0.05, 0.05])
# Further from where it began, a fit has slid onto something else.
_FURTHEST = np.array([4.0, 4.0, 0.2, 0.15])
# A step smaller than that is not worth another look.
_NOTHING = np.array([0.03, 0.03, 0.001, 0.001])
# Of the taught contrast, so much has to be there.
_LEAST_GAIN = 0.2


@dataclass(frozen=True)
class Aligner:
    """A patch's cells and slopes at half of the resolution; D numbers, all channels together."""

    cells: Cells
    slopes: Floats  # (4, D) by right, down, turn and log of the scale
    slope_means: Floats  # (C, 3, 4), of each cell
    slope_products: Floats  # (C, 4, 4)
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
        by_kind = np.ascontiguousarray(each.reshape(-1, 4).T)
        return Aligner(
            cells,
            by_kind,
            _means(inside, cells).reshape(-1, 3, 4),
            _means(products, cells).reshape(-1, 4, 4),
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
            if (_distances(here, fit) > _FURTHEST).any():
                break
            look = self.look(scene, here)
            if look.score > best[0].score:
                best = replace(here, score=look.score), look
            if (np.abs(step) < _NOTHING).all():
                break
        return best

    def _step(self, look: Look) -> Doubles:
        """By how much (4,) the patch seems to be off."""
        trust = look.trust()
        whole = look.whole(trust)
        if whole.gain < _LEAST_GAIN:
            return np.zeros(4)
        means = np.tensordot(trust, self.slope_means, 1)  # (3, 4)
        normal = np.tensordot(trust, self.slope_products, 1) - means.T @ means + self.prior
        cells = self.cells
        light = np.float32(1 / whole.gain)
        level = (whole.taught_mean - whole.mean * light).astype(np.float32)
        # Flat, and not broadcast over three channels, which numpy does in steps of three numbers.
        left = look.seen.ravel() * light - cells.image.ravel()
        left += np.tile(level, SIDE * SIDE)
        left *= self._pixel_trust(trust)
        return np.asarray(np.linalg.solve(normal, (self.slopes @ left).astype(np.float64)))

    def _pixel_trust(self, trust: Floats) -> Floats:
        """What each number of the difference counts (D,)."""
        weight = spread_out(trust / self.cells.size) * self.cells.solid
        return np.repeat(weight.ravel(), 3)


def as_taught(scene: Pyramid, fit: Fit) -> Floats:
    """The scene (64, 64, 3) moved so that the fitted object lies as in the demonstration."""
    level = scene.level(FINE)
    step = 1 << FINE
    cos, sin = fit.scale * np.cos(fit.turn_rad), fit.scale * np.sin(fit.turn_rad)
    turn = np.array([[cos, sin], [-sin, cos]])  # from the upright window to the scene
    center = (np.array(fit.center_px) + 0.5) / step - 0.5
    motion = np.concatenate([turn, (center - turn @ np.full(2, (SIDE - 1) / 2))[:, None]], axis=1)
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
    right, down, turn, growth = step
    angle, scale = fit.turn_rad - float(turn), fit.scale * float(np.exp(-growth))
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    (x, y), halved = fit.center_px, 1 << FINE
    x -= halved * float(cos * right + sin * down)
    y -= halved * float(cos * down - sin * right)
    return Fit(fit.score, angle, scale, (x, y))


def _distances(one: Fit, other: Fit) -> Doubles:
    """How far apart two fits are: right, down [px of the level], turn and log of the scale."""
    (x, y), (other_x, other_y) = one.center_px, other.center_px
    halved = 1 << FINE
    values = (
        (x - other_x) / halved,
        (y - other_y) / halved,
        one.turn_rad - other.turn_rad,
        np.log(one.scale / other.scale),
    )
    return np.abs(values)
