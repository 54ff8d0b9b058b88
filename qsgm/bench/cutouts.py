"""Objects cut off their tables by their masks, and laid elsewhere with their own shadows.

The object is taken off the table by laying another part of the same table over it. A pose is a
3x3 homography from the pixels of the demonstration to those of a scene.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError

Frame = NDArray[np.uint8]  # (H, W, 3) BGR
Mask = NDArray[np.bool_]  # (H, W)
Floats = NDArray[np.float32]
Pose = NDArray[np.float64]  # (3, 3)
Point = tuple[float, float]  # (x, y) [px]

# What is taken off the table around the object, and what of that is carried along as shadow.
REMOVED_MARGIN_PX = 36
SHADOW_MARGIN_PX = 22
FEATHER_PX = 1.0
DARKEST_SHADOW = 0.35
# Distance of the camera that sees a tilted object in perspective.
CAMERA_PX = 900.0


@dataclass(frozen=True)
class CutOut:
    """An object off its table: layers of the part of its demonstration that it takes up."""

    table: Frame  # the whole table without it
    patch: Frame  # (h, w, 3)
    mask: Mask  # (h, w)
    alpha: Floats  # (h, w), 1 on the object
    shade: Floats  # (h, w), share of the light on the table that is left
    corner_px: tuple[int, int]  # (x, y) of the layers in the demonstration
    center_px: Point  # of the demonstration


def cut_out(frame: Frame, mask: Mask, center_px: Point) -> CutOut:
    """Take the object that `mask` (H, W) shows off its table.

    Raises:
        QsgmError: the mask has another size, or is all one colour.
    """
    if mask.shape != frame.shape[:2]:
        raise QsgmError(
            f"a mask of {mask.shape[1]}x{mask.shape[0]} px does not fit a frame of "
            f"{frame.shape[1]}x{frame.shape[0]} px; expected the same size"
        )
    if not mask.any() or mask.all():
        raise QsgmError("a mask is all one colour: expected white on the object")
    table = empty_table(frame, grown(mask, REMOVED_MARGIN_PX))
    blurred = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), FEATHER_PX)
    alpha = np.asarray(blurred, dtype=np.float32)
    x, y, w, h = cv2.boundingRect(grown(mask, SHADOW_MARGIN_PX + 2).astype(np.uint8))
    part = np.s_[y : y + h, x : x + w]
    return CutOut(
        table=table,
        patch=_bled(frame, mask)[part],
        mask=mask[part],
        alpha=alpha[part],
        shade=shadow(frame, table, mask)[part],
        corner_px=(x, y),
        center_px=center_px,
    )


def pose_of(
    from_px: Point,
    to_px: Point,
    turn_rad: float,
    scale: float = 1.0,
    tilt_rad: float = 0.0,
    tilt_axis_rad: float = 0.0,
) -> Pose:
    """The pose that takes `from_px` to `to_px`.

    Args:
        from_px: a point of the demonstration.
        to_px: its place in the scene.
        turn_rad: counter-clockwise as seen in the image.
        scale: larger than 1 enlarges.
        tilt_rad: how far the object leans away from the camera, after it was turned.
        tilt_axis_rad: the direction that is foreshortened.
    """
    lean = np.eye(3)
    lean[0, 0], lean[2, 0] = np.cos(tilt_rad), np.sin(tilt_rad) / CAMERA_PX
    tilted = _turned(tilt_axis_rad) @ lean @ _turned(-tilt_axis_rad)
    enlarged = np.diag([scale, scale, 1.0])
    moved = _shifted(to_px) @ tilted @ enlarged @ _turned(turn_rad)
    return np.asarray(moved @ _shifted((-from_px[0], -from_px[1])))


def lay(canvas: Floats, cut: CutOut, pose: Pose) -> Floats:
    """The canvas (H, W, 3) with the object and its shadow on it; the canvas itself stays."""
    where, motion = _destination(cut, pose, canvas.shape[:2])
    laid = canvas.copy()
    if motion is None:
        return laid
    under = laid[where]
    alpha = _warped(cut.alpha, motion, under.shape[:2], cv2.BORDER_CONSTANT, 0.0)[:, :, None]
    shade = _warped(cut.shade, motion, under.shape[:2], cv2.BORDER_CONSTANT, 1.0)[:, :, None]
    patch = cut.patch.astype(np.float32)
    color = _warped(patch, motion, under.shape[:2], cv2.BORDER_REPLICATE, 0.0, cv2.INTER_CUBIC)
    laid[where] = under * shade * (1 - alpha) + np.clip(color, 0, 255) * alpha
    return laid


def footprint(cut: CutOut, pose: Pose, frame_hw: tuple[int, int]) -> Mask:
    """Pixels (H, W) of a scene that the object takes up."""
    covered = np.zeros(frame_hw, dtype=np.bool_)
    where, motion = _destination(cut, pose, frame_hw)
    if motion is not None:
        shape = covered[where].shape
        mask = cut.mask.astype(np.float32)
        covered[where] = _warped(mask, motion, shape, cv2.BORDER_CONSTANT, 0.0) > 0.5
    return covered


def grown(mask: Mask, margin_px: int) -> Mask:
    """The mask and everything within `margin_px` of it."""
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin_px + 1, 2 * margin_px + 1))
    return np.asarray(cv2.dilate(mask.astype(np.uint8), disk)) > 0


def empty_table(frame: Frame, hole: Mask) -> Frame:
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


def shadow(frame: Frame, table: Frame, mask: Mask) -> Floats:
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


def _bled(frame: Frame, mask: Mask) -> Frame:
    """The frame, its object's colours spread outwards so that no old table shines through."""
    away = (~mask).astype(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(
        away, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    source = np.zeros(int(labels.max()) + 1, dtype=np.int64)
    source[labels[mask]] = np.flatnonzero(mask)
    spread: Frame = frame.reshape(-1, 3)[source[labels]]
    return spread


def _shifted_copies(frame: Frame, hole: Mask) -> list[Frame]:
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


def _mismatch(frame: Frame, copy: Frame, hole: Mask) -> float:
    """How badly the copy continues the frame around the hole [grey levels]."""
    ring = grown(hole, 6) & ~hole
    difference = cv2.GaussianBlur(cv2.absdiff(frame, copy), (0, 0), 2.0)
    return float(difference[ring].mean()) if ring.any() else 0.0


def _turned(angle_rad: float) -> Pose:
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)  # y points down
    return np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _shifted(by_px: Point) -> Pose:
    return np.array([[1.0, 0.0, by_px[0]], [0.0, 1.0, by_px[1]], [0.0, 0.0, 1.0]])


def _destination(
    cut: CutOut, pose: Pose, frame_hw: tuple[int, int]
) -> tuple[tuple[slice, slice], Pose | None]:
    """The part of a scene that a cut-out reaches, and the motion of its layers into that part.

    The motion is None where nothing of it is in view.
    """
    h, w = cut.mask.shape
    layers = pose @ _shifted(cut.corner_px)
    corners = np.array([[0, w, w, 0], [0, 0, h, h], [1, 1, 1, 1]], dtype=np.float64)
    x, y, depth = layers @ corners
    left, right = np.clip([(x / depth).min() - 2, (x / depth).max() + 3], 0, frame_hw[1])
    top, bottom = np.clip([(y / depth).min() - 2, (y / depth).max() + 3], 0, frame_hw[0])
    rows, cols = slice(int(top), int(bottom)), slice(int(left), int(right))
    if rows.start >= rows.stop or cols.start >= cols.stop:
        return (rows, cols), None
    return (rows, cols), _shifted((-cols.start, -rows.start)) @ layers


def _warped(
    layer: Floats,
    motion: Pose,
    size_hw: tuple[int, ...],
    border: int,
    outside: float,
    interpolation: int = cv2.INTER_LINEAR,
) -> Floats:
    warped = cv2.warpPerspective(
        layer,
        motion,
        (size_hw[1], size_hw[0]),
        flags=interpolation,
        borderMode=border,
        borderValue=(outside, outside, outside),
    )
    return np.asarray(warped, dtype=np.float32)
