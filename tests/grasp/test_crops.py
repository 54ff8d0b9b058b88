"""Crops: what they show, how it is turned, and that labels say the same."""

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.angles import angle_error, decode_angle
from qsgm.grasp.crops import (
    HALF_CROP_PX,
    NEGATIVE_DISTANCE_PX,
    POSITIVE_JITTER_PX,
    CropPlan,
    _color_jitter,
    cut_crops,
    cut_widened,
    label_crops,
    plan_crops,
    widened,
)
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.pixels import OPENCV, arithmetic

FRAME_HW = (480, 640)
CENTER = (320.0, 240.0)
SAME_COLORS = np.eye(3, 4, dtype=np.float32)


def noise_frame() -> NDArray[np.uint8]:
    return np.random.default_rng(5).integers(0, 256, (*FRAME_HW, 3), dtype=np.uint8)


def single_crop_plan(center: tuple[float, float], turn_rad: float) -> CropPlan:
    return CropPlan(
        center_px=np.array([center], dtype=np.float32),
        turn_rad=np.array([turn_rad], dtype=np.float32),
        color=SAME_COLORS[None],
        quality=np.ones(1, dtype=np.float32),
    )


def plan(seed: int = 0, count: int = 60, center: tuple[float, float] = CENTER) -> CropPlan:
    return plan_crops(FRAME_HW, center, np.random.default_rng(seed), count)


def orientation_rad(crop: NDArray[np.uint8]) -> float:
    """Direction of what differs from black, counter-clockwise: from second image moments."""
    moments = cv2.moments(crop[:, :, 0])
    # Image rows count downwards, hence the minus: counter-clockwise is towards smaller rows.
    return -0.5 * math.atan2(2 * moments["mu11"], moments["mu20"] - moments["mu02"])


def test_the_same_seed_gives_the_same_crops_and_another_seed_others() -> None:
    frame = noise_frame()
    first, again, other = (cut_crops(frame, plan(seed, 8)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any(axis=(1, 2, 3)).all()


def test_slices_of_the_plan_give_the_same_crops_as_the_whole() -> None:
    frame, whole = noise_frame(), plan(count=11)
    slices = [cut_crops(frame, whole[start : start + 4]) for start in range(0, 11, 4)]
    np.testing.assert_array_equal(np.concatenate(slices), cut_crops(frame, whole))


def test_any_rows_of_the_plan_give_the_same_crops_as_the_whole() -> None:
    frame, whole = noise_frame(), plan(count=11)
    rows = np.array([7, 0, 10, 7])
    crops = cut_widened(widened(frame), whole[rows])
    np.testing.assert_array_equal(crops, cut_crops(frame, whole)[rows])


@pytest.mark.parametrize("degrees", [-80, -45, -10, 0, 25, 60, 89])
def test_a_line_turned_counter_clockwise_is_seen_turned_counter_clockwise(degrees: int) -> None:
    frame = np.zeros((*FRAME_HW, 3), dtype=np.uint8)
    frame[236:245, 280:361] = 255  # a horizontal bar around pixel (320, 240)
    crop = cut_crops(frame, single_crop_plan(CENTER, math.radians(degrees)))[0]
    error = angle_error(np.array(orientation_rad(crop)), np.array(math.radians(degrees)))
    assert math.degrees(float(error)) < 0.3


def test_a_quarter_turn_brings_the_right_end_up() -> None:
    frame = np.zeros((*FRAME_HW, 3), dtype=np.uint8)
    frame[238:243, 350:359] = 255  # to the right of the centre
    crop = cut_crops(frame, single_crop_plan(CENTER, math.pi / 2))[0]
    rows, cols = np.nonzero(crop[:, :, 0])
    assert rows.mean() == pytest.approx(HALF_CROP_PX - 34, abs=1)
    assert cols.mean() == pytest.approx(HALF_CROP_PX, abs=1)


@given(x=st.integers(64, 576), y=st.integers(64, 416))
@settings(max_examples=25)
def test_an_unturned_uncoloured_crop_is_the_frames_own_window(x: int, y: int) -> None:
    frame = noise_frame()
    crop = cut_crops(frame, single_crop_plan((x, y), 0.0))[0]
    np.testing.assert_array_equal(crop, frame[y - 64 : y + 64, x - 64 : x + 64])


@given(
    seed=st.integers(0, 2**32),
    x=st.floats(HALF_CROP_PX, FRAME_HW[1] - HALF_CROP_PX),
    y=st.floats(HALF_CROP_PX, FRAME_HW[0] - HALF_CROP_PX),
)
@settings(max_examples=50)
def test_every_window_lies_inside_the_frame(seed: int, x: float, y: float) -> None:
    centers = plan(seed, center=(x, y)).center_px
    assert (centers >= HALF_CROP_PX).all()
    assert (centers <= np.array(FRAME_HW[::-1]) - HALF_CROP_PX).all()


@given(
    seed=st.integers(0, 2**32),
    x=st.floats(HALF_CROP_PX, FRAME_HW[1] - HALF_CROP_PX),
    y=st.floats(HALF_CROP_PX, FRAME_HW[0] - HALF_CROP_PX),
)
@settings(max_examples=50)
def test_no_negative_is_on_the_object_wherever_the_object_is(seed: int, x: float, y: float) -> None:
    drawn = plan(seed, center=(x, y))
    distance = np.linalg.norm(drawn.center_px - np.array([x, y]), axis=1)
    # Centres are stored as float32, good to 1e-4 px.
    assert distance[drawn.quality == 0].min() >= NEGATIVE_DISTANCE_PX - 1e-3


def test_positives_stay_within_the_jitter_and_turn_every_way() -> None:
    drawn = plan(count=1000)
    positive = drawn.quality == 1
    assert np.abs(drawn.center_px[positive] - CENTER).max() <= POSITIVE_JITTER_PX + 1e-3
    turns, _ = np.histogram(drawn.turn_rad[positive], bins=8, range=(-np.pi, np.pi))
    assert turns.sum() == positive.sum()
    assert turns.min() > 30


def test_half_of_the_crops_are_positive_and_their_order_is_random() -> None:
    quality = plan(count=1000).quality
    assert quality.sum() == 500
    assert 430 < np.count_nonzero(np.diff(quality)) < 570


def test_negatives_come_from_the_whole_frame() -> None:
    drawn = plan(count=1000)
    away = drawn.center_px[drawn.quality == 0]
    for side in (away[:, 0] < 130, away[:, 0] > 510, away[:, 1] < 100, away[:, 1] > 380):
        assert side.sum() > 5


def test_turned_crops_are_what_opencv_makes_of_a_frame_of_three_channels() -> None:
    if arithmetic().warp is not OPENCV.warp:
        pytest.skip(f"OpenCV {cv2.__version__} warps by another arithmetic than the defined one")
    frame, turn = noise_frame(), 0.7
    crop = cut_crops(frame, single_crop_plan((100, 90), turn))[0]
    cos, sin = math.cos(turn), math.sin(turn)
    window = np.array([[cos, -sin, 100 - 64 * (cos - sin)], [sin, cos, 90 - 64 * (sin + cos)]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    expected = cv2.warpAffine(
        frame, window, (CROP_PX, CROP_PX), flags=flags, borderMode=cv2.BORDER_REFLECT_101
    )
    # The plan has the angle in float32, which may round a pixel the other way.
    assert np.abs(crop.astype(int) - expected).max() <= 1


def test_outside_the_frame_its_content_is_mirrored() -> None:
    frame = np.full((*FRAME_HW, 3), 77, dtype=np.uint8)
    corner = cut_crops(frame, single_crop_plan((64, 64), math.pi / 4))[0]
    assert (corner == 77).all()


def test_colour_maps_are_applied_and_saturate() -> None:
    frame = noise_frame()
    turned_red = np.zeros((1, 3, 4), dtype=np.float32)
    turned_red[0, 2] = [0, 0, 2, 10]
    red_only = dataclasses.replace(single_crop_plan(CENTER, 0.0), color=turned_red)
    crop = cut_crops(frame, red_only)[0]
    window = frame[176:304, 256:384, 2].astype(int)
    assert not crop[:, :, :2].any()
    np.testing.assert_array_equal(crop[:, :, 2], np.minimum(2 * window + 10, 255))


def test_colours_change_by_saturation_white_balance_contrast_about_grey_and_brightness() -> None:
    """From the definition, colour by colour, with numbers drawn in the same order."""
    maps, rng, count = _color_jitter(np.random.default_rng(3), 40), np.random.default_rng(3), 40
    contrast, saturation = rng.uniform(0.8, 1.25, count), rng.uniform(0.7, 1.3, count)
    white, brightness = rng.uniform(0.9, 1.1, (count, 3)), rng.uniform(-25, 25, count)
    for number in range(count):
        for color in np.array([[255, 0, 0], [10, 200, 90], [128, 128, 128]], float):
            grey = 0.114 * color[0] + 0.587 * color[1] + 0.299 * color[2]
            pale = grey + saturation[number] * (color - grey)
            seen = 128 + contrast[number] * (white[number] * pale - 128) + brightness[number]
            got = maps[number] @ np.append(color, 1)
            np.testing.assert_allclose(got, seen, atol=1e-3)


def test_labels_say_the_turn_plus_the_offset_and_nothing_for_negatives() -> None:
    drawn = plan()
    labels = label_crops(drawn, offset_rad=0.3)
    positive = drawn.quality == 1
    np.testing.assert_array_equal(labels[:, 0], drawn.quality)
    assert not labels[~positive].any()
    decoded = decode_angle(labels[positive, 1], labels[positive, 2])
    assert angle_error(decoded, drawn.turn_rad[positive] + 0.3).max() < 1e-5


@pytest.mark.parametrize("center", [(63.9, 240.0), (320.0, 417.0), (-5.0, 240.0), (700.0, 240.0)])
def test_a_centre_too_close_to_the_border_is_refused(center: tuple[float, float]) -> None:
    with pytest.raises(QsgmError) as refusal:
        plan_crops(FRAME_HW, center, np.random.default_rng(0))
    text = str(refusal.value)
    assert f"({center[0]:g}, {center[1]:g})" in text
    assert "640x480" in text
    assert f"{HALF_CROP_PX} px" in text
    assert "--center" in text
    assert "\n" not in text


def test_crops_are_128_px_uint8() -> None:
    crops = cut_crops(noise_frame(), plan(count=3))
    assert crops.shape == (3, CROP_PX, CROP_PX, 3)
    assert crops.dtype == np.uint8


@pytest.mark.parametrize("frame_hw", [(128, 128), (168, 168), (130, 170)])
def test_a_frame_without_room_for_negatives_is_refused_instead_of_drawn_from_forever(
    frame_hw: tuple[int, int],
) -> None:
    center = frame_hw[1] / 2, frame_hw[0] / 2
    with pytest.raises(QsgmError, match="no room for windows 28 px and more from the object"):
        plan_crops(frame_hw, center, np.random.default_rng(0), 4)


def test_the_smallest_demonstration_has_room_for_negatives() -> None:
    for center in ((128, 128), (64, 64)):
        whole = plan_crops((256, 256), center, np.random.default_rng(0), 200)
        negatives = whole.center_px[whole.quality == 0]
        distance = np.linalg.norm(negatives - center, axis=1)
        assert distance.min() >= NEGATIVE_DISTANCE_PX - 1e-3
