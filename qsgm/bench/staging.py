"""Scenes made from one demonstration: the same object elsewhere, turned, in other light, or gone.

The object is taken off the table by laying another part of the same table over it, and put back
somewhere else with its own shadow, so that nothing but place, turn and light is new.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.crops import HALF_CROP_PX
from qsgm.errors import QsgmError

Frame = NDArray[np.uint8]  # (H, W, 3) BGR
Floats = NDArray[np.float32]

# A new centre keeps this much beyond its window from the border.
BORDER_PX = HALF_CROP_PX + 8
# What is taken off the table around the object, and what of that is carried along as shadow.
REMOVED_MARGIN_PX = 36
SHADOW_MARGIN_PX = 22
FEATHER_PX = 1.0
DARKEST_SHADOW = 0.35


@dataclass(frozen=True)
class Scene:
    """A frame and what is true of it."""

    frame: Frame
    center_px: tuple[float, float] | None  # (x, y) of the object; None: it is not there
    turn_rad: float = 0.0  # since the demonstration, counter-clockwise


@dataclass(frozen=True)
class CutOut:
    """An object off its table, in the pixels of its demonstration."""

    table: Frame  # what was there without it
    object: Floats  # (H, W, 3)
    alpha: Floats  # (H, W), 1 on the object
    shade: Floats  # (H, W), how much of the light on the table is left
    center_px: tuple[float, float]  # of the demonstration


def cut_out(frame: Frame, mask: NDArray[np.bool_], center_px: tuple[float, float]) -> CutOut:
    """Take the object that `mask` (H, W) shows off its table."""
    if mask.shape != frame.shape[:2]:
        raise QsgmError(
            f"a mask of {mask.shape[1]}x{mask.shape[0]} px does not fit a frame of "
            f"{frame.shape[1]}x{frame.shape[0]} px; expected the same size"
        )
    table = empty_table(frame, grown(mask, REMOVED_MARGIN_PX))
    alpha = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), FEATHER_PX).astype(np.float32)
    return CutOut(table, frame.astype(np.float32), alpha, shadow(frame, table, mask), center_px)


def put_down(cut: CutOut, center_px: tuple[float, float], turn_rad: float) -> Scene:
    """The object with its demonstration's centre at `center_px`, turned counter-clockwise."""
    height, width = cut.alpha.shape
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    rotation = np.array([[cos, sin], [-sin, cos]])  # y points down
    shift = np.asarray(center_px) - rotation @ np.asarray(cut.center_px)
    motion = np.concatenate([rotation, shift[:, None]], axis=1)

    def moved(layer: Floats, outside: float) -> Floats:
        border = cv2.BORDER_CONSTANT
        warped = cv2.warpAffine(
            layer,
            motion,
            (width, height),
            flags=cv2.INTER_LINEAR,
            borderMode=border,
            borderValue=(outside, outside, outside),
        )
        return np.asarray(warped, dtype=np.float32)

    alpha = moved(cut.alpha, 0.0)[:, :, None]
    shaded = cut.table * moved(cut.shade, 1.0)[:, :, None]
    mixed = shaded * (1 - alpha) + moved(cut.object, 0.0) * alpha
    return Scene(_as_frame(mixed), center_px, turn_rad)


def make_scenes(cut: CutOut, count: int, rng: np.random.Generator) -> list[Scene]:
    """`count` scenes with the object and, last, one of the empty table; each in its own light."""
    height, width = cut.alpha.shape
    scenes = []
    for _ in range(count):
        x = rng.uniform(BORDER_PX, width - BORDER_PX)
        y = rng.uniform(BORDER_PX, height - BORDER_PX)
        scenes.append(put_down(cut, (float(x), float(y)), float(rng.uniform(-np.pi, np.pi))))
    scenes.append(Scene(cut.table, None))
    return [Scene(relit(s.frame, rng), s.center_px, s.turn_rad) for s in scenes]


def relit(frame: Frame, rng: np.random.Generator) -> Frame:
    """The frame in other light: brighter or darker, warmer or colder, from another side; noisy."""
    height, width = frame.shape[:2]
    light = rng.uniform(0.75, 1.2) * rng.uniform(0.94, 1.06, 3)
    from_side = rng.uniform(-np.pi, np.pi)
    y, x = np.mgrid[-0.5 : 0.5 : height * 1j, -0.5 : 0.5 : width * 1j]
    gradient = 1 + rng.uniform(0.0, 0.3) * (x * np.cos(from_side) + y * np.sin(from_side))
    gamma = rng.uniform(0.85, 1.2)
    lit = 255 * (frame / 255.0) ** gamma * light * gradient[:, :, None]
    return _as_frame(lit + rng.normal(0.0, 2.0, frame.shape))


def empty_table(frame: Frame, hole: NDArray[np.bool_]) -> Frame:
    """The frame with `hole` (H, W) covered by another part of the same table, blended in."""
    patch = min(_shifted_copies(frame, hole), key=lambda copy: _mismatch(frame, copy, hole))
    height, width = hole.shape
    rows, cols = np.flatnonzero(hole.any(axis=1)), np.flatnonzero(hole.any(axis=0))
    # Poisson blending wants a hole that stays off the border.
    top, bottom = max(rows[0] - 2, 1), min(rows[-1] + 3, height - 1)
    left, right = max(cols[0] - 2, 1), min(cols[-1] + 3, width - 1)
    inside = np.zeros(hole.shape, dtype=np.uint8)
    inside[top:bottom, left:right] = 255 * hole[top:bottom, left:right]
    x, y, w, h = cv2.boundingRect(inside)
    middle = (x + w // 2, y + h // 2)
    blended = cv2.seamlessClone(patch, frame, inside, middle, cv2.NORMAL_CLONE)
    return np.asarray(blended, dtype=np.uint8)


def shadow(frame: Frame, table: Frame, mask: NDArray[np.bool_]) -> Floats:
    """Share of light (H, W) that is left beside the object; 1 away from it."""
    before = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY).astype(np.float32)
    after = cv2.cvtColor(table, cv2.COLOR_BGR2GRAY).astype(np.float32)
    # Smoothed over the table only: texture differs pixel by pixel, a soft shadow does not.
    beside = 1 - grown(mask, 2).astype(np.float32)

    def smooth(values: Floats) -> Floats:
        return np.asarray(cv2.GaussianBlur(values * beside, (0, 0), 4.0), dtype=np.float32)

    ratio = smooth(before) / np.maximum(smooth(after), 1.0)
    reach = np.asarray(cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5))
    fade = np.clip(1 - reach / SHADOW_MARGIN_PX, 0, 1)
    # A few per cent are texture, not shadow.
    depth = np.clip(0.97 - ratio, 0, 1 - DARKEST_SHADOW)
    return np.asarray(1 - depth * np.sqrt(fade), dtype=np.float32)


def grown(mask: NDArray[np.bool_], margin_px: int) -> NDArray[np.bool_]:
    """The mask and everything within `margin_px` of it."""
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin_px + 1, 2 * margin_px + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk)) > 0


def _shifted_copies(frame: Frame, hole: NDArray[np.bool_]) -> list[Frame]:
    """The frame moved so that table comes to lie where the hole is; mirrored where it ends."""
    rows, cols = np.flatnonzero(hole.any(axis=1)), np.flatnonzero(hole.any(axis=0))
    height, width = rows[-1] - rows[0] + 4, cols[-1] - cols[0] + 4
    size = (frame.shape[1], frame.shape[0])
    copies = []
    for right, down in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)):
        motion = np.array([[1.0, 0.0, right * width], [0.0, 1.0, down * height]])
        moved = cv2.warpAffine(
            frame, motion, size, flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT_101
        )
        copies.append(np.asarray(moved, dtype=np.uint8))
    return copies


def _mismatch(frame: Frame, copy: Frame, hole: NDArray[np.bool_]) -> float:
    """How badly the copy continues the frame around the hole [grey levels]."""
    ring = grown(hole, 6) & ~hole
    difference = cv2.GaussianBlur(cv2.absdiff(frame, copy), (0, 0), 2.0)
    return float(difference[ring].mean())


def _as_frame(values: NDArray[np.floating]) -> Frame:
    rounded: Frame = np.clip(np.rint(values), 0, 255).astype(np.uint8)
    return rounded
