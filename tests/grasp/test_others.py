"""Things that the user names become sprites of the size in which scenes show them."""

import numpy as np
import pytest
from toys import lay, table, toy

from qsgm.grasp.distractors import TILE_PX, Distractors
from qsgm.grasp.others import Other, add_others, other_in
from qsgm.grasp.patch import cut_patch
from qsgm.grasp.source import Demonstration

CENTER = (320.0, 240.0)


def named(scale: float = 1.0) -> Demonstration:
    return Demonstration(lay(toy(), table(0), CENTER, 30, scale), CENTER)


def span(sprite: np.ndarray) -> float:
    y, x = np.nonzero(sprite[..., 3] > 127)
    points = np.stack([x, y]) - np.array([[x.mean()], [y.mean()]])
    values, vectors = np.linalg.eigh(points @ points.T)
    along = vectors[:, 1] @ points
    assert values[1] > values[0]
    return float(np.ptp(along))


def test_a_thing_is_cut_out_of_its_table() -> None:
    things = add_others(None, [other_in(named())], 1.0)
    assert things is not None
    sprite = things.sprites[0]
    shape = toy().copy()
    shape[..., :3] = 255
    truth = lay(shape, np.zeros((480, 640, 3), np.uint8), CENTER, 30)[176:304, 256:384, 0] > 127
    opaque = sprite[..., 3] > 127
    assert (opaque & truth).sum() / (opaque | truth).sum() > 0.85
    inside = sprite[..., 3] > 250
    colours = named().frame[176:304, 256:384]
    assert np.abs(sprite[..., :3].astype(int) - colours)[inside].mean() < 3
    assert (sprite[sprite[..., 3] == 0] == 0).all()


@pytest.mark.parametrize(("scale", "expected"), [(1.0, 90), (0.5, 45), (1.25, 112), (8.0, 120)])
def test_it_is_as_large_as_the_objects_camera_sees_it_and_fits_its_tile(
    scale: float, expected: float
) -> None:
    things = add_others(None, [other_in(named())], scale)
    assert things is not None
    assert span(things.sprites[0]) == pytest.approx(expected, rel=0.08)
    assert things.sprites.shape == (1, TILE_PX, TILE_PX, 4)


def test_one_that_is_too_large_for_a_patch_is_made_smaller_first() -> None:
    center = (640.0, 480.0)
    other = other_in(Demonstration(lay(toy(), table(1, (960, 1280)), center, 0, 4), center))
    assert other.scale == pytest.approx(120 / 360, rel=0.1)
    things = add_others(None, [other], 0.25)
    assert things is not None
    assert span(things.sprites[0]) == pytest.approx(90, rel=0.1)


def test_without_any_the_bundles_things_are_as_they_were() -> None:
    things = Distractors(np.zeros((2, 128, 128, 4), np.uint8), np.zeros((2, 2), np.int32))
    assert add_others(things, [], 1.0) is things
    assert add_others(None, [], 1.0) is None


def test_what_was_named_can_be_told_from_its_sum() -> None:
    one, two = (Other(cut_patch(named(scale).frame, CENTER)) for scale in (1.0, 1.1))
    assert one.sha256 == Other(cut_patch(named().frame, CENTER)).sha256 != two.sha256
