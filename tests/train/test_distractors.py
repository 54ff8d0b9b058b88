import struct
import zlib
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp import distractors
from qsgm.grasp.distractors import (
    GRAIN,
    Distractors,
    EdgePlan,
    Shadow,
    load_distractors,
    paint_edge,
    paint_planned,
    paste,
    paste_planned,
    plan_edges,
    plan_pastes,
)
from qsgm.grasp.pixels import arithmetic
from qsgm.train.grasp.draw_distractors import distractor_file, draw_sheet, encode_sheet
from qsgm.train.grasp.drawing.shapes import OBJECT_KINDS

NOTHING = np.array([256, 256, 256], np.int32)


@pytest.fixture(scope="module")
def data() -> bytes:
    return distractor_file(0)


@pytest.fixture(scope="module")
def things(data: bytes) -> Distractors:
    return load_distractors(data)


def some_crop(seed: int = 0) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (128, 128, 3)).astype(np.uint8)


def rounded(product: NDArray[np.int64]) -> NDArray[np.int64]:
    return (product + 127) // 255


def bilinear(
    sprite: NDArray[np.uint8], center: NDArray[np.float32], turn: float, scale: float
) -> NDArray[np.float64]:
    """The sprite on a crop's pixels (128, 128, 4), from the definition alone."""
    y, x = np.mgrid[:128, :128] * 1.0
    x, y = (x - center[0]) / scale, (y - center[1]) / scale
    # Turned back clockwise as seen, rows counting downwards.
    u = np.cos(turn) * x - np.sin(turn) * y + 63.5
    v = np.sin(turn) * x + np.cos(turn) * y + 63.5
    padded = np.pad(sprite.astype(float), ((200, 200), (200, 200), (0, 0)))
    u, v = u + 200, v + 200
    left, top = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = (u - left)[..., None], (v - top)[..., None]
    upper = (1 - a) * padded[top, left] + a * padded[top, left + 1]
    lower = (1 - a) * padded[top + 1, left] + a * padded[top + 1, left + 1]
    return (1 - b) * upper + b * lower


def naive_paste(
    crop: NDArray[np.uint8], layer: NDArray[np.int64], shadow: Shadow
) -> NDArray[np.int64]:
    """A layer (128, 128, 4) and its shadow on a crop, in integers and without boxes."""
    opacity = layer[..., 3]
    (x, y), radius = shadow.offset_px, shadow.radius_px
    side = 2 * radius + 1
    padded = np.pad(opacity, radius)
    total = sum(padded[i : i + 128, j : j + 128] for i in range(side) for j in range(side))
    soft = np.pad((total + side * side // 2) // (side * side), 128)
    soft = soft[128 - y : 256 - y, 128 - x : 256 - x]
    light = 255 - rounded(shadow.strength * soft)
    seen = rounded(light * (255 - opacity))[..., None]
    return np.minimum(rounded(crop.astype(np.int64) * seen) + layer[..., :3], 255)


def test_products_and_blurs_are_the_integers_they_are_said_to_be() -> None:
    first, second = np.meshgrid(*[np.arange(256, dtype=np.uint8)] * 2)
    product = cv2.multiply(first, second, scale=1 / 255)
    assert np.array_equal(product, rounded(first.astype(np.int64) * second))
    picture = some_crop()[..., 0]
    for side in (3, 5, 7, 9):
        padded = np.pad(picture.astype(int), side // 2)
        total = sum(padded[i : i + 128, j : j + 128] for i in range(side) for j in range(side))
        blurred = cv2.blur(picture, (side, side), borderType=cv2.BORDER_CONSTANT)
        assert np.array_equal(blurred, (total + side * side // 2) // (side * side))


@pytest.mark.parametrize("seed", range(12))
def test_a_paste_is_the_naive_one_within_a_level_or_two(things: Distractors, seed: int) -> None:
    rng = np.random.default_rng(seed)
    center = rng.uniform(-20, 148, 2).astype(np.float32) if seed % 2 else np.full(2, 64, "f4")
    turn, scale = rng.uniform(-4, 4), rng.uniform(0.7, 1.4)
    x, y, radius = rng.integers(-9, 10), rng.integers(-9, 10), rng.integers(0, 5)
    shadow = Shadow((int(x), int(y)), int(radius), int(rng.integers(0, 256)))
    crop, which = some_crop(seed), seed % len(things)
    sprite = things.sprites[which]
    layer = np.rint(bilinear(sprite, center, turn, scale)).astype(np.int64)
    expected = naive_paste(crop, layer, shadow)
    paste(
        crop,
        sprite,
        things.reach_px[which],
        center_px=center,
        turn_rad=turn,
        scale=scale,
        shadow=shadow,
    )
    difference = np.abs(crop - expected)
    assert difference.max() <= 12  # OpenCV 4 knows 32 places between two pixels
    assert difference.mean() < 0.1


def test_a_paste_that_falls_on_whole_pixels_is_exact(things: Distractors) -> None:
    center = np.array([63.5, 60.5], np.float32)
    for which in range(len(things)):
        crop, shadow = some_crop(which), Shadow((which - 12, 5), which % 5, 10 * which)
        layer = np.zeros((128, 128, 4), np.int64)
        layer[:-3] = things.sprites[which][3:]
        expected = naive_paste(crop, layer, shadow)
        paste(crop, things.sprites[which], things.reach_px[which], center_px=center, shadow=shadow)
        assert np.array_equal(crop, expected)


def test_a_gain_changes_colours_but_not_the_outline(things: Distractors) -> None:
    center, gain = np.full(2, 63.5, np.float32), np.array([128, 256, 400], np.int32)
    plain, tinted = np.zeros((2, 128, 128, 3), np.uint8)
    sprite, reach = things.sprites[3], things.reach_px[3]
    paste(plain, sprite, reach, center_px=center)
    paste(tinted, sprite, reach, center_px=center, gain=gain)
    assert np.array_equal(plain, sprite[..., :3])
    assert np.array_equal(tinted, np.minimum((plain.astype(int) * gain + 128) // 256, 255))
    crop = some_crop()
    paste(crop, sprite, reach, center_px=center, gain=gain)
    assert np.array_equal(crop[sprite[..., 3] == 0], some_crop()[sprite[..., 3] == 0])


def test_a_thing_outside_the_crop_leaves_it_alone(things: Distractors) -> None:
    crop = some_crop()
    for center in ((-200, 64), (64, 400), (300, 300)):
        spot = np.array(center, np.float32)
        paste(crop, things.sprites[0], things.reach_px[0], center_px=spot, shadow=Shadow((9, 9), 3))
    assert np.array_equal(crop, some_crop())


@pytest.mark.parametrize("degrees", [0, 35, 80, 90, 200])
def test_no_more_of_a_crop_is_worked_on_than_the_thing_covers(
    things: Distractors, degrees: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    worked, usual = [], arithmetic()

    def warp(sprite: NDArray, motion: NDArray, border: int, layer: NDArray) -> None:
        worked.append(layer.shape[:2])
        usual.warp(sprite, motion, border, layer)

    monkeypatch.setattr(distractors, "arithmetic", lambda: replace(usual, warp=warp))
    turn, center = np.radians(degrees), np.full(2, 64, np.float32)
    for sprite, reach in zip(things.sprites, things.reach_px, strict=True):
        x, y = reach.tolist()
        paste(some_crop(), sprite, reach, center_px=center, turn_rad=turn, scale=0.5)
        cos, sin = abs(np.cos(turn)) / 2, abs(np.sin(turn)) / 2
        height, width = worked.pop()
        assert width <= 2 * (cos * x + sin * y + 1) + 3
        assert height <= 2 * (sin * x + cos * y + 1) + 3


def test_a_plan_is_in_range_and_pastes_the_same_whole_or_in_slices(things: Distractors) -> None:
    plan = plan_pastes(np.random.default_rng(1), 200, len(things))
    assert len(plan) == 200
    assert set(plan.sprite.tolist()) == set(range(24))
    assert np.abs(plan.center_px - 64).max() <= 4
    assert plan.scale.min() >= 0.8
    assert plan.scale.max() <= 1.2
    assert plan.gain.shape == (200, 3)
    first, second = some_crop(), some_crop()
    paste_planned(first, things, plan, 150)
    paste_planned(second, things, plan[150:], 0)
    assert np.array_equal(first, second)
    assert not np.array_equal(first, some_crop())


def test_the_light_of_a_pasted_thing_is_its_own_times_a_tint_of_each_channel() -> None:
    rng = np.random.default_rng(4)
    light, tint = rng.uniform(0.75, 1.2, (300, 1)), rng.uniform(0.9, 1.1, (300, 3))
    plan = plan_pastes(np.random.default_rng(4), 300, 5)
    for number in range(300):
        for channel in range(3):
            product = 256 * light[number, 0] * tint[number, channel]
            assert plan.gain[number, channel] == round(product)


@pytest.mark.parametrize("seed", range(6))
def test_an_edge_is_painted_as_its_formula_says(seed: int) -> None:
    plan = plan_edges(np.random.default_rng(seed), 3)
    for row in range(3):
        crop = some_crop(seed)
        tile, left, top, strength = plan.grain[row].tolist()
        y, x = np.mgrid[:128, :128]
        least = np.full((128, 128), 255)
        for p, q, r in plan.planes[row].tolist():
            least = np.minimum(least, (p * x + q * y + r) >> 8)
        share = np.clip(least, 0, 255)[..., None]
        grain = GRAIN[tile, top : top + 128, left : left + 128, None].astype(int)
        surface = np.clip(plan.color[row] + ((grain - 128) * strength >> 7), 0, 255)
        expected = rounded(surface * share) + rounded(crop.astype(int) * (255 - share))
        paint_planned(crop, plan, row)
        assert np.array_equal(crop, expected)


def test_half_planes_of_every_number_are_painted() -> None:
    hard = np.array([[65280, 0, -64 * 65280], [0, 65280, -64 * 65280]], np.int32)
    white = np.full(3, 255, np.uint8)
    for planes, share in ((hard[:0], 1.0), (hard[:1], 63 / 128), (hard, (63 / 128) ** 2)):
        crop = np.zeros((128, 128, 3), np.uint8)
        paint_edge(crop, planes, white, GRAIN[0], 0)
        assert crop.mean() / 255 == pytest.approx(share)


def test_edges_gaps_and_sheets_cross_the_middle_of_the_crop() -> None:
    plan = plan_edges(np.random.default_rng(0), 300)
    shares = []
    for row in range(300):
        painted = np.zeros((128, 128, 3), np.uint8)
        paint_edge(painted, plan.planes[row], np.full(3, 255, np.uint8), GRAIN[0], 0)
        middle = painted[38:90, 38:90]
        assert middle.any()
        shares.append(painted.mean() / 255)
    assert np.mean(shares) == pytest.approx(0.3, abs=0.1)
    assert isinstance(plan[:2], EdgePlan)
    assert len(plan[:2]) == 2


def test_surfaces_are_drawn_as_often_and_as_differently_as_they_are_said_to_be() -> None:
    plan = plan_edges(np.random.default_rng(3), 6000)
    tile, left, top, strength = plan.grain.T
    assert set(tile.tolist()) == {0, 1}
    assert (left.min(), left.max(), top.min(), top.max()) == (0, 64, 0, 64)
    assert (strength.min(), strength.max()) == (0, 60)
    assert strength.mean() == pytest.approx(10, abs=0.5)
    # A far side that hides nothing is 1000 px away, so that its offset is much larger.
    offsets = np.abs(plan.planes[..., 2] / np.hypot(plan.planes[..., 0], plan.planes[..., 1]))
    far = (offsets > 800).sum(axis=1)
    shares = [np.mean(far == count) for count in (3, 2, 0)]
    assert shares == pytest.approx([1 / 3] * 3, abs=0.03)
    light, dark = plan.color[far != 2].mean(), plan.color[far == 2].mean()
    assert light == pytest.approx(127.5, abs=3)
    assert dark == pytest.approx(0.35 * 127.5 + 1.5, abs=3)
    rng = np.random.default_rng(4)
    alike = rng.uniform(0, 255, (4000, 1)) + rng.normal(0, 30, (4000, 3))
    spreads = []
    for colors in (plan.color[far != 2].astype(float), np.clip(alike, 0, 255)):
        inside = colors[np.all((colors > 60) & (colors < 195), axis=1)]
        spreads.append(inside.std(axis=1).mean())
    assert spreads[0] == pytest.approx(spreads[1], abs=1)
    assert (plan.color[far != 2].min(), plan.color[far != 2].max()) == (0, 255)
    steep = np.hypot(plan.planes[:, 0, 0], plan.planes[:, 0, 1]) / 256 / 255
    assert np.mean(steep < 0.9) == pytest.approx(0.3, abs=0.02)
    assert 1 / steep.min() == pytest.approx(16, abs=0.1)


def test_the_grain_is_the_hash_it_is_said_to_be() -> None:
    def byte(number: int) -> int:
        number ^= number >> 16
        number = number * 0x7FEB352D % 2**32
        number ^= number >> 15
        number = number * 0x846CA68B % 2**32
        return (number ^ number >> 16) & 255

    for y, x in ((0, 1), (5, 7), (100, 191)):
        assert GRAIN[0, y, x] == byte(192 * y + x)
    around = [byte(192 * (y % 192) + x) for y in range(-2, 3) for x in range(48, 53)]
    assert GRAIN[1, 0, 50] == np.clip(128 + (sum(around) - 3200) * 4 // 25, 0, 255)
    assert np.all(np.abs(GRAIN.mean(axis=(1, 2)) - 128) < 2)


def test_the_sheet_is_read_as_it_was_drawn(data: bytes, things: Distractors) -> None:
    sheet = draw_sheet(0)
    assert np.array_equal(cv2.imdecode(np.frombuffer(data, np.uint8), -1), sheet)
    assert things.sprites.shape == (24, 128, 128, 4)
    assert np.array_equal(things.sprites[7], sheet[128:256, 128:256])
    assert distractor_file(0) == data
    assert distractor_file(1) != data


def test_the_sheet_is_small_and_holds_things_of_the_usual_size(things: Distractors) -> None:
    assert len(things) >= len(OBJECT_KINDS)
    for seed in range(3):
        assert len(distractor_file(seed)) < 80_000
    for sprite, reach in zip(things.sprites, things.reach_px, strict=True):
        rows, columns = np.nonzero(sprite[..., 3] > 127)
        size = cv2.minAreaRect(np.stack([columns, rows], -1).astype(np.float32))[1]
        assert 53 <= max(size) <= 117
        assert np.all(sprite[sprite[..., 3] == 0] == 0)
        rows, columns = np.nonzero(sprite[..., 3])
        assert reach.tolist() == [
            np.ceil(np.abs(columns - 63.5).max()),
            np.ceil(np.abs(rows - 63.5).max()),
        ]


def with_header(data: bytes, width: int, height: int, depth: int = 8) -> bytes:
    header = b"IHDR" + struct.pack(">II5B", width, height, depth, 6, 0, 0, 0)
    return data[:12] + header + struct.pack(">I", zlib.crc32(header)) + data[33:]


def filtered(data: bytes) -> bytes:
    return cv2.imencode(".png", cv2.imdecode(np.frombuffer(data, np.uint8), -1))[1].tobytes()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda _: b"", "no PNG"),
        (lambda _: b"\xff\xd8\xff" + bytes(100), "no PNG"),
        (lambda data: data[:-60], "truncated or damaged"),
        (lambda data: data[:9000] + bytes([data[9000] ^ 1]) + data[9001:], "truncated or damaged"),
        (lambda data: with_header(data, 128 * 500_000, 128), "64000000x128"),
        (lambda data: with_header(data, 768, 500), "768x500"),
        (lambda data: with_header(data, 768, 512, 16), "of kind"),
        (lambda data: with_header(data, 768, 384), "truncated or damaged"),
        (lambda data: with_header(data, 768, 640), "truncated or damaged"),
        (filtered, "another program"),
        (lambda _: encode_sheet(np.zeros((128, 4096, 4), np.uint8)), "4096x128"),
    ],
)
def test_another_file_is_refused_in_one_line(
    data: bytes, change: Callable[[bytes], bytes], message: str
) -> None:
    with pytest.raises(QsgmError, match=message) as caught:
        load_distractors(change(data))
    assert "\n" not in str(caught.value)
    assert "get the bundle anew" in str(caught.value)
