"""Angles are line directions: everything holds modulo 180 degrees, the seam included."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qsgm.grasp.angles import (
    AngleEncoding,
    angle_error,
    decode_angle,
    encode_angle,
    mean_direction,
    round_degrees,
    wrap_half_turn,
)

angles = st.floats(-20.0, 20.0)
encodings = pytest.mark.parametrize("encoding", ["double", "paper"])


def same_direction(first: float, second: float) -> float:
    """Angle between two lines [rad], by their direction vectors."""
    cross = math.cos(first) * math.sin(second) - math.sin(first) * math.cos(second)
    return math.asin(min(1.0, abs(cross)))


@given(angles)
def test_wrapping_keeps_the_line_and_lands_in_the_half_open_range(angle: float) -> None:
    wrapped = float(wrap_half_turn(np.array(angle)))
    assert -math.pi / 2 < wrapped <= math.pi / 2
    assert same_direction(angle, wrapped) < 1e-9


@pytest.mark.parametrize(
    "angle", [math.pi / 2, -math.pi / 2, 1.5 * math.pi, np.nextafter(math.pi / 2, 4.0)]
)
def test_the_seam_is_reported_as_plus_ninety_degrees(angle: float) -> None:
    assert float(wrap_half_turn(np.array(angle))) == pytest.approx(math.pi / 2)


@encodings
@given(angle=angles)
def test_decoding_undoes_encoding(encoding: AngleEncoding, angle: float) -> None:
    sine, cosine = encode_angle(np.array([angle]), encoding)[0]
    decoded = float(decode_angle(np.array(sine), np.array(cosine), encoding))
    assert same_direction(decoded, angle) < 1e-6


def test_the_double_angle_has_no_seam_and_the_papers_encoding_has_one() -> None:
    either_side = np.radians([89.9, -89.9])
    double = encode_angle(either_side, "double")
    paper = encode_angle(either_side, "paper")
    assert np.linalg.norm(double[0] - double[1]) < 0.01
    assert np.linalg.norm(paper[0] - paper[1]) > 1.99


@encodings
def test_labels_are_sine_then_cosine_in_float32(encoding: AngleEncoding) -> None:
    labels = encode_angle(np.radians([0.0, 30.0]), encoding)
    factor = 2 if encoding == "double" else 1
    turned = math.radians(30 * factor)
    assert labels.dtype == np.float32
    expected = np.array([[0.0, 1.0], [math.sin(turned), math.cos(turned)]])
    np.testing.assert_allclose(labels, expected, atol=1e-6)


@given(angles, angles)
def test_the_error_is_symmetric_and_the_angle_between_the_lines(
    first: float, second: float
) -> None:
    error = float(angle_error(np.array(first), np.array(second)))
    assert error == pytest.approx(float(angle_error(np.array(second), np.array(first))), abs=1e-9)
    assert 0 <= error <= math.pi / 2
    # asin flattens at 90 degrees, so compare where it does not lose digits.
    assert math.sin(error) == pytest.approx(math.sin(same_direction(first, second)), abs=1e-9)


def test_a_half_turn_is_no_error_and_a_quarter_turn_the_largest() -> None:
    errors = angle_error(np.radians([170.0, 45.0]), np.radians([-10.0, -45.0]))
    np.testing.assert_allclose(np.degrees(errors), [0.0, 90.0], atol=1e-9)


@given(st.floats(-math.pi, math.pi), st.lists(st.floats(-0.6, 0.6), min_size=1, max_size=8))
def test_the_mean_direction_is_the_best_of_all_directions(base: float, spread: list[float]) -> None:
    lines = base + np.array(spread)
    mean, strength = mean_direction(lines)
    everywhere = np.linspace(-np.pi / 2, np.pi / 2, 3601)
    agreement = np.cos(2 * (lines[:, None] - everywhere)).mean(axis=0)
    assert same_direction(mean, everywhere[agreement.argmax()]) < 2e-3
    assert strength == pytest.approx(agreement.max(), abs=1e-5)


def test_lines_without_a_common_direction_have_no_strength() -> None:
    _, strength = mean_direction(np.radians([0.0, 60.0, 120.0]))
    assert strength == pytest.approx(0.0, abs=1e-12)


def test_rounded_degrees_stay_in_their_half_turn() -> None:
    assert round_degrees(-89.998, 2) == 90.0
    assert round_degrees(-89.994, 2) == -89.99
    assert round_degrees(-89.96, 1) == 90.0
    assert round_degrees(89.999, 2) == 90.0
    assert math.copysign(1, round_degrees(-0.001, 2)) == 1
