"""Room is made where a demonstration has none, and only there."""

import numpy as np
import pytest
from toys import lay, table, toy

from qsgm.grasp.source import Demonstration
from qsgm.grasp.surroundings import LEAST_AROUND_PX, LEAST_SIDE_PX, with_room


def test_a_frame_with_room_stays_as_it_is() -> None:
    one = Demonstration(lay(toy(), table(), (320.0, 240.0)), (320.0, 240.0))
    assert with_room(one) is one


@pytest.mark.parametrize(
    ("frame_hw", "center"),
    [((120, 160), (80.0, 60.0)), ((480, 640), (50.0, 240.0)), ((100, 400), (350.0, 45.5))],
)
def test_a_small_frame_and_one_with_its_object_at_the_border_are_continued(
    frame_hw: tuple[int, int], center: tuple[float, float]
) -> None:
    frame = lay(toy(), table(1, frame_hw), center, 30)
    wide = with_room(Demonstration(frame, center))
    height, width = wide.frame.shape[:2]
    assert min(height, width) >= LEAST_SIDE_PX
    x, y = wide.center_px
    assert min(x, y, width - x, height - y) >= LEAST_AROUND_PX - 1
    left, top = round(x - center[0]), round(y - center[1])
    here = wide.frame[top : top + frame_hw[0], left : left + frame_hw[1]]
    np.testing.assert_array_equal(here, frame)


def test_the_object_does_not_show_itself_again_beyond_the_border() -> None:
    frame = lay(toy(), table(1, (120, 160), grey=90), (80.0, 60.0))
    wide = with_room(Demonstration(frame, (80.0, 60.0))).frame.astype(int)
    red = wide[..., 2] - wide[..., 0] > 60
    top, left = (wide.shape[0] - 120) // 2, (wide.shape[1] - 160) // 2
    assert red[top : top + 120, left : left + 160].sum() > 1000
    red[top : top + 120, left : left + 160] = False
    assert not red.any()
