"""How large the object is in its demonstration, and what the frame is scaled by because of that.

The network looks at windows of 128 px, in which an object should span 60 to 110. A photograph does
not say how large its object is: so it is halved again and again, and cut out of every halving. A
cut that is right gives the same span in two of them; one that is a part of the object, or table
with it, hardly ever does. Where no two agree, as of an object that is large in its frame, it is
cut out of the whole frame, too, and of all cuts that counts which lies best where it was shown.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.patch import LARGEST_RADIUS_PX, PATCH_PX, cut_out, cut_patch, mirrored_square

Frame = NDArray[np.uint8]
Point = tuple[float, float]

# A span between these is left as it is: the frame is not scaled at all.
LEAST_SPAN_PX, LARGEST_SPAN_PX = 45.0, 124.0
IDEAL_SPAN_PX = 90.0
MOST_ENLARGED = 2.0
# An object that spans more of its frame's longer side has nothing around it.
LARGEST_SHARE = 0.95
# Spans in two halvings that differ by less than this factor are of the same thing.
_SAME_SPAN = 1.25
# A cut that reaches the radius where GrabCut is told that everything is table was cut off there.
_TOUCHING_PX = 2.0
# A halving with less than this on each side shows hardly more than the patch's mirrored border.
_LEAST_HALVED_PX = 3 * PATCH_PX // 4
# An object of this share of the frame's shorter side is hardly a part of a larger one.
_LARGE_SHARE = 0.12
# Of a halving's pixels: a cut that spans less is mostly noise.
_LEAST_CUT_PX = 18.0
# Cut out of the whole frame: its shorter side then, and as shares of it how far from the centre the
# object may reach, where it surely is, and what it spans at least.
_WHOLE_PX, _REACHES, _SURE_SHARE, _LEAST_WHOLE_SHARE = 96, (0.3, 0.5, 0.65), 0.12, 0.2
# Of a long narrow frame so many times its shorter side on each side of the centre are looked at.
_MOST_WHOLE = 2
# What lies in several parts has to lie that much better in the middle, of its span, than one part.
_IN_PARTS = 0.08
_LEAST_PART_PX = 12
# What is as large as its frame lies in the middle whatever it is, and has to be so much better;
# of what lies there as well, to so much, the largest counts.
_AS_LARGE_AS_FRAME, _AS_WELL = 0.1, 0.01
# The image's gradient along the edge of an object, over what it is elsewhere: light on a cloth ends
# gradually.
_LEAST_EDGE = 1.3
_RIM_PX = 2  # of the whole frame, made small: table, whatever it looks like
_NEXT, _AROUND = np.ones((3, 3), np.uint8), np.ones((5, 5), np.uint8)


def measured_span(frame: Frame, center_px: Point) -> float | None:
    """Long side [px] of the object at `center_px` (x, y) in a frame (H, W, 3) BGR.

    None where nothing can be cut out that is neither too small nor too large.
    """
    cuts = _cuts(frame, center_px)
    span = _agreed(cuts)
    if span is None:
        every = [*filter(None, cuts), *_cuts_of_whole(frame, center_px)]
        span = _best_in_middle(every, min(frame.shape[:2]))
    if span is not None and span < LEAST_SPAN_PX:
        return _span_of_small(frame, center_px, span)
    return span


def scale_for(span_px: float | None, frame_hw: tuple[int, int]) -> float:
    """What a frame is scaled by so that its object fits the network's windows.

    Args:
        span_px: the object's long side; None, or one that fits: 1.
        frame_hw: height and width [px].

    Raises:
        QsgmError: the object fills its frame, so that there is nothing beside it to tell it from.
    """
    if span_px is None or LEAST_SPAN_PX <= span_px <= LARGEST_SPAN_PX:
        return 1.0
    if span_px > LARGEST_SHARE * max(frame_hw):
        height, width = frame_hw
        raise QsgmError(
            f"the object spans about {span_px:.0f} px of the {width}x{height} frame, which leaves "
            "nothing around it to tell it from; step back, or say how large it is with --span"
        )
    return min(IDEAL_SPAN_PX / span_px, MOST_ENLARGED)


def scaled_frame(frame: Frame, scale: float) -> Frame:
    """A frame (H, W, 3) made smaller by area or larger by bilinear interpolation."""
    if scale == 1.0:
        return frame
    height, width = scaled_shape(frame.shape[:2], scale)
    how = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(frame, (width, height), interpolation=how), dtype=np.uint8)


def scaled_shape(frame_hw: tuple[int, ...], scale: float) -> tuple[int, int]:
    """Height and width of a scaled frame."""
    height, width = (max(round(side * scale), 1) for side in frame_hw)
    return height, width


def moved_point(point_px: Point, source_hw: tuple[int, int], target_hw: tuple[int, int]) -> Point:
    """Where a point (x, y) of a frame lies in the same frame at another size."""
    x, y = (
        (value + 0.5) * target / source - 0.5
        for value, source, target in zip(point_px, source_hw[::-1], target_hw[::-1], strict=True)
    )
    return x, y


@dataclass(frozen=True)
class _Cut:
    """What may be the object."""

    span_px: float  # of the frame
    off_middle: float  # how far from where the object was shown, of its span


def _best_in_middle(cuts: Sequence[_Cut], shorter_px: int) -> float | None:
    """The span of that cut which lies best in the middle of what was shown.

    A part of the object hardly ever does, nor does the object with something else.

    Args:
        cuts: of a frame.
        shorter_px: its shorter side.
    """

    def off_middle(cut: _Cut) -> float:
        return cut.off_middle + _AS_LARGE_AS_FRAME * (cut.span_px / shorter_px) ** 12

    least = min(map(off_middle, cuts), default=0.0)
    best = [cut.span_px for cut in cuts if off_middle(cut) <= least + _AS_WELL]
    return max(best, default=None)


def _cuts(frame: Frame, center_px: Point) -> list[_Cut | None]:
    """The cut in each halving, from the frame itself on; None: no good one."""
    cuts: list[_Cut | None] = []
    halved, times = frame, 1
    while min(halved.shape[:2]) >= _LEAST_HALVED_PX:
        cut = _cut(halved, moved_point(center_px, frame.shape[:2], halved.shape[:2]))
        cuts.append(None if cut is None else replace(cut, span_px=cut.span_px * times))
        if (_agreed(cuts) or 0.0) >= _LARGE_SHARE * min(frame.shape[:2]):
            break
        halved, times = scaled_frame(halved, 0.5), 2 * times
    return cuts


def _cuts_of_whole(frame: Frame, center_px: Point) -> list[_Cut]:
    """Cuts of an object that takes up much of its frame, out of all of it.

    How far it reaches is not known, nor whether it is seen in one piece. What reaches from border
    to border counts as large as its frame.
    """
    shorter, longer = sorted(frame.shape[:2])
    left, top = (max(round(value) - _MOST_WHOLE * shorter, 0) for value in center_px)
    near = frame[top : top + 2 * _MOST_WHOLE * shorter, left : left + 2 * _MOST_WHOLE * shorter]
    small = scaled_frame(near, _WHOLE_PX / shorter)
    middle = moved_point((center_px[0] - left, center_px[1] - top), near.shape[:2], small.shape[:2])
    slope, cuts = _slope(small), list[_Cut]()
    for reach in _REACHES:
        for pixels, handicap in _found_in_whole(small, middle, reach):
            (y, x), size, _ = cv2.minAreaRect(np.argwhere(pixels).astype(np.float32))
            wide, span = sorted(size)
            if span < _LEAST_WHOLE_SHARE * _WHOLE_PX or _sharpness(pixels, slope) < _LEAST_EDGE:
                continue
            off = float(np.hypot(x - middle[0], y - middle[1])) / span
            fills = wide > _WHOLE_PX - 2 * _RIM_PX - 2
            span_px = float(longer) if fills else span * shorter / _WHOLE_PX
            cuts.append(_Cut(span_px, off + handicap))
    return cuts


def _found_in_whole(
    small: Frame, middle: Point, reach: float
) -> Iterator[tuple[NDArray[np.bool_], float]]:
    """What lies in the middle, then all parts that do not reach the border, with a handicap."""
    down, right = np.ogrid[: small.shape[0], : small.shape[1]]
    away = np.hypot(right - middle[0], down - middle[1])
    inner = np.zeros(small.shape[:2], np.bool_)
    inner[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX] = True
    trimap = np.where(inner, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    trimap[inner & (away < reach * _WHOLE_PX)] = cv2.GC_PR_FGD
    found = cut_out(small, trimap)
    count, parts, sizes, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8))
    in_middle = parts[found & (away < _SURE_SHARE * _WHOLE_PX)]
    if in_middle.size:
        yield parts == np.bincount(in_middle).argmax(), 0.0
    outermost = set(parts[_edge(inner)].tolist())
    whole = [
        part
        for part in range(1, count)
        if sizes[part, cv2.CC_STAT_AREA] >= _LEAST_PART_PX and part not in outermost
    ]
    if whole:
        yield np.isin(parts, whole), _IN_PARTS


def _sharpness(pixels: NDArray[np.bool_], slope: NDArray[np.uint8]) -> float:
    """The image's gradient along the edge of some pixels, over that elsewhere."""
    edge = _edge(pixels)
    away = cv2.dilate(edge.astype(np.uint8), _AROUND) == 0
    elsewhere = float(np.median(slope[away])) if away.any() else np.inf
    return float(np.median(slope[edge])) / (1.0 + elsewhere)


def _slope(image: Frame) -> NDArray[np.uint8]:
    """How much the levels of an image (h, w, 3) differ around each pixel: (h, w)."""
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_GRADIENT, _NEXT).max(axis=-1), np.uint8)


def _edge(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The outermost of some pixels (h, w)."""
    return np.asarray(pixels & (cv2.erode(pixels.astype(np.uint8), _NEXT) == 0))


def _span_of_small(frame: Frame, center_px: Point, span_px: float) -> float | None:
    """A span that is small, if it is the same in the frame enlarged: else it is that of a part."""
    left, top = (round(value) - PATCH_PX // 2 for value in center_px)
    doubled = scaled_frame(mirrored_square(frame, left, top, PATCH_PX), 2.0)
    middle = (PATCH_PX - 0.5, PATCH_PX - 0.5)
    large = _cut(doubled, middle)
    return large.span_px / 2 if large and _same(large.span_px / 2, span_px) else None


def _cut(frame: Frame, center_px: Point) -> _Cut | None:
    patch = cut_patch(frame, center_px)
    if not patch.cut_out or patch.radius_px > LARGEST_RADIUS_PX - _TOUCHING_PX:
        return None
    (x, y), size, _ = cv2.minAreaRect(cv2.findNonZero(patch.mask))
    if max(size) < _LEAST_CUT_PX:
        return None
    off = float(np.hypot(x - patch.center_px[0], y - patch.center_px[1]))
    return _Cut(float(max(size)), off / max(size))


def _agreed(cuts: Sequence[_Cut | None]) -> float | None:
    """The largest span on which two neighbouring halvings agree."""
    pairs = [(a.span_px, b.span_px) for a, b in pairwise(cuts) if a and b]
    return max((a for a, b in pairs if _same(a, b)), default=None)


def _same(one_px: float, other_px: float) -> bool:
    return max(one_px, other_px) <= _SAME_SPAN * min(one_px, other_px)
