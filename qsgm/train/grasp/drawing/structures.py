"""What else is in view without being a thing: a table's edge, a gap, a sheet.

All three are polygons filled with another surface. They lie under everything that is put on the
table afterwards.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.train.grasp.drawing.noise import (
    blur,
    chance,
    dim,
    grainy,
    hsv,
    mean_colour,
    smooth_noise,
)

STRUCTURE_KINDS: tuple[str, ...] = ("edge", "gap", "sheet")

_FRACTION_BITS = 4  # of polygon corners handed to OpenCV
_FAR_PX = 2000.0
_LEAST_DISTANCE_PX = 35.0  # from what lies on the table to the edge of the table

Image = NDArray[np.uint8]
Points = NDArray[np.float64]


def draw_structure(
    rng: np.random.Generator, image: Image, kind: str, spot_px: tuple[float, float]
) -> None:
    """Draws a structure into a table (H, W, 3); ``spot_px`` (x, y) stays on the table.

    A sheet may lie under the spot, an edge or a gap passes it by at least 35 px. Raises QsgmError
    for a kind that is not in STRUCTURE_KINDS.
    """
    if kind not in STRUCTURE_KINDS:
        known = ", ".join(STRUCTURE_KINDS)
        raise QsgmError(f"unknown structure {kind!r}: expected one of {known}")
    if kind == "sheet":
        _draw_sheet(rng, image)
        return
    # Edges of tables are most often upright or level, as cameras and tables are set up.
    turn = float(rng.integers(4) * np.pi / 2 + rng.normal(0, 0.1))
    turn = rng.uniform(0, 2 * np.pi) if chance(rng, 0.5) else turn
    away = rng.uniform(_LEAST_DISTANCE_PX, 250)
    deep = rng.uniform(3, 45) if kind == "gap" else _FAR_PX
    corners = _strip(spot_px, turn, away, away + deep)
    mask = _filled(image.shape[:2], corners, _softness(rng))
    if kind == "edge":
        _draw_floor(rng, image, mask)
    else:
        _draw_gap(rng, image, mask)


def _strip(spot_px: tuple[float, float], turn: float, near: float, far: float) -> Points:
    """Corners (4, 2) of what is ``near`` to ``far`` px away from the spot in one direction."""
    ahead = np.array([np.cos(turn), np.sin(turn)])
    aside = np.array([-ahead[1], ahead[0]]) * _FAR_PX
    middle = np.array(spot_px)
    first, last = middle + near * ahead, middle + far * ahead
    return np.stack([first - aside, first + aside, last + aside, last - aside])


def _softness(rng: np.random.Generator) -> float:
    """Blur [px] of an edge: mostly sharp, sometimes a rounded or distant one."""
    return float(rng.uniform(2, 8)) if chance(rng, 0.3) else 0.0


def _filled(shape: tuple[int, ...], corners: Points, softness: float) -> NDArray[np.float32]:
    """Share (0 to 1) of every pixel that is inside a polygon, its edge softened."""
    mask = np.zeros(shape, np.uint8)
    fixed = np.rint(corners * (1 << _FRACTION_BITS)).astype(np.int32)
    cv2.fillPoly(mask, [fixed], 255, cv2.LINE_AA, _FRACTION_BITS)
    share = mask.astype(np.float32) * np.float32(1 / 255)
    return blur(share, softness) if softness else share


def _draw_floor(rng: np.random.Generator, image: Image, mask: NDArray[np.float32]) -> None:
    """A floor beyond the table's edge, often darker near it."""
    floor = _surface(rng, image)
    if chance(rng, 0.6):
        small = np.asarray(cv2.resize(1 - mask, None, fx=0.25, fy=0.25), np.float32)
        under = blur(small, rng.uniform(1, 6))
        shade = 1 - np.float32(rng.uniform(0.2, 0.8)) * under
        dim(floor, np.asarray(cv2.resize(shade, image.shape[1::-1]), np.float32))
    _cover(image, floor, mask)
    if chance(rng, 0.5):  # the edge's own side, in shadow or catching the light
        border = cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
        dim(image, 1 + np.float32(rng.uniform(-0.7, 0.3)) * np.asarray(border, np.float32))


def _draw_gap(rng: np.random.Generator, image: Image, mask: NDArray[np.float32]) -> None:
    """A gap between two boards or tables, mostly dark."""
    dim(image, 1 - np.float32(rng.uniform(0.5, 0.95)) * mask)


def _draw_sheet(rng: np.random.Generator, image: Image) -> None:
    """A sheet, mat or book with straight sides that lies flat, with a thin shadow."""
    height, width = image.shape[:2]
    half = rng.uniform(30, 200, 2)
    turn = rng.uniform(0, np.pi)
    cos, sin = np.cos(turn), np.sin(turn)
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    corners = corners + rng.normal(0, 4, (4, 2)) * chance(rng, 0.3)
    middle = rng.uniform(0, 1, 2) * (width, height)
    corners = corners @ np.array([[cos, sin], [-sin, cos]]) + middle
    mask = _filled(image.shape[:2], corners, 0.0)
    fall = rng.uniform(-3, 3, 2)
    move = np.array([[1, 0, fall[0]], [0, 1, fall[1]]])
    cast = np.asarray(cv2.warpAffine(mask, move, (width, height)), np.float32)
    dim(image, 1 - np.float32(rng.uniform(0, 0.6)) * blur(cast, 1.5))
    _cover(image, _surface(rng, image), mask)


def _surface(rng: np.random.Generator, image: Image) -> Image:
    """Another surface (H, W, 3): the table's own texture recoloured, or a plain one."""
    colour = np.array(hsv(rng.random(), rng.beta(1, 3), rng.uniform(0.08, 0.95)))
    if chance(rng, 0.5):
        gain = rng.uniform(0.3, 1.5)
        levels = (np.arange(256)[:, None] - np.array(mean_colour(image))) * gain + colour
        lookup = np.clip(np.rint(levels), 0, 255).astype(np.uint8).reshape(1, 256, 3)
        return np.asarray(cv2.LUT(cv2.flip(image, -1), lookup), np.uint8)
    bumps = smooth_noise(rng, (image.shape[0] // 8, image.shape[1] // 8), rng.uniform(1.5, 12))
    shade = np.asarray(cv2.resize(bumps, image.shape[1::-1]), np.float32)
    shade = 1 + np.float32(rng.uniform(0, 0.12)) * shade
    plain = np.empty_like(image)
    plain[:] = np.clip(colour, 0, 255)
    dim(plain, shade)
    return grainy(rng, plain, 4.0)


def _cover(image: Image, surface: Image, mask: NDArray[np.float32]) -> None:
    image[:] = cv2.blendLinear(image, surface, 1 - mask, mask)
