"""Random fields and colours that the drawn tables and objects are made of.

Fields are float32 arrays of shape (height, width) with mean about 0 and standard deviation
about 1 unless said otherwise; lengths are pixels; colours are BGR, 0 to 255.
"""

import colorsys
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]
Colour = tuple[float, float, float]
Shape = tuple[int, int]
_BYTE_DEVIATION = 73.9  # of a uniform byte


def white_noise(rng: np.random.Generator, shape: tuple[int, ...]) -> Field:
    """Independent values of any shape (uniform, unit deviation).

    Drawn as bytes because a normal value for each pixel would take longer than all the rest.
    """
    raw = np.frombuffer(rng.bytes(int(np.prod(shape))), dtype=np.uint8).reshape(shape)
    return ((raw.astype(np.float32) - 127.5) * (1 / _BYTE_DEVIATION)).astype(np.float32)


def smooth_noise(
    rng: np.random.Generator, shape: Shape, cell_y: float, cell_x: float | None = None
) -> Field:
    """Smooth bumps about ``cell_y`` high and ``cell_x`` (as high, if left out) wide."""
    cell_x = cell_x or cell_y
    grid = white_noise(rng, (int(shape[0] / cell_y) + 2, int(shape[1] / cell_x) + 2))
    grid *= np.float32(1.3)
    # A coarse field is curved at a quarter of the size first: the slow cubic step is then short.
    height = shape[0] // 4 if cell_y >= 12 else shape[0]
    width = shape[1] // 4 if cell_x >= 12 else shape[1]
    grown = cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
    if (height, width) != shape:
        grown = cv2.resize(grown, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(grown, dtype=np.float32)


def cloud_noise(
    rng: np.random.Generator,
    shape: Shape,
    cell: float,
    octaves: int = 4,
    roughness: float = 0.55,
    stretch: float = 1.0,
) -> Field:
    """Octaves of :func:`smooth_noise`, each half as large and ``roughness`` as strong.

    ``stretch`` makes every bump that many times wider than high.
    """
    total = np.zeros(shape, np.float32)
    weight, power = 1.0, 0.0
    for _ in range(octaves):
        total += np.float32(weight) * smooth_noise(rng, shape, cell, cell * stretch)
        power += weight * weight
        weight *= roughness
        cell = max(cell / 2, 1.0)
    return total * np.float32(1 / np.sqrt(power))


def blur(field: Field, sigma: float) -> Field:
    """Gaussian blur with deviation ``sigma`` [px]."""
    return np.asarray(cv2.GaussianBlur(field, (0, 0), sigma), dtype=np.float32)


def grainy(rng: np.random.Generator, image: NDArray[np.uint8], mean: float) -> NDArray[np.uint8]:
    """An image with a sensor's grain, whose strength [levels] is ``mean`` on average."""
    grain = np.frombuffer(rng.bytes(image.size), np.uint8).reshape(image.shape)
    share = rng.exponential(mean) / _BYTE_DEVIATION
    return np.asarray(cv2.addWeighted(image, 1.0, grain, share, -127.5 * share), np.uint8)


def dim(image: NDArray[np.uint8], light: Field) -> None:
    """Multiplies each pixel of an image (H, W, 3) by a factor (H, W), in place."""
    cv2.multiply(image, cv2.merge([light, light, light]), image, dtype=cv2.CV_8U)


def cast_shadow(covered: Field, away: NDArray[np.float64]) -> Field:
    """What (H, W) the shadow of a covered area falls on; its tip lies ``away`` (x, y) [px].

    An upright side throws a shadow all the way to the foot.
    """
    size, cast = covered.shape[::-1], np.zeros_like(covered)
    for share in (0.35, 0.7, 1.0):
        matrix = np.array([[1, 0, away[0] * share], [0, 1, away[1] * share]], np.float64)
        cast = np.maximum(cast, np.asarray(cv2.warpAffine(covered, matrix, size)))
    return np.asarray(cast, np.float32)


def paint(field: Field, stops: Sequence[Colour]) -> NDArray[np.uint8]:
    """A field of 0 to 1 (values outside are clipped) painted with evenly spaced colour stops.

    Returns a BGR image, shape (height, width, 3).
    """
    index = np.linspace(0, len(stops) - 1, 256)
    table = np.stack(
        [np.interp(index, np.arange(len(stops)), [s[c] for s in stops]) for c in range(3)], axis=-1
    )
    level = np.asarray(cv2.convertScaleAbs(cv2.max(field, 0.0), alpha=255.0))  # type: ignore[call-overload]
    grown = np.asarray(cv2.merge([level, level, level]))
    lookup = np.clip(np.rint(table), 0, 255).astype(np.uint8).reshape(1, 256, 3)
    return np.asarray(cv2.LUT(grown, lookup), dtype=np.uint8)


def hsv(hue: float, saturation: float, value: float) -> Colour:
    """Colour from hue [turns] and saturation and value [0 to 1]."""
    red, green, blue = colorsys.hsv_to_rgb(
        hue % 1.0, min(max(saturation, 0.0), 1.0), min(max(value, 0.0), 1.0)
    )
    return 255 * blue, 255 * green, 255 * red


def scaled(colour: Colour, factor: float) -> Colour:
    """The colour ``factor`` times as bright, clipped to 255."""
    return (
        min(colour[0] * factor, 255.0),
        min(colour[1] * factor, 255.0),
        min(colour[2] * factor, 255.0),
    )


def mixed(first: Colour, second: Colour, share: float) -> Colour:
    """``first`` with ``share`` (0 to 1) of it replaced by ``second``."""
    keep = 1 - share
    return (
        first[0] * keep + second[0] * share,
        first[1] * keep + second[1] * share,
        first[2] * keep + second[2] * share,
    )


def chance(rng: np.random.Generator, probability: float) -> bool:
    """True with the given probability."""
    return bool(rng.random() < probability)


def drawn_from(rng: np.random.Generator, kinds: Sequence[str], weights: Mapping[str, float]) -> str:
    """One of the kinds; one without a weight counts 1."""
    share = np.array([weights.get(kind, 1.0) for kind in kinds])
    return kinds[rng.choice(len(kinds), p=share / share.sum())]


def mean_colour(image: NDArray[np.uint8]) -> Colour:
    """Mean colour of a BGR image, of every 16th pixel each way."""
    blue, green, red = image[::16, ::16].reshape(-1, 3).mean(axis=0).tolist()
    return blue, green, red
