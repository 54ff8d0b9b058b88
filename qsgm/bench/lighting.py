"""Light and camera of a scene: brightness, tint, slope, contrast, blur, noise."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

Frame = NDArray[np.uint8]  # (H, W, 3) BGR
Floats = NDArray[np.float32]

NOISE_LEVELS = 2.0
MOTION_PX = 7
BLUR_SIGMA_PX = (1.5, 2.0)


@dataclass(frozen=True)
class Camera:
    """How a scene is lit and taken; one camera gives every scene of a pair the same noise."""

    gain: tuple[float, float, float]  # BGR
    gamma: float
    slope: float  # from one side of the frame to the other, a share of the light
    from_side_rad: float
    noise_seed: int
    kernel: Floats | None = None  # of the blur


def mild_camera(rng: np.random.Generator) -> Camera:
    """Other light: brighter or darker, warmer or colder, from another side."""
    return _camera(rng, (0.75, 1.2), (0.94, 1.06), (0.0, 0.3))


def dim_camera(rng: np.random.Generator) -> Camera:
    """Half the light, with more tint and a steeper slope."""
    return _camera(rng, (0.42, 0.58), (0.88, 1.12), (0.1, 0.5))


def blurred_camera(rng: np.random.Generator) -> Camera:
    """Mild light, out of focus or moving."""
    camera = mild_camera(rng)
    kernel = _defocus(rng) if rng.random() < 0.5 else _motion(rng)
    return replace(camera, kernel=kernel)


def photograph(scenes: Sequence[Floats], camera: Camera) -> list[Frame]:
    """Scenes (H, W, 3) of one size, 0 to 255, as a camera sees them: same light, same noise."""
    height, width = scenes[0].shape[:2]
    y = np.linspace(-0.5, 0.5, height, dtype=np.float32)[:, None]
    x = np.linspace(-0.5, 0.5, width, dtype=np.float32)
    side = x * np.cos(camera.from_side_rad) + y * np.sin(camera.from_side_rad)
    light = (1 + camera.slope * side)[:, :, None] * np.array(camera.gain, dtype=np.float32)
    rng = np.random.default_rng(camera.noise_seed)
    noise = NOISE_LEVELS * rng.standard_normal(scenes[0].shape, dtype=np.float32)
    return [_exposed(scene, camera, light, noise) for scene in scenes]


def _exposed(scene: Floats, camera: Camera, light: Floats, noise: Floats) -> Frame:
    """One scene in a light (H, W, 3), with noise (H, W, 3)."""
    seen = np.clip(scene, 0, 255)
    if camera.kernel is not None:
        blurred = cv2.filter2D(seen, -1, camera.kernel, borderType=cv2.BORDER_REFLECT_101)
        seen = np.clip(np.asarray(blurred, dtype=np.float32), 0, 255)
    lit = 255 * cv2.pow(seen / np.float32(255), camera.gamma) * light + noise
    return np.asarray(cv2.convertScaleAbs(np.maximum(lit, 0)), dtype=np.uint8)


def _camera(
    rng: np.random.Generator,
    brightness: tuple[float, float],
    tint: tuple[float, float],
    slope: tuple[float, float],
) -> Camera:
    blue, green, red = rng.uniform(*brightness) * rng.uniform(*tint, 3)
    return Camera(
        gain=(float(blue), float(green), float(red)),
        gamma=float(rng.uniform(0.85, 1.2)),
        slope=float(rng.uniform(*slope)),
        from_side_rad=float(rng.uniform(-np.pi, np.pi)),
        noise_seed=int(rng.integers(2**31)),
    )


def _defocus(rng: np.random.Generator) -> Floats:
    line = cv2.getGaussianKernel(13, rng.uniform(*BLUR_SIGMA_PX), cv2.CV_32F)
    return np.asarray(line @ line.T, dtype=np.float32)


def _motion(rng: np.random.Generator) -> Floats:
    """A line of :data:`MOTION_PX` pixels in any direction."""
    direction, reach = rng.uniform(0, np.pi), MOTION_PX // 2
    y, x = np.mgrid[-reach - 1 : reach + 2, -reach - 1 : reach + 2]
    along = x * np.cos(direction) - y * np.sin(direction)
    across = x * np.sin(direction) + y * np.cos(direction)
    beyond = np.hypot(across, np.maximum(np.abs(along) - reach, 0))
    line = np.clip(1 - beyond, 0, 1)
    return np.asarray(line / line.sum(), dtype=np.float32)
