"""Fits moved to the object's edges, where its pixels do not say where it is."""

import math

import numpy as np
import pytest
from toys import lay, plain, table, toy

from qsgm.grasp.correlation import Fit, pyramid_of
from qsgm.grasp.judge import Appearance
from qsgm.grasp.patch import cut_patch

CENTER = (320.0, 240.0)


PLAIN = Appearance.of(cut_patch(lay(plain(), table(), CENTER), CENTER))


def errors(appearance: Appearance, fit: Fit, turn_deg: float) -> tuple[float, float]:
    off = math.dist(appearance.center_of(fit), CENTER)
    return off, abs((math.degrees(fit.turn_rad) - turn_deg + 180) % 360 - 180)


@pytest.mark.parametrize("seed", range(8))
def test_a_plain_object_on_another_table_is_brought_to_its_edges(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = float(rng.uniform(-180, 180))
    scene = pyramid_of(lay(plain(), table(seed + 1, grey=60), CENTER, turn))
    x, y = np.array(CENTER) - 0.5 + rng.uniform(-4, 4, 2)
    start = Fit(0.5, math.radians(turn + rng.uniform(-7, 7)), rng.uniform(0.95, 1.05), (x, y))
    moved = PLAIN.snapper.snapped(scene, start)
    off, turned = errors(PLAIN, moved, turn)
    assert off < 2
    assert turned < 2
    assert moved.score == start.score


def test_a_fit_that_is_right_stays() -> None:
    appearance = Appearance.of(cut_patch(lay(toy(), table(), CENTER), CENTER))
    scene = pyramid_of(lay(toy(), table(3), CENTER, 33))
    fit, _ = appearance.aligner.aligned(scene, Fit(0.0, math.radians(35), 1.0, (321.0, 239.0)))
    assert errors(appearance, fit, 33)[0] < 0.3
    off, turned = errors(appearance, appearance.snapper.snapped(scene, fit), 33)
    assert off < 1
    assert turned < 1


def test_where_there_is_no_edge_a_fit_stays_near() -> None:
    scene = pyramid_of(np.full((480, 640, 3), 120, np.uint8))
    moved = PLAIN.snapper.snapped(scene, Fit(0.1, 0.4, 1.0, CENTER))
    assert math.dist(moved.center_px, CENTER) < 1
    assert moved.turn_rad == pytest.approx(0.4, abs=0.02)
