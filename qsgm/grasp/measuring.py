"""How large the object is in its demonstration, and what the frame is scaled by because of that.

The network looks at windows of 128 px, in which an object should span 60 to 110. A photograph does
not say how large its object is: so it is halved again and again, and cut out of every halving. A
cut that is right gives the same span in two of them; one that is a part of the object, or table
with it, hardly ever does. An object that is large in its frame has too little around it for that:
it is cut out of the whole frame.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, zip_longest
from math import sqrt

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
# What lies in several parts has to lie that much better in the middle, of its span, than one part.
_IN_PARTS = 0.08
_LEAST_PART_PX = 12
# The image's gradient along the edge of an object, over what it is elsewhere: light on a cloth ends
# gradually.
_LEAST_EDGE = 1.3
# A span on which nothing agrees is a guess, and this share of the shorter side the largest.
_LARGEST_GUESS = 0.5
_RIM_PX = 2  # of the whole frame, made small: table, whatever it looks like
_NEXT, _AROUND = np.ones((3, 3), np.uint8), np.ones((5, 5), np.uint8)


def measured_span(frame: Frame, center_px: Point) -> float | None:
    """Long side [px] of the object at `center_px` (x, y) in a frame (H, W, 3) BGR.

    None where no two sizes of the frame agree on it.
    """
    spans = _spans(frame, center_px)
    agreed = _agreed(spans) or _span_of_large(frame, center_px)
    if agreed is None:
        agreed = _span_between(frame, center_px, spans)
    if agreed is not None and agreed < LEAST_SPAN_PX:
        return _span_of_small(frame, center_px, agreed)
    return agreed


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


def _spans(frame: Frame, center_px: Point) -> list[float | None]:
    """The span [px of the frame] in each halving, from the frame itself on; None: no good cut."""
    spans: list[float | None] = []
    halved, times = frame, 1
    while min(halved.shape[:2]) >= _LEAST_HALVED_PX:
        span = _span(halved, moved_point(center_px, frame.shape[:2], halved.shape[:2]))
        spans.append(None if span is None else span * times)
        if (_agreed(spans) or 0.0) >= _LARGE_SHARE * min(frame.shape[:2]):
            break
        halved, times = scaled_frame(halved, 0.5), 2 * times
    return spans


@dataclass(frozen=True)
class _Cut:
    """What may be the object, in the whole frame made small."""

    span_px: float
    wide_px: float  # its shorter side
    off_middle: float  # how far from where the object was shown, of its span
    edge: float  # the image's gradient along it, over that elsewhere


def _span_of_large(frame: Frame, center_px: Point) -> float | None:
    """The span of an object that takes up much of its frame, by cuts of all of it.

    How far it reaches is not known, nor whether it is seen in one piece. Of several cuts that one
    counts which lies best in the middle of what was shown: a part of the object hardly ever does.
    What reaches from border to border counts as large as its frame.
    """
    shorter, longer = sorted(frame.shape[:2])
    small = scaled_frame(frame, _WHOLE_PX / shorter)
    middle = moved_point(center_px, frame.shape[:2], small.shape[:2])
    cuts = [cut for reach in _REACHES for cut in _cuts_of_whole(small, middle, reach)]
    least = _LEAST_WHOLE_SHARE * _WHOLE_PX
    sound = [cut for cut in cuts if cut.span_px >= least and cut.edge >= _LEAST_EDGE]
    best = min(sound, key=lambda cut: cut.off_middle, default=None)
    if best is None:
        return None
    fills = best.wide_px > _WHOLE_PX - 2 * _RIM_PX - 2
    return float(longer) if fills else best.span_px * shorter / _WHOLE_PX


def _cuts_of_whole(small: Frame, middle: Point, reach: float) -> Iterator[_Cut]:
    """What lies in the middle, then all that does not reach the border, if it is in parts."""
    down, right = np.ogrid[: small.shape[0], : small.shape[1]]
    away = np.hypot(right - middle[0], down - middle[1])
    inner = np.zeros(small.shape[:2], np.bool_)
    inner[_RIM_PX:-_RIM_PX, _RIM_PX:-_RIM_PX] = True
    trimap = np.where(inner, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    trimap[inner & (away < reach * _WHOLE_PX)] = cv2.GC_PR_FGD
    found, slope = cut_out(small, trimap), _slope(small)
    count, parts, sizes, _ = cv2.connectedComponentsWithStats(found.astype(np.uint8))
    in_middle = parts[found & (away < _SURE_SHARE * _WHOLE_PX)]
    if in_middle.size:
        yield _cut_of(parts == np.bincount(in_middle).argmax(), middle, slope)
    outermost = set(parts[_edge(inner)].tolist())
    whole = [
        part
        for part in range(1, count)
        if sizes[part, cv2.CC_STAT_AREA] >= _LEAST_PART_PX and part not in outermost
    ]
    if whole:
        yield _cut_of(np.isin(parts, whole), middle, slope, _IN_PARTS)


def _cut_of(
    pixels: NDArray[np.bool_], middle: Point, slope: NDArray[np.uint8], handicap: float = 0.0
) -> _Cut:
    (y, x), size, _ = cv2.minAreaRect(np.argwhere(pixels).astype(np.float32))
    (wide, span), edge = sorted(size), _edge(pixels)
    near = cv2.dilate(edge.astype(np.uint8), _AROUND) > 0
    elsewhere = 1.0 + float(np.median(slope[~near])) if not near.all() else np.inf
    off = float(np.hypot(x - middle[0], y - middle[1])) / max(span, 1.0) + handicap
    return _Cut(span, wide, off, float(np.median(slope[edge])) / elsewhere)


def _slope(image: Frame) -> NDArray[np.uint8]:
    """How much the levels of an image (h, w, 3) differ around each pixel: (h, w)."""
    return np.asarray(cv2.morphologyEx(image, cv2.MORPH_GRADIENT, _NEXT).max(axis=-1), np.uint8)


def _edge(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The outermost of some pixels (h, w)."""
    return np.asarray(pixels & (cv2.erode(pixels.astype(np.uint8), _NEXT) == 0))


def _span_between(frame: Frame, center_px: Point, spans: Sequence[float | None]) -> float | None:
    """Between the halvings, where an object may be that is too large in one, too small in two."""
    between = scaled_frame(frame, sqrt(0.5))
    middle = moved_point(center_px, frame.shape[:2], between.shape[:2])
    others = [span and span * sqrt(2) for span in _spans(between, middle)]
    mixed = [span for both in zip_longest(spans, others) for span in both]
    guess = max((span for span in mixed if span), default=None)
    if guess is not None and guess > _LARGEST_GUESS * min(frame.shape[:2]):
        guess = None
    return _agreed(mixed) or guess


def _span_of_small(frame: Frame, center_px: Point, span_px: float) -> float | None:
    """A span that is small, if it is the same in the frame enlarged: else it is that of a part."""
    left, top = (round(value) - PATCH_PX // 2 for value in center_px)
    doubled = scaled_frame(mirrored_square(frame, left, top, PATCH_PX), 2.0)
    middle = (PATCH_PX - 0.5, PATCH_PX - 0.5)
    large = _span(doubled, middle)
    return _agreed([None if large is None else large / 2, span_px])


def _span(frame: Frame, center_px: Point) -> float | None:
    patch = cut_patch(frame, center_px)
    if not patch.cut_out or patch.radius_px > LARGEST_RADIUS_PX - _TOUCHING_PX:
        return None
    long_px, _ = patch.span_px
    return long_px if long_px >= _LEAST_CUT_PX else None


def _agreed(spans: Sequence[float | None]) -> float | None:
    """The largest span on which two neighbouring halvings agree."""
    pairs = [(a, b) for a, b in pairwise(spans) if a and b]
    same = [a for a, b in pairs if max(a, b) <= _SAME_SPAN * min(a, b)]
    return max(same, default=None)
