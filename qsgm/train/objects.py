"""Drawn training frames: one household object lying on a table, seen by a camera above.

Nothing is copied from a photograph: tables, objects, shadows and the camera's faults are all
drawn from random numbers, so the same generator state gives the same frame.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.angles import wrap_half_turn
from qsgm.errors import QsgmError
from qsgm.train.drawing.noise import Colour, Field, blur, chance, smooth_noise
from qsgm.train.drawing.parts import Brush
from qsgm.train.drawing.render import Light, Sprite, fitted, render
from qsgm.train.drawing.shapes import COMPACT, ELONGATED
from qsgm.train.drawing.tables import TABLE_KINDS, draw_table

__all__ = ["OBJECT_KINDS", "TABLE_KINDS", "DrawnFrame", "draw_frame"]

FRAME_SHAPE = (480, 640)
OBJECT_KINDS: tuple[str, ...] = (*ELONGATED, *COMPACT)

_ELONGATED_SHARE = 0.85
_LEAST_ELONGATION = 1.42  # of the drawn outline; leaves room for the pixels' rounding to 1.35
_LEAST_CONTRAST = 14.0  # levels of 255, before the exposure; below it nobody could tell
_TRIES = 4
_PATCH = 256  # px; side of the square around the centre that holds the object and its shadow
_OBJECT_WEIGHTS = {
    "bottle": 3.0,
    "can": 2.0,
    "carton": 2.2,
    "bag": 2.2,
    "bent": 1.3,
    "tapered": 1.3,
    "composite": 1.8,
    "handle_tool": 1.6,
    "ring": 0.4,
}
_TABLE_WEIGHTS = {"plain": 1.3, "gradient": 1.6, "planks": 2.2, "carpet": 1.2, "cloth": 0.4}


@dataclass(frozen=True)
class DrawnFrame:
    """A drawn camera frame and the truth about the object in it."""

    image: NDArray[np.uint8]
    """The frame, shape (480, 640, 3), BGR."""
    mask: NDArray[np.bool_]
    """Shape (480, 640), True on the object but not on its shadow."""
    axis_rad: float
    """Direction of the mask's principal axis in (-π/2, π/2], counter-clockwise positive as seen
    in the image: above 0 when the long axis rises to the right."""
    elongation: float
    """Long over short side of the mask's minimum-area rectangle, at least 1."""
    object_kind: str
    table_kind: str


def draw_frame(
    rng: np.random.Generator,
    *,
    object_kind: str | None = None,
    table_kind: str | None = None,
    elongated: bool | None = None,
) -> DrawnFrame:
    """Draws one frame; the object's minimum-area rectangle is centred on pixel (320, 240).

    Left out, the kinds are drawn at random: 85 % of objects are elongated (at least 1.35),
    the others round or square. ``elongated`` picks the one or the other; it has no effect
    where ``object_kind`` is given. Raises QsgmError for a kind that does not exist.
    """
    object_kind = _chosen_object(rng, object_kind, elongated)
    table_kind = _chosen_table(rng, table_kind)
    table = draw_table(rng, table_kind, FRAME_SHAPE)
    light = _random_light(rng)
    sprite = _random_sprite(rng, object_kind, _mean_colour(table), light)
    # Pixels, not outlines, decide where the rectangle's centre is: it is moved there whole.
    rect = _rectangle(sprite.coverage >= 0.5)
    corner = (round(320 - rect[0][0]), round(240 - rect[0][1]))
    image = _composed(rng, table, sprite, corner, light)
    image = _seen_by_camera(rng, image, light)
    mask = np.zeros(FRAME_SHAPE, np.bool_)
    side = len(sprite.coverage)
    mask[corner[1] : corner[1] + side, corner[0] : corner[0] + side] = sprite.coverage >= 0.5
    long_side, short_side = max(rect[1]), min(rect[1])
    return DrawnFrame(
        image=image,
        mask=mask,
        axis_rad=_principal_axis(sprite.coverage >= 0.5),
        elongation=long_side / max(short_side, 1.0),
        object_kind=object_kind,
        table_kind=table_kind,
    )


def _chosen_object(rng: np.random.Generator, kind: str | None, elongated: bool | None) -> str:
    if kind is None:
        if elongated is None:
            elongated = chance(rng, _ELONGATED_SHARE)
        return _drawn_from(rng, tuple(ELONGATED if elongated else COMPACT), _OBJECT_WEIGHTS)
    if kind not in OBJECT_KINDS:
        raise QsgmError(f"unknown object kind {kind!r}: expected one of {', '.join(OBJECT_KINDS)}")
    return kind


def _chosen_table(rng: np.random.Generator, kind: str | None) -> str:
    if kind is not None:
        return kind
    return _drawn_from(rng, TABLE_KINDS, _TABLE_WEIGHTS)


def _drawn_from(rng: np.random.Generator, kinds: tuple[str, ...], weights: dict[str, float]) -> str:
    """One of the kinds; one without a weight counts 1."""
    share = np.array([weights.get(kind, 1.0) for kind in kinds])
    return kinds[rng.choice(len(kinds), p=share / share.sum())]


def _mean_colour(image: NDArray[np.uint8]) -> Colour:
    blue, green, red = image[::16, ::16].reshape(-1, 3).mean(axis=0).tolist()
    return blue, green, red


def _random_light(rng: np.random.Generator) -> Light:
    """A light from any side, 30 to 75 degrees above the table."""
    around = rng.uniform(0, 2 * np.pi)
    above = np.deg2rad(rng.uniform(30, 75))
    flat = np.cos(above)
    return Light(float(flat * np.cos(around)), float(flat * np.sin(around)), float(np.sin(above)))


def _random_sprite(rng: np.random.Generator, kind: str, table: Colour, light: Light) -> Sprite:
    """The object at a random size and direction; short side from 6 px to square."""
    builder, least = (ELONGATED, _LEAST_ELONGATION) if kind in ELONGATED else (COMPACT, 1.0)
    long_px = rng.uniform(70, 105) if chance(rng, 0.8) else rng.uniform(55, 115)
    for _ in range(_TRIES):
        shape = fitted(builder[kind](rng, Brush(rng, table)), long_px, least, 6.5)
        sprite = render(shape, rng.uniform(0, 2 * np.pi), light, rng)
        if _contrast(sprite, table) > _LEAST_CONTRAST:
            break
    return sprite


def _contrast(sprite: Sprite, table: Colour) -> float:
    """Mean difference [levels] between the object and the table it hides."""
    hidden = sprite.opacity[..., None] * np.array(table, np.float32)
    area = np.maximum(sprite.coverage.sum(), 1.0)
    return float(np.abs(sprite.colour - hidden).max(axis=-1).sum() / area)


def _rectangle(mask: NDArray[np.bool_]) -> tuple[tuple[float, float], tuple[float, float]]:
    """Centre (x, y) and side lengths [px] of a mask's minimum-area rectangle."""
    points = cv2.findNonZero(mask.astype(np.uint8))
    centre, size, _ = cv2.minAreaRect(points)
    return (float(centre[0]), float(centre[1])), (float(size[0]), float(size[1]))


def _principal_axis(mask: NDArray[np.bool_]) -> float:
    """Direction [rad] of a mask's principal axis, counter-clockwise positive as seen."""
    moments = cv2.moments(mask.astype(np.uint8), binaryImage=True)
    down = 0.5 * np.arctan2(2 * moments["mu11"], moments["mu20"] - moments["mu02"])
    return float(wrap_half_turn(np.array([-down]))[0])  # rows count downwards


def _composed(
    rng: np.random.Generator,
    table: NDArray[np.uint8],
    sprite: Sprite,
    corner: tuple[int, int],
    light: Light,
) -> NDArray[np.uint8]:
    """The table with the object's shadow and the object; ``corner`` is the sprite's [px]."""
    left, top = 320 - _PATCH // 2, 240 - _PATCH // 2
    place = (
        slice(corner[1] - top, corner[1] - top + len(sprite.coverage)),
        slice(corner[0] - left, corner[0] - left + len(sprite.coverage)),
    )
    patch = table[top : top + _PATCH, left : left + _PATCH].astype(np.float32)
    covered = np.zeros((_PATCH, _PATCH), np.float32)
    covered[place] = sprite.opacity
    patch *= _shadow(rng, covered, light)[..., None]
    patch[place] = patch[place] * (1 - sprite.opacity[..., None]) + sprite.colour
    result = table.copy()
    result[top : top + _PATCH, left : left + _PATCH] = np.clip(patch, 0, 255).astype(np.uint8)
    return result


def _shadow(rng: np.random.Generator, covered: Field, light: Light) -> Field:
    """How much light (0 to 1) is left on the table: a contact shadow and a cast one."""
    contact = blur(covered, rng.uniform(1.0, 3.0)) * np.float32(rng.uniform(0, 0.6))
    height = rng.uniform(1, 12)  # px; of the object above the table
    away = -height / light.z * np.array([light.x, light.y])
    cast = np.zeros_like(covered)
    for share in (0.35, 0.7, 1.0):  # an upright side throws a shadow all the way to the foot
        matrix = np.array([[1, 0, away[0] * share], [0, 1, away[1] * share]], np.float64)
        cast = np.maximum(cast, np.asarray(cv2.warpAffine(covered, matrix, (_PATCH, _PATCH))))
    cast = blur(cast.astype(np.float32), rng.uniform(0.8, 7.0)) * np.float32(rng.uniform(0, 0.75))
    return np.asarray((1 - contact) * (1 - cast), dtype=np.float32)


def _seen_by_camera(
    rng: np.random.Generator, image: NDArray[np.uint8], light: Light
) -> NDArray[np.uint8]:
    """Uneven light, exposure, white balance, blur, sensor noise and sometimes JPEG."""
    gain = _light_field(rng, light)
    tint = 1 + np.clip(rng.normal(0, 0.04, 3), -0.1, 0.1)
    gains = cv2.merge([gain * np.float32(channel) for channel in tint])
    seen = cv2.multiply(image, gains, dtype=cv2.CV_8U)
    if chance(rng, 0.6):
        seen = cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.3, 1.0))
    if chance(rng, 0.8):
        grain = np.frombuffer(rng.bytes(image.size), np.uint8).reshape(image.shape)
        share = rng.exponential(2.0) / 73.9  # 73.9 is the deviation of a uniform byte
        seen = cv2.addWeighted(seen, 1.0, grain, share, -127.5 * share)
    if chance(rng, 0.2):
        quality = int(rng.integers(50, 96))
        packed = cv2.imencode(".jpg", seen, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)
    return np.asarray(seen, dtype=np.uint8)


def _light_field(rng: np.random.Generator, light: Light) -> Field:
    """Brightness over the frame, shape FRAME_SHAPE: slope, vignette, blotches, shadow edges."""
    y, x = np.mgrid[-1:1:24j, -1:1:32j].astype(np.float32)  # smooth, so drawn small
    slope = rng.uniform(0, 0.3) if chance(rng, 0.6) else 0.0
    field = 1 + np.float32(slope) * (light.x * x + light.y * y)
    field = field - np.float32(rng.uniform(0, 0.2) * chance(rng, 0.4)) * (x * x + y * y)
    field = field + np.float32(rng.uniform(0, 0.05)) * smooth_noise(rng, (24, 32), 10)
    exposure = rng.uniform(0.35, 0.7) if chance(rng, 0.1) else rng.uniform(0.8, 1.2)
    field = np.asarray(field * exposure, dtype=np.float32)
    grown = np.asarray(cv2.resize(field, FRAME_SHAPE[::-1], interpolation=cv2.INTER_LINEAR))
    if chance(rng, 0.25):
        grown = grown * _edge(rng)
    return np.asarray(grown, dtype=np.float32)


def _edge(rng: np.random.Generator) -> Field:
    """A shadow or a darker board that covers one side of a line across the frame."""
    turn = rng.uniform(0, 2 * np.pi) if chance(rng, 0.6) else rng.integers(4) * np.pi / 2
    offset = rng.uniform(-60, 300)
    softness = rng.uniform(0.5, 2) if chance(rng, 0.5) else rng.uniform(5, 60)
    x = np.arange(FRAME_SHAPE[1], dtype=np.float32)[None, :] - 320
    y = np.arange(FRAME_SHAPE[0], dtype=np.float32)[:, None] - 240
    beyond = x * np.float32(np.cos(turn)) + y * np.float32(np.sin(turn)) - np.float32(offset)
    share = np.clip(0.5 + beyond / np.float32(2 * softness), 0, 1)
    return np.asarray(1 - np.float32(rng.uniform(0.1, 0.5)) * share, dtype=np.float32)
