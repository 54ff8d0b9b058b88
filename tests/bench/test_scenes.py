import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.angles import angle_error
from qsgm.train.grasp.drawing.scenes import (
    DrawnObject,
    DrawnScene,
    View,
    draw_object,
    draw_scene,
    in_colours_of,
)
from qsgm.train.grasp.drawing.shapes import OBJECT_KINDS
from qsgm.train.grasp.drawing.structures import STRUCTURE_KINDS

TABLE = np.full((480, 640, 3), 150, np.uint8)


def an_object(seed: int, kind: str = "carton") -> DrawnObject:
    return draw_object(np.random.default_rng(seed), kind=kind)


def scene(seed: int, drawn: DrawnObject | None, **settings: object) -> DrawnScene:
    settings.setdefault("table", TABLE)
    return draw_scene(np.random.default_rng(seed), drawn, **settings)  # type: ignore[arg-type]


def long_axis(mask: NDArray[np.bool_]) -> float:
    rows, columns = np.nonzero(mask)
    _, vectors = np.linalg.eigh(np.cov(np.stack([columns, -rows])))
    return float(np.arctan2(vectors[1, 1], vectors[0, 1]))


def turned_back(drawn: DrawnScene, turn_rad: float) -> NDArray[np.float64]:
    """The object's surroundings (64, 64, 3), turned clockwise as seen."""
    assert drawn.center_px is not None
    matrix = cv2.getRotationMatrix2D(drawn.center_px, -np.degrees(turn_rad), 1.0)
    matrix[:, 2] += 32 - np.array(drawn.center_px)
    return cv2.warpAffine(drawn.image, matrix, (64, 64)).astype(np.float64)


def alikeness(first: NDArray[np.float64], second: NDArray[np.float64]) -> float:
    return float(np.corrcoef(first.ravel(), second.ravel())[0, 1])


def test_the_same_seed_gives_the_same_scene_and_object() -> None:
    scenes = [
        draw_scene(np.random.default_rng(4), an_object(1), others=[an_object(2)]) for _ in range(2)
    ]
    assert np.array_equal(scenes[0].image, scenes[1].image)
    assert np.array_equal(scenes[0].mask, scenes[1].mask)
    assert not np.array_equal(scenes[0].image, scene(5, an_object(1)).image)


def test_an_object_looks_the_same_in_another_scene_but_for_its_turn() -> None:
    for seed in range(4):
        drawn = an_object(seed)
        first, second = scene(20 + seed, drawn), scene(30 + seed, drawn, turn_rad=2.0)
        same = alikeness(turned_back(first, 0), turned_back(second, 2.0))
        assert same > 0.85
        assert same > alikeness(turned_back(first, 0), turned_back(second, -2.0)) + 0.1
        stranger = scene(30 + seed, an_object(seed + 9), turn_rad=2.0)
        assert same > alikeness(turned_back(first, 0), turned_back(stranger, 2.0)) + 0.1


@pytest.mark.parametrize("kind", OBJECT_KINDS)
def test_an_object_lies_where_and_turned_as_it_should(kind: str) -> None:
    for seed, (center, turn) in enumerate([((200.0, 150.0), 0.7), ((401.5, 300.25), -2.0)]):
        drawn = an_object(seed, kind)
        level = scene(seed, drawn)
        seen = scene(seed, drawn, center_px=center, turn_rad=turn)
        assert seen.center_px == center
        matrix = cv2.getRotationMatrix2D(center, -np.degrees(turn), 1.0)
        matrix[:, 2] += np.array([320, 240]) - center
        back = cv2.warpAffine(seen.mask.astype(np.float32), matrix, (640, 480)) > 0.5
        assert (back & level.mask).sum() > 0.85 * (back | level.mask).sum()
        if drawn.elongation > 2:
            grown = np.array([long_axis(seen.mask) - long_axis(level.mask)])
            assert angle_error(grown, np.array([turn]))[0] < np.deg2rad(1)


@pytest.mark.parametrize("kind", ["carton", "can", "tube"])
def test_the_centre_is_that_of_the_rectangle_around_the_object(kind: str) -> None:
    # Of these kinds: around a racket, say, there are two rectangles of the same least area.
    for seed in range(4):
        drawn = an_object(seed + 2, kind)
        points = np.argwhere(scene(seed, drawn, center_px=(300.5, 200.0)).mask)[:, ::-1]
        middle, size, _ = cv2.minAreaRect(points.astype(np.float32))
        assert np.abs(np.array(middle) - (300.5, 200)).max() <= 1
        assert sorted(np.array(size) + 1) == pytest.approx(sorted(drawn.size_px), abs=1.5)


def test_a_view_scales_and_squeezes_along_its_direction() -> None:
    drawn = an_object(0, "pen")
    along = np.argwhere(scene(0, drawn, view=View(1.25, np.deg2rad(25), 0.0)).mask)
    across = np.argwhere(scene(0, drawn, view=View(0.8, np.deg2rad(25), np.pi / 2)).mask)
    length, tilted = drawn.size_px[0], np.cos(np.deg2rad(25))
    assert np.ptp(along[:, 1]) + 1 == pytest.approx(1.25 * tilted * length, abs=1.5)
    assert np.ptp(across[:, 1]) + 1 == pytest.approx(0.8 * length, abs=1.5)


@pytest.mark.parametrize("turn", [-2.5, -0.4, 0.0, 1.1, 3.0])
def test_a_slant_does_not_bias_the_turn(turn: float) -> None:
    linear = View(1.1, np.deg2rad(25), 0.8).linear(turn)
    left, _, right = np.linalg.svd(linear)
    rotation = left @ right  # the nearest rotation; rows count downwards
    assert np.arctan2(rotation[0, 1], rotation[0, 0]) == pytest.approx(turn)


def test_others_may_touch_but_do_not_hide_the_object() -> None:
    others = [an_object(seed, kind) for seed, kind in enumerate(["bottle", "mug", "wrench"])]
    near = 0
    for seed in range(8):
        seen = scene(seed, an_object(7), others=others)
        assert seen.hidden_share == 0
        assert not np.any(seen.mask & seen.others)
        assert seen.mask.sum() == scene(seed, an_object(7)).mask.sum()
        around = cv2.dilate(seen.mask.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
        near += bool(np.any(around & seen.others))
    assert near >= 4


def test_the_first_of_the_others_hides_about_the_share_asked_for() -> None:
    others = [an_object(1, "square_box"), an_object(2, "mug")]
    shares = [
        scene(seed, an_object(7), others=others, hidden_share=0.3).hidden_share for seed in range(6)
    ]
    assert all(0.15 < share <= 0.3 for share in shares)


def test_a_scene_is_drawn_without_its_object_and_nothing_else_changes() -> None:
    others, box = [an_object(1, "square_box"), an_object(2, "mug")], an_object(7)
    for seed in range(3):
        full = scene(seed, box, others=others, structures=["edge"])
        empty = scene(seed, box, others=others, structures=["edge"], taken_away=True)
        assert empty.center_px is None
        assert not empty.mask.any()
        assert np.array_equal(full.others, empty.others)
        far = cv2.dilate(full.mask.astype(np.uint8), np.ones((121, 121), np.uint8)) == 0
        # A picture pressed into JPEG changes a little all around.
        assert np.abs(full.image[far].astype(int) - empty.image[far]).mean() < 1


def test_a_scene_may_have_no_object_at_all() -> None:
    empty = scene(0, None, others=[an_object(1), an_object(2)])
    assert empty.center_px is None
    assert not empty.mask.any()
    assert empty.others.any()


def test_an_object_may_lie_partly_outside_the_frame() -> None:
    seen = scene(0, an_object(0), center_px=(2.0, 478.0))
    assert 0 < seen.mask.sum() < scene(0, an_object(0)).mask.sum() / 2


@pytest.mark.parametrize("kind", STRUCTURE_KINDS)
def test_a_structure_changes_the_table_elsewhere(kind: str) -> None:
    for seed in range(4):
        seen = scene(seed, None, structures=[kind], center_px=(320, 240))
        plain = scene(seed, None)
        assert np.abs(seen.image.astype(int) - plain.image).max() > 20


def test_a_given_table_is_not_drawn_on() -> None:
    scene(0, an_object(0), others=[an_object(1)], structures=STRUCTURE_KINDS)
    assert np.all(TABLE == 150)


def test_an_unknown_structure_is_refused_with_the_known_ones() -> None:
    with pytest.raises(QsgmError, match=r"'cliff'.*edge, gap, sheet"):
        scene(0, None, structures=["cliff"])


def test_an_object_throws_a_shadow() -> None:
    dark = []
    for seed in range(6):
        full, empty = (scene(seed, an_object(3), taken_away=away) for away in (False, True))
        ring = cv2.dilate(full.mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
        ring &= ~(cv2.dilate(full.mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        dark.append(float((empty.image[ring].astype(int) - full.image[ring]).mean()))
    assert np.mean(dark) > 5


def test_a_thing_in_anothers_colours_keeps_its_shape_and_takes_the_mean_colour() -> None:
    thing, model = an_object(3), an_object(8)
    painted = in_colours_of(thing, model)
    assert painted.kind == thing.kind
    np.testing.assert_array_equal(painted.painted.coverage, thing.painted.coverage)
    inside, wanted = (one.painted.coverage > 127 for one in (thing, model))
    got = painted.painted.colour[inside].mean(axis=0)
    before = thing.painted.colour[inside].mean(axis=0)
    target = model.painted.colour[wanted].mean(axis=0)
    assert np.abs(got - target).max() < 0.3 * np.abs(before - target).max()
