"""An outline's points, and the colours just inside it."""

import numpy as np
import pytest

from qsgm.grasp.outline import Outline


def disk(radius: float = 20.0) -> np.ndarray:
    y, x = np.mgrid[:64, :64]
    return np.clip(radius + 0.5 - np.hypot(x - 31.5, y - 31.5), 0, 1).astype(np.float32)


def test_lines_lead_from_inside_to_outside_all_around() -> None:
    x, y = Outline.of(disk()).lines(np.array([-3.0, -1.5, 0.0, 1.5, 3.0], np.float32))
    away = np.hypot(x - 31.5, y - 31.5)
    np.testing.assert_allclose(away[:, 2], 19.5, atol=0.6)
    np.testing.assert_allclose(np.diff(away, axis=1), 1.5, atol=0.05)


def test_points_lie_at_equal_distances() -> None:
    points = Outline.of(disk()).points
    apart = np.hypot(*(points - np.roll(points, 1, axis=0)).T)
    assert apart.max() < 1.2 * apart.min()


def test_colours_inside_are_the_objects_own() -> None:
    image = np.full((64, 64, 3), 50, np.float32)
    image[disk() > 0.1] = (80, 90, 50)
    colours = Outline.of(disk()).colours_inside(image)
    np.testing.assert_allclose(colours, np.broadcast_to([80, 90, 50], colours.shape), atol=0.5)


@pytest.mark.parametrize("points", [[(30, 30)], [(3, 3), (60, 60)], [(0, 0), (63, 0), (30, 63)]])
def test_any_mask_has_an_outline(points: list[tuple[int, int]]) -> None:
    solid = np.zeros((64, 64), np.float32)
    for x, y in points:
        solid[y, x] = 0.3
    outline = Outline.of(solid)
    assert np.isfinite(outline.points).all()
    colours = outline.colours_inside(np.ones((64, 64, 3), np.float32))
    np.testing.assert_allclose(colours, 1)
