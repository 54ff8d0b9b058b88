"""Answers made up from a known place and angle: `locate` and `refine` must give both back."""

import math
from collections.abc import Callable
from dataclasses import replace
from io import StringIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rich.console import Console

from qsgm.errors import QsgmError
from qsgm.grasp.angles import AngleEncoding, angle_error, encode_angle
from qsgm.grasp.heatmap import Detection, locate, refine
from qsgm.grasp.pictures import _values
from qsgm.grasp.report import detection_table, predict_json
from qsgm.tables import plain_table
from qsgm.tune.report import fidelity_table

FRAME_HW = (480, 640)
ROWS_COLS = (23, 33)
ABSENT = Detection(False, 0.0, (0.0, 0.0), (0.0, 0.0), 0.0)


def response(
    x: float,
    y: float,
    angle_rad: float = 0.0,
    *,
    radius: float = 17.0,
    rows_cols: tuple[int, int] = ROWS_COLS,
    encoding: AngleEncoding = "double",
) -> NDArray[np.float32]:
    """A symmetrical bump: quality falls from 1 to 0 around `radius` px from (x, y)."""
    rows, cols = np.mgrid[: rows_cols[0], : rows_cols[1]]
    distance = np.hypot(64 + 16 * cols - x, 64 + 16 * rows - y)
    quality = 1 / (1 + np.exp((distance - radius) / 3))
    sine, cosine = encode_angle(np.array([angle_rad]), encoding)[0]
    return np.stack([quality, np.full_like(quality, sine), np.full_like(quality, cosine)]).astype(
        np.float32
    )


@given(x=st.floats(84, 556), y=st.floats(84, 396), radius=st.floats(12, 19))
def test_a_symmetrical_bump_is_located_between_cells(x: float, y: float, radius: float) -> None:
    detection = locate(response(x, y, radius=radius), FRAME_HW, 0.0)
    assert detection.found
    # A tenth of a cell; picking the best cell would be off by up to 11.
    assert math.dist(detection.center_px, (x, y)) < 2.0


def test_the_located_centre_is_unbiased_over_a_cell() -> None:
    steps = np.arange(-8, 8) + 0.5
    errors = np.array(
        [
            np.subtract(locate(response(320 + x, 240 + y), FRAME_HW, 0.0).center_px, (320, 240))
            - (x, y)
            for x in steps
            for y in steps
        ]
    )
    assert np.abs(errors.mean(axis=0)).max() < 0.01
    assert np.abs(errors).mean() < 0.6


@pytest.mark.parametrize("encoding", ["double", "paper"])
@given(angle=st.floats(-10, 10), offset=st.floats(-4, 4))
def test_the_angle_is_recovered_modulo_180_degrees(
    encoding: AngleEncoding, angle: float, offset: float
) -> None:
    heatmap = response(300, 200, angle + offset, encoding=encoding)
    degrees = locate(heatmap, FRAME_HW, offset, encoding).angle_deg
    assert -90 < degrees <= 90
    assert angle_error(np.array(math.radians(degrees)), np.array(angle)) < 1e-5


def test_cells_that_disagree_across_the_seam_average_to_ninety_degrees() -> None:
    heatmap = response(328, 240)  # halfway between two cells
    for col, degrees in ((16, 88.0), (17, -88.0)):
        labels = encode_angle(np.radians([degrees]))[0]
        heatmap[1:, :, col] = labels[:, None]
    heatmap[0, :, :16] = heatmap[0, :, 18:] = 0
    assert abs(locate(heatmap, FRAME_HW, 0.0).angle_deg) == pytest.approx(90, abs=0.01)


def test_the_angle_is_weighted_by_quality() -> None:
    heatmap = response(320, 240, math.radians(20))
    heatmap[0] = 0.001
    heatmap[0, 11, 16] = 0.9
    heatmap[1:, :, 17] = encode_angle(np.radians([-70.0]))[0][:, None]
    assert locate(heatmap, FRAME_HW, 0.0).angle_deg == pytest.approx(20, abs=0.5)


def test_the_displacement_is_from_the_frames_centre_right_and_down() -> None:
    detection = locate(response(400, 304), FRAME_HW, 0.0)
    assert detection.displacement_px == pytest.approx((80, 64), abs=0.1)
    centred = locate(response(320, 240), FRAME_HW, 0.0)
    assert centred.displacement_px == pytest.approx((0, 0), abs=1e-6)


def test_nothing_is_found_on_a_flat_low_heatmap() -> None:
    detection = locate(np.full((3, *ROWS_COLS), 0.1, dtype=np.float32), FRAME_HW, 0.0)
    assert not detection.found
    assert detection.quality == pytest.approx(0.1)
    assert np.isfinite(
        [*detection.center_px, *detection.displacement_px, detection.angle_deg]
    ).all()


def test_a_heatmap_of_zeros_gives_finite_numbers() -> None:
    detection = locate(np.zeros((3, *ROWS_COLS), dtype=np.float32), FRAME_HW, 0.0)
    assert not detection.found
    assert detection.quality == 0
    assert np.isfinite(
        [*detection.center_px, *detection.displacement_px, detection.angle_deg]
    ).all()


def test_the_threshold_decides_what_is_found() -> None:
    heatmap = response(320, 240)
    heatmap[0] *= np.float32(0.6 / heatmap[0].max())
    assert locate(heatmap, FRAME_HW, 0.0, threshold=0.59).found
    assert not locate(heatmap, FRAME_HW, 0.0, threshold=0.61).found


@pytest.mark.parametrize("shape", [(2, 2), (1, 2), (3, 3), (1, 3)])
def test_the_middle_of_a_plateau_of_equal_cells_is_reported(shape: tuple[int, int]) -> None:
    heatmap = np.zeros((3, *ROWS_COLS), dtype=np.float32)
    heatmap[0, 5 : 5 + shape[0], 7 : 7 + shape[1]] = 1.0
    middle = (64 + 16 * (7 + (shape[1] - 1) / 2), 64 + 16 * (5 + (shape[0] - 1) / 2))
    assert locate(heatmap, FRAME_HW, 0.0).center_px == pytest.approx(middle, abs=1e-4)


def test_of_two_equally_strong_blobs_the_better_supported_one_is_reported() -> None:
    heatmap = response(400, 304)
    heatmap[0, 3, 3] = heatmap[0].max()
    assert locate(heatmap, FRAME_HW, 0.0).center_px == pytest.approx((400, 304), abs=0.1)


def test_a_clearly_stronger_cell_wins_over_a_wide_weak_blob() -> None:
    heatmap = response(400, 304)
    heatmap[0] *= 0.6
    heatmap[0, 3, 3] = 0.95
    detection = locate(heatmap, FRAME_HW, 0.0)
    assert detection.center_px == pytest.approx((112, 112), abs=0.1)
    assert detection.quality == pytest.approx(0.95)


def test_another_blob_elsewhere_does_not_move_the_centre() -> None:
    alone = response(400, 304)
    both = alone.copy()
    both[0] = np.maximum(alone[0], 0.8 * response(120, 120)[0])
    expected = locate(alone, FRAME_HW, 0.0).center_px
    assert locate(both, FRAME_HW, 0.0).center_px == pytest.approx(expected, abs=1e-3)


def test_a_heatmap_of_one_cell_is_the_frames_only_window() -> None:
    heatmap = response(64, 64, 0.5, rows_cols=(1, 1))
    detection = locate(heatmap, (128, 128), 0.0)
    assert detection.found
    assert detection.center_px == (64, 64)
    assert detection.displacement_px == (0, 0)
    assert detection.angle_deg == pytest.approx(math.degrees(0.5), abs=1e-4)


@pytest.mark.parametrize("x", [64, 576])
@pytest.mark.parametrize("y", [64, 416])
def test_a_peak_at_the_border_is_located_within_half_a_cell(x: int, y: int) -> None:
    found_x, found_y = locate(response(x, y), FRAME_HW, 0.0).center_px
    assert abs(found_x - x) < 8
    assert abs(found_y - y) < 8


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_heatmap_that_is_not_finite_is_refused(bad: float) -> None:
    heatmap = response(320, 240)
    heatmap[1, 2, 3] = bad
    with pytest.raises(QsgmError, match="tune it again"):
        locate(heatmap, FRAME_HW, 0.0)


@pytest.mark.parametrize("shape", [(23, 33), (2, 23, 33), (3, 0, 33)])
def test_a_heatmap_of_another_shape_is_a_programming_error(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="must be"):
        locate(np.zeros(shape, dtype=np.float32), FRAME_HW, 0.0)


def frame_of_places(height: int, width: int) -> NDArray[np.uint8]:
    """A frame that says at every pixel where that pixel is."""
    y, x = np.mgrid[:height, :width]
    return np.stack([x & 255, (x >> 8) | ((y >> 8) << 4), y & 255], axis=-1).astype(np.uint8)


def answers_at(
    x: float, y: float, angle_rad: float, skew: float = 0.0
) -> Callable[[NDArray[np.uint8]], NDArray[np.float32]]:
    """A network that sees an object at (x, y), and its angle wrong by `skew` rad per px off."""

    def heatmap_of(part: NDArray[np.uint8]) -> NDArray[np.float32]:
        corner = part[: part.shape[0] - 127 : 16, : part.shape[1] - 127 : 16].astype(int)
        window_x = corner[..., 0] + 256 * (corner[..., 1] & 15) + 64
        window_y = corner[..., 2] + 256 * (corner[..., 1] >> 4) + 64
        off = np.hypot(window_x - x, window_y - y)
        quality = 1 / (1 + np.exp((off - 18) / 2))
        angle = angle_rad + skew * off
        return np.stack([quality, np.sin(2 * angle), np.cos(2 * angle)]).astype(np.float32)

    return heatmap_of


@given(
    x=st.floats(100, 540),
    y=st.floats(100, 380),
    angle=st.floats(-1.5, 1.5),
    off=st.tuples(st.floats(-8, 8), st.floats(-8, 8)),
)
def test_a_second_look_finds_the_centre_to_a_pixel_from_anywhere_near_it(
    x: float, y: float, angle: float, off: tuple[float, float]
) -> None:
    coarse = replace(ABSENT, found=True, center_px=(x + off[0], y + off[1]))
    detection = refine(coarse, frame_of_places(480, 640), answers_at(x, y, angle), 0.25)
    assert math.dist(detection.center_px, (x, y)) < 1.0
    assert detection.displacement_px == pytest.approx(
        (detection.center_px[0] - 320, detection.center_px[1] - 240)
    )
    turned = math.radians(detection.angle_deg) + 0.25
    assert angle_error(np.array(turned), np.array(angle)) < 1e-3


def test_a_second_look_takes_the_angle_from_windows_at_the_centre() -> None:
    coarse = replace(ABSENT, found=True, center_px=(300.0, 200.0))
    network = answers_at(305.0, 203.0, 0.5, skew=0.02)
    detection = refine(coarse, frame_of_places(480, 640), network, 0.0)
    everywhere = locate(network(frame_of_places(480, 640)), FRAME_HW, 0.0)
    wrong = abs(math.radians(detection.angle_deg) - 0.5)
    assert wrong < 0.12
    assert wrong < abs(math.radians(everywhere.angle_deg) - 0.5) / 2


@pytest.mark.parametrize(("height", "width"), [(128, 128), (140, 200), (192, 192)])
def test_a_second_look_works_in_a_frame_hardly_larger_than_a_window(
    height: int, width: int
) -> None:
    coarse = replace(ABSENT, found=True, center_px=(64.0, 64.0))
    detection = refine(coarse, frame_of_places(height, width), answers_at(64, 64, 0.5), 0.0)
    assert math.dist(detection.center_px, (64, 64)) < 24
    assert detection.angle_deg == pytest.approx(math.degrees(0.5), abs=1e-3)


def test_a_turn_just_above_minus_90_is_reported_as_90_everywhere() -> None:
    found = Detection(True, 0.9, (200.0, 300.0), (-120.0, 60.0), -89.998)
    assert predict_json(found, (3, 23, 33), "mug", None)["angle_deg"] == 90.0
    shown = StringIO()
    Console(file=shown, width=80).print(detection_table(found, "mug"))
    assert "+90.0°" in shown.getvalue()
    assert ("turn (counter-clockwise)", "+90.0 deg") in _values(found)


def test_a_name_that_looks_like_markup_is_shown_as_it_is() -> None:
    shown = StringIO()
    for name in ("[bold]", "[/x]"):
        Console(file=shown, width=80).print(detection_table(ABSENT, name), plain_table(name))
        assert name in shown.getvalue()
    Console(file=shown, width=80).print(fidelity_table({}))
    assert "[dB]" in shown.getvalue()
