"""Room around an object that is large in its demonstration, or close to its border.

Windows of 128 px are cut around the object and beside it. Where a frame is too small for that, it
is continued by its own mirror image, from which the object was removed first: else it would show
itself again, as something that it is not.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.crops import HALF_CROP_PX
from qsgm.grasp.patch import cut_patch
from qsgm.grasp.source import Demonstration

# A frame has at least that on each side, and around the object's centre.
LEAST_SIDE_PX, LEAST_AROUND_PX = 256, 96
# Around the object's pixels, where its shadow is.
_GROWN_PX = 9
_INPAINTED_FROM_PX = 3.0


def with_room(one: Demonstration) -> Demonstration:
    """The demonstration itself where it has room around its object, else continued."""
    height, width = one.frame.shape[:2]
    x, y = one.center_px
    near = min(x, y, width - x, height - y)
    if min(height, width) >= LEAST_SIDE_PX and near >= HALF_CROP_PX:
        return one
    left, right = _added(x, width)
    top, bottom = _added(y, height)
    room = top, bottom, left, right
    empty = _without_object(one.frame, one.center_px)
    wide = np.asarray(cv2.copyMakeBorder(empty, *room, cv2.BORDER_REFLECT_101), dtype=np.uint8)
    wide[top : top + height, left : left + width] = one.frame
    return Demonstration(wide, (x + left, y + top))


def _added(center: float, size: int) -> tuple[int, int]:
    """How much is added before and behind, so that there is enough around a centre."""
    before = max(round(LEAST_AROUND_PX - center), 0)
    behind = max(round(center + LEAST_AROUND_PX - size), 0)
    missing = max(LEAST_SIDE_PX - (before + size + behind), 0)
    return before + missing // 2, behind + missing - missing // 2


def _without_object(frame: NDArray[np.uint8], center_px: tuple[float, float]) -> NDArray[np.uint8]:
    """The frame (H, W, 3) with its object painted over by what lies around it."""
    patch = cut_patch(frame, center_px)
    grown = cv2.dilate(patch.mask, np.ones((_GROWN_PX, _GROWN_PX), np.uint8))
    side = len(grown)
    left, top = (
        round(value - middle) for value, middle in zip(center_px, patch.center_px, strict=True)
    )
    covered = np.zeros((frame.shape[0] + 2 * side, frame.shape[1] + 2 * side), np.uint8)
    covered[side + top : side + top + side, side + left : side + left + side] = grown
    hole = np.ascontiguousarray(covered[side:-side, side:-side])
    painted = cv2.inpaint(frame, hole, _INPAINTED_FROM_PX, cv2.INPAINT_TELEA)
    return np.asarray(painted, dtype=np.uint8)
