"""How a drawn scene reaches the picture: the light it lies in and the camera's faults."""

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.train.grasp.drawing.noise import Field, chance, grainy, smooth_noise
from qsgm.train.grasp.drawing.render import Light

FRAME_HW = (480, 640)
CENTER_PX = (320.0, 240.0)


def random_light(rng: np.random.Generator) -> Light:
    """A light from any side, 30 to 75 degrees above the table."""
    around = rng.uniform(0, 2 * np.pi)
    above = np.deg2rad(rng.uniform(30, 75))
    flat = np.cos(above)
    return Light(float(flat * np.cos(around)), float(flat * np.sin(around)), float(np.sin(above)))


def seen_by_camera(
    rng: np.random.Generator, image: NDArray[np.uint8], light: Light
) -> NDArray[np.uint8]:
    """Uneven light, exposure, white balance, blur, sensor noise and sometimes JPEG."""
    gain = _light_field(rng, light)
    tint = 1 + np.clip(rng.normal(0, 0.04, 3), -0.1, 0.1)
    gains = cv2.merge([gain * np.float32(channel) for channel in tint])
    seen = np.asarray(cv2.multiply(image, gains, dtype=cv2.CV_8U), np.uint8)
    if chance(rng, 0.6):
        seen = np.asarray(cv2.GaussianBlur(seen, (0, 0), rng.uniform(0.3, 1.0)), np.uint8)
    if chance(rng, 0.8):
        seen = grainy(rng, seen, 2.0)
    if chance(rng, 0.2):
        quality = int(rng.integers(50, 96))
        packed = cv2.imencode(".jpg", seen, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        return np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)
    return seen


def _light_field(rng: np.random.Generator, light: Light) -> Field:
    """Brightness over the frame, shape FRAME_HW: slope, vignette, blotches, shadow edges."""
    y, x = np.mgrid[-1:1:24j, -1:1:32j].astype(np.float32)  # smooth, so drawn small
    slope = rng.uniform(0, 0.3) if chance(rng, 0.6) else 0.0
    field = 1 + np.float32(slope) * (light.x * x + light.y * y)
    field = field - np.float32(rng.uniform(0, 0.2) * chance(rng, 0.4)) * (x * x + y * y)
    field = field + np.float32(rng.uniform(0, 0.05)) * smooth_noise(rng, (24, 32), 10)
    exposure = rng.uniform(0.35, 0.7) if chance(rng, 0.1) else rng.uniform(0.8, 1.2)
    field = np.asarray(field * exposure, dtype=np.float32)
    grown = np.asarray(cv2.resize(field, FRAME_HW[::-1], interpolation=cv2.INTER_LINEAR))
    if chance(rng, 0.25):
        grown = grown * _edge(rng)
    return np.asarray(grown, dtype=np.float32)


def _edge(rng: np.random.Generator) -> Field:
    """A shadow or a darker board that covers one side of a line across the frame."""
    turn = rng.uniform(0, 2 * np.pi) if chance(rng, 0.6) else rng.integers(4) * np.pi / 2
    offset = rng.uniform(-60, 300)
    softness = rng.uniform(0.5, 2) if chance(rng, 0.5) else rng.uniform(5, 60)
    x = np.arange(FRAME_HW[1], dtype=np.float32)[None, :] - 320
    y = np.arange(FRAME_HW[0], dtype=np.float32)[:, None] - 240
    beyond = x * np.float32(np.cos(turn)) + y * np.float32(np.sin(turn)) - np.float32(offset)
    share = np.clip(0.5 + beyond / np.float32(2 * softness), 0, 1)
    return np.asarray(1 - np.float32(rng.uniform(0.1, 0.5)) * share, dtype=np.float32)
