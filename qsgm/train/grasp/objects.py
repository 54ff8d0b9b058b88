"""Drawn training frames: one household object lying on a table, seen by a camera above.

Nothing is copied from a photograph: tables, objects, shadows and the camera's faults are all
drawn from random numbers, so the same generator state gives the same frame.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.angles import wrap_half_turn
from qsgm.train.grasp.drawing.camera import FRAME_HW, random_light, seen_by_camera
from qsgm.train.grasp.drawing.noise import Colour, Field, blur, cast_shadow, mean_colour
from qsgm.train.grasp.drawing.render import (
    LEAST_CONTRAST,
    Light,
    Sprite,
    contrast,
    rectangle,
    render,
)
from qsgm.train.grasp.drawing.shapes import (
    OBJECT_KINDS,
    TRIES,
    chosen_object,
    random_length,
    random_shape,
)
from qsgm.train.grasp.drawing.tables import TABLE_KINDS, chosen_table, draw_table

__all__ = ["OBJECT_KINDS", "TABLE_KINDS", "DrawnFrame", "draw_frame"]

_PATCH = 256  # px; side of the square around the centre that holds the object and its shadow


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
    object_kind = chosen_object(rng, object_kind, elongated)
    table_kind = chosen_table(rng, table_kind)
    table = draw_table(rng, table_kind, FRAME_HW)
    light = random_light(rng)
    sprite = _random_sprite(rng, object_kind, mean_colour(table), light)
    # Pixels, not outlines, decide where the rectangle's centre is: it is moved there whole.
    rect = rectangle(sprite)
    corner = (round(320 - rect[0][0]), round(240 - rect[0][1]))
    image = _composed(rng, table, sprite, corner, light)
    image = seen_by_camera(rng, image, light)
    mask = np.zeros(FRAME_HW, np.bool_)
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


def _random_sprite(rng: np.random.Generator, kind: str, table: Colour, light: Light) -> Sprite:
    """The object at a random size and direction; short side from 6 px to square."""
    long_px = random_length(rng)
    for _ in range(TRIES):
        shape = random_shape(rng, kind, table, long_px)
        sprite = render(shape, rng.uniform(0, 2 * np.pi), light, rng)
        if contrast(sprite, table) > LEAST_CONTRAST:
            break
    return sprite


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
    cast = blur(cast_shadow(covered, away), rng.uniform(0.8, 7.0))
    cast = cast * np.float32(rng.uniform(0, 0.75))
    return np.asarray((1 - contact) * (1 - cast), dtype=np.float32)
