"""One demonstration frame becomes 1000 labelled crops (paper section 3.1, "Dataset").

Positives show the object at the crop's centre under every rotation; negatives are near misses
and windows from anywhere in the frame, without which detections land on the far background.
Every crop has its own colours. What is drawn at random is drawn first, as a :class:`CropPlan`;
cutting is then deterministic and can go in slices, so that all crops never have to be in memory
together.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.angles import AngleEncoding, encode_angle
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.pixels import MIRRORED, arithmetic

HALF_CROP_PX = CROP_PX // 2
TRAIN_CROPS = 800
VALIDATION_CROPS = 200
CROPS = TRAIN_CROPS + VALIDATION_CROPS

# Heatmap cells are 16 px apart, so the nearest one is off by up to 8 px on each axis.
POSITIVE_JITTER_PX = 4.0
# Closer than this, a window is neither clearly centred nor clearly not: never a negative.
NEGATIVE_DISTANCE_PX = 28.0
NEAR_MISS_DISTANCE_PX = 64.0
# At least this share of the frame's windows has to be as far as that from the object.
LEAST_NEGATIVE_SHARE = 0.05

_LUMA_BGR = np.array([0.114, 0.587, 0.299])


@dataclass(frozen=True)
class CropPlan:
    """Where, how turned and in what colours each of N crops is cut."""

    center_px: NDArray[np.float32]  # (N, 2) window centre (x, y) in the frame
    turn_rad: NDArray[np.float32]  # (N,) how far the frame is turned, counter-clockwise
    color: NDArray[np.float32]  # (N, 3, 4) BGR -> BGR affine map
    quality: NDArray[np.float32]  # (N,) 1 where the object is centred, else 0

    def __len__(self) -> int:
        return len(self.quality)

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> "CropPlan":
        return CropPlan(
            self.center_px[rows], self.turn_rad[rows], self.color[rows], self.quality[rows]
        )


def plan_crops(
    frame_hw: tuple[int, int],
    center_px: tuple[float, float],
    rng: np.random.Generator,
    count: int = CROPS,
) -> CropPlan:
    """Draw a plan of `count` crops, half of them positive, in random order.

    Args:
        frame_hw: height and width of the frame [px].
        center_px: the object's centre (x, y) [px].
        rng: the only source of randomness.
        count: number of crops.

    Raises:
        QsgmError: the window around the centre does not lie inside the frame, or the frame has no
            room for windows beside it.
    """
    check_center(frame_hw, center_px)
    _check_room(frame_hw, center_px)
    quality = rng.permutation(np.arange(count) % 2).astype(np.float32)
    jitter = rng.uniform(-POSITIVE_JITTER_PX, POSITIVE_JITTER_PX, (count, 2))
    centers = np.where(
        quality[:, None] > 0,
        _inside(np.asarray(center_px) + jitter, frame_hw),
        _negative_centers(frame_hw, center_px, rng, count),
    )
    return CropPlan(
        center_px=centers.astype(np.float32),
        turn_rad=rng.uniform(-np.pi, np.pi, count).astype(np.float32),
        color=_color_jitter(rng, count),
        quality=quality,
    )


def cut_crops(frame: NDArray[np.uint8], plan: CropPlan) -> NDArray[np.uint8]:
    """Cut the planned crops out of a frame.

    Args:
        frame: (H, W, 3) BGR.
        plan: N crops.

    Returns:
        (N, 128, 128, 3) BGR. Outside the frame its content is mirrored.
    """
    return cut_widened(widened(frame), plan)


def widened(frame: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A frame (H, W, 3) BGR with a fourth channel, (H, W, 4).

    OpenCV 5 warps four channels in less than half the time of three (4.10 in a little less), to the
    same numbers. Once is enough for all slices of a plan.
    """
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_BGR2BGRA), dtype=np.uint8)


def cut_widened(wide: NDArray[np.uint8], plan: CropPlan) -> NDArray[np.uint8]:
    """:func:`cut_crops` of a frame (H, W, 4) that is :func:`widened` already."""
    crops = np.empty((len(plan), CROP_PX, CROP_PX, 3), dtype=np.uint8)
    recolor = arithmetic().recolor
    for crop, window, color in zip(crops, windows_of(wide, plan), plan.color, strict=True):
        recolor(window, color, crop)
    return crops


def windows_of(wide: NDArray[np.uint8], plan: CropPlan) -> Iterator[NDArray[np.uint8]]:
    """Each planned crop (128, 128, 3) of a widened frame in the frame's own colours.

    One array is used for all: what a caller does to it lasts until the next one is asked for.
    """
    # Used for every crop: allocating them anew takes longer than converting.
    cut, narrow = (np.empty((CROP_PX, CROP_PX, channels), np.uint8) for channels in (4, 3))
    warp = arithmetic().warp
    for window in _windows(plan):
        warp(wide, window, MIRRORED, cut)
        cv2.cvtColor(cut, cv2.COLOR_BGRA2BGR, narrow)
        yield narrow


def label_crops(
    plan: CropPlan,
    offset_rad: float | NDArray[np.float32] = 0.0,
    encoding: AngleEncoding = "double",
) -> NDArray[np.float32]:
    """Labels (N, 3) of the planned crops: quality, sine and cosine; zeros for negatives.

    `offset_rad` is the demonstration's own orientation as the network sees it,
    so that angles mean the same for every object; one for each crop where there are several.
    """
    angle = encode_angle(plan.turn_rad + offset_rad, encoding)
    return np.concatenate([plan.quality[:, None], angle * plan.quality[:, None]], axis=1)


def check_center(frame_hw: tuple[int, int], center_px: tuple[float, float]) -> None:
    """Refuse a point (x, y) whose window leaves a frame.

    Raises:
        QsgmError: says how far inside it has to be.
    """
    height, width = frame_hw
    x, y = center_px
    margin = HALF_CROP_PX
    if not (margin <= x <= width - margin and margin <= y <= height - margin):
        raise QsgmError(
            f"the object's centre ({x:g}, {y:g}) is closer than {HALF_CROP_PX} px to the border "
            f"of the {width}x{height} frame; move the camera or pass another --center"
        )


def _check_room(frame_hw: tuple[int, int], center_px: tuple[float, float]) -> None:
    """Negatives are drawn until they are far enough from the object: they have to exist."""
    height, width = frame_hw
    x = np.linspace(HALF_CROP_PX, width - HALF_CROP_PX, 33) - center_px[0]
    y = np.linspace(HALF_CROP_PX, height - HALF_CROP_PX, 33) - center_px[1]
    far = np.hypot(x[:, None], y) >= NEGATIVE_DISTANCE_PX
    if far.mean() < LEAST_NEGATIVE_SHARE:
        raise QsgmError(
            f"the {width}x{height} frame has no room for windows {NEGATIVE_DISTANCE_PX:g} px and "
            f"more from the object: expected about 640x480 (at least {2 * CROP_PX} px on each "
            f"side); take a larger frame"
        )


def _windows(plan: CropPlan) -> NDArray[np.float64]:
    """Affine maps (N, 2, 3) from crop pixels to frame pixels; pixel (64, 64) is the centre."""
    cos, sin = np.cos(plan.turn_rad.astype(np.float64)), np.sin(plan.turn_rad.astype(np.float64))
    rotation = np.stack([np.stack([cos, -sin], -1), np.stack([sin, cos], -1)], -2)  # (N, 2, 2)
    half = np.full(2, HALF_CROP_PX)
    shift = plan.center_px - rotation @ half
    return np.concatenate([rotation, shift[:, :, None]], axis=2)


def _negative_centers(
    frame_hw: tuple[int, int],
    center_px: tuple[float, float],
    rng: np.random.Generator,
    count: int,
) -> NDArray[np.float64]:
    """Window centres (N, 2) [px]: half of them near misses, none of them on the object."""
    near = rng.random((count, 1)) < 0.5
    centers = np.where(near, _ring(center_px, rng, count), _anywhere(frame_hw, rng, count))
    centers = _inside(centers, frame_hw)
    while (bad := np.linalg.norm(centers - center_px, axis=1) < NEGATIVE_DISTANCE_PX).any():
        centers[bad] = _anywhere(frame_hw, rng, int(bad.sum()))
    return centers


def _ring(
    center_px: tuple[float, float], rng: np.random.Generator, count: int
) -> NDArray[np.float64]:
    """Points (N, 2) [px] in a ring around the object."""
    direction = rng.uniform(-np.pi, np.pi, count)
    radius = rng.uniform(NEGATIVE_DISTANCE_PX, NEAR_MISS_DISTANCE_PX, count)
    offset: NDArray[np.float64] = radius[:, None] * np.stack(
        [np.cos(direction), np.sin(direction)], axis=-1
    )
    return np.add(offset, center_px)


def _anywhere(
    frame_hw: tuple[int, int], rng: np.random.Generator, count: int
) -> NDArray[np.float64]:
    """Centres (N, 2) [px] of windows anywhere in the frame."""
    height, width = frame_hw
    high = np.array([width - HALF_CROP_PX, height - HALF_CROP_PX], dtype=np.float64)
    return rng.uniform(HALF_CROP_PX, high, (count, 2))


def _inside(centers: NDArray[np.float64], frame_hw: tuple[int, int]) -> NDArray[np.float64]:
    """Window centres (N, 2) [px] moved so far that the windows lie inside the frame."""
    height, width = frame_hw
    high = np.array([width - HALF_CROP_PX, height - HALF_CROP_PX], dtype=np.float64)
    inside: NDArray[np.float64] = np.clip(centers, HALF_CROP_PX, high)
    return inside


def _color_jitter(rng: np.random.Generator, count: int) -> NDArray[np.float32]:
    """Affine colour maps (N, 3, 4): contrast, saturation, white balance and brightness."""
    contrast = rng.uniform(0.8, 1.25, count)[:, None, None]
    saturation = rng.uniform(0.7, 1.3, count)[:, None, None]
    white = rng.uniform(0.9, 1.1, (count, 3))[:, :, None]
    brightness = rng.uniform(-25.0, 25.0, count)[:, None, None]
    mix = saturation * np.eye(3) + (1 - saturation) * _LUMA_BGR[None, None, :]
    shift = brightness + 128.0 * (1 - contrast) * np.ones((1, 3, 1))
    return np.concatenate([contrast * white * mix, shift], axis=2).astype(np.float32)
