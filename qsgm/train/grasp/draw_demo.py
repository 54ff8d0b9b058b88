"""Two drawn pictures for `make demo`: a demonstration, and a scene with the same object in it."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.angles import wrap_half_turn
from qsgm.train.grasp.drawing.camera import FRAME_HW
from qsgm.train.grasp.drawing.noise import Colour, blur, white_noise
from qsgm.train.grasp.drawing.parts import Brush
from qsgm.train.grasp.drawing.render import Light, Sprite, fitted, rectangle, render
from qsgm.train.grasp.drawing.shapes import ELONGATED
from qsgm.train.grasp.drawing.tables import draw_table

CENTER_PX = (320, 240)
LONG_PX = 96.0
LEAST_ELONGATION = 1.5
LEAST_PX = 10.0
SHADOW_PX = 7.0  # length of the cast shadow of an upright side, light at 45 degrees
GRAIN_LEVELS = 1.5

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Demo:
    """The pictures (480, 640, 3) BGR, and what `qsgm predict` should find in the scene."""

    demonstration: Image
    scene: Image
    center_px: tuple[int, int]  # of the object in the scene
    angle_deg: float  # turn from demonstration to scene, counter-clockwise, modulo 180


@dataclass(frozen=True)
class _View:
    """How one of the pictures is taken."""

    center_px: tuple[int, int]
    clockwise_rad: float  # direction of the object's long axis
    table_corner: tuple[int, int]  # (x, y) of the frame on a larger table
    light: Light
    gain_bgr: tuple[float, float, float]
    slope: float  # brightness change from the frame's left edge to its right


_DEMONSTRATION = _View(CENTER_PX, 0.35, (0, 0), Light(-0.5, -0.4, 0.77), (1.0, 1.0, 1.0), 0.05)
_SCENE = _View((207, 301), 1.40, (150, 90), Light(0.55, -0.3, 0.78), (0.8, 0.9, 0.97), -0.2)


def draw_demo(seed: int) -> Demo:
    """Draw both pictures; the same numbers give the same pictures."""
    table = draw_table(np.random.default_rng([seed, 0]), "planks", (600, 800))
    brush = Brush(np.random.default_rng([seed, 1]), _mean_colour(table))
    outline = ELONGATED["handle_tool"](np.random.default_rng([seed, 2]), brush)
    shape = fitted(outline, LONG_PX, LEAST_ELONGATION, LEAST_PX)
    pictures = []
    for i, view in enumerate((_DEMONSTRATION, _SCENE)):
        # Prints and finishes are drawn while painting: the same numbers make it the same object.
        paint_rng = np.random.default_rng([seed, 3])
        sprite = render(shape, view.clockwise_rad, view.light, paint_rng)
        x, y = view.table_corner
        picture = _put(table[y : y + FRAME_HW[0], x : x + FRAME_HW[1]], sprite, view)
        pictures.append(_seen(picture, view, np.random.default_rng([seed, 4, i])))
    turn = wrap_half_turn(np.array([_DEMONSTRATION.clockwise_rad - _SCENE.clockwise_rad]))
    angle = round(float(np.degrees(turn[0])), 2)
    return Demo(pictures[0], pictures[1], _SCENE.center_px, angle)


def _mean_colour(image: Image) -> Colour:
    blue, green, red = image.reshape(-1, 3).mean(axis=0).tolist()
    return blue, green, red


def _put(table: Image, sprite: Sprite, view: _View) -> NDArray[np.float32]:
    """The table with the object's shadow and the object on it."""
    side = len(sprite.coverage)
    (x, y), _ = rectangle(sprite)
    left, top = round(view.center_px[0] - x), round(view.center_px[1] - y)
    place = slice(top, top + side), slice(left, left + side)
    covered = np.zeros(FRAME_HW, np.float32)
    covered[place] = sprite.opacity
    reach = SHADOW_PX / view.light.z * np.array([view.light.x, view.light.y])
    move = np.array([[1, 0, -reach[0]], [0, 1, -reach[1]]])
    cast = np.asarray(cv2.warpAffine(covered, move, FRAME_HW[::-1]), np.float32)
    shadow = (1 - 0.45 * blur(cast, 3.0)) * (1 - 0.3 * blur(covered, 1.5))
    picture = table.astype(np.float32) * shadow[..., None]
    picture[place] = picture[place] * (1 - sprite.opacity[..., None]) + sprite.colour
    return np.asarray(picture, np.float32)


def _seen(picture: NDArray[np.float32], view: _View, rng: np.random.Generator) -> Image:
    """Brightness that changes over the frame, white balance, and the sensor's noise."""
    ramp = 1 + view.slope * np.linspace(-0.5, 0.5, FRAME_HW[1], dtype=np.float32)
    lit = picture * ramp[None, :, None] * np.array(view.gain_bgr, np.float32)
    sharp = np.asarray(cv2.GaussianBlur(lit, (0, 0), 0.5), np.float32)
    noisy = sharp + np.float32(GRAIN_LEVELS) * white_noise(rng, sharp.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
