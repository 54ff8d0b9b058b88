"""Both sides of an outline, and colours whatever the light."""

import cv2
import numpy as np
import pytest

from qsgm.grasp.colours import Colours
from qsgm.grasp.outline import STRETCHES, Outline, contrasts, likeness


def disk(radius: float = 20.0) -> np.ndarray:
    y, x = np.mgrid[:64, :64]
    return np.clip(radius + 0.5 - np.hypot(x - 31.5, y - 31.5), 0, 1).astype(np.float32)


def test_inside_is_inside_and_outside_is_outside_all_around() -> None:
    outline = Outline.of(disk())
    for points, low, high in ((outline.inner, 16, 20), (outline.outer, 20, 24)):
        away = np.hypot(*(points - 31.5).T)
        assert low < away.min() < away.max() < high
        from_it = np.hypot(*(points - np.tile(outline.points, (2, 1))).T).reshape(2, -1)
        np.testing.assert_allclose(from_it, np.broadcast_to([[1.5], [3.0]], from_it.shape), 1e-4)


def test_contrast_is_the_colours_distance_where_the_object_ends() -> None:
    image = np.full((64, 64, 3), 50, np.float32)
    image[disk(25) > 0.5] = (80, 90, 50)  # reaches further than the outline
    left = image.copy()
    left[:, :32] = np.where((disk(20) > 0.5)[:, :32, None], (80, 90, 50), 50)
    outline = Outline.of(disk())
    assert contrasts(*outline.sides(image)).max() < 1
    half = contrasts(*outline.sides(left))
    assert half.shape == (STRETCHES,)
    assert (half > 40).sum() == pytest.approx(STRETCHES / 2, abs=2)
    assert half.max() == pytest.approx(50, abs=2)  # (30, 40, 0) apart


def test_colours_along_the_outline_are_alike_in_other_light() -> None:
    rng = np.random.default_rng(0)
    taught = rng.uniform(40, 200, (96, 3)).astype(np.float32)
    assert likeness(taught, taught * np.float32(0.6) + 10) > 0.98
    assert abs(likeness(taught, rng.uniform(40, 200, (96, 3)).astype(np.float32))) < 0.3


@pytest.mark.parametrize("points", [[(30, 30)], [(3, 3), (60, 60)], [(0, 0), (63, 0), (30, 63)]])
def test_any_mask_has_an_outline(points: list[tuple[int, int]]) -> None:
    solid = np.zeros((64, 64), np.float32)
    for x, y in points:
        solid[y, x] = 0.3
    outline = Outline.of(solid)
    assert np.isfinite(outline.inner).all()
    inside, outside = outline.sides(np.ones((64, 64, 3), np.float32))
    np.testing.assert_allclose(contrasts(inside, outside), 0)


def pixels(hue: int, count: int = 400) -> np.ndarray:
    rng = np.random.default_rng(hue)
    hsv = np.stack(
        [
            np.full(count, hue),
            rng.integers(120, 200, count),
            rng.integers(120, 250, count),
        ],
        axis=1,
    )
    return cv2.cvtColor(hsv[None].astype(np.uint8), cv2.COLOR_HSV2BGR)[0].astype(np.float32)


def test_less_light_changes_no_colours_and_another_hue_does() -> None:
    taught = Colours.of(pixels(10))
    dim, other = Colours.of(pixels(10) * np.float32(0.7)), Colours.of(pixels(90))
    assert taught.overlap(taught) == pytest.approx(1, abs=1e-5)
    assert taught.overlap(dim) > 0.6 > 0.2 > taught.overlap(other)
    assert taught.shift(dim) < 0.1 < taught.shift(other)
    assert taught.tint(dim) < 0.1 < taught.tint(other)


@pytest.mark.parametrize("color", [(0, 0, 0), (250, 30, 4), (60, 128, 255)])
def test_a_hue_is_of_levels_and_a_dozen_more(color: tuple[int, int, int]) -> None:
    blue, green, red = (level + 12 for level in color)
    seen = Colours.of(np.array([color] * 3, np.float32))
    expected = np.log([red / green, blue / green])
    np.testing.assert_allclose(seen.middle, expected, atol=1e-5)
    np.testing.assert_allclose(seen.mean, np.log([blue, green, red]), atol=1e-5)


def test_what_is_black_has_no_hue() -> None:
    rng = np.random.default_rng(1)
    one, other = (Colours.of(rng.uniform(0, 4, (300, 3)).astype(np.float32)) for _ in range(2))
    assert one.shift(other) < 0.1
    assert one.overlap(other) > 0.9
