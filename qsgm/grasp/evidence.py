"""What speaks for and against a candidate being the taught object.

The scene is turned, scaled and moved so that the candidate lies as the demonstration does; then the
two are compared pixel by pixel, at half of the resolution. No single number tells an object from
its like on another table, in other light, partly hidden: :data:`NAMES` lists those that together
do, and a :class:`qsgm.grasp.decision.Decision` weighs them.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.alignment import around, as_taught, means, slopes, upright
from qsgm.grasp.correlation import NOISE_VARIANCE, Fit, Pyramid, Template

Floats = NDArray[np.float32]

NAMES = (
    "correlation",  # colours, each channel around its own mean
    "joint_correlation",  # the same around the mean of all channels: hue counts
    "edge_agreement",  # directions of the brightness gradient, sign ignored
    "outline",  # share of the gradient at the outline that stands across it
    "gain",  # |log| of how much brighter the object is
    "tint",  # how far apart the three channels' gains are
    "spread",  # log of the variance, seen over taught
    "scale",  # |log|
    "agreement_low",  # of six parts of the object: the two worst correlations' mean
    "agreement_middle",  # and the median
    "agreement_high",  # and the mean of the three best
    "seen_correlation",  # over the four best parts alone, as if the others were hidden
    "residual",  # median colour difference once brightness and contrast are fitted
    "contrast",  # of the object to what lies around it
    "detail",  # log of the taught object's own variance
    "quality_logit",  # what the tuned network says
    "turn_difference",  # |sine| of the angle between the network's turn and the patch's
    "lead",  # over the best fit at another turn
)
_PARTS = 6
_SHOWN_PARTS = 4  # of an object that is partly hidden
_GRADIENT_NOISE = 4.0  # levels
_RING_PX = 5  # of the level
_LARGEST_LOGIT = 8.0


@dataclass(frozen=True)
class Reference:
    """The demonstration's side of every comparison, at half of the resolution."""

    image: Floats  # (64, 64, 3)
    mask: Floats  # (64, 64), sums to 1
    rim: Floats  # (64, 64), the mask with its surroundings, sums to 1
    ring: Floats  # (64, 64), around the object, sums to 1
    outline: Floats  # (64, 64, 2), the outline's normal times its strength
    parts: Floats  # (6, 64, 64), each sums to 1 or is empty
    gradient: Floats  # (64, 64, 2)


def reference_of(template: Template) -> Reference:
    """Everything about a demonstration's patch that does not depend on the scene."""
    image, solid = upright(template)
    mask = solid / max(float(solid.sum()), 1e-6)
    wide = np.asarray(cv2.dilate(solid, np.ones((5, 5))), np.float32)
    far = np.asarray(cv2.dilate(solid, np.ones((2 * _RING_PX + 3, 2 * _RING_PX + 3))), np.float32)
    ring = np.clip(far - np.asarray(cv2.dilate(solid, np.ones((3, 3)))), 0, 1)
    slope = np.dstack(slopes(solid))
    return Reference(
        image,
        mask,
        wide / max(float(wide.sum()), 1e-6),
        ring / max(float(ring.sum()), 1e-6),
        slope / max(float(np.hypot(slope[..., 0], slope[..., 1]).sum()), 1e-6),
        _parts(solid),
        _directions(image),
    )


def evidence(
    reference: Reference, scene: Pyramid, fit: Fit, quality: float, angle_rad: float, lead: float
) -> Floats:
    """One number for each of :data:`NAMES`.

    Args:
        reference: the demonstration.
        scene: the frame.
        fit: how the patch lies over it.
        quality: of the network, in [0, 1].
        angle_rad: the turn that the network sees there, modulo a half turn.
        lead: the fit's correlation over that of the best one at another turn.
    """
    seen = as_taught(scene, fit)
    image, mask = reference.image, reference.mask
    mean, taught_mean = means(seen, mask), means(image, mask)
    flat, taught_flat = around(seen, mean), around(image, taught_mean)
    weights = np.concatenate([mask[None], reference.parts]).reshape(1 + _PARTS, -1)
    variances, taught_variances, products = _moments(flat, taught_flat) @ weights.T
    correlations = products / np.sqrt(
        (variances + NOISE_VARIANCE) * (taught_variances + NOISE_VARIANCE)
    )
    variance, taught_variance = float(variances[0]), float(taught_variances[0])
    order = np.argsort(correlations[1:], kind="stable")
    parts = correlations[1:][order]
    shown = reference.parts[order[-_SHOWN_PARTS:]].mean(axis=0)
    gains = np.log((mean + 8) / (taught_mean + 8))
    ring = means(seen, reference.ring)
    odds = np.log(max(quality, 1e-6) / max(1 - quality, 1e-6))
    values = (
        correlations[0],
        _correlation(seen - mean.mean(), image - taught_mean.mean(), mask),
        _edge_agreement(seen, reference),
        _outline_share(seen, reference),
        abs(gains.mean()),
        np.linalg.norm(gains - gains.mean()),
        np.log((variance + NOISE_VARIANCE) / (taught_variance + NOISE_VARIANCE)),
        abs(np.log(fit.scale)),
        parts[:2].mean(),
        np.median(parts),
        parts[-3:].mean(),
        _correlation(around(seen, means(seen, shown)), around(image, means(image, shown)), shown),
        _residual(flat, taught_flat, mask, variance, taught_variance),
        np.abs(ring - mean).max() / 50,
        np.log(taught_variance + NOISE_VARIANCE),
        np.clip(odds, -_LARGEST_LOGIT, _LARGEST_LOGIT),
        abs(np.sin(angle_rad - fit.turn_rad)),
        lead,
    )
    return np.array(values, np.float32)


def _moments(seen: Floats, taught: Floats) -> Floats:
    """Squares and product of two images (h, w, 3), summed over the channels: (3, h w)."""
    pairs = ((seen, seen), (taught, taught), (seen, taught))
    ones = np.ones(seen.shape[2], np.float32)
    return np.stack([(a * b).reshape(-1, len(ones)) @ ones for a, b in pairs])


def _correlation(seen: Floats, taught: Floats, weight: Floats) -> float:
    variance, taught_variance, product = _moments(seen, taught) @ weight.ravel()
    size = (variance + NOISE_VARIANCE) * (taught_variance + NOISE_VARIANCE)
    return float(product / np.sqrt(size))


def _residual(
    seen: Floats, taught: Floats, mask: Floats, variance: float, taught_variance: float
) -> float:
    """Median of the largest channel's difference, in the taught object's standard deviations."""
    inside = mask > 0.5 * mask.max()
    if not inside.any():
        return 0.0
    spread = np.sqrt(taught_variance + NOISE_VARIANCE)
    contrast = np.sqrt(variance + NOISE_VARIANCE) / spread
    difference = np.abs(seen[inside] / contrast - taught[inside]).max(axis=1)
    return float(np.median(difference) / spread)


def _grey(image: Floats) -> Floats:
    return np.asarray(image @ np.full(3, 1 / 3, np.float32))


def _directions(image: Floats) -> Floats:
    """Twice the gradient's angle as (cosine, sine), shorter where the gradient is weak."""
    right, down = slopes(_grey(image))
    size = np.hypot(right, down) + _GRADIENT_NOISE
    double = np.dstack([right * right - down * down, 2 * right * down])
    return np.asarray(double / (size * size)[..., None], dtype=np.float32)


def _edge_agreement(seen: Floats, reference: Reference) -> float:
    here, there, weight = _directions(seen), reference.gradient, reference.rim
    size_here, size_there, both = _moments(here, there) @ weight.ravel()
    return float(both / np.sqrt((size_here + 1e-4) * (size_there + 1e-4)))


def _outline_share(seen: Floats, reference: Reference) -> float:
    right, down = slopes(_grey(seen))
    normal = reference.outline
    across = np.abs(right * normal[..., 0] + down * normal[..., 1])
    strength = np.hypot(normal[..., 0], normal[..., 1])
    return float(
        (across / (np.hypot(right, down) + _GRADIENT_NOISE)).sum() / (strength.sum() + 1e-6)
    )


def _parts(solid: Floats) -> Floats:
    """Six parts of the mask, three along its long axis times both sides of it."""
    y, x = np.nonzero(solid > 0.5)
    parts = np.zeros((_PARTS, *solid.shape), np.float32)
    if len(x) < _PARTS:
        return parts
    points = np.stack([x - x.mean(), y - y.mean()])
    _, axes = np.linalg.eigh(points @ points.T)
    across, along = axes.T @ points  # eigenvalues ascend
    thirds = np.searchsorted(np.quantile(along, (1 / 3, 2 / 3)), along)
    number = 2 * thirds + (across > np.median(across))
    parts[number, y, x] = 1
    return np.asarray(parts / np.maximum(parts.sum(axis=(1, 2), keepdims=True), 1), np.float32)
