"""Pictures of what `qsgm predict` found, drawn with OpenCV alone.

Everything is drawn on an enlarged canvas, so that lines and text are crisp whatever the frame's
size; lengths that belong to the drawing are in units of 1/1280 of the canvas width.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import as_text
from qsgm.grasp.angles import round_degrees
from qsgm.grasp.crops import HALF_CROP_PX
from qsgm.grasp.heatmap import CELL_PX, Detection
from qsgm.grasp.network import CROP_PX

Picture = NDArray[np.uint8]
Color = tuple[int, int, int]  # BGR
Point = tuple[float, float]  # (x, y) on the canvas

CANVAS_WIDTH_PX = 1280
# The heatmap shows from here up; below, the frame is untouched.
NOTABLE_QUALITY = 0.15
_HEAT_OPACITY = 0.6
_CONTOUR_QUALITY = 0.5
_STRIP_ROWS = 128  # of the canvas, for which the heatmap is drawn at once

_HEAT: Color = (60, 190, 255)  # amber
_GRIPPER: Color = (255, 255, 255)
_MOVE: Color = (255, 200, 70)  # sky blue
_OUTLINE: Color = (25, 22, 20)
_PANEL: Color = (34, 30, 28)
_VALUE: Color = (245, 245, 245)
_LABEL: Color = (170, 160, 155)
_GOOD: Color = (120, 205, 110)
_BAD: Color = (90, 95, 240)

# Lengths of the gripper symbol, in pixels that the network saw.
_OPENING_PX = 76.0
_FINGER_PX = 40.0
_AXIS_PX = 62.0
_BARB_PX = 11.0

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_SHIFT = 4  # fractional bits of OpenCV's sub-pixel drawing coordinates
_PANEL_HEIGHT = 150


@dataclass(frozen=True)
class _Canvas:
    """An enlarged frame to draw on."""

    image: Picture  # (scale * H, scale * W, 3)
    scale: int  # canvas pixels per frame pixel
    unit: float  # canvas pixels per drawing unit
    reach: float  # frame pixels per pixel that the network saw

    def at(self, frame_xy: Point) -> Point:
        """Where a point of the frame [px] lies on the canvas."""
        return frame_xy[0] * self.scale, frame_xy[1] * self.scale

    def thick(self, units: float) -> int:
        return max(1, round(units * self.unit))


def draw_detection(
    frame: Picture,
    heatmap: NDArray[np.float32],
    detection: Detection,
    title: str,
    instances: Sequence[Detection] = (),
) -> Picture:
    """Draw what was found, where, how far to move and how far to turn.

    Args:
        frame: (H, W, 3) BGR.
        heatmap: (3, rows, cols) as :func:`qsgm.grasp.heatmap.locate` took it; channel 0 is shown.
        detection: what it found.
        title: one line over the values, such as the object's name.
        instances: everything that is to be shown as found, if it is more than that.

    Returns:
        (H', W', 3) BGR: the enlarged frame with a caption below; W' is at least 1280.
    """
    whole, canvas = _enlarge(frame, 1 / detection.scale, _PANEL_HEIGHT)
    if not detection.found:
        _dim(canvas.image)
    _draw_heat(canvas, heatmap[0], HALF_CROP_PX - detection.margin_px)
    for other in instances:
        if other.center_px != detection.center_px:
            _draw_window(canvas, other.center_px)
            _draw_gripper(canvas, other)
    if detection.found:
        _draw_window(canvas, detection.center_px)
        _draw_move(canvas, _middle(frame), detection.center_px)
        _draw_turn(canvas, canvas.at(detection.center_px), math.radians(_turn_deg(detection)))
        _draw_gripper(canvas, detection)
    else:
        _draw_guess(canvas, detection.center_px)
    found = max(len(instances), int(detection.found))
    _caption(whole[len(canvas.image) :], canvas.unit, detection, title, found)
    return whole


def draw_objects(
    frame: Picture, places: Sequence[tuple[str, Detection]], *, enlarged: bool = True
) -> Picture:
    """Draw where several objects are, each with its name; those not found are listed below.

    Args:
        frame: (H, W, 3) BGR.
        places: by name of the object.
        enlarged: to at least 1280 px; else the picture is as large as the frame.
    """
    if enlarged:
        _, canvas = _enlarge(frame, 1.0, 0)
    else:
        canvas = _Canvas(frame.copy(), 1, max(frame.shape[1] / CANVAS_WIDTH_PX, 0.6), 1.0)
    for name, place in places:
        if place.found:
            seen = replace(canvas, reach=1 / place.scale)
            _draw_window(seen, place.center_px)
            _draw_gripper(seen, place)
            x, y = seen.at(place.center_px)
            corner = HALF_CROP_PX * seen.scale * seen.reach
            _label(canvas, f"{name} {place.quality:.2f}", (x - corner, y - corner), _GOOD)
    absent = [name for name, place in places if not place.found]
    if absent:
        below = (12 * canvas.unit, canvas.image.shape[0] - 16 * canvas.unit)
        _label(canvas, "not found: " + ", ".join(absent), below, _BAD)
    return canvas.image


def _label(canvas: _Canvas, text: str, at: Point, color: Color) -> None:
    """Text with a dark rim, inside of the canvas.

    The rim is the text itself, moved: a heavier one is wider, and would lie beside it.
    """
    size, (height, width) = canvas.unit * 0.8, canvas.image.shape[:2]
    shown = _shortened(as_text(text), width - 16 * canvas.unit, size, bold=True)
    x = min(max(at[0], 8 * canvas.unit), width - 8 * canvas.unit - _text_width(shown, size, True))
    y = min(max(at[1], 32 * canvas.unit), height - 8)
    rim = max(1, canvas.thick(3) // 2)
    for right, down in product((-rim, 0, rim), repeat=2):
        _text(canvas.image, shown, (x + right, y + down), size, _OUTLINE, bold=True)
    _text(canvas.image, shown, (x, y), size, color, bold=True)


def _enlarge(frame: Picture, reach: float, below: int) -> tuple[Picture, _Canvas]:
    """A picture with room below, in drawing units, and the canvas that is the rest of it."""
    scale = max(1, math.ceil(CANVAS_WIDTH_PX / frame.shape[1]))
    height, width = (scale * side for side in frame.shape[:2])
    unit = width / CANVAS_WIDTH_PX
    whole = np.empty((height + round(below * unit), width, 3), np.uint8)
    cv2.resize(frame, (width, height), whole[:height], interpolation=cv2.INTER_CUBIC)
    return whole, _Canvas(whole[:height], scale, unit, reach)


def _dim(image: Picture) -> None:
    """Darken a picture (H, W, 3) and take its colours away, in place."""
    dark = np.rint(np.arange(256, dtype=np.float32) * np.float32(0.7)).astype(np.uint8)
    grey = cv2.LUT(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dark)
    cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR, image)


def _draw_heat(canvas: _Canvas, quality: NDArray[np.float32], first_px: int) -> None:
    """Lay the quality (rows, cols) over the canvas where it is notable, with a line at 0.5.

    The first cell's window has its middle `first_px` from the corner of the scaled frame.
    """
    height, width = canvas.image.shape[:2]
    step, first = (side * canvas.scale * canvas.reach for side in (CELL_PX, first_px))
    inside = np.zeros((height, width), np.uint8)
    highest = max(strip.max() for _, strip in _smooth(quality, step, first, (height, width)))
    # The blur lowers narrow blobs: give the best cell its own value back.
    gain = float(np.max(quality)) / highest if highest > 0 else 1.0
    for rows, strip in _smooth(quality, step, first, (height, width)):
        heat = strip * gain
        _warm(canvas.image[rows], heat)
        inside[rows] = heat >= _CONTOUR_QUALITY
    contours, _ = cv2.findContours(inside, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(canvas.image, contours, -1, _HEAT, canvas.thick(1.5), cv2.LINE_AA)


def _smooth(
    quality: NDArray[np.float32], step: float, first: float, canvas_hw: tuple[int, int]
) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """The quality of every pixel, strip by strip with its rows: all at once takes much memory.

    Cells (rows, cols) are `step` pixels apart, the first one `first` pixels from the corner.
    """
    height, width = canvas_hw
    sigma = step / 3
    reach = math.ceil(4 * sigma) + 1
    for start in range(0, height, _STRIP_ROWS):
        stop = min(start + _STRIP_ROWS, height)
        top, bottom = max(start - reach, 0), min(stop + reach, height)
        cell_of_pixel = np.array(
            [[1 / step, 0, -first / step], [0, 1 / step, (top - first) / step]]
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        sharp = cv2.warpAffine(quality, cell_of_pixel, (width, bottom - top), flags=flags)
        smooth = cv2.GaussianBlur(sharp, (0, 0), sigma)
        yield slice(start, stop), np.asarray(smooth[start - top : stop - top], np.float32)


def _warm(image: Picture, heat: NDArray[np.float32]) -> None:
    """Lay heat (h, w) over a picture (h, w, 3) where it is notable, in place."""
    opacity = np.clip((heat - NOTABLE_QUALITY) / (1 - NOTABLE_QUALITY), 0, 1) * _HEAT_OPACITY
    warm = opacity > 0
    mixed = image[warm] + opacity[warm][:, None] * (np.array(_HEAT) - image[warm])
    image[warm] = np.rint(mixed).astype(np.uint8)


def _draw_window(canvas: _Canvas, center: Point) -> None:
    """Corners of the 128x128 window that the network saw there."""
    arm, half = 14.0 * canvas.reach, HALF_CROP_PX * canvas.reach
    for right in (-1, 1):
        for down in (-1, 1):
            x, y = center[0] + right * half, center[1] + down * half
            corner = [(x - right * arm, y), (x, y), (x, y - down * arm)]
            _line(canvas, [canvas.at(point) for point in corner], _GRIPPER, 2)


def _draw_move(canvas: _Canvas, start: Point, end: Point) -> None:
    """The way from the frame's centre, marked by a small cross, to the object's centre."""
    x, y = canvas.at(start)
    arm = 10 * canvas.unit
    _line(canvas, [(x - arm, y), (x + arm, y)], _MOVE, 3)
    _line(canvas, [(x, y - arm), (x, y + arm)], _MOVE, 3)
    tip = canvas.at(end)
    length = math.dist((x, y), tip)
    clear = 14 * canvas.unit  # room for the dot at the centre
    if length < 3 * clear:
        return
    way = ((tip[0] - x) / length, (tip[1] - y) / length)
    head = (x + way[0] * (length - clear), y + way[1] * (length - clear))
    barb = 16 * canvas.unit
    left = (head[0] - barb * (way[0] + 0.5 * way[1]), head[1] - barb * (way[1] - 0.5 * way[0]))
    right = (head[0] - barb * (way[0] - 0.5 * way[1]), head[1] - barb * (way[1] + 0.5 * way[0]))
    _line(canvas, [(x, y), head], _MOVE, 3)
    _line(canvas, [left, head, right], _MOVE, 3)


def _draw_gripper(canvas: _Canvas, found: Detection) -> None:
    """Two finger bars and the axis they close along; at angle 0 that axis is horizontal.

    Where the full turn is known, an arrow shows what was the right-hand side when it was taught.
    """
    x, y = canvas.at(found.center_px)
    angle_rad, grown = math.radians(_turn_deg(found)), canvas.scale * canvas.reach

    def place(along: float, across: float) -> Point:
        """Lengths in the network's pixels along and across the axis; counter-clockwise is up."""
        cos, sin = math.cos(angle_rad), math.sin(angle_rad)
        return x + grown * (along * cos + across * sin), y + grown * (across * cos - along * sin)

    _line(canvas, [place(-_AXIS_PX, 0), place(_AXIS_PX, 0)], _GRIPPER, 2)
    if found.full_angle_deg is not None:
        head = [place(_AXIS_PX - _BARB_PX, side * 0.6 * _BARB_PX) for side in (-1, 1)]
        _line(canvas, [head[0], place(_AXIS_PX, 0), head[1]], _GRIPPER, 3)
    for side in (-_OPENING_PX / 2, _OPENING_PX / 2):
        _line(canvas, [place(side, -_FINGER_PX / 2), place(side, _FINGER_PX / 2)], _GRIPPER, 8)
    _dot(canvas, (x, y), 5, _GRIPPER)


def _turn_deg(found: Detection) -> float:
    """Over the full circle where that is known."""
    return found.angle_deg if found.full_angle_deg is None else found.full_angle_deg


def _draw_turn(canvas: _Canvas, center: Point, angle_rad: float) -> None:
    """A dashed line where the axis was in the demonstration, and an arc from there to here."""
    x, y = center
    grown = canvas.scale * canvas.reach
    radius = (_AXIS_PX - 6) * grown
    dashes = np.linspace(0, _AXIS_PX * grown, 16)
    for start, end in zip(dashes[0::2], dashes[1::2], strict=True):
        _line(canvas, [(x + start, y), (x + end, y)], _HEAT, 2)
    turns = np.linspace(0, angle_rad, 40)
    arc = [(x + radius * math.cos(t), y - radius * math.sin(t)) for t in turns]
    _line(canvas, arc, _HEAT, 2)


def _draw_guess(canvas: _Canvas, center: Point) -> None:
    """A quiet ring where the quality was highest, though not high enough."""
    x, y = canvas.at(center)
    turns = np.linspace(0, 2 * math.pi, 97)
    radius = CROP_PX / 4 * canvas.scale * canvas.reach
    for start in range(0, 96, 8):
        arc = [
            (x + radius * math.cos(t), y + radius * math.sin(t)) for t in turns[start : start + 5]
        ]
        _line(canvas, arc, _BAD, 2)


def _caption(panel: Picture, unit: float, detection: Detection, title: str, found: int) -> None:
    """Fill the panel below the frame: title, verdict and the four values."""
    width = panel.shape[1]
    panel[:] = _PANEL
    accent = _GOOD if detection.found else _BAD
    panel[:, : round(10 * unit)] = accent
    verdict = (f"{found} found" if found > 1 else "found") if detection.found else "NOT FOUND"
    verdict_width = _text_width(verdict, unit * 0.85, bold=True)
    _text(panel, verdict, (width - 36 * unit - verdict_width, 44 * unit), unit * 0.85, accent, True)
    room = width - 110 * unit - verdict_width
    title = _shortened(as_text(title), room, unit * 0.85)
    _text(panel, title, (36 * unit, 44 * unit), unit * 0.85, _VALUE)
    for column, (label, value) in enumerate(_values(detection)):
        x = (36 + 310 * column) * unit
        _text(panel, label, (x, 86 * unit), unit * 0.6, _LABEL)
        _text(panel, value, (x, 124 * unit), unit * 0.9, _VALUE)
    _quality_bar(panel, detection.quality, ((36 + 310 * 3 + 110) * unit, 112 * unit), unit, accent)


def _values(detection: Detection) -> list[tuple[str, str]]:
    """Labels and values of the caption's columns."""
    quality = ("quality", f"{detection.quality:.2f}")
    x, y = detection.center_px
    if not detection.found:
        return [("best guess at", f"{x:.0f}, {y:.0f} px"), ("move", "-"), ("turn", "-"), quality]
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    right, down = (round(value, 1) + 0.0 for value in detection.displacement_px)
    full = detection.full_angle_deg
    turn = round_degrees(detection.angle_deg, 1) if full is None else round(full, 1) + 0.0
    return [
        ("centre (x, y)", f"{x:.1f}, {y:.1f} px"),
        ("move (right, down)", f"{right:+.1f}, {down:+.1f} px"),
        ("turn (counter-clockwise)", f"{turn:+.1f} deg"),
        quality,
    ]


def _quality_bar(panel: Picture, quality: float, at: Point, unit: float, color: Color) -> None:
    left, top = round(at[0]), round(at[1])
    width, height = round(170 * unit), max(2, round(10 * unit))
    panel[top : top + height, left : left + width] = (70, 64, 60)
    panel[top : top + height, left : left + round(width * min(max(quality, 0.0), 1.0))] = color


def _middle(frame: Picture) -> Point:
    return frame.shape[1] / 2, frame.shape[0] / 2


def _line(canvas: _Canvas, points: list[Point], color: Color, units: float) -> None:
    """An anti-aliased line with a dark rim, legible on any background."""
    path = [np.rint(np.array(points) * (1 << _SHIFT)).astype(np.int32)]
    thickness, rim = canvas.thick(units), canvas.thick(1.5)
    for paint, width in ((_OUTLINE, thickness + 2 * rim), (color, thickness)):
        cv2.polylines(canvas.image, path, False, paint, width, cv2.LINE_AA, _SHIFT)


def _dot(canvas: _Canvas, center: Point, units: float, color: Color) -> None:
    at = (round(center[0] * (1 << _SHIFT)), round(center[1] * (1 << _SHIFT)))
    for paint, grow in ((_OUTLINE, 2.0), (color, 0.0)):
        radius = round((units + grow) * canvas.unit * (1 << _SHIFT))
        cv2.circle(canvas.image, at, radius, paint, cv2.FILLED, cv2.LINE_AA, _SHIFT)


def _text(
    image: Picture, text: str, at: Point, scale: float, color: Color, bold: bool = False
) -> None:
    """Text with its baseline starting at a point (x, y)."""
    where = (round(at[0]), round(at[1]))
    cv2.putText(image, text, where, _FONT, scale, color, _weight(scale, bold), cv2.LINE_AA)


def _text_width(text: str, scale: float, bold: bool = False) -> int:
    return int(cv2.getTextSize(text, _FONT, scale, _weight(scale, bold))[0][0])


def _weight(scale: float, bold: bool) -> int:
    return max(1, round(scale * (2.4 if bold else 1.4)))


def _shortened(text: str, room: float, scale: float, bold: bool = False) -> str:
    """As much of a text as fits."""
    if _text_width(text, scale, bold) <= room:
        return text
    while text and _text_width(text + "...", scale, bold) > room:
        text = text[:-1]
    return text + "..."
