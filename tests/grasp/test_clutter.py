"""Crops with other things on them: what is planned is what is pasted, and in the shares stated."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from toys import draw_things

from qsgm.grasp import clutter
from qsgm.grasp.clutter import Addition, plan_clutter
from qsgm.grasp.crops import cut_crops, plan_crops
from qsgm.grasp.distractors import (
    TILE_PX,
    Distractors,
    load_distractors,
    paint_planned,
    paste_planned,
    with_named,
)
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.source import CropSource, Demonstration, crop_source
from qsgm.train.grasp.draw_distractors import encode_sheet

MANY = 20_000
Frame = NDArray[np.uint8]


@pytest.fixture(scope="module")
def things() -> Distractors:
    return load_distractors(encode_sheet(draw_things()))


def source_of(
    frames: list[Frame], things: Distractors | None, count: int = 300, seed: int = 0
) -> CropSource:
    shown = [Demonstration(frame, (320.0, 240.0)) for frame in frames]
    return crop_source(shown, things, np.random.default_rng(seed), count)


def test_of_negatives_and_positives_the_stated_shares_get_something() -> None:
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), MANY)
    planned = plan_clutter(plan, 2, np.random.default_rng(1))
    negative = plan.quality == 0
    for rows, addition, share in (
        (negative, Addition.THING, clutter.THING_SHARE),
        (negative, Addition.EDGE, clutter.EDGE_SHARE),
        (~negative, Addition.THING, clutter.BESIDE_SHARE),
        (~negative, Addition.EDGE, 0.0),
    ):
        assert (planned.addition[rows] == addition).mean() == pytest.approx(share, abs=0.02)


def test_a_thing_is_in_the_middle_of_a_negative_and_beside_a_positives() -> None:
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), MANY)
    planned = plan_clutter(plan, 2, np.random.default_rng(1))
    off = np.linalg.norm(planned.things.center_px - CROP_PX / 2, axis=1)
    assert off[plan.quality == 0].max() < 6
    beside = off[plan.quality > 0]
    low, high = clutter.BESIDE_PX
    assert (beside.min(), beside.max()) == pytest.approx((low, high), abs=0.1)


def test_named_things_are_half_of_all_and_without_any_the_plan_is_as_ever() -> None:
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), MANY)
    plain = plan_clutter(plan, 5, np.random.default_rng(1))
    named = plan_clutter(plan, 7, np.random.default_rng(1), named=2)
    share = (named.things.sprite >= 5).mean()
    assert share == pytest.approx(clutter.NAMED_SHARE, abs=0.02)
    assert set(named.things.sprite[named.things.sprite >= 5]) == {5, 6}
    again = plan_clutter(plan, 5, np.random.default_rng(1), named=0)
    np.testing.assert_array_equal(plain.things.sprite, again.things.sprite)
    alone = plan_clutter(plan, 2, np.random.default_rng(1), named=2)
    assert set(alone.things.sprite) == {0, 1}


def test_a_crop_shows_what_was_planned_in_the_crops_own_colours(
    frame: Frame, things: Distractors
) -> None:
    source = source_of([frame], things)
    assert source.clutter is not None
    unchanged = np.tile(np.eye(3, 4, dtype=np.float32), (len(source), 1, 1))
    expected = cut_crops(frame, replace(source.plan, color=unchanged))
    seen = set()
    for row, crop in enumerate(expected):
        addition = source.addition[row]
        if addition == Addition.THING:
            paste_planned(crop, things, source.clutter.things, row)
        elif addition == Addition.EDGE:
            paint_planned(crop, source.clutter.edges, row)
        seen.add((int(addition), float(source.plan.quality[row])))
        crop[:] = cv2.transform(crop, source.plan.color[row])
    np.testing.assert_array_equal(source.cut(np.arange(len(source))), expected)
    assert len(seen) == 5


def test_crops_are_the_same_in_any_order(frame: Frame, things: Distractors) -> None:
    source = source_of([frame, frame[::-1].copy()], things)
    rows = np.random.default_rng(0).permutation(len(source))[:40]
    np.testing.assert_array_equal(source.cut(rows), source.cut(np.arange(len(source)))[rows])


def test_without_things_crops_are_those_of_the_frame_alone(frame: Frame) -> None:
    source = source_of([frame], None, 30)
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), 30)
    np.testing.assert_array_equal(source.cut(np.arange(30)), cut_crops(frame, plan))
    assert (source.addition == Addition.NOTHING).all()


def test_some_crops_are_in_dimmer_light_and_none_in_brighter() -> None:
    bright = plan_crops((480, 640), (320, 240), np.random.default_rng(0), MANY)
    dim = clutter.dimmed(bright, np.random.default_rng(1))
    factor = dim.color[:, 0, 0] / bright.color[:, 0, 0]
    assert (factor < 1).mean() == pytest.approx(clutter.DIM_SHARE, abs=0.02)
    assert clutter.DIMMEST <= factor.min() < clutter.DIMMEST + 0.01
    assert factor.max() == 1


def test_several_demonstrations_have_equal_shares_in_training_and_validation(
    frame: Frame, things: Distractors
) -> None:
    frames = [frame, frame[:, ::-1].copy(), frame[::-1].copy()]
    source = source_of(frames, things, 999)
    for rows in (slice(None, 800), slice(800, None)):
        shares = np.bincount(source.shown[rows]) / len(source.shown[rows])
        assert shares == pytest.approx([1 / 3] * 3, abs=0.08)
    assert source.plan.quality.mean() == pytest.approx(0.5, abs=0.01)
    for number, picture in enumerate(frames):
        rows = np.flatnonzero((source.shown == number) & (source.addition == 0))[:3]
        np.testing.assert_array_equal(source.cut(rows), cut_crops(picture, source.plan[rows]))


def test_named_things_come_behind_the_drawn_ones(things: Distractors) -> None:
    tile = np.zeros((1, TILE_PX, TILE_PX, 4), np.uint8)
    tile[0, 60:68, 44:84] = 255
    both = with_named(things, tile)
    assert (len(both), both.named) == (3, 1)
    np.testing.assert_array_equal(both.sprites[2], tile[0])
    assert both.reach_px[2].tolist() == [20, 4]
    alone = with_named(None, tile)
    assert (len(alone), alone.named) == (1, 1)
