"""The arithmetic of crops: numpy's and OpenCV 5's agree to the byte, and others are found out."""

from collections.abc import Callable
from dataclasses import fields, replace
from fractions import Fraction
from functools import partial
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from qsgm.grasp import crops as crops_module
from qsgm.grasp import distractors as distractors_module
from qsgm.grasp import pixels
from qsgm.grasp import source as source_module
from qsgm.grasp.distractors import with_named
from qsgm.grasp.pixels import (
    MIRRORED,
    OPENCV,
    WRITTEN_OUT,
    ZERO,
    Arithmetic,
    agreeing,
    arithmetic,
)
from qsgm.grasp.source import Demonstration, crop_source

Warp = Callable[..., None]

_FMA3 = 12  # OpenCV's number of the instructions that round a product and a sum once
from_opencv_5_on = pytest.mark.skipif(
    int(cv2.__version__.split(".")[0]) < 5 or not cv2.checkHardwareSupport(_FMA3),
    reason="the arithmetic is OpenCV 5's on CPUs that round a product and a sum once",
)


def motion(turn: float, scale: float, x: float, y: float) -> NDArray[np.float64]:
    cos, sin = np.cos(turn) / scale, np.sin(turn) / scale
    return np.array([[cos, -sin, x], [sin, cos, y]])


def warped(
    image: NDArray[np.uint8], at: NDArray[np.float64], border: int, hw: tuple[int, int]
) -> NDArray[np.uint8]:
    out = np.zeros((*hw, image.shape[2]), np.uint8)
    WRITTEN_OUT.warp(image, at, border, out)
    return out


@from_opencv_5_on
@given(
    seed=st.integers(0, 2**32),
    turn=st.floats(-np.pi, np.pi),
    scale=st.floats(0.25, 4),
    at=st.tuples(st.floats(-80, 200), st.floats(-80, 200)),
    border=st.sampled_from([MIRRORED, ZERO]),
    channels=st.sampled_from([1, 3, 4]),
    image_hw=st.tuples(st.integers(1, 150), st.integers(1, 150)),
    hw=st.tuples(st.integers(1, 130), st.integers(1, 130)),
)
def test_warps_are_opencv_5s_for_any_map_size_and_number_of_channels(
    seed: int,
    turn: float,
    scale: float,
    at: tuple[float, float],
    border: int,
    channels: int,
    image_hw: tuple[int, int],
    hw: tuple[int, int],
) -> None:
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 256, (*image_hw, channels), dtype=np.uint8)
    theirs = np.zeros((*hw, channels), np.uint8)
    OPENCV.warp(image, motion(turn, scale, *at), border, theirs)
    np.testing.assert_array_equal(warped(image, motion(turn, scale, *at), border, hw), theirs)


@from_opencv_5_on
def test_opencv_5_itself_is_used_for_everything() -> None:
    assert arithmetic() == OPENCV


def test_a_warp_is_the_weighed_mean_of_four_pixels_counted_in_fractions() -> None:
    """Counted exactly from the map's float32 numbers; a byte may differ where a half is rounded."""
    image = np.random.default_rng(3).integers(0, 256, (40, 50, 1), dtype=np.uint8)
    at = motion(0.7, 1.3, 20, 5)
    exact = [[Fraction(float(value)) for value in row] for row in at.astype(np.float32)]
    ours = warped(image, at, ZERO, (20, 24))
    for y, x in np.ndindex(20, 24):
        place = [row[0] * x + row[1] * y + row[2] for row in exact]
        total = Fraction(0)
        for dy, dx in np.ndindex(2, 2):
            column, row = place[0] // 1 + dx, place[1] // 1 + dy
            if 0 <= column < 50 and 0 <= row < 40:
                share = (1 - abs(place[0] - column)) * (1 - abs(place[1] - row))
                total += share * int(image[row, column, 0])
        assert abs(int(ours[y, x, 0]) - total) <= Fraction(1, 2) + Fraction(1, 500)


def test_whole_steps_move_pixels_and_mirror_or_blacken_what_is_outside() -> None:
    image = np.random.default_rng(4).integers(0, 256, (9, 7, 4), dtype=np.uint8)
    step = np.array([[1.0, 0, -3], [0, 1, -4]])
    np.testing.assert_array_equal(
        warped(image, step, MIRRORED, (18, 14)),
        np.pad(image, ((4, 5), (3, 4), (0, 0)), mode="reflect"),
    )
    np.testing.assert_array_equal(
        warped(image, step, ZERO, (18, 14)), np.pad(image, ((4, 5), (3, 4), (0, 0)))
    )


def test_products_are_divided_by_255_and_rounded_for_all_pairs_of_bytes() -> None:
    levels = np.arange(256, dtype=np.uint8)
    a, b = np.broadcast_arrays(levels[:, None], levels)
    out = np.zeros((256, 256), np.uint8)
    WRITTEN_OUT.product(a, b, out)
    np.testing.assert_array_equal(
        out, [[round(Fraction(i * j, 255)) for j in range(256)] for i in range(256)]
    )


@pytest.mark.parametrize("radius", [1, 2, 3, 4])
def test_box_means_are_the_mean_of_each_square_rounded(radius: int) -> None:
    image = np.random.default_rng(radius).integers(0, 256, (13, 17), dtype=np.uint8)
    wide = np.pad(image, radius)
    side = 2 * radius + 1
    expected = [
        [
            round(Fraction(int(wide[y : y + side, x : x + side].sum()), side * side))
            for x in range(17)
        ]
        for y in range(13)
    ]
    out = np.zeros_like(image)
    WRITTEN_OUT.box_mean(image, radius, out)
    np.testing.assert_array_equal(out, expected)


@given(
    seed=st.integers(0, 2**32),
    reach=st.floats(0.1, 4),
    shift=st.floats(-300, 300),
)
def test_colours_are_opencvs_in_both_versions(seed: int, reach: float, shift: float) -> None:
    rng = np.random.default_rng(seed)
    crop = rng.integers(0, 256, (128, 128, 3), dtype=np.uint8)
    color = np.c_[rng.uniform(-reach, reach, (3, 3)), rng.uniform(-1, 1, 3) * shift]
    ours, theirs = np.zeros((2, *crop.shape), np.uint8)
    WRITTEN_OUT.recolor(crop, color.astype(np.float32), ours)
    OPENCV.recolor(crop, color.astype(np.float32), theirs)
    np.testing.assert_array_equal(ours, theirs)


def rounding_twice(where: Callable[[NDArray[np.float32]], bool]) -> Warp:
    """The warp as it comes out where some products are rounded before something is added."""
    once = pixels._fused

    def warp(*arguments: Any) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(
                pixels, "_fused", lambda a, b, c: a * b + c if where(a) else once(a, b, c)
            )
            WRITTEN_OUT.warp(*arguments)

    return warp


def on_a_grid(image: Any, at: Any, border: int, out: NDArray[np.uint8]) -> None:
    """OpenCV 4's warp in small: places are multiples of 1/32 px."""
    WRITTEN_OUT.warp(image, np.rint(at * 32) / 32, border, out)


def rounded_down(a: NDArray[np.uint8], b: NDArray[np.uint8], out: NDArray[np.uint8]) -> None:
    out[:] = np.multiply(a, b, dtype=np.int32) // 255


def of_a_float(crop: NDArray[np.uint8], color: Any, out: NDArray[np.uint8]) -> None:
    out[:] = np.clip(np.rint(crop @ color[:, :3].T + color[:, 3]), 0, 255)


def mirrored_mean(image: NDArray[np.uint8], radius: int, out: NDArray[np.uint8]) -> None:
    cv2.blur(image, (2 * radius + 1,) * 2, out)


@pytest.mark.parametrize(
    ("name", "deviant"),
    [
        ("warp", rounding_twice(lambda a: a.size == 2)),
        ("warp", rounding_twice(lambda a: a.size > 2)),
        ("warp", on_a_grid),
        ("recolor", of_a_float),
        ("product", rounded_down),
        ("box_mean", mirrored_mean),
    ],
    ids=["places", "weights", "grid", "recolor", "product", "box_mean"],
)
def test_another_arithmetic_is_found_out_and_numpy_takes_its_place(
    name: str, deviant: Callable[..., None]
) -> None:
    assert agreeing(WRITTEN_OUT) == WRITTEN_OUT
    copies = {one.name: partial(getattr(WRITTEN_OUT, one.name)) for one in fields(WRITTEN_OUT)}
    chosen = agreeing(replace(Arithmetic(**copies), **{name: deviant}))
    for each, copy in copies.items():
        assert getattr(chosen, each) is (getattr(WRITTEN_OUT, each) if each == name else copy)


def test_crops_are_the_same_to_the_byte_whether_numpy_or_opencv_cuts_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (200, 260, 3), dtype=np.uint8)
    things = with_named(None, striped_sprites())
    source = crop_source(
        [Demonstration(frame, (130.0, 100.0))], things, np.random.default_rng(1), 60
    )
    crops = source.cut(np.arange(60))
    assert set(source.addition) == {0, 1, 2}
    for module in (crops_module, distractors_module, source_module):
        monkeypatch.setattr(module, "arithmetic", lambda: WRITTEN_OUT)
    np.testing.assert_array_equal(source.cut(np.arange(60)), crops)


def striped_sprites() -> NDArray[np.uint8]:
    """Two half transparent things (2, 128, 128, 4), colours multiplied by opacity."""
    sprites = np.zeros((2, 128, 128, 4), np.uint8)
    rng = np.random.default_rng(2)
    for sprite, half in zip(sprites, (20, 45), strict=True):
        seen = np.s_[64 - half : 64 + half, 50:78]
        sprite[seen] = rng.integers(0, 256, sprite[seen].shape)
        sprite[..., :3] = np.minimum(sprite[..., :3], sprite[..., 3:])
    return sprites
