"""The scenes benchmark at a glance: a row per condition, drawn with OpenCV alone.

Left what became of the scenes with the object, then the false alarms without it, then examples:
scenes that are evenly spread over the subjects, not picked by how they went.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.bench.composing import CONDITIONS, Scene
from qsgm.bench.judging import Judged, Outcome, Spot

Picture = NDArray[np.uint8]
Color = tuple[int, int, int]  # BGR

EXAMPLES = 4  # per condition, the last of them without the object
PICTURES_OF_EACH = 2  # of every way to go wrong in a condition

_SCALE = 2  # drawn larger, then made smaller: smooth edges everywhere
_PAPER: Color = (255, 255, 255)
_INK: Color = (50, 42, 38)
_FAINT: Color = (150, 140, 132)
_RULE: Color = (228, 224, 220)
_COLORS: dict[Outcome, Color] = {
    "right_place": (110, 160, 46),
    "wrong_thing": (60, 60, 214),
    "background": (54, 150, 242),
    "missed": (205, 199, 194),
    "false_alarm": (60, 60, 214),
    "quiet": (205, 199, 194),
}
_ON: dict[Spot, Color] = {
    "object": _COLORS["right_place"],
    "thing": _COLORS["wrong_thing"],
    "background": _COLORS["background"],
}
_ROW, _TOP, _BOTTOM = 132, 122, 56
_LABEL_X, _BAR_X, _BAR_WIDTH, _ALARM_X, _ALARM_WIDTH = 28, 172, 300, 522, 150
_BAR_HEIGHT = 30
_THUMB = (160, 120)  # width, height
_LARGE_THUMB = (_SCALE * _THUMB[0], _SCALE * _THUMB[1])
_THUMB_X, _THUMB_STEP = 722, 170
_WIDTH = _THUMB_X + EXAMPLES * _THUMB_STEP + 18


@dataclass
class Album:
    """Keeps a few scenes with their answers drawn: examples, and ways to go wrong."""

    subjects: tuple[str, ...]  # names of those that are taught, in their order
    examples: dict[str, dict[int, Picture]] = field(default_factory=dict)  # of each column
    failures: dict[str, Picture] = field(default_factory=dict)
    _kept: dict[tuple[str, Outcome], int] = field(default_factory=dict)

    def look(self, scene: Scene, judged: Judged) -> None:
        """Keep a scene if it is one of the examples, or among the first to go wrong this way."""
        truth, outcome = judged.truth, judged.outcome
        column = self._column(judged)
        if column is not None:
            drawn = annotated(scene, judged, thickness=4)
            small = cv2.resize(drawn, _LARGE_THUMB, interpolation=cv2.INTER_AREA)
            self.examples.setdefault(truth.condition, {})[column] = np.asarray(small, np.uint8)
        key = truth.condition, outcome
        if outcome in ("right_place", "quiet") or self._kept.get(key, 0) == PICTURES_OF_EACH:
            return
        self._kept[key] = self._kept.get(key, 0) + 1
        name = f"{truth.condition}_{outcome}_{truth.frame}_{truth.number}"
        self.failures[name] = annotated(scene, judged, thickness=2)

    def _column(self, judged: Judged) -> int | None:
        """Where a scene is an example; every column and condition shows other subjects."""
        truth, count = judged.truth, len(self.subjects)
        shift = CONDITIONS.index(truth.condition) % max(count // EXAMPLES, 1)
        shown = [(k * count) // EXAMPLES + shift for k in range(EXAMPLES)]
        taken = self.examples.get(truth.condition, {})
        last = EXAMPLES - 1
        if truth.present:
            free = (k for k in range(last) if k not in taken)
            return next((k for k in free if self.subjects[shown[k]] == truth.frame), None)
        fits = self.subjects[shown[last]] == truth.frame
        return last if fits and (truth.absent_thing or last not in taken) else None


def annotated(scene: Scene, judged: Judged, thickness: int) -> Picture:
    """The scene with the answer: a box in the outcome's colour, a cross at the true centre."""
    picture = scene.frame.copy()
    if judged.truth.center_px is not None:
        x, y = (round(value) for value in judged.truth.center_px)
        for color, width in ((_INK, thickness + 2), (_PAPER, thickness)):
            cv2.drawMarker(picture, (x, y), color, cv2.MARKER_CROSS, 9 * thickness, width)
    if judged.answer.found:
        color = _ON[judged.spot]
        turned = -np.radians(judged.answer.turn_deg)  # y points down
        corners = np.array([[-60, -34], [60, -34], [60, 34], [-60, 34]]) @ np.array(
            [[np.cos(turned), np.sin(turned)], [-np.sin(turned), np.cos(turned)]]
        )
        box = np.rint(16 * (corners + np.array(judged.answer.center_px))).astype(np.int32)
        for paint, width in ((_PAPER, thickness + 4), (color, thickness + 1)):
            cv2.polylines(picture, [box], True, paint, width, cv2.LINE_AA, 4)
    return picture


def draw_scenes(values: dict[str, Any], album: Album) -> Picture:
    """The whole picture of a report (:func:`qsgm.bench.scenes_report.report_json`)."""
    conditions: dict[str, Any] = values["conditions"]
    height = _TOP + _ROW * (len(conditions) + 1) + _BOTTOM
    page = np.full((_SCALE * height, _SCALE * _WIDTH, 3), _PAPER, dtype=np.uint8)
    _head(page, values)
    rows = [*conditions.items(), ("all of them", values["pooled"])]
    for k, (name, row) in enumerate(rows):
        top = _TOP + k * _ROW
        _rule(page, top, _FAINT if k == len(rows) - 1 else _RULE)
        _row(page, name.replace("_", " "), row, top, bold=k == len(rows) - 1)
        for i, thumb in album.examples.get(name, {}).items():
            _paste(page, thumb, _THUMB_X + i * _THUMB_STEP, top + (_ROW - _THUMB[1]) // 2)
    _legend(page, height - 26)
    small = cv2.resize(page, (_WIDTH, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8)


def _head(page: Picture, values: dict[str, Any]) -> None:
    how = "backpropagation" if values["method"] == "bp" else f"{values['precision']} SGMs"
    title = f"Taught on one frame of each of {values['objects']} objects, looked for in scenes"
    _text(page, title, (_LABEL_X, 42), 0.78, _INK, bold=True)
    line = f"last {values['layers']} layers, {how}, {values['epochs']} epochs"
    _text(page, line if values["epochs"] else "untouched", (_LABEL_X, 68), 0.5, _FAINT)
    _text(page, f"found in its right place, {values['scenes']} scenes", (_BAR_X, 106), 0.5, _INK)
    _text(page, "found though absent", (_ALARM_X, 106), 0.5, _INK)
    _text(page, "examples", (_THUMB_X, 106), 0.5, _INK)
    last = _THUMB_X + (EXAMPLES - 1) * _THUMB_STEP
    _text(page, "without it", (last, 106), 0.5, _INK)


def _row(page: Picture, name: str, row: dict[str, Any], top: int, *, bold: bool) -> None:
    middle = top + _ROW // 2
    _text(page, name, (_LABEL_X, middle + 6), 0.56, _INK, bold=bold)
    bar = middle - _BAR_HEIGHT // 2
    left = float(_BAR_X)
    for outcome in ("right_place", "wrong_thing", "background", "missed"):
        width = _BAR_WIDTH * row[outcome]
        _box(page, left, bar, width, _COLORS[outcome])
        left += width
    _interval(page, row["right_place_95"], _BAR_X, _BAR_WIDTH, bar + _BAR_HEIGHT + 7)
    _text(page, f"{100 * row['right_place']:.1f} %", (_BAR_X, bar - 8), 0.5, _INK, bold=bold)
    _alarms(page, row, middle, bold=bold)


def _alarms(page: Picture, row: dict[str, Any], middle: int, *, bold: bool) -> None:
    """False alarms on other things and on background."""
    left, bar = float(_ALARM_X), middle - _BAR_HEIGHT // 2
    _box(page, left, bar, _ALARM_WIDTH, (244, 242, 240))
    for spot in ("thing", "background"):
        width = _ALARM_WIDTH * row[f"false_alarm_{spot}"]
        _box(page, left, bar, width, _ON[spot])
        left += width
    _interval(page, row["false_alarm_95"], _ALARM_X, _ALARM_WIDTH, bar + _BAR_HEIGHT + 7)
    _text(page, f"{100 * row['false_alarm']:.1f} %", (_ALARM_X, bar - 8), 0.5, _INK, bold=bold)


def _interval(page: Picture, ends: Sequence[float], left: int, width: int, y: int) -> None:
    """A thin line under a bar: the 95 % interval of its first part."""
    low, high = (left + width * value for value in ends)
    _line(page, (low, y), (high, y), _INK)
    for x in (low, high):
        _line(page, (x, y - 3), (x, y + 3), _INK)


def _legend(page: Picture, y: int) -> None:
    x = _LABEL_X
    entries: tuple[tuple[str, Outcome], ...] = (
        ("right place", "right_place"),
        ("on a wrong thing", "wrong_thing"),
        ("on background", "background"),
        ("not found", "missed"),
    )
    for label, outcome in entries:
        _box(page, x, y - 11, 14, _COLORS[outcome], height=14)
        _text(page, label, (x + 22, y), 0.5, _INK)
        x += 22 + round(_text_width(label, 0.5)) + 26
    end = "lines under the bars: 95 % intervals; cross: where the object is; box: what was found"
    _text(page, end, (x, y), 0.5, _FAINT)


def _rule(page: Picture, y: int, color: Color) -> None:
    _line(page, (_LABEL_X, y), (_WIDTH - _LABEL_X, y), color)


def _line(page: Picture, start: tuple[float, float], end: tuple[float, float], c: Color) -> None:
    first, last = (tuple(round(_SCALE * v) for v in point) for point in (start, end))
    cv2.line(page, first, last, c, _SCALE)


def _box(
    page: Picture, left: float, top: float, width: float, color: Color, height: int = _BAR_HEIGHT
) -> None:
    x, y = round(_SCALE * left), round(_SCALE * top)
    page[y : y + _SCALE * height, x : round(_SCALE * (left + width))] = color


def _paste(page: Picture, picture: Picture, left: int, top: int) -> None:
    h, w = picture.shape[:2]
    page[_SCALE * top : _SCALE * top + h, _SCALE * left : _SCALE * left + w] = picture


def _text(
    page: Picture,
    text: str,
    at: tuple[float, float],
    size: float,
    color: Color,
    bold: bool = False,
) -> None:
    where = (round(_SCALE * at[0]), round(_SCALE * at[1]))
    weight = 3 if bold else 2
    cv2.putText(
        page, text, where, cv2.FONT_HERSHEY_SIMPLEX, _SCALE * size, color, weight, cv2.LINE_AA
    )


def _text_width(text: str, size: float) -> float:
    return float(cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)[0][0])
