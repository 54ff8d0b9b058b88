"""Several demonstrations of one object: how far each is turned, and which look different."""

import math

import numpy as np
import pytest
from toys import lay, table, toy

from qsgm.grasp.shown import shown
from qsgm.grasp.source import Demonstration

FIRST = Demonstration(lay(toy(), table(0), (320.0, 240.0)), (320.0, 240.0))


def turned(turn_deg: float, scale: float = 1.0, seed: int = 4) -> Demonstration:
    center = (300.5, 250.25)
    return Demonstration(lay(toy(), table(seed), center, turn_deg, scale), center)


def other_side() -> Demonstration:
    picture = toy()[..., [1, 2, 0, 3]]
    center = (330.0, 230.0)
    return Demonstration(lay(picture[:, ::-1].copy(), table(5), center, 10), center)


@pytest.mark.parametrize("turn", [0, 45, -130, 180])
def test_the_patch_says_how_far_another_demonstration_is_turned(turn: float) -> None:
    both = shown([FIRST, turned(turn)])
    assert both.turns_rad[0] == 0
    assert both.turns_rad[1] is not None
    error = (math.degrees(both.turns_rad[1]) - turn + 180) % 360 - 180
    assert abs(error) < 0.5
    assert len(both.views([0.0, 0.0])) == 1


def test_what_looks_different_has_a_look_of_its_own_turned_as_the_network_sees_it() -> None:
    both = shown([FIRST, other_side(), turned(30)])
    assert both.turns_rad[1] is None
    first, second = both.views([0.5, 0.9, 0.6])
    assert (first.turn_rad, first.whole) == (0, True)
    assert (second.turn_rad, second.whole) == (pytest.approx(0.4), False)
    np.testing.assert_array_equal(second.patch.image, both.patches[1].image)


def test_one_frame_of_the_usual_size_is_left_as_it_is() -> None:
    one = shown([FIRST])
    assert one.scale == 1
    assert one.demonstrations[0] is FIRST
    assert one.span_px == pytest.approx(90, abs=5)
    assert one.turns_rad == (0,)


def test_a_large_object_makes_its_frame_smaller_and_its_centre_goes_with_it() -> None:
    center = (640.0, 500.0)
    large = Demonstration(lay(toy(), table(1, (960, 1280)), center, 20, 3.0), center)
    one = shown([large])
    assert one.scale == pytest.approx(90 / 270, rel=0.1)
    frame, (x, y) = one.demonstrations[0].frame, one.demonstrations[0].center_px
    assert frame.shape[:2] == (round(960 * one.scale), round(1280 * one.scale))
    assert x == pytest.approx((640.5 / 1280) * frame.shape[1] - 0.5)
    assert y == pytest.approx((500.5 / 960) * frame.shape[0] - 0.5)
    assert max(one.patches[0].span_px) == pytest.approx(90, abs=10)


def test_the_same_camera_sees_every_demonstration_at_one_scale() -> None:
    center = (640.0, 480.0)
    near, far = (
        Demonstration(lay(toy(), table(1, (960, 1280)), center, 20, scale), center)
        for scale in (3.0, 2.6)
    )
    both = shown([near, far])
    assert both.demonstrations[0].frame.shape == both.demonstrations[1].frame.shape
    small = shown([near, turned(20)])
    assert small.demonstrations[1].frame.shape == (480, 640, 3)


def test_what_the_user_says_of_its_size_is_not_measured() -> None:
    assert shown([FIRST], span_px=180).scale == 0.5
    assert shown([FIRST], span_px=90).scale == 1
