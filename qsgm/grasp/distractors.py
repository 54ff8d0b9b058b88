"""Things that are not the object: drawn sprites and other surfaces, put onto crops as negatives.

Taught on one frame alone, a network finds *an* object; it learns to tell its own apart from others
by crops of its own background with other things at the middle. A bundle brings 24 of them in one
small file. Edges of tables, gaps and sheets need no picture: they are half planes of plain colour
and grain.

Everything random is drawn first, as a :class:`PastePlan` or an :class:`EdgePlan`. What is then done
to a crop is integer arithmetic on bytes, written down here so that other languages can repeat it,
behind one bilinear mapping (as crops have it). `x / 255` stands for `(x + 127) // 255` throughout.
"""

import math
import struct
import zlib
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.crops import HALF_CROP_PX, POSITIVE_JITTER_PX
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.pixels import ZERO, arithmetic
from qsgm.images import png_chunks

FILE = "distractors.png"
TILE_PX = 128
MOST_TILES_A_SIDE = 16
UNIT_GAIN = 256
GRAIN_PX = 192  # side of a grain tile; a crop's window starts anywhere in the first 65 x 65
_LEVELS = np.arange(256, dtype=np.int32)
_FRACTION_BITS = 8  # of a half plane's coefficients

_PNG_START = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
_PNG_KIND = (8, 6, 0, 0, 0)  # 8 bits, RGBA, deflate, standard filters, not interlaced

Crop = NDArray[np.uint8]
Layer = NDArray[np.uint8]
Box = tuple[int, int, int, int]  # left, top, right, bottom [px], the last two outside


@dataclass(frozen=True)
class Distractors:
    """Sprites of K things, each lying along x with its middle in the middle of its tile.

    Colours are multiplied by the opacity already: only so are they right between two pixels, where
    a turned sprite is read.
    """

    sprites: NDArray[np.uint8]
    """(K, 128, 128, 4) BGR times opacity, opacity."""
    reach_px: NDArray[np.int32]
    """(K, 2) how far (x, y) the outermost visible pixels are from the middle, rounded up."""
    named: int = 0
    """How many of them, the last ones, the user named."""

    def __len__(self) -> int:
        return len(self.sprites)


@dataclass(frozen=True)
class Shadow:
    """A soft shadow: the opacity, shifted, box-blurred, and dimming what lies under it."""

    offset_px: tuple[int, int] = (0, 0)
    radius_px: int = 0
    """The box has sides of twice that and one more."""
    strength: int = 0
    """0 leaves everything as it is, 255 makes it black."""


@dataclass(frozen=True)
class PastePlan:
    """Which thing is put on each of N crops, where, how large and in what light."""

    sprite: NDArray[np.int32]  # (N,) which one
    center_px: NDArray[np.float32]  # (N, 2) of the thing (x, y) in the crop
    turn_rad: NDArray[np.float32]  # (N,) counter-clockwise as seen
    scale: NDArray[np.float32]  # (N,)
    gain: NDArray[np.int32]  # (N, 3) of blue, green and red; 256 leaves them as they are
    shadow: NDArray[np.int32]  # (N, 4) offset x and y, radius [px], strength 0 to 255

    def __len__(self) -> int:
        return len(self.sprite)

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> "PastePlan":
        return PastePlan(*(values[rows] for values in vars(self).values()))


@dataclass(frozen=True)
class EdgePlan:
    """What other surface covers a part of each of N crops."""

    planes: NDArray[np.int32]  # (N, 4, 3) see :func:`paint_edge`
    color: NDArray[np.uint8]  # (N, 3) BGR
    grain: NDArray[np.int32]  # (N, 4) tile 0 or 1, window's corner x and y 0 to 64, strength

    def __len__(self) -> int:
        return len(self.color)

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> "EdgePlan":
        return EdgePlan(*(values[rows] for values in vars(self).values()))


def load_distractors(data: bytes) -> Distractors:
    """Read the sheet that comes with a bundle: a PNG whose 128 x 128 tiles hold a thing each.

    Raises:
        QsgmError: it is not such a sheet; nothing is unpacked before its header is right, and
            never more than that promises.
    """
    width, height = _sheet_size(data)
    rows = _unpacked(data, height, 1 + 4 * width)
    rgba = rows[:, 1:].reshape(height, width, 4)
    bgra = np.asarray(cv2.cvtColor(rgba, cv2.COLOR_RGBA2BGRA), dtype=np.uint8)
    tiles = bgra.reshape(height // TILE_PX, TILE_PX, width // TILE_PX, TILE_PX, 4)
    sprites = np.ascontiguousarray(tiles.swapaxes(1, 2).reshape(-1, TILE_PX, TILE_PX, 4))
    return Distractors(sprites, _reaches(sprites))


def with_named(things: Distractors | None, sprites: NDArray[np.uint8]) -> Distractors:
    """Some things, if any, and behind them those that the user named: (K, 128, 128, 4)."""
    named = Distractors(sprites, _reaches(sprites), len(sprites))
    if things is None:
        return named
    return Distractors(
        np.concatenate([things.sprites, sprites]),
        np.concatenate([things.reach_px, named.reach_px]),
        len(sprites),
    )


def plan_pastes(rng: np.random.Generator, count: int, sprites: int) -> PastePlan:
    """Draw a plan of `count` things out of `sprites`, at the crop's middle or near it.

    Every turn, 0.8 to 1.2 times as large, in a little other light and with a soft shadow. The
    middle is off by up to 4 px on each axis, as the object's own is in crops of it.
    """
    size = (count, 1)
    brightness = rng.uniform(0.75, 1.2, size) * rng.uniform(0.9, 1.1, (count, 3))
    direction, length = rng.uniform(-np.pi, np.pi, size), rng.uniform(0, 8, size)
    offset = np.rint(length * np.concatenate([np.cos(direction), np.sin(direction)], axis=1))
    radius = rng.integers(1, 5, size)
    strength = np.rint(rng.uniform(0, 0.6, size) * 255)
    return PastePlan(
        sprite=rng.integers(0, sprites, count).astype(np.int32),
        center_px=(
            HALF_CROP_PX + rng.uniform(-POSITIVE_JITTER_PX, POSITIVE_JITTER_PX, (count, 2))
        ).astype(np.float32),
        turn_rad=rng.uniform(-np.pi, np.pi, count).astype(np.float32),
        scale=rng.uniform(0.8, 1.2, count).astype(np.float32),
        gain=np.rint(brightness * UNIT_GAIN).astype(np.int32),
        shadow=np.concatenate([offset, radius, strength], axis=1).astype(np.int32),
    )


def paste_planned(crop: Crop, things: Distractors, plan: PastePlan, row: int) -> None:
    """Put the thing of one row of a plan onto a crop (128, 128, 3), in place."""
    sprite = int(plan.sprite[row])
    x, y, radius, strength = plan.shadow[row].tolist()
    paste(
        crop,
        things.sprites[sprite],
        things.reach_px[sprite],
        center_px=plan.center_px[row],
        turn_rad=float(plan.turn_rad[row]),
        scale=float(plan.scale[row]),
        gain=plan.gain[row],
        shadow=Shadow((x, y), radius, strength),
    )


def paste(
    crop: Crop,
    sprite: Layer,
    reach_px: NDArray[np.int32],
    *,
    center_px: NDArray[np.float32],
    turn_rad: float = 0.0,
    scale: float = 1.0,
    gain: NDArray[np.int32] | None = None,
    shadow: Shadow | None = None,
) -> None:
    """Put a sprite (128, 128, 4) and its shadow onto a crop (128, 128, 3), in place.

    Per byte, with c the crop's, s the sprite's colour times its gain, a its opacity and b the
    opacity blurred and shifted: `l = 255 - strength * b / 255` is the light that is left,
    `k = l * (255 - a) / 255` the share of it that is seen, and c becomes
    `min(255, c * k / 255 + s)`. What lies outside the crop throws no shadow.

    Args:
        crop: BGR.
        sprite: BGR times opacity, and opacity.
        reach_px: (2,) how far (x, y) its visible pixels are from its middle.
        center_px: (2,) where (x, y) in the crop its middle goes.
        turn_rad: counter-clockwise as seen.
        scale: times as large.
        gain: (3,) of blue, green and red, `min(255, (s * gain + 128) // 256)`; left out, 256.
        shadow: left out, none.
    """
    cos, sin = scale * math.cos(turn_rad), scale * math.sin(turn_rad)
    (x, y), (reach_x, reach_y) = center_px.tolist(), reach_px.tolist()
    half_x = abs(cos) * reach_x + abs(sin) * reach_y + 1
    half_y = abs(sin) * reach_x + abs(cos) * reach_y + 1
    box = _box(x, y, half_x, half_y)
    if box[0] >= box[2] or box[1] >= box[3]:
        return
    middle = (TILE_PX - 1) / 2
    cos, sin, x, y = math.cos(turn_rad) / scale, math.sin(turn_rad) / scale, x - box[0], y - box[1]
    motion = np.array(
        [[cos, -sin, middle - cos * x + sin * y], [sin, cos, middle - sin * x - cos * y]]
    )
    lit = sprite if gain is None else _gained(sprite, reach_px, gain)
    layer = np.empty((box[3] - box[1], box[2] - box[0], 4), np.uint8)
    arithmetic().warp(lit, motion, ZERO, layer)
    _blend(crop, layer, box, shadow)


def plan_edges(rng: np.random.Generator, count: int) -> EdgePlan:
    """Draw a plan of `count` other surfaces: edges of tables, gaps and sheets, a third each.

    An edge or the middle of a gap or sheet passes within 24 px of the crop's middle, where the
    network looks.
    """
    kind = rng.integers(0, 3, count)
    turn = rng.uniform(-np.pi, np.pi, count)
    middle = HALF_CROP_PX + rng.uniform(-24, 24, (count, 2))
    # Half sizes across and along: an edge has no far side, a gap no ends.
    across = np.choose(kind, [np.inf, rng.uniform(1.5, 20, count), rng.uniform(12, 60, count)])
    along = np.choose(kind, [np.inf, np.inf, rng.uniform(12, 60, count)])
    softness = np.where(rng.random(count) < 0.3, rng.uniform(3, 16, count), 1.0)
    dark = np.where(kind == 1, 0.35, 1.0)[:, None]
    color = rng.uniform(0, 1, (count, 1)) * 255 + rng.normal(0, 30, (count, 3))
    strength = np.minimum(rng.exponential(10, (count, 1)), 60)
    grain = [rng.integers(0, 2, (count, 1)), rng.integers(0, 65, (count, 2)), np.rint(strength)]
    return EdgePlan(
        planes=_rectangle_planes(middle, turn, across, along, softness),
        color=np.clip(color * dark, 0, 255).astype(np.uint8),
        grain=np.concatenate(grain, axis=1).astype(np.int32),
    )


def paint_planned(crop: Crop, plan: EdgePlan, row: int) -> None:
    """Paint the surface of one row of a plan onto a crop (128, 128, 3), in place."""
    tile, x, y, strength = plan.grain[row].tolist()
    paint_edge(crop, plan.planes[row], plan.color[row], GRAIN[tile, y:, x:], strength)


def paint_edge(
    crop: Crop,
    planes: NDArray[np.int32],
    color: NDArray[np.uint8],
    grain: NDArray[np.uint8],
    strength: int,
) -> None:
    """Cover what lies inside all of some half planes with another surface, in place.

    Its share m of pixel (x, y) is the least of `(p * x + q * y + r) >> 8` over the half planes,
    clipped to 0 to 255; a steep one is a hard edge, a flat one a soft edge. With g the grain,
    the surface is `s = clip(color + ((g - 128) * strength >> 7), 0, 255)`, and a byte c of the crop
    becomes `s * m / 255 + c * (255 - m) / 255`.

    Args:
        crop: (128, 128, 3) BGR.
        planes: (P, 3) p, q, r of each half plane: one for a table's edge, two for a gap, more for
            a polygon. p and q up to 2^22 and r up to 2^29 fit 32 bits.
        color: (3,) BGR.
        grain: (128, 128) or larger, of which the first are used.
        strength: of the grain, 0 to 255.
    """
    share = np.repeat(_inside(planes)[..., None], 3, axis=2)
    bumps = (_LEVELS - 128) * strength >> 7
    levels = np.clip(color[:, None] + bumps, 0, 255).astype(np.uint8)
    window = grain[:CROP_PX, :CROP_PX]
    surface = np.asarray(cv2.merge([cv2.LUT(window, level) for level in levels]), np.uint8)
    product = arithmetic().product
    product(surface, share, surface)
    product(crop, ~share, crop)
    cv2.add(crop, surface, crop)


def _sheet_size(data: bytes) -> tuple[int, int]:
    """Width and height [px] that the header of a sheet gives."""
    if len(data) < 33 or not data.startswith(_PNG_START):
        raise QsgmError(
            f"{FILE} is no PNG picture ({len(data)} bytes): expected the sheet of drawn things "
            f"that `qsgm fold-and-quantize` writes; get the bundle anew"
        )
    width, height, *kind = struct.unpack_from(">II5B", data, 16)
    sides = range(TILE_PX, MOST_TILES_A_SIDE * TILE_PX + 1, TILE_PX)
    if tuple(kind) != _PNG_KIND or width not in sides or height not in sides:
        raise QsgmError(
            f"{FILE} has {width}x{height} px of kind {kind}: expected tiles of {TILE_PX} px, at "
            f"most {MOST_TILES_A_SIDE} by {MOST_TILES_A_SIDE}, of kind {list(_PNG_KIND)} (8 bit "
            f"RGBA); get the bundle anew"
        )
    return width, height


def _unpacked(data: bytes, rows: int, row_bytes: int) -> NDArray[np.uint8]:
    """The bytes of a sheet's rows (rows, row_bytes), each behind its filter, which is 0.

    That is the filter which packs few colours best, and the one that any language can read.
    """
    inflate = zlib.decompressobj()
    packed = b"".join(body for kind, body in png_chunks(data) if kind == b"IDAT")
    try:
        raw = inflate.decompress(packed, rows * row_bytes + 1)
    except zlib.error:
        raw = b""
    if len(raw) != rows * row_bytes or not inflate.eof:
        raise QsgmError(
            f"{FILE} is truncated or damaged: expected {rows} rows of {row_bytes} bytes, got "
            f"{len(raw)} bytes; get the bundle anew"
        )
    unpacked = np.frombuffer(raw, np.uint8).reshape(rows, row_bytes)
    if unpacked[:, 0].any():
        raise QsgmError(
            f"{FILE} was saved by another program: expected rows without filter; get the bundle "
            f"anew"
        )
    return unpacked


def _reaches(sprites: NDArray[np.uint8]) -> NDArray[np.int32]:
    return np.array([_reach(sprite) for sprite in sprites], np.int32).reshape(-1, 2)


def _reach(sprite: Layer) -> tuple[int, int]:
    """How far (x, y) the visible pixels are from the middle of a sprite, rounded up."""
    visible = sprite[..., 3] > 0
    columns, rows = (np.flatnonzero(visible.any(axis=axis)) for axis in (0, 1))
    x, y = (np.abs(2 * at - (TILE_PX - 1)).max(initial=0) for at in (columns, rows))
    return (int(x) + 1) // 2, (int(y) + 1) // 2


def _box(x: float, y: float, half_x: float, half_y: float) -> Box:
    """The pixels of a crop that are no further than that from a point (x, y)."""
    return (
        max(math.floor(x - half_x), 0),
        max(math.floor(y - half_y), 0),
        min(math.ceil(x + half_x) + 1, CROP_PX),
        min(math.ceil(y + half_y) + 1, CROP_PX),
    )


def _gained(sprite: Layer, reach_px: NDArray[np.int32], gain: NDArray[np.int32]) -> Layer:
    """The sprite with its colours times a gain [1/256]; what cannot be seen is left out."""
    table = np.empty((256, 4), np.uint8)
    table[:, :3] = np.minimum((_LEVELS[:, None] * gain + 128) >> 8, 255)
    table[:, 3] = _LEVELS
    x, y = reach_px.tolist()
    half = TILE_PX // 2
    visible = slice(half - y, half + y), slice(half - x, half + x)
    result = np.zeros(sprite.shape, np.uint8)
    result[visible] = cv2.LUT(sprite[visible], table[None])
    return result


def _blend(crop: Crop, layer: Layer, box: Box, shadow: Shadow | None) -> None:
    """Lay a layer (h, w, 4) and its shadow on a box of the crop."""
    opacity = np.asarray(cv2.extractChannel(layer, 3), np.uint8)
    seen = ~opacity
    whole = box
    if shadow is not None and shadow.strength > 0:
        light, whole = _shadowed(opacity, box, shadow)
        under = _of(light, box, whole)
        arithmetic().product(under, seen, under)
        seen = light
    view = _of(crop, whole)
    arithmetic().product(view, np.repeat(seen[..., None], 3, axis=2), view)
    view = _of(crop, box)
    cv2.add(view, cv2.cvtColor(layer, cv2.COLOR_BGRA2BGR), view)


def _of(pixels: Layer, box: Box, around: Box = (0, 0, 0, 0)) -> Layer:
    """A box of a picture that itself lies at the corner of another box."""
    x, y = around[:2]
    return pixels[box[1] - y : box[3] - y, box[0] - x : box[2] - x]


def _shadowed(opacity: Layer, box: Box, shadow: Shadow) -> tuple[Layer, Box]:
    """The light (H, W), 0 to 255, that is left on and around a box, and the box it covers."""
    (x, y), radius = shadow.offset_px, shadow.radius_px
    reach = max(abs(x), abs(y)) + radius
    whole = (
        max(box[0] - reach, 0),
        max(box[1] - reach, 0),
        min(box[2] + reach, CROP_PX),
        min(box[3] + reach, CROP_PX),
    )
    light = np.zeros((whole[3] - whole[1], whole[2] - whole[0]), np.uint8)
    _of(light, box, whole)[:] = opacity
    soft = np.empty_like(light)
    arithmetic().box_mean(light, radius, soft)
    levels = 255 - (shadow.strength * _LEVELS + 127) // 255
    dimmed = cv2.LUT(soft, levels.astype(np.uint8))
    return _moved(np.asarray(dimmed, np.uint8), x, y), whole


def _moved(light: Layer, x: int, y: int) -> Layer:
    """The picture moved by whole pixels; 255 comes in from outside."""
    height, width = light.shape
    moved = np.full_like(light, 255)
    moved[max(y, 0) : height + min(y, 0), max(x, 0) : width + min(x, 0)] = light[
        max(-y, 0) : height + min(-y, 0), max(-x, 0) : width + min(-x, 0)
    ]
    return moved


def _rectangle_planes(
    middle: NDArray[np.float64],
    turn: NDArray[np.float64],
    across: NDArray[np.float64],
    along: NDArray[np.float64],
    softness: NDArray[np.float64],
) -> NDArray[np.int32]:
    """Half planes (N, 4, 3) of N rectangles; the first side is the near one of half planes.

    `middle` (N, 2) is of the rectangle, or on the edge where `across` is infinite. `softness` [px]
    is how far a side takes from 0 to 255.
    """
    planes = []
    for quarter, half in enumerate((across, along, across, along)):
        inward = turn + quarter * np.pi / 2
        normal = np.stack([np.cos(inward), np.sin(inward)], axis=1)
        # Without a far side, the near one goes through the middle and the others hide nothing.
        near = np.where(np.isinf(half), 0.0 if quarter == 0 else 1e3, half)
        distance = near - np.sum(normal * middle, axis=1)
        steep = 255 * (1 << _FRACTION_BITS) / softness
        planes.append(
            np.concatenate(
                [normal * steep[:, None], ((distance + softness / 2) * steep)[:, None]], axis=1
            )
        )
    rounded: NDArray[np.int32] = np.rint(np.stack(planes, axis=1)).astype(np.int32)
    return rounded


def _inside(planes: NDArray[np.int32]) -> Layer:
    """Share (128, 128), 0 to 255, of every pixel that is inside all half planes."""
    at = np.arange(CROP_PX, dtype=np.int32)
    all_inside = 255 << _FRACTION_BITS
    least = np.full((CROP_PX, CROP_PX), all_inside, np.int32)
    here = np.empty_like(least)
    for p, q, r in planes.tolist():
        # Planes are least at a corner: one that hides nothing there need not be looked at.
        if r + min((CROP_PX - 1) * p, 0) + min((CROP_PX - 1) * q, 0) < all_inside:
            np.add((p * at + r)[None, :], (q * at)[:, None], out=here)
            np.minimum(least, here, out=least)
    np.maximum(least, 0, out=least)
    return np.asarray(least >> _FRACTION_BITS).astype(np.uint8)


def grain_tiles() -> NDArray[np.uint8]:
    """Two tiles (2, 192, 192) of noise about 128, fine and blotchy, by integers alone.

    The fine one is a byte of a hash of each pixel's number (Wellons' lowbias32, 32 bits without
    sign); the other the mean of its 5 x 5 neighbours around the tile, four times as strong.
    """
    number: NDArray[np.uint32] = np.arange(GRAIN_PX * GRAIN_PX, dtype=np.uint32)
    number ^= number >> np.uint32(16)
    number *= np.uint32(0x7FEB352D)
    number ^= number >> np.uint32(15)
    number *= np.uint32(0x846CA68B)
    number ^= number >> np.uint32(16)
    fine = (number & np.uint32(255)).astype(np.int32).reshape(GRAIN_PX, GRAIN_PX)
    total = np.zeros_like(fine)
    for x, y in product(range(-2, 3), repeat=2):
        total += np.roll(fine, (y, x), (0, 1))
    blotchy = np.clip(128 + (total - 25 * 128) * 4 // 25, 0, 255)
    return np.stack([fine, blotchy]).astype(np.uint8)


GRAIN = grain_tiles()
