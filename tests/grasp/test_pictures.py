"""Pictures: large enough, drawn where the numbers say, quiet where nothing was found."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm.grasp.heatmap import Detection
from qsgm.grasp.pictures import _shortened, _text_width, _values, draw_detection, draw_objects

FRAME = np.full((480, 640, 3), 128, dtype=np.uint8)
NOTHING = np.zeros((3, 23, 33), dtype=np.float32)


def detection(found: bool = True, angle_deg: float = 0.0) -> Detection:
    return Detection(found, 0.9 if found else 0.2, (200.0, 300.0), (-120.0, 60.0), angle_deg)


def drawn(found: bool = True, angle_deg: float = 0.0) -> NDArray[np.uint8]:
    return draw_detection(FRAME, NOTHING, detection(found, angle_deg), "mug")


def extent(inked: NDArray[np.bool_]) -> tuple[int, int, int, int]:
    """First and last row, first and last column of what is inked."""
    rows, columns = inked.any(axis=1).nonzero()[0], inked.any(axis=0).nonzero()[0]
    return int(rows[0]), int(rows[-1]), int(columns[0]), int(columns[-1])


def is_white(picture: NDArray[np.uint8], x: float, y: float) -> bool:
    """Whether the gripper covers a point of the frame [px]."""
    return bool((picture[round(2 * y), round(2 * x)] > 240).all())


@pytest.mark.parametrize("size", [(128, 128), (480, 640), (300, 1281)])
def test_the_canvas_is_large_enough_for_crisp_text(size: tuple[int, int]) -> None:
    frame = np.full((*size, 3), 90, dtype=np.uint8)
    picture = draw_detection(frame, NOTHING, detection(), "a title that never ends " * 20)
    assert picture.dtype == np.uint8
    assert picture.shape[1] >= 1280
    assert picture.shape[1] % size[1] == 0
    caption = picture.shape[0] - size[0] * picture.shape[1] // size[1]
    assert caption == pytest.approx(150 * picture.shape[1] / 1280, abs=0.5)


def test_the_frame_and_the_heatmap_are_left_as_they_were() -> None:
    frame, heatmap = FRAME.copy(), np.full((3, 23, 33), 0.8, dtype=np.float32)
    draw_detection(frame, heatmap, detection(), "mug")
    np.testing.assert_array_equal(frame, FRAME)
    assert (heatmap == np.float32(0.8)).all()


def test_the_fingers_are_turned_counter_clockwise_about_the_centre() -> None:
    level, upright, tilted = drawn(angle_deg=0), drawn(angle_deg=90), drawn(angle_deg=30)
    assert is_white(level, 200 + 38, 300 + 10)
    assert is_white(level, 200 - 38, 300 - 10)
    assert is_white(upright, 200 + 10, 300 - 38)
    assert not is_white(upright, 200 + 38, 300 + 10)
    # 38 px along an axis that rises to the right by 30 degrees
    assert is_white(tilted, 200 + 32.9, 300 - 19)
    assert not is_white(tilted, 200 + 32.9, 300 + 19)


def test_nothing_is_drawn_far_from_the_object_and_the_way_to_it() -> None:
    picture = drawn()
    assert (picture[:300] == 128).all()
    assert (picture[:960, 800:] == 128).all()


def test_the_heatmap_shows_where_quality_is_notable_and_only_there() -> None:
    heatmap = NOTHING.copy()
    heatmap[0, 2, 28] = 0.9  # looks at pixel (512, 96)
    picture = draw_detection(FRAME, heatmap, detection(), "mug")
    blue, _, red = picture[192, 1024].astype(int)
    assert red > blue + 40
    assert (picture[192, 1024 + 128] == 128).all()
    weak = draw_detection(FRAME, heatmap * np.float32(0.1), detection(), "mug")
    np.testing.assert_array_equal(weak, drawn())


def test_when_nothing_was_found_the_frame_is_dimmed_and_has_no_gripper() -> None:
    picture = drawn(found=False)
    assert (picture[:300] < 100).all()
    assert not is_white(picture, 200 + 38, 300 + 10)
    assert not is_white(picture, 200, 300)


def test_an_arrow_says_where_the_right_hand_side_is_where_that_is_known() -> None:
    plain = drawn(angle_deg=0)
    right, left = (
        draw_detection(FRAME, NOTHING, replace(detection(), full_angle_deg=turn), "mug")
        for turn in (0.0, 180.0)
    )
    tip = 62 - 8
    assert not is_white(plain, 200 + tip, 300 + 5)
    assert is_white(right, 200 + tip, 300 + 5)
    assert not is_white(right, 200 - tip, 300 + 5)
    assert is_white(left, 200 - tip, 300 + 5)
    assert not is_white(left, 200 + tip, 300 + 5)


def test_every_instance_has_its_gripper() -> None:
    other = replace(detection(angle_deg=90), center_px=(480.0, 150.0))
    both = draw_detection(FRAME, NOTHING, detection(), "mug", [detection(), other])
    assert is_white(both, 200 + 38, 300 + 10)
    assert is_white(both, 480 + 10, 150 - 38)
    assert not is_white(drawn(), 480 + 10, 150 - 38)


def test_what_was_scaled_is_drawn_as_large_as_the_object() -> None:
    frame = np.full((960, 1280, 3), 128, dtype=np.uint8)
    large = replace(detection(), scale=0.5, center_px=(400.0, 600.0))
    heatmap = NOTHING.copy()
    heatmap[0, 2, 28] = 0.9  # looks at pixel (512, 96) of the frame at half its size
    picture = draw_detection(frame, heatmap, large, "mug")
    assert (picture[600 + 20, 400 + 76] > 240).all()
    blue, _, red = picture[192, 1024].astype(int)
    assert red > blue + 40


def test_the_caption_gives_the_full_turn_where_it_is_known() -> None:
    found = replace(detection(angle_deg=-30), full_angle_deg=150.04)
    assert ("turn (counter-clockwise)", "+150.0 deg") in _values(found)


def test_the_verdict_has_its_own_colour() -> None:
    found, missing = drawn()[1000, 2].astype(int), drawn(found=False)[1000, 2].astype(int)
    assert found[1] > found[2]
    assert missing[2] > missing[1]


@pytest.mark.parametrize("enlarged", [True, False])
def test_a_names_dark_rim_lies_around_its_letters(enlarged: bool) -> None:
    absent = [("a name of some length", detection(found=False))]
    picture = draw_objects(FRAME, absent, enlarged=enlarged).astype(int)
    ink = (picture.max(axis=2) - picture.min(axis=2) > 60).any(axis=0).nonzero()[0]
    changed = (np.abs(picture - 128).max(axis=2) > 8).any(axis=0).nonzero()[0]
    assert len(ink) > 100
    assert 0 <= ink[0] - changed[0] <= 6
    assert 0 <= changed[-1] - ink[-1] <= 6


@pytest.mark.parametrize("size", [(480, 1280), (1280, 480)])
def test_what_was_not_found_is_listed_above_the_lower_end(size: tuple[int, int]) -> None:
    frame = np.full((*size, 3), 128, dtype=np.uint8)
    picture = draw_objects(frame, [("hat", detection(found=False))], enlarged=False).astype(int)
    unit = max(size[1] / 1280, 0.6)
    _, bottom, left, _ = extent(picture.max(axis=2) - picture.min(axis=2) > 60)
    assert size[0] - 1 - bottom == pytest.approx(16 * unit, abs=3)
    assert left == pytest.approx(12 * unit, abs=4)


def test_where_nothing_was_found_a_dashed_ring_is_around_the_best_guess() -> None:
    """Twelve dashes, of 15 degrees and as far apart, and a pixel or two more at their ends."""
    picture = drawn(found=False)[:960].astype(int)
    inked = picture.max(axis=2) - picture.min(axis=2) > 60

    def on_it(degrees: float) -> bool:
        turn = np.radians(degrees)
        return bool(inked[round(600 + 64 * np.sin(turn)), round(400 + 64 * np.cos(turn))])

    for dash in range(0, 360, 30):
        assert all(on_it(dash + degrees) for degrees in (1, 4, 8, 12, 14))
        assert not any(on_it(dash + degrees) for degrees in (18.5, 21, 24, 26.5))
    rows, columns = inked.nonzero()
    assert np.abs(np.hypot(columns - 400, rows - 600) - 64).max() < 5


def test_of_a_long_title_as_much_is_left_as_has_room() -> None:
    title = "a name that never ends " * 20
    for room in (100, 500):
        shown = _shortened(title, room, 1.0)
        assert title.startswith(shown.removesuffix("..."))
        assert room - 40 < _text_width(shown, 1.0, bold=False) <= room
    assert _shortened("mug", 500, 1.0) == "mug"


def test_the_bar_is_filled_as_far_as_the_quality_goes() -> None:
    for quality, share in ((0.0, 0.0), (0.25, 0.25), (0.9, 0.9), (1.0, 1.0), (1.5, 1.0)):
        picture = draw_detection(FRAME, NOTHING, replace(detection(), quality=quality), "mug")
        good = picture[970, 2].tolist()
        bar = picture[960:, 1050:].tolist()
        filled = np.array([[pixel == good for pixel in row] for row in bar])[50:]
        empty = np.array([[pixel == [70, 64, 60] for pixel in row] for row in bar])[50:]
        top, bottom, left, right = extent(filled | empty)
        assert (bottom - top + 1, right - left + 1) == (10, 170)
        inside = filled[top : bottom + 1, left : right + 1]
        assert inside.sum() == 10 * round(170 * share)
        assert inside[:, : round(170 * share)].all()


def test_the_gripper_is_as_large_as_the_network_sees_it() -> None:
    """Two bars of 40 px, 76 apart, and between and beyond them an axis of 124, in two px each."""
    picture = drawn()[: 2 * 480]
    white = (picture > 240).all(axis=2)
    x, y = 400, 600
    corners = (slice(y - 120, y + 120), slice(x - 124, x + 124))
    for side in (-76, 76):
        rows = white[y - 100 : y + 100, x + side].nonzero()[0] - 100
        assert (rows[0], rows[-1]) == (pytest.approx(-40, abs=5), pytest.approx(40, abs=5))
        columns = white[y - 30, x + side - 20 : x + side + 20].nonzero()[0] - 20
        assert len(columns) == pytest.approx(8, abs=1)
    along = white[corners][118:123].any(axis=0).nonzero()[0] - 124
    assert (along[0], along[-1]) == (pytest.approx(-124, abs=2), pytest.approx(123, abs=2))
    above = white[y - 30 : y + 30, x + 50].nonzero()[0]
    assert len(above) == pytest.approx(2, abs=1)
    middle = white[y - 20 : y + 20, x].nonzero()[0] - 20
    assert (middle[0], middle[-1]) == (pytest.approx(-5, abs=1), pytest.approx(5, abs=1))


def test_the_window_that_the_network_saw_has_corners() -> None:
    picture = drawn()
    for right in (-1, 1):
        for down in (-1, 1):
            x, y = 200 + 64 * right, 300 + 64 * down
            for inward in (0, 7, 13):
                assert is_white(picture, x - inward * right, y)
                assert is_white(picture, x, y - inward * down)
            assert not is_white(picture, x - 17 * right, y)
            assert not is_white(picture, x, y - 17 * down)
            assert not is_white(picture, x + 4 * right, y)
            assert not is_white(picture, x, y + 4 * down)


@pytest.mark.parametrize("way", [(160.0, 0.0), (-160.0, 0.0), (0.0, 160.0), (0.0, -160.0)])
def test_the_way_to_the_object_is_an_arrow_from_the_middle(way: tuple[float, float]) -> None:
    """Turned to the right, arrows to all sides are the same: symmetric, its head before its end."""
    frame = np.full((640, 640, 3), 128, dtype=np.uint8)
    found = replace(detection(), center_px=(320 + way[0], 320 + way[1]), displacement_px=way)
    picture = draw_detection(frame, NOTHING, found, "mug")[:1280].astype(int)
    blue = (picture[..., 0] > 220) & (picture[..., 1] < 225) & (picture[..., 2] < 150)
    turns = {(160.0, 0.0): 0, (0.0, 160.0): 1, (-160.0, 0.0): 2, (0.0, -160.0): 3}
    blue = np.rot90(blue, turns[way])
    top, bottom, left, right = extent(blue)
    assert [top, bottom] == pytest.approx([640 - 10, 640 + 10], abs=4)
    assert [left, right] == pytest.approx([640 - 10, 960 - 14], abs=6)
    top, bottom, _, _ = extent(blue[:, 700:])
    assert [top, bottom] == pytest.approx([640 - 8, 640 + 8], abs=4)
    ends = [columns[0] for columns in (blue[row, 700:].nonzero()[0] for row in (634, 646))]
    assert ends == pytest.approx([960 - 14 - 16 - 700] * 2, abs=6)


def test_the_caption_says_what_was_found_in_words_and_numbers() -> None:
    turned = detection(angle_deg=-30.04)
    values = dict(_values(turned))
    assert values == {
        "centre (x, y)": "200.0, 300.0 px",
        "move (right, down)": "-120.0, +60.0 px",
        "turn (counter-clockwise)": "-30.0 deg",
        "quality": "0.90",
    }
    assert dict(_values(detection(angle_deg=-0.04)))["turn (counter-clockwise)"] == "+0.0 deg"
    same = draw_detection(FRAME, NOTHING, turned, "mug")
    other = draw_detection(FRAME, NOTHING, turned, "cup")
    changed = (same != other).any(axis=2)
    top, bottom, left, right = extent(changed)
    assert 960 < top < bottom < 960 + 60
    assert 30 < left < right < 150
