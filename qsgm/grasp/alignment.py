"""Lay the patch over a scene between pixels, turns and scales: Gauss-Newton on the difference.

The scene is moved so that the object lies as it was taught. What is left of the difference, once
the light is made the same, says by the patch's own slopes how far off that is (inverse
compositional, Baker and Matthews 2004); the slopes stay, so their normal equations do, too.
"""

from dataclasses import dataclass, replace
from math import sqrt
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.correlation import FINE, NOISE_VARIANCE, WINDOW_PX, Fit, Pyramid, Template

Floats = NDArray[np.float32]

SIDE = WINDOW_PX >> FINE
_STEPS = 4
_SLACK = 0.02
# What a fit is off by before: right and down [px of the level], turn [rad], log of the scale.
_EXPECTED_ERROR = np.array([1.0, 1.0, 0.05, 0.05])
# Further from where it began, a fit has slid onto something else.
_FURTHEST = np.array([4.0, 4.0, 0.15, 0.12])
# Of the taught contrast, so much has to be there.
_LEAST_GAIN = 0.2


@dataclass(frozen=True)
class Aligner:
    """A patch's pixels and slopes at half of the resolution; D pixels, all channels together."""

    taught: Floats  # (D,) around each channel's mean
    weight: Floats  # (D,) sums to 1 over each channel
    solid: Floats  # (64, 64), 0 to 1
    slopes: Floats  # (D, 4) by right, down, turn and log of the scale
    normal: NDArray[np.float64]  # (4, 4)
    variance: float  # of the patch, all channels together
    middle_px: tuple[float, float]  # of the mask (x, y) [px of the frame] from the patch's middle

    @staticmethod
    def of(template: Template) -> "Aligner":
        """Of the demonstration's patch."""
        image, solid = upright(template)
        of_each = [slopes(image[..., channel]) for channel in range(3)]
        right, down = (np.dstack(one) / 2 for one in zip(*of_each, strict=True))
        at = np.arange(SIDE, dtype=np.float32) - (SIDE - 1) / 2
        x, y = at[None, :, None], at[:, None, None]
        columns = (right, down, y * right - x * down, x * right + y * down)
        flat = np.stack([_flattened(column, solid) for column in columns], axis=1)
        total = max(float(solid.sum()), 1e-6)
        weight = np.repeat(solid.ravel() / total, 3)
        prior = np.diag(NOISE_VARIANCE / (total * _EXPECTED_ERROR**2))
        normal = ((flat.T * weight) @ flat).astype(np.float64) + prior
        across, below = (
            (1 << FINE) * float((solid * along).sum()) / total for along in (x[..., 0], y[..., 0])
        )
        taught = _flattened(image, solid)
        variance = float((weight * taught * taught).sum())
        return Aligner(taught, weight, solid, flat, normal, variance, (across, below))

    def aligned(self, scene: Pyramid, fit: Fit) -> Fit:
        """The fit that is left once the patch seems to be off by nothing.

        The given one where that leads away from it, or to a worse one.
        """
        here = fit
        first, step = self._look(scene, here)
        score = first
        for _ in range(_STEPS):
            here = _stepped(here, step)
            if (_distances(here, fit) > _FURTHEST).any():
                return replace(fit, score=first)
            score, step = self._look(scene, here)
        # Least squares and the highest correlation are not quite the same.
        return replace(here, score=score) if score >= first - _SLACK else replace(fit, score=first)

    def _look(self, scene: Pyramid, fit: Fit) -> tuple[float, NDArray[np.float64]]:
        """Correlation of a fit, and by how much (4,) the patch seems to be off from it."""
        seen = _flattened(as_taught(scene, fit), self.solid)
        weighed = self.weight * seen
        product, own = float(weighed @ self.taught), float(weighed @ seen)
        score = product / sqrt((own + NOISE_VARIANCE) * (self.variance + NOISE_VARIANCE))
        gain = product / max(self.variance, 1e-6)
        if gain < _LEAST_GAIN:
            return score, np.zeros(4)
        left = self.weight * (seen / gain - self.taught)
        step = np.linalg.solve(self.normal, (self.slopes.T @ left).astype(np.float64))
        return score, np.asarray(step, dtype=np.float64)


def as_taught(scene: Pyramid, fit: Fit) -> Floats:
    """The scene (64, 64, 3) moved so that the fitted object lies as in the demonstration."""
    level = scene.levels[FINE]
    step = 1 << FINE
    cos, sin = fit.scale * np.cos(fit.turn_rad), fit.scale * np.sin(fit.turn_rad)
    turn = np.array([[cos, sin], [-sin, cos]])  # from the upright window to the scene
    center = (np.array(fit.center_px) + 0.5) / step - 0.5
    motion = np.concatenate([turn, (center - turn @ np.full(2, (SIDE - 1) / 2))[:, None]], axis=1)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = cv2.warpAffine(level, motion, (SIDE, SIDE), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(seen, dtype=np.float32)


def upright(template: Template) -> tuple[Floats, Floats]:
    """Image (64, 64, 3) and mask (64, 64) in 0 to 1 of the patch's middle."""
    layer = template.layer(FINE)
    margin = (len(layer) - SIDE) // 2
    middle = layer[margin : margin + SIDE, margin : margin + SIDE]
    mask = middle[..., 3] / np.float32(255)
    return np.ascontiguousarray(middle[..., :3]), np.ascontiguousarray(mask, dtype=np.float32)


def slopes(image: Floats) -> tuple[Floats, Floats]:
    """Derivatives to the right and down (h, w), central differences, 0 at the border."""
    right, down = np.zeros_like(image), np.zeros_like(image)
    right[:, 1:-1] = image[:, 2:] - image[:, :-2]
    down[1:-1] = image[2:] - image[:-2]
    return right, down


def _stepped(fit: Fit, step: NDArray[np.float64]) -> Fit:
    """The fit from which the patch is off by nothing, if it was off by `step` (4,)."""
    right, down, turn, growth = step
    angle, scale = fit.turn_rad - float(turn), fit.scale * float(np.exp(-growth))
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    (x, y), halved = fit.center_px, 1 << FINE
    x -= halved * float(cos * right + sin * down)
    y -= halved * float(cos * down - sin * right)
    return Fit(fit.score, angle, scale, (x, y))


def _distances(one: Fit, other: Fit) -> NDArray[np.float64]:
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


def _flattened(image: NDArray[np.floating[Any]], solid: Floats) -> Floats:
    """An image (64, 64, 3) around each channel's mean over the mask, as one row (D,)."""
    mean = means(image, solid) / max(float(solid.sum()), 1e-6)
    return np.asarray(around(image, mean).ravel(), dtype=np.float32)


def means(image: NDArray[np.floating[Any]], weight: Floats) -> Floats:
    """Sums of an image (h, w, 3) times a weight (h, w), by channel."""
    return np.asarray(weight.ravel() @ image.reshape(-1, 3), dtype=np.float32)


def around(image: NDArray[np.floating[Any]], level: Floats) -> NDArray[np.floating[Any]]:
    """An image (h, w, 3) minus a level for each channel, faster than numpy takes it away itself."""
    return (image.ravel() - np.tile(level, image.size // 3)).reshape(image.shape)
