"""Procedurally drawn table tops seen from above: plain, wood, fabric, carpet, stone.

Every table fills the whole image. Nothing here is taken from a photograph.
"""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.train.grasp.drawing.noise import (
    Colour,
    Field,
    Shape,
    blur,
    chance,
    cloud_noise,
    dim,
    drawn_from,
    hsv,
    mixed,
    paint,
    scaled,
    smooth_noise,
    white_noise,
)

Image = NDArray[np.uint8]
Painter = Callable[[np.random.Generator, Shape], Image]

# Hue [turns], saturation and value of the woods; drawn around, never exactly.
_WOODS: tuple[tuple[float, float, float], ...] = (
    (0.075, 0.34, 0.82),  # beech
    (0.090, 0.50, 0.78),  # oak
    (0.085, 0.85, 0.58),  # orange varnish
    (0.035, 0.75, 0.42),  # mahogany
    (0.065, 0.70, 0.30),  # walnut
    (0.060, 0.30, 0.20),  # nearly black
    (0.090, 0.12, 0.55),  # weathered grey
)


def draw_table(rng: np.random.Generator, kind: str, shape: Shape = (480, 640)) -> Image:
    """A table top of the given kind as a BGR image, shape (height, width, 3).

    Raises QsgmError for a kind that is not in TABLE_KINDS.
    """
    if kind not in _PAINTERS:
        raise QsgmError(f"unknown table kind {kind!r}: expected one of {', '.join(TABLE_KINDS)}")
    painter = _PAINTERS[kind]
    draw = rng.random()
    if draw < 0.2:
        return _turned(painter, rng, shape)
    if draw < 0.57:
        upright = painter(rng, (shape[1], shape[0]))
        return np.ascontiguousarray(upright.transpose(1, 0, 2))
    return painter(rng, shape)


def _turned(painter: Painter, rng: np.random.Generator, shape: Shape) -> Image:
    """The table turned by any angle: drawn on a square that covers the frame, then cut."""
    side = int(np.ceil(np.hypot(*shape))) + 4
    square = painter(rng, (side, side))
    matrix = cv2.getRotationMatrix2D((side / 2, side / 2), float(rng.uniform(0, 360)), 1.0)
    matrix[0, 2] += (shape[1] - side) / 2
    matrix[1, 2] += (shape[0] - side) / 2
    turned = cv2.warpAffine(
        square, matrix, (shape[1], shape[0]), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT
    )
    return np.asarray(turned, dtype=np.uint8)


def _surface_colour(rng: np.random.Generator) -> Colour:
    """Mostly light and nearly grey, as table tops are; sometimes dark or colourful."""
    draw = rng.random()
    if draw < 0.65:
        return hsv(rng.uniform(0, 0.17), rng.uniform(0, 0.22), rng.uniform(0.62, 0.93))
    if draw < 0.80:
        return hsv(rng.uniform(0.3, 0.75), rng.uniform(0, 0.15), rng.uniform(0.5, 0.9))
    if draw < 0.93:
        return hsv(rng.random(), rng.uniform(0, 0.3), rng.uniform(0.12, 0.5))
    return hsv(rng.random(), rng.uniform(0.3, 0.85), rng.uniform(0.3, 0.9))


def _spread(colour: Colour, contrast: float) -> tuple[Colour, Colour, Colour]:
    """Three stops around a colour, ``contrast`` (0 to 1) of it darker and lighter."""
    return scaled(colour, 1 - contrast), colour, scaled(colour, 1 + contrast)


def _wood_stops(rng: np.random.Generator) -> tuple[Colour, Colour, Colour]:
    hue, saturation, value = _WOODS[rng.integers(len(_WOODS))]
    hue += rng.normal(0, 0.010)
    saturation *= rng.uniform(0.75, 1.2)
    value *= rng.uniform(0.75, 1.2)
    depth = rng.uniform(0.2, 0.6)
    return (
        hsv(hue - 0.012, saturation * 1.15, value * (1 - depth)),
        hsv(hue, saturation, value),
        hsv(hue + 0.01, saturation * 0.85, value * (1 + 0.6 * depth)),
    )


def _grain(rng: np.random.Generator, shape: Shape) -> Field:
    """Wood grain running along x: fibres, broad bands and flowing growth rings."""
    fibre = smooth_noise(rng, shape, rng.uniform(1.0, 2.0), rng.uniform(20, 120))
    bands = cloud_noise(rng, shape, rng.uniform(15, 60), 3, stretch=rng.uniform(6, 20))
    flow = cloud_noise(rng, shape, rng.uniform(40, 120), 2, stretch=rng.uniform(2, 6))
    rows = np.arange(shape[0], dtype=np.float32)[:, None] / np.float32(rng.uniform(6, 30))
    rings = np.sin((rows + flow * np.float32(rng.uniform(0.5, 2.5))) * np.float32(2 * np.pi))
    weights = rng.dirichlet((1.2, 1.2, 1.0)).astype(np.float32)
    return np.asarray(
        1.5 * (weights[0] * fibre + weights[1] * bands + weights[2] * rings), dtype=np.float32
    )


def _plain(rng: np.random.Generator, shape: Shape) -> Image:
    cloud = cloud_noise(rng, shape, rng.uniform(20, 160), 3)
    speck = white_noise(rng, shape)
    level = 0.5 + rng.uniform(0, 0.25) * cloud + rng.uniform(0, 0.25) * speck
    return paint(level, _spread(_surface_colour(rng), rng.uniform(0.01, 0.06)))


def _gradient(rng: np.random.Generator, shape: Shape) -> Image:
    """A plain table whose colour and brightness drift across the frame."""
    base = _surface_colour(rng)
    far = mixed(scaled(base, rng.uniform(0.65, 1.0)), _surface_colour(rng), rng.uniform(0, 0.25))
    ramp = np.linspace(0, 1, shape[1], dtype=np.float32)[None, :]
    tilt = np.linspace(-0.5, 0.5, shape[0], dtype=np.float32)[:, None]
    level = ramp + np.float32(rng.uniform(-0.6, 0.6)) * tilt
    level = level + 0.05 * cloud_noise(rng, shape, rng.uniform(80, 240), 2)
    level = level + np.float32(rng.uniform(0, 0.04)) * white_noise(rng, shape)
    return paint(np.asarray(level, np.float32), (base, far))


def _board_rows(rng: np.random.Generator, height: int, mean_width: float) -> list[tuple[int, int]]:
    """Top and bottom [px] of boards that fill the height; widths vary a little."""
    edge = -rng.uniform(0, mean_width)
    rows = []
    while edge < height:
        after = edge + mean_width * rng.uniform(0.85, 1.15)
        rows.append((max(0, round(edge)), min(height, round(after))))
        edge = after
    return [row for row in rows if row[1] > row[0]]


def _board_ends(rng: np.random.Generator, width: int, mean_length: float) -> list[int]:
    """Where [px] the boards of one row end, the last at the frame's edge."""
    ends = [round(rng.uniform(0, mean_length))]
    while ends[-1] < width:
        ends.append(ends[-1] + round(mean_length * rng.uniform(0.7, 1.3)))
    ends[-1] = width
    return ends


def _planks(rng: np.random.Generator, shape: Shape) -> Image:
    """Boards along x; each has its own tone and its own stretch of the grain."""
    width = rng.uniform(25, 170)
    length = rng.uniform(3, 14) * width
    seam_depth = rng.choice([0.05, 0.3, 0.6, 0.9], p=[0.2, 0.2, 0.3, 0.3])
    seam_width = rng.uniform(0.5, 3.0)
    slack = 200  # px by which two boards in a row may differ in their cut of the grain
    board_contrast = rng.uniform(0.0, 0.22)
    source = _grain(rng, (shape[0], shape[1] + slack))
    level = np.empty(shape, np.float32)
    seam = np.zeros(shape, np.float32)
    for top, bottom in _board_rows(rng, shape[0], width):
        left = 0
        for right in _board_ends(rng, shape[1], length):
            shift = int(rng.integers(slack))
            part = source[top:bottom, left + shift : right + shift]
            part = part[::-1] if chance(rng, 0.5) else part
            level[top:bottom, left:right] = part + np.float32(rng.normal(0, board_contrast / 0.22))
            cv2.line(seam, (right, top), (right, bottom), 1.0, 1)
            left = right
        cv2.line(seam, (0, bottom), (shape[1], bottom), 1.0, max(1, round(seam_width)))
    image = paint(0.5 + np.float32(rng.uniform(0.06, 0.22)) * level, _wood_stops(rng))
    return _darkened(image, blur(seam, 0.4 + 0.2 * seam_width) * np.float32(seam_depth))


def _darkened(image: Image, amount: Field) -> Image:
    """The image, each of its pixels dimmed by ``amount`` (0 to 1)."""
    dim(image, np.clip(1 - amount, 0, 1).astype(np.float32))
    return image


def _veneer(rng: np.random.Generator, shape: Shape) -> Image:
    """One sheet of wood: grain with dark flecks and cloudy stain, no seams."""
    stain = cloud_noise(rng, shape, rng.uniform(30, 120), 4, stretch=rng.uniform(1, 3))
    fleck = np.maximum(smooth_noise(rng, shape, rng.uniform(2, 4), rng.uniform(8, 40)) - 0.8, 0)
    share = np.float32(rng.uniform(0, 1))
    level = share * stain + (1 - share) * _grain(rng, shape) - np.float32(rng.uniform(0, 1)) * fleck
    return paint(np.asarray(0.5 + rng.uniform(0.06, 0.2) * level, np.float32), _wood_stops(rng))


def _parquet(rng: np.random.Generator, shape: Shape) -> Image:
    """Squares of wood whose grain runs by turns along x and along y, with thin dark joints."""
    side = int(rng.integers(50, 240))
    along = _grain(rng, shape)
    across = _grain(rng, shape[::-1]).T
    strips = int(rng.choice([1, 1, 3, 4, 5]))
    level = np.empty(shape, np.float32)
    seam = np.zeros(shape, np.float32)
    start_y, start_x = -int(rng.integers(side)), -int(rng.integers(side))
    for row, top in enumerate(range(start_y, shape[0], side)):
        for column, left in enumerate(range(start_x, shape[1], side)):
            box = (max(top, 0), min(top + side, shape[0]), max(left, 0), min(left + side, shape[1]))
            upright = (row + column) % 2 == 0
            source = across if upright else along
            piece = source[box[0] : box[1], box[2] : box[3]]
            tone = rng.normal(0, 0.6, strips).astype(np.float32)
            line = tone[np.arange(side) * strips // side]
            cut = line[box[2] - left : box[3] - left][None, :]
            if not upright:
                cut = line[box[0] - top : box[1] - top][:, None]
            level[box[0] : box[1], box[2] : box[3]] = piece + cut
            cv2.rectangle(seam, (left, top), (left + side, top + side), 1.0, 1)
    image = paint(0.5 + np.float32(rng.uniform(0.08, 0.2)) * level, _wood_stops(rng))
    depth = np.float32(rng.uniform(0.3, 1.3))
    return _darkened(image, blur(seam, rng.uniform(0.5, 0.9)) * depth)


def _waves(rng: np.random.Generator, shape: Shape, period: float, wobble: float) -> Field:
    """Ribs along y that repeat every ``period`` px across x and wander by ``wobble`` periods."""
    columns = np.arange(shape[1], dtype=np.float32)[None, :] / np.float32(period)
    bend = smooth_noise(rng, shape, rng.uniform(5, 60), rng.uniform(8, 60)) * np.float32(wobble)
    return np.asarray(np.sin((columns + bend) * np.float32(2 * np.pi)), dtype=np.float32)


def _fabric(rng: np.random.Generator, shape: Shape) -> Image:
    """Knitted ribs, a plain weave or slubby linen."""
    period = rng.uniform(3, 12)
    style = rng.integers(3)
    if style == 0:
        level = _waves(rng, shape, period, rng.uniform(0.02, 0.15))
        level = level + smooth_noise(rng, shape, 2.5, 2.5)
    elif style == 1:
        turned = _waves(rng, (shape[1], shape[0]), period * rng.uniform(0.7, 1.4), 0.05).T
        level = _waves(rng, shape, period, 0.05) * turned * np.float32(1.5)
        level = level + 0.5 * white_noise(rng, shape)
    else:
        level = smooth_noise(rng, shape, 1.5, 40) + smooth_noise(rng, shape, 40, 1.5)
    level = np.asarray(level + 0.4 * cloud_noise(rng, shape, 60, 3), np.float32)
    return paint(
        np.asarray(0.5 + 0.2 * level, np.float32),
        _spread(_surface_colour(rng), rng.uniform(0.05, 0.4)),
    )


def _carpet(rng: np.random.Generator, shape: Shape) -> Image:
    """Fine strong noise: curled pale fibres over dark gaps, or plain speckle."""
    cell = rng.uniform(1.0, 2.4)
    fibre = smooth_noise(rng, shape, cell)
    curl = np.float32(0.9) - np.abs(smooth_noise(rng, shape, cell * rng.uniform(1.3, 2.2))) * 1.6
    share = np.float32(rng.uniform(0, 1))
    level = share * fibre + (1 - share) * curl + 0.15 * cloud_noise(rng, shape, 60, 2)
    colour = hsv(rng.random(), rng.uniform(0, 0.12), rng.uniform(0.2, 0.75))
    if chance(rng, 0.25):
        colour = _surface_colour(rng)
    level = np.asarray(0.5 + 0.28 * level, np.float32)
    return paint(level, _spread(colour, rng.uniform(0.2, 0.9)))


def _marble(rng: np.random.Generator, shape: Shape) -> Image:
    """Cloudy stone with thin veins along the zero lines of a rough field."""
    cloud = cloud_noise(rng, shape, rng.uniform(40, 120), 4)
    cell = rng.uniform(40, 160)
    lines = np.abs(cloud_noise(rng, shape, cell, 5, 0.6))
    patches = np.clip(smooth_noise(rng, shape, cell) + rng.uniform(0, 0.8), 0, 1)
    vein = np.clip(1 - lines / np.float32(rng.uniform(0.04, 0.3)), 0, 1) * patches
    light, dark = _surface_colour(rng), _surface_colour(rng)
    base = paint(0.5 + 0.25 * cloud, _spread(light, rng.uniform(0.01, 0.10)))
    stain = mixed(scaled(light, rng.uniform(0.5, 0.9)), dark, rng.uniform(0, 0.4))
    share = np.asarray(vein * np.float32(rng.uniform(0.15, 0.8)), dtype=np.float32)
    stained = np.broadcast_to(np.array(stain).astype(np.uint8), base.shape)
    result = cv2.blendLinear(base, np.ascontiguousarray(stained), 1 - share, share)
    return np.asarray(result, dtype=np.uint8)


def _concrete(rng: np.random.Generator, shape: Shape) -> Image:
    """Blotches at several scales and some fine grit."""
    level = cloud_noise(rng, shape, rng.uniform(30, 160), 6, rng.uniform(0.5, 0.8))
    level = level + np.float32(rng.uniform(0, 0.5)) * white_noise(rng, shape)
    colour = _surface_colour(rng)
    if chance(rng, 0.6):
        colour = hsv(rng.uniform(0.1, 0.6), rng.uniform(0, 0.1), rng.uniform(0.3, 0.85))
    return paint(
        np.asarray(0.5 + 0.2 * level, np.float32), _spread(colour, rng.uniform(0.04, 0.22))
    )


def _cloth(rng: np.random.Generator, shape: Shape) -> Image:
    """Printed stripes or checks: strong straight lines that are not the object."""
    period = int(rng.integers(8, 70))
    columns = (np.arange(shape[1]) % period < period * rng.uniform(0.2, 0.6)).astype(np.float32)
    level = np.broadcast_to(columns, shape)
    if chance(rng, 0.5):
        rows = (np.arange(shape[0]) % period < period * 0.4).astype(np.float32)
        level = 0.5 * level + 0.5 * rows[:, None]
    level = level + 0.1 * white_noise(rng, shape)
    first = _surface_colour(rng)
    second = mixed(first, _surface_colour(rng), rng.uniform(0.2, 0.9))
    return paint(blur(np.ascontiguousarray(level, np.float32), 0.7), (first, second))


_PAINTERS: dict[str, Painter] = {
    "plain": _plain,
    "gradient": _gradient,
    "planks": _planks,
    "veneer": _veneer,
    "parquet": _parquet,
    "fabric": _fabric,
    "carpet": _carpet,
    "marble": _marble,
    "concrete": _concrete,
    "cloth": _cloth,
}
TABLE_KINDS: tuple[str, ...] = tuple(_PAINTERS)
_TABLE_WEIGHTS = {"plain": 1.3, "gradient": 1.6, "planks": 2.2, "carpet": 1.2, "cloth": 0.4}


def chosen_table(rng: np.random.Generator, kind: str | None) -> str:
    """The kind asked for, or one at random."""
    if kind is not None:
        return kind
    return drawn_from(rng, TABLE_KINDS, _TABLE_WEIGHTS)
