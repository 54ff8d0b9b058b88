"""How large an object is, whatever the camera: measured, scaled by, and refused in one line."""

import math
from typing import Any

import cv2
import numpy as np
import pytest
from toys import lay, table, toy

from qsgm import QsgmError
from qsgm.bench.subjects import drawn_subjects
from qsgm.grasp import measuring
from qsgm.grasp.measuring import (
    _best_in_middle,
    _Cut,
    _cuts_of_whole,
    measured_span,
    moved_point,
    scale_for,
    scaled_frame,
)


def _at(point: Any) -> tuple[int, int]:
    x, y = point
    return round(float(x)), round(float(y))


def shown(scale: float, frame_hw: tuple[int, int] = (480, 640), turn_deg: float = 25) -> Any:
    """An object of 90 px times a scale in the middle of a frame, and that middle."""
    height, width = frame_hw
    center = (width / 2, height / 2)
    return lay(toy(), table(1, frame_hw), center, turn_deg, scale), center


@pytest.mark.parametrize("scale", [0.35, 0.6, 0.8, 1.0, 1.2, 1.5, 2.0])
def test_the_long_side_is_measured_from_small_to_large(scale: float) -> None:
    assert measured_span(*shown(scale)) == pytest.approx(90 * scale, rel=0.1)


@pytest.mark.parametrize("enlarged", [2, 3.3, 6.3])
def test_a_photograph_of_many_pixels_has_its_object_measured(enlarged: float) -> None:
    frame, (x, y) = shown(1.0)
    large = cv2.resize(frame, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
    center = moved_point((x, y), frame.shape[:2], large.shape[:2])
    assert measured_span(large, center) == pytest.approx(90 * enlarged, rel=0.1)


@pytest.mark.parametrize("scale", [2.6, 3.4, 4.2])
@pytest.mark.parametrize("frame_hw", [(480, 640), (960, 720)])
def test_an_object_that_nearly_fills_its_frame_is_measured(
    scale: float, frame_hw: tuple[int, int]
) -> None:
    assert measured_span(*shown(scale, frame_hw, 60)) == pytest.approx(90 * scale, rel=0.1)


def test_a_cut_of_the_whole_frame_measures_what_spans_a_fifth_of_it_and_more() -> None:
    for scale in (1.2, 1.6, 2.0, 3.4):
        span = _best_in_middle(_cuts_of_whole(*shown(scale)), 480)
        assert span == pytest.approx(90 * scale, rel=0.1)
    for scale in (0.6, 0.9):
        assert _cuts_of_whole(*shown(scale)) == []


def test_a_larger_thing_close_by_is_not_what_lies_at_the_centre() -> None:
    frame = table(1)
    cv2.rectangle(frame, (255, 232), (385, 248), (30, 30, 200), cv2.FILLED)
    cv2.rectangle(frame, (190, 282), (450, 382), (30, 30, 200), cv2.FILLED)
    span = _best_in_middle(_cuts_of_whole(frame, (320.0, 240.0)), 480)
    assert span == pytest.approx(130, rel=0.1)


@pytest.mark.parametrize("turn_deg", [0, 50])
def test_a_large_object_is_measured_whole_though_its_ends_look_like_nothing_else(
    turn_deg: float,
) -> None:
    """As of shears: black grips far from the middle, a steel blade over it."""
    frame, center = table(1), (320.0, 240.0)
    along = np.array([math.cos(math.radians(turn_deg)), math.sin(math.radians(turn_deg))])
    grip, tip = (np.asarray(center) + side * 200 * along for side in (-1, 1))
    cv2.line(frame, _at(grip), _at(tip), (215, 215, 215), 14, cv2.LINE_AA)
    cv2.circle(frame, _at(grip + 40 * along), 40, (15, 15, 15), cv2.FILLED, cv2.LINE_AA)
    assert measured_span(frame, center) == pytest.approx(404, rel=0.1)


def test_a_large_object_in_two_parts_is_measured_as_one() -> None:
    """As of sunglasses, whose bridge is too thin to be seen."""
    frame, center = table(1), (320.0, 240.0)
    for side in (-1, 1):
        cv2.ellipse(frame, (320 + side * 105, 240), (80, 55), 0, 0, 360, (30, 25, 25), cv2.FILLED)
    assert measured_span(frame, center) == pytest.approx(370, rel=0.1)


def test_of_a_long_narrow_frame_only_what_is_near_is_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """All of it would take half a minute."""
    pixels, cut_out = list[int](), measuring.cut_out

    def counted(image: Any, trimap: Any) -> Any:
        pixels.append(trimap.size)
        return cut_out(image, trimap)

    monkeypatch.setattr(measuring, "cut_out", counted)
    wide = table(1, (120, 4000))
    found = _cuts_of_whole(lay(toy(), wide, (3000.0, 60.0)), (3000.0, 60.0))
    assert [cut.span_px for cut in found] == pytest.approx([90] * len(found), rel=0.15)
    assert found
    assert max(pixels) <= 96 * 4 * 96


@pytest.mark.parametrize(
    ("cuts", "span"),
    [
        ([(97, 0.028), (300, 0.007)], 300),
        ([(97, 0.028), (450, 0.007)], 97),
        ([(97, 0.08), (450, 0.007)], 450),
        ([(201, 0.002), (376, 0.001)], 376),
        ([], None),
    ],
)
def test_what_fills_the_frame_is_not_the_object_only_because_it_lies_in_its_middle(
    cuts: list[tuple[float, float]], span: float | None
) -> None:
    assert _best_in_middle([_Cut(*cut) for cut in cuts], 480) == span


def test_a_table_that_looks_like_a_large_thing_is_not_taken_for_one() -> None:
    """A spoon on a blotchy cloth: no two cuts agree, and the largest spans half of the frame."""
    (subject,) = (one for one in drawn_subjects(5) if one.name == "cutlery_11")
    span = measured_span(subject.frame, subject.center_px)
    assert scale_for(span, subject.frame.shape[:2]) == 1


def test_nothing_is_measured_where_there_is_no_object() -> None:
    assert measured_span(table(2), (320.0, 240.0)) is None


@pytest.mark.parametrize("span", [None, 45.0, 60.0, 90.0, 115.0, 124.0])
def test_an_object_that_fits_is_left_as_it_is(span: float | None) -> None:
    assert scale_for(span, (480, 640)) == 1


@pytest.mark.parametrize(
    ("span", "frame_hw", "scale"),
    [
        (180.0, (480, 640), 0.5),
        (450.0, (480, 640), 0.2),
        (180.0, (720, 1280), 0.5),
        (800.0, (3024, 4032), 90 / 800),
        (40.0, (480, 640), 2.0),
        (20.0, (480, 640), 2.0),
        (44.9, (480, 640), 2.0),
    ],
)
def test_others_are_scaled_until_they_do(
    span: float, frame_hw: tuple[int, int], scale: float
) -> None:
    assert scale_for(span, frame_hw) == pytest.approx(scale, abs=0.005)


def test_an_object_that_fills_its_frame_is_refused_in_one_line() -> None:
    with pytest.raises(QsgmError, match=r"spans about 620 px of the 640x480 frame, .* step") as got:
        scale_for(620, (480, 640))
    assert "\n" not in str(got.value)
    assert "--span" in str(got.value)


def test_a_long_object_may_span_more_than_the_frames_shorter_side_but_no_round_one() -> None:
    bar, disc = table(1), table(1)
    cv2.line(bar, (70, 240), (570, 240), (40, 60, 200), 40)
    cv2.circle(disc, (320, 240), 260, (40, 60, 200), cv2.FILLED)
    long_px = measured_span(bar, (320.0, 240.0))
    assert long_px == pytest.approx(540, rel=0.05)
    assert scale_for(long_px, (480, 640)) == pytest.approx(90 / 540, rel=0.05)
    with pytest.raises(QsgmError, match="nothing around it"):
        scale_for(measured_span(disc, (320.0, 240.0)), (480, 640))


def test_a_point_stays_on_the_same_spot_of_a_scaled_frame() -> None:
    frame = np.zeros((300, 500, 3), np.uint8)
    frame[100:104, 200:204] = 255
    small = scaled_frame(frame, 0.25)
    assert small.shape == (75, 125, 3)
    y, x = np.argwhere(small[..., 0] > 250)[0]
    assert moved_point((201.5, 101.5), (300, 500), (75, 125)) == (x, y)
    assert moved_point((x, y), (75, 125), (300, 500)) == (201.5, 101.5)
    assert scaled_frame(frame, 1.0) is frame
