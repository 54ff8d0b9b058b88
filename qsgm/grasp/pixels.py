"""The arithmetic of crops, byte for byte: warping, recolouring, products and box means.

What OpenCV 5 computes is written out in numpy, which is the definition (docs/bundle.md): OpenCV 4
warps to other bytes. Of the four, OpenCV's own is used where it has the same bits on this machine.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
MIRRORED, ZERO = int(cv2.BORDER_REFLECT_101), int(cv2.BORDER_CONSTANT)

# OpenCV's vectors hold this many pixels or fewer; what is left of a row gets other arithmetic.
_VECTOR_PX = 32
_COLOR_BITS = 10
_STRIP_ROWS = 32  # what numpy works on stays in the cache
# With these pictures a warp that rounds once more is found out in every step where it might.
_LOOK_SEED = 149


@dataclass(frozen=True)
class Arithmetic:
    """Four functions that write into their last argument."""

    warp: Callable[[Pixels, NDArray[np.float64], int, Pixels], None]
    """An image (H, W, C), MIRRORED or ZERO outside, by a map (2, 3) from pixels (x, y, 1) of the
    result (h, w, C) to its own (x, y), bilinear."""
    recolor: Callable[[Pixels, NDArray[np.float32], Pixels], None]
    """An affine map (3, 4) of each pixel's colour, (H, W, 3)."""
    product: Callable[[Pixels, Pixels, Pixels], None]
    """a * b / 255, rounded."""
    box_mean: Callable[[Pixels, int, Pixels], None]
    """The mean around each pixel (H, W), up to a radius [px], rounded; 0 outside."""


@cache
def arithmetic() -> Arithmetic:
    """Of each function OpenCV's where it gives the defined bits here, else numpy's.

    Found out once per process, on small pictures.
    """
    return agreeing(OPENCV)


def agreeing(other: Arithmetic) -> Arithmetic:
    """Of each function the other's where it gives the defined bits, else the one written out."""
    chosen = {}
    for name in (one.name for one in fields(Arithmetic)):
        defined, offered = getattr(WRITTEN_OUT, name), getattr(other, name)
        same = all(_same(defined, offered, look) for look in _LOOKS[name]())
        chosen[name] = offered if same else defined
    return Arithmetic(**chosen)


def _warped(image: Pixels, motion: NDArray[np.float64], border: int, out: Pixels) -> None:
    """Places and weights in float32; along x first; half goes to even."""
    height, width, channels = out.shape
    m = motion.astype(np.float32)
    start = np.add(m[:, 1:2] * np.arange(height, dtype=np.float32), m[:, 2:])
    at = _fused(m[:, 0, None, None], np.arange(width, dtype=np.float32), start[:, :, None])
    first = np.floor(at)
    weights = (at - first)[..., None]
    columns, rows = (_places(first[1 - axis], image.shape[axis], border) for axis in (1, 0))
    if border == ZERO:
        image = np.pad(image, ((1, 1), (1, 1), (0, 0)))
    pixels, rows = image.reshape(-1, channels), rows * image.shape[1]
    for top in range(0, height, _STRIP_ROWS):
        strip = np.s_[:, top : top + _STRIP_ROWS]
        corners = [
            [pixels.take(row + column, axis=0).astype(np.float32) for column in columns[strip]]
            for row in rows[strip]
        ]
        # One weight for each byte: numpy takes five times as long to repeat it as it multiplies.
        beside, below = np.repeat(weights[strip], channels, axis=3)
        upper, lower = (_fused(beside, right - left, left) for left, right in corners)
        into = out[top : top + _STRIP_ROWS]
        np.rint(_fused(below, lower - upper, upper), out=into, casting="unsafe")


def _fused(
    a: NDArray[np.float32], b: NDArray[np.float32], c: NDArray[np.float32]
) -> NDArray[np.float32]:
    """`a * b + c`, in float64 and then rounded to float32, as if rounded once."""
    return np.asarray((np.multiply(a, b, dtype=np.float64) + c).astype(np.float32))


def _places(at: NDArray[np.float32], side: int, border: int) -> NDArray[np.intp]:
    """Indices (2, ...) of pixels and the next ones; ZERO counts from a frame of one pixel."""
    both = np.stack([at, at + np.float32(1)]).astype(np.intp)
    if border == ZERO:
        return np.clip(both + 1, 0, side + 1)
    if both.min() >= 0 and both.max() < side:
        return both
    period = max(2 * (side - 1), 1)
    both = np.abs(both) % period
    return np.minimum(both, period - both)


def _recolored(crop: Pixels, color: NDArray[np.float32], out: Pixels) -> None:
    """Fixed point: 10 bits behind the point, half added, rounded down."""
    mix = np.rint(color[:, :3] * np.float32(1 << _COLOR_BITS)).astype(np.int32)
    shift = np.rint(color[:, 3] * np.float32(1 << _COLOR_BITS)) + (1 << _COLOR_BITS) // 2
    total = crop.astype(np.int32) @ mix.T + shift.astype(np.int32)
    out[:] = np.clip(total >> _COLOR_BITS, 0, 255)


def _product(a: Pixels, b: Pixels, out: Pixels) -> None:
    out[:] = (np.multiply(a, b, dtype=np.int32) + 127) // 255


def _box_mean(image: Pixels, radius: int, out: Pixels) -> None:
    height, width = image.shape
    side = 2 * radius + 1
    wide = np.pad(image.astype(np.int32), radius)
    tall = np.add.reduce([wide[:, x : x + width] for x in range(side)])
    total = np.add.reduce([tall[y : y + height] for y in range(side)])
    out[:] = (total + side * side // 2) // (side * side)


def _cv2_warped(image: Pixels, motion: NDArray[np.float64], border: int, out: Pixels) -> None:
    height, width, channels = out.shape
    spare = -width % _VECTOR_PX
    cut = np.empty((height, width + spare, channels), np.uint8) if spare else out
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    cv2.warpAffine(image, motion, (width + spare, height), cut, flags, border)
    if spare:
        out[:] = cut[:, :width]


def _cv2_recolored(crop: Pixels, color: NDArray[np.float32], out: Pixels) -> None:
    cv2.transform(crop, color, out)


def _cv2_product(a: Pixels, b: Pixels, out: Pixels) -> None:
    cv2.multiply(a, b, out, scale=1 / 255)


def _cv2_box_mean(image: Pixels, radius: int, out: Pixels) -> None:
    side = 2 * radius + 1
    cv2.blur(image, (side, side), out, borderType=cv2.BORDER_CONSTANT)


WRITTEN_OUT = Arithmetic(_warped, _recolored, _product, _box_mean)
OPENCV = Arithmetic(_cv2_warped, _cv2_recolored, _cv2_product, _cv2_box_mean)


def _same(one: Callable[..., None], other: Callable[..., None], look: tuple[Any, ...]) -> bool:
    """Whether two functions make the same of a look: the result's shape, and all arguments."""
    shape, *arguments = look
    results = np.zeros((2, *shape), np.uint8)
    for function, result in zip((one, other), results, strict=True):
        function(*arguments, result)
    return bool(np.array_equal(*results))


def _warp_looks() -> Iterator[tuple[Any, ...]]:
    rng = np.random.default_rng(_LOOK_SEED)
    for border in (MIRRORED, ZERO):
        image = rng.integers(0, 256, (150, 140, 4), dtype=np.uint8)
        turn, scale = rng.uniform(-np.pi, np.pi), rng.uniform(0.8, 1.2)
        cos, sin = scale * np.cos(turn), scale * np.sin(turn)
        shift_x, shift_y = rng.uniform(60, 80, 2) - (64 * (cos - sin), 64 * (sin + cos))
        motion = np.array([[cos, -sin, shift_x], [sin, cos, shift_y]])
        yield (128, 128, 4), image, motion, border


def _recolor_looks() -> Iterator[tuple[Any, ...]]:
    rng = np.random.default_rng(_LOOK_SEED)
    for _ in range(4):
        crop = rng.integers(0, 256, (64, 64, 3), dtype=np.uint8)
        mix, shift = rng.uniform(-0.5, 1.5, (3, 3)), rng.uniform(-60, 60, (3, 1))
        yield crop.shape, crop, np.concatenate([mix, shift], axis=1).astype(np.float32)


def _product_looks() -> Iterator[tuple[Any, ...]]:
    levels = np.broadcast_to(np.arange(256, dtype=np.uint8), (256, 256))
    yield levels.shape, levels.copy(), levels.T.copy()


def _box_mean_looks() -> Iterator[tuple[Any, ...]]:
    image = np.random.default_rng(_LOOK_SEED).integers(0, 256, (64, 99), dtype=np.uint8)
    for radius in (1, 2, 3, 4):
        yield image.shape, image, radius


_LOOKS = {
    "warp": _warp_looks,
    "recolor": _recolor_looks,
    "product": _product_looks,
    "box_mean": _box_mean_looks,
}
