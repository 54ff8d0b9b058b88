"""Grasp angles: modulo 180 degrees, counter-clockwise positive as seen in the image.

A two-finger gripper cannot tell an angle from its opposite, so an angle is a line's direction.
The double angle (sin 2θ, cos 2θ) has no seam anywhere; the paper's (sin θ, cos θ) with
θ in (-π/2, π/2] breaks at ±90° and is kept for the paper's tables.
"""

import math
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

AngleEncoding = Literal["double", "paper"]
ENCODINGS: tuple[AngleEncoding, ...] = get_args(AngleEncoding)
Floats = NDArray[np.float32] | NDArray[np.float64]


def wrap_half_turn(angle_rad: Floats) -> NDArray[np.float64]:
    """Any angles [rad] mapped to (-π/2, π/2]."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    wrapped = np.pi / 2 - np.mod(np.pi / 2 - angle, np.pi)
    # A tiny negative argument makes `mod` round up to π itself.
    return np.where(wrapped <= -np.pi / 2, np.pi / 2, wrapped)


def encode_angle(angle_rad: Floats, encoding: AngleEncoding = "double") -> NDArray[np.float32]:
    """Angles [rad], shape (N,), as their two label channels (sine, cosine), shape (N, 2)."""
    factor = 2.0 if encoding == "double" else 1.0
    angle = factor * wrap_half_turn(angle_rad)
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1).astype(np.float32)


def decode_angle(
    sine: Floats, cosine: Floats, encoding: AngleEncoding = "double"
) -> NDArray[np.float64]:
    """Label channels back to angles [rad] in (-π/2, π/2]; the inverse of :func:`encode_angle`."""
    factor = 2.0 if encoding == "double" else 1.0
    return wrap_half_turn(np.arctan2(np.asarray(sine), np.asarray(cosine)) / factor)


def angle_error(predicted_rad: Floats, true_rad: Floats) -> NDArray[np.float64]:
    """Absolute difference of line directions [rad], in [0, π/2]."""
    return np.abs(wrap_half_turn(np.asarray(predicted_rad) - np.asarray(true_rad)))


def round_degrees(angle_deg: float, digits: int) -> float:
    """An angle in (-90, 90] rounded so that it stays there: what would be -90 is 90."""
    rounded = round(angle_deg, digits) + 0.0  # adding 0.0 turns -0.0 into 0.0
    return 90.0 if rounded <= -90.0 else rounded


def mean_direction(angle_rad: Floats) -> tuple[float, float]:
    """Circular mean of line directions [rad] and its strength in [0, 1].

    The strength is the mean resultant length of the doubled angles: 1 when all agree,
    near 0 when there is no common direction (a round object).
    """
    resultant = np.mean(np.exp(2j * np.asarray(angle_rad, dtype=np.float64)))
    mean = wrap_half_turn(np.asarray(np.angle(resultant) / 2))
    return float(mean), float(np.abs(resultant))


def full_degrees(turn_rad: float) -> float:
    """A turn in degrees in (-180, 180]."""
    return float(180 - (180 - np.degrees(turn_rad)) % 360)


def rounded_angle(angle_deg: float, digits: int) -> float | None:
    """An angle in (-90, 90], rounded; None unless it is finite."""
    return round_degrees(angle_deg, digits) if math.isfinite(angle_deg) else None


def rounded_turn(turn_rad: float) -> float:
    """A turn in degrees in (-180, 180], rounded to hundredths."""
    rounded = round(full_degrees(turn_rad), 2) + 0.0
    return 180.0 if rounded <= -180.0 else rounded
