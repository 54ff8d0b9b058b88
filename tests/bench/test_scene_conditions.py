"""Composed scenes: whatever they say is true of them can be seen in them."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm import QsgmError
from qsgm.bench.composing import (
    BORDER_PX,
    CONDITIONS,
    OBJECT_SCALE,
    Composer,
    Condition,
    ScenePair,
    Subject,
    kind_of,
)
from qsgm.bench.cutouts import cut_out
from qsgm.bench.frames import spread
from qsgm.bench.subjects import drawn_subjects
from qsgm.bench.surfaces import with_surface

H, W = 240, 320
CENTER = (160.0, 120.0)
RED, GREEN, BLUE = (50, 40, 220), (60, 200, 50), (215, 70, 40)
Shade = NDArray[np.floating]


def painted(name: str, color: tuple[int, int, int], kind: str, table: float = 100.0) -> Subject:
    """A bar with one light end, on a grainy table."""
    rng = np.random.default_rng(len(name))
    frame = rng.normal(table, 4, (H, W, 3))
    mask = np.zeros((H, W), bool)
    mask[102:138, 115:205] = True
    frame[mask] = color
    frame[102:138, 185:205] = 245
    return Subject(name, kind, np.clip(frame, 0, 255).astype(np.uint8), mask, True, True)


@pytest.fixture(scope="module")
def composer() -> Composer:
    """Two bars of one kind, red and green, and a blue one of another."""
    return Composer(
        [
            painted("red", RED, "bar"),
            painted("green", GREEN, "bar", 106.0),
            painted("blue", BLUE, "stick", 112.0),
        ]
    )


def pairs(composer: Composer, condition: Condition, count: int = 4) -> list[ScenePair]:
    """Scenes of the red bar."""
    return [composer.pair(0, condition, np.random.default_rng([5, k])) for k in range(count)]


def without_thing(composer: Composer, condition: Condition) -> Iterator[ScenePair]:
    """Those whose other scene shows nothing in the object's place."""
    found = [pair for pair in pairs(composer, condition, 6) if not pair.absent_thing]
    assert found
    yield from found


def changed(pair: ScenePair) -> NDArray[np.bool_]:
    """Where the scene with the object differs from the one without: the object itself."""
    difference = np.abs(pair.present.frame.astype(int) - pair.absent.frame).max(axis=2)
    return difference > 0.4 * np.percentile(difference[difference > 0], 50)


def light_end(pair: ScenePair, pixels: NDArray[np.bool_]) -> tuple[float, float]:
    """Middle (x, y) of the object's lighter end, told from its colour: grey, the rest is red."""
    part = pair.present.frame.astype(int)
    rows, cols = np.nonzero(pixels & (part[:, :, 2] - part[:, :, 0] < 25))
    return float(cols.mean()), float(rows.mean())


@pytest.mark.parametrize("condition", [c for c in CONDITIONS if c != "hidden"])
def test_the_object_is_where_its_scene_says(composer: Composer, condition: Condition) -> None:
    for pair in without_thing(composer, condition):
        rows, cols = np.nonzero(changed(pair))
        assert pair.present.center_px is not None
        assert (cols.mean(), rows.mean()) == pytest.approx(pair.present.center_px, abs=3)


@pytest.mark.parametrize("condition", ["same_table", "edges", "scale", "half_light"])
def test_the_object_is_turned_as_its_scene_says_over_the_full_circle(
    composer: Composer, condition: Condition
) -> None:
    for pair in without_thing(composer, condition):
        end, middle = light_end(pair, changed(pair)), pair.present.center_px
        assert middle is not None
        direction = math.atan2(middle[1] - end[1], end[0] - middle[0])  # 0 in the demonstration
        difference = math.degrees(direction - pair.present.turn_rad)
        assert abs((difference + 180) % 360 - 180) < 4


def test_a_scene_is_the_same_without_the_object_but_for_its_place(composer: Composer) -> None:
    for condition in CONDITIONS:
        for pair in pairs(composer, condition, 2):
            x, y = (round(value) for value in pair.present.center_px or ())
            away = np.ones((H, W), bool)
            away[max(y - 95, 0) : y + 96, max(x - 95, 0) : x + 96] = False
            np.testing.assert_array_equal(pair.present.frame[away], pair.absent.frame[away])
            assert pair.absent.center_px is None


def test_half_of_the_scenes_without_show_another_thing_in_its_place(composer: Composer) -> None:
    shown = pairs(composer, "same_table", 30)
    assert 8 <= sum(pair.absent_thing for pair in shown) <= 22
    for pair in shown[:8]:
        x, y = (round(value) for value in pair.present.center_px or ())
        assert pair.absent.others[y, x] == pair.absent_thing
        assert not pair.present.others.any()


def test_windows_stay_inside_the_frame(composer: Composer) -> None:
    for condition, pair in product(CONDITIONS, range(3)):
        x, y = composer.pair(0, condition, np.random.default_rng(pair)).present.center_px or (0, 0)
        assert BORDER_PX <= x <= W - BORDER_PX
        assert BORDER_PX <= y <= H - BORDER_PX


def test_nothing_of_the_objects_kind_is_ever_beside_it_or_over_it(composer: Composer) -> None:
    for condition in ("beside", "hidden", "same_table"):
        for pair in pairs(composer, condition, 6):
            for scene in (pair.present, pair.absent):
                blue, green, red = np.moveaxis(scene.frame.astype(int), 2, 0)
                assert not ((green - blue > 60) & (green - red > 60)).any()


def test_other_things_lie_where_the_scene_says(composer: Composer) -> None:
    for pair in pairs(composer, "beside"):
        blue, green, red = np.moveaxis(pair.present.frame.astype(int), 2, 0)
        seen = (blue - red > 60) & (blue - green > 60)
        assert seen.sum() > 500
        assert (seen & ~pair.present.others).sum() < 0.06 * seen.sum()  # soft outlines


def test_beside_other_things_at_least_nine_tenths_stay_visible(composer: Composer) -> None:
    area = composer.subjects[0].mask.sum()
    for pair in without_thing(composer, "beside"):
        assert 0.88 < changed(pair).sum() / area < 1.1


def test_some_other_things_touch_the_object(composer: Composer) -> None:
    gaps = []
    for pair in without_thing(composer, "beside"):
        rows, cols = np.nonzero(pair.present.others)
        y, x = np.nonzero(changed(pair))
        some = slice(None, None, 7)
        near = np.hypot(rows[some, None] - y[some], cols[some, None] - x[some]).min(axis=0)
        gaps.append(near.min())
    assert min(gaps) < 5


def test_a_third_is_hidden_under_another_thing(composer: Composer) -> None:
    area = composer.subjects[0].mask.sum()
    for pair in without_thing(composer, "hidden"):
        assert 0.24 < 1 - changed(pair).sum() / area < 0.36  # soft outlines blur it a little


def test_scaled_objects_take_up_as_much_as_the_scale_says(composer: Composer) -> None:
    area = composer.subjects[0].mask.sum()
    for pair in without_thing(composer, "scale"):
        assert OBJECT_SCALE[0] <= pair.present.scale <= OBJECT_SCALE[1]
        assert changed(pair).sum() / area == pytest.approx(pair.present.scale**2, rel=0.08)


def test_a_tilted_object_is_foreshortened(composer: Composer) -> None:
    area = composer.subjects[0].mask.sum()
    for pair in without_thing(composer, "tilt"):
        assert changed(pair).sum() / area == pytest.approx(math.cos(math.radians(25)), abs=0.06)


def test_half_light_is_half_the_light(composer: Composer) -> None:
    for pair in pairs(composer, "half_light"):
        assert 0.35 < pair.absent.frame.mean() / 100 < 0.65


def test_blur_takes_the_edges_away(composer: Composer) -> None:
    def steepest(pair: ScenePair) -> float:
        frame = pair.present.frame.astype(int)
        return float(
            np.percentile(np.abs(np.diff(frame[:, :, 0], axis=1))[changed(pair)[:, 1:]], 99)
        )

    sharp, blurred = (
        [steepest(pair) for pair in without_thing(composer, condition)]
        for condition in ("same_table", "blur")
    )
    assert np.median(blurred) < 0.8 * np.median(sharp)


def test_no_border_of_a_surface_runs_through_the_object() -> None:
    covered = np.zeros((H, W), bool)
    covered[100:140, 120:200] = True
    table, other = (np.full((H, W, 3), value, np.float32) for value in (100.0, 200.0))
    rows, cols = slice(100, 140), slice(120, 200)
    borders = 0
    for seed in range(40):
        surfaced = with_surface(table, other, covered, np.random.default_rng(seed))
        part = surfaced[rows, cols]
        assert max(np.abs(np.diff(part, axis=axis)).max() for axis in (0, 1)) < 25
        borders += np.ptp(surfaced) > 20
    assert borders == 40


def test_the_same_seed_makes_the_same_scenes(composer: Composer) -> None:
    for condition in CONDITIONS:
        first, second = pairs(composer, condition, 1) + pairs(composer, condition, 1)
        np.testing.assert_array_equal(first.present.frame, second.present.frame)
        np.testing.assert_array_equal(first.absent.frame, second.absent.frame)


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("beer bottle (brown)", "bottle"),
        ("Bottles", "bottle"),
        ("mug (upright, handle)", "mug"),
        ("Rubik's cube", "cube"),
        ("scissors", "scissor"),
        ("magnifying glass", "glass"),
        ("beer bottle (green, tilted)", "bottle"),
        ("7", "7"),
    ],
)
def test_a_kind_is_the_last_word_of_the_name(text: str, kind: str) -> None:
    assert kind_of(text) == kind


def test_frames_of_one_kind_are_refused() -> None:
    alone = Composer([painted("red", RED, "bar"), painted("green", GREEN, "bar")])
    with pytest.raises(QsgmError, match=r"'bar'.* at least two kinds"):
        alone.pair(0, "beside", np.random.default_rng(0))


def test_frames_of_several_sizes_or_none_are_refused() -> None:
    red = painted("red", RED, "bar")
    small = replace(red, name="small", frame=red.frame[:200], mask=red.mask[:200])
    with pytest.raises(QsgmError, match="small is 320x200 px, red 320x240 px"):
        Composer([red, small])
    tiny = replace(red, name="tiny", frame=red.frame[:130], mask=red.mask[:130])
    with pytest.raises(QsgmError, match="more than 144 px"):
        Composer([tiny])
    with pytest.raises(QsgmError, match="at least one"):
        Composer([])


def test_a_mask_that_cannot_be_used_is_refused() -> None:
    red = painted("red", RED, "bar")
    with pytest.raises(QsgmError, match="does not fit"):
        cut_out(red.frame, red.mask[:100], CENTER)
    with pytest.raises(QsgmError, match="all one colour"):
        cut_out(red.frame, np.zeros_like(red.mask), CENTER)


@pytest.mark.parametrize("condition", CONDITIONS)
def test_masks_of_any_shape_make_scenes(condition: Condition) -> None:
    red = painted("red", RED, "bar")
    masks = [np.zeros((H, W), bool) for _ in range(4)]
    masks[0][120, 160] = True  # a single pixel
    masks[1][:, 158:162] = True  # from border to border
    masks[2][30:220, 40:290] = True  # larger than any window
    masks[3][::30, ::30] = True  # scattered
    odd = [replace(red, name=str(i), kind=str(i), mask=mask) for i, mask in enumerate(masks)]
    scenes = Composer(odd)
    for number in range(len(odd)):
        pair = scenes.pair(number, condition, np.random.default_rng(number))
        assert pair.present.frame.shape == (H, W, 3)


def test_the_object_is_gone_from_the_empty_table() -> None:
    red = painted("red", RED, "bar")
    cut = cut_out(red.frame, red.mask, CENTER)
    blue, _, strong = np.moveaxis(cut.table.astype(int), 2, 0)
    assert not (strong - blue > 60).any()
    away = np.ones(red.mask.shape, bool)
    away[50:190, 65:255] = False
    np.testing.assert_array_equal(cut.table[away], red.frame[away])


def test_drawn_subjects_are_repeated_by_their_seed() -> None:
    first, again, other = drawn_subjects(3, 4), drawn_subjects(3, 4), drawn_subjects(4, 4)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.frame, b.frame)
    assert len({subject.kind for subject in first}) == 4
    assert any((a.frame != b.frame).any() for a, b in zip(first, other, strict=True))


def test_a_limit_is_spread_evenly() -> None:
    assert spread(10, None) == spread(10, 99) == list(range(10))
    assert spread(10, 3) == [0, 3, 6]
