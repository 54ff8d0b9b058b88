"""What speaks for and against a candidate being the taught object.

The scene is turned, scaled and moved so that the candidate lies as the demonstration does; then the
two are compared at half of the resolution. No single number tells an object from its like on
another table, in other light, partly hidden: :data:`NAMES` lists those that together do, and a
:class:`qsgm.grasp.decision.Decision` weighs them. Each was kept because drawn scenes never used in
the fit are told apart worse without it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log, sqrt

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.alignment import slopes
from qsgm.grasp.cells import Cells, Look
from qsgm.grasp.colours import Colours, medians
from qsgm.grasp.correlation import NOISE_VARIANCE
from qsgm.grasp.outline import Outline, contrasts, likeness

Floats = NDArray[np.float32]

NAMES = (
    "correlation",  # of the cells that agree, as one image
    "agreement_low",  # of the cells' own correlations, textured ones first: reached by 70 %
    "agreement_middle",  # and by a half
    "texture",  # how much there is to agree on, 0 to 1
    "deviation",  # colour of a cell's mean, once the light is made the same: 70 % are below
    "edge_agreement",  # directions of the brightness gradient, sign ignored
    "outline",  # share of the gradient at the outline that stands across it
    "edge_low",  # contrast across the outline: what nine tenths of it reach, log of levels
    "edge_quarter",  # three quarters
    "edge_middle",  # a half
    "inside",  # correlation of the colours just inside the outline
    "spread",  # log of the variance, seen over taught
    "contrast_gain",  # log of how much stronger the object's contrast is, where cells agree
    "residual",  # median colour difference once brightness and contrast are fitted
    "surroundings",  # how much the object differs from what lies around it
    "tint",  # how far apart the three channels' gains are
    "hue",  # how far the median hue is off
    "palette",  # what the histograms of hue and saturation share
    "detail",  # log of the taught object's own variance
    "scale",  # |log|
    "quality_logit",  # what the tuned network says
    "lead",  # over the other way round
)
_GRADIENT_NOISE = np.float32(4.0)  # levels
_GREY = np.full(3, 1 / 3, np.float32)
_TINY = 1e-4
_EDGES_AT = np.array([0.1, 0.25, 0.5])
# Of squares that the mask grows by: for its rim, out to the ring around it, and in to that ring.
_RIM_PX, _OUTER_PX, _INNER_PX = 5, 13, 3
_LARGEST_LOGIT = 8.0
# A cell with less of the object than that share of the fullest one's says nothing.
_LEAST_CELL = 0.25
# How much edges count beside the score when one pose of a place is preferred to another: fitted on
# drawn scenes, where right poses are the preferred ones in 87 of 100 instead of 83.
_EDGES_COUNT, _OUTLINE_COUNTS = 0.6, 1.75


@dataclass(frozen=True)
class Reference:
    """The demonstration's side of every comparison, at half of the resolution."""

    cells: Cells
    rim: Floats  # (64, 64), the mask with its surroundings, sums to 1
    ring: Floats  # (64, 64), around the object, sums to 1
    normal: Floats  # (2, 4096), the outline's normal times its strength, which sums to 1
    gradient: Floats  # (2, 4096), see :func:`_directions`
    inside: NDArray[np.bool_]  # (64, 64), never empty
    outline: Outline
    rim_colours: Floats  # (N, 3), just inside the outline
    colours: Colours
    mean: Floats  # (3,) of the object
    variance: float  # of it, all channels together, noise included

    @cached_property
    def _places(self) -> NDArray[np.intp]:
        """Of the pixels inside, in reading order."""
        return np.flatnonzero(self.inside)

    def pixels(self, image: Floats) -> Floats:
        """Colours (3, M) of an image's pixels inside."""
        return np.ascontiguousarray(image.reshape(-1, 3)[self._places].T)

    @cached_property
    def taught_pixels(self) -> Floats:
        """Colours (3, M) inside, each channel around its mean."""
        return np.asarray(self.pixels(self.cells.image) - self.mean[:, None], dtype=np.float32)

    @cached_property
    def rim_gradient(self) -> Floats:
        """The gradient (2, 4096) as the rim counts."""
        return self.gradient * self.rim.ravel()

    @cached_property
    def edginess(self) -> float:
        """The gradient's mean square on the rim."""
        return float((self.rim_gradient * self.gradient).sum()) + _TINY


@dataclass(frozen=True)
class Edges:
    """Whether there are edges where they belong."""

    agreement: float  # of the gradient's directions, sign ignored
    outline: float  # share of the gradient at the outline that stands across it


def reference_of(cells: Cells) -> Reference:
    """Everything about a demonstration that does not depend on the scene."""
    solid, image = cells.solid, cells.image
    wide, far, close = (_dilated(solid, side) for side in (_RIM_PX, _OUTER_PX, _INNER_PX))
    right, down = slopes(solid)
    normal = np.stack([right.ravel(), down.ravel()])
    mean, variance = _spread(cells.share, cells.mean, cells.variance)
    inside = solid >= min(0.5, float(solid.max()))
    outline = Outline.of(solid)
    return Reference(
        cells,
        _normalised(wide),
        _normalised(np.clip(far - close, 0, 1)),
        normal / max(float(np.hypot(right, down).sum()), 1e-6),
        _directions(image),
        inside,
        outline,
        outline.sides(image)[0],
        Colours.of(image[inside]),
        mean,
        variance,
    )


def evidence(
    reference: Reference,
    look: Look,
    scale: float,
    quality: float,
    lead: float,
    edges: Edges | None = None,
) -> Floats:
    """One number for each of :data:`NAMES`.

    Args:
        reference: the demonstration.
        look: how it compares with the scene where it fits best.
        scale: of that fit.
        quality: of the network, in [0, 1].
        lead: the fit's score over that of the other way round.
        edges: of that look; None: they are not known yet.
    """
    pixels = reference.pixels(look.seen)
    edges = edges or edges_of(reference, look)
    odds = np.log(max(quality, 1e-6) / max(1 - quality, 1e-6))
    values = (
        *_of_cells(look),
        edges.agreement,
        edges.outline,
        *_of_outline(look.seen, reference),
        *_of_contrast(look, pixels, reference),
        *_of_colours(pixels, reference),
        abs(np.log(scale)),
        np.clip(odds, -_LARGEST_LOGIT, _LARGEST_LOGIT),
        lead,
    )
    return np.array(values, np.float32)


def firmness(look: Look, edges: Edges) -> float:
    """How firmly a pose holds, to prefer one to another: its score, and edges where they belong."""
    return look.score + _EDGES_COUNT * edges.agreement + _OUTLINE_COUNTS * edges.outline


def edges_of(reference: Reference, look: Look) -> Edges:
    """Edges of what is seen, next to those of the demonstration."""
    right, down, length = _gradient(look.seen)
    shorter = 1 / (length + _GRADIENT_NOISE)
    across, along = reference.rim_gradient, shorter * shorter
    together = (right * right - down * down) * across[0]
    together += (2 * right * down) * across[1]
    strength = (length * shorter) ** 2
    own = float((strength * strength) @ reference.rim.ravel()) + _TINY
    over = np.abs(right * reference.normal[0] + down * reference.normal[1])
    return Edges(float(together @ along) / sqrt(own * reference.edginess), float(over @ shorter))


def _of_cells(look: Look) -> tuple[float, ...]:
    """Correlation, agreement low and middle, texture, deviation."""
    cells = look.cells
    whole = look.trusted
    live = np.where(cells.share > _LEAST_CELL * cells.share.max(), cells.share, np.float32(0))
    low, middle = _quantiles(look.agreement, live * cells.texture, (0.3, 0.5))
    expected = (cells.mean - whole.taught_mean) * np.float32(whole.gain) + whole.mean
    off = np.abs(look.mean - expected).max(axis=1)
    (deviation,) = _quantiles(off, live, (0.7,))
    return (
        whole.correlation,
        low,
        middle,
        float(cells.share @ cells.texture),
        float(np.log1p(deviation / max(whole.gain, 0.2))),
    )


def _of_outline(seen: Floats, reference: Reference) -> tuple[float, ...]:
    """What a tenth, a quarter and a half of the edges do not reach, and the colours inside."""
    inner, outer = reference.outline.sides(seen)
    edges = np.sort(contrasts(inner, outer))
    at = np.interp(_EDGES_AT * (len(edges) - 1), np.arange(len(edges)), edges)
    return (*np.log1p(at).tolist(), likeness(inner, reference.rim_colours))


def _of_contrast(look: Look, pixels: Floats, reference: Reference) -> tuple[float, ...]:
    """Spread, contrast gain, residual and surroundings."""
    mean, variance = _spread(look.cells.share, look.mean, look.variance)
    light = np.float32(sqrt(reference.variance) / sqrt(variance))
    left = (pixels - mean[:, None]) * light
    left -= reference.taught_pixels
    off = np.abs(left, out=left).max(axis=0)
    around = _weighed(look.seen, reference.ring)
    return (
        log(variance / reference.variance),
        log(max(look.trusted.gain, 0.05)),
        float(medians(off[None])[0]) / sqrt(reference.variance),
        float(np.abs(around - mean).max()) / 50,
    )


def _of_colours(pixels: Floats, reference: Reference) -> tuple[float, ...]:
    """Tint, hue, palette and the taught object's detail."""
    colours, taught = Colours.of(pixels.T), reference.colours
    return (
        colours.tint(taught),
        colours.shift(taught),
        colours.overlap(taught),
        log(reference.variance),
    )


def _spread(share: Floats, mean: Floats, variance: Floats) -> tuple[Floats, float]:
    """Mean (3,) and variance, noise included, of all cells' pixels."""
    middle = share @ mean
    square = float(share @ (variance + (mean * mean).sum(axis=1)))
    return middle, max(square - float(middle @ middle), 0.0) + NOISE_VARIANCE


def _quantiles(values: Floats, weight: Floats, at: Sequence[float]) -> list[float]:
    """Weighted quantiles of values (C,)."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(weight[order], dtype=np.float64) / max(float(weight.sum()), 1e-9)
    found: list[float] = np.interp(at, below, values[order]).tolist()
    return found


def _dilated(solid: Floats, side: int) -> Floats:
    return np.asarray(cv2.dilate(solid, np.ones((side, side))), dtype=np.float32)


def _normalised(weight: Floats) -> Floats:
    return np.asarray(weight / max(float(weight.sum()), 1e-6), dtype=np.float32)


def _weighed(image: Floats, weight: Floats) -> Floats:
    """Sums (3,) of an image (h, w, 3) times a weight (h, w)."""
    return np.asarray(weight.ravel() @ image.reshape(-1, 3), dtype=np.float32)


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
