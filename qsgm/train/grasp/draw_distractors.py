"""The sheet of drawn things that a bundle brings along: see :mod:`qsgm.grasp.distractors`.

Full size with 32 levels a channel packs into less than two thirds of the size with 256. The latter
would look blurred beside the frame's own crops, which a network soon takes for the difference
between the object and everything else.
"""

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.distractors import TILE_PX
from qsgm.train.grasp.drawing.camera import random_light
from qsgm.train.grasp.drawing.noise import Colour
from qsgm.train.grasp.drawing.scenes import draw_alone, draw_object
from qsgm.train.grasp.drawing.shapes import OBJECT_KINDS

SHEET_SEED = 0  # of the sheet that ships
TILES_HW = (4, 6)  # 24 things, every kind among them
COLOUR_BITS = 5
OPACITY_BITS = 4
_GREY: Colour = (128.0, 128.0, 128.0)  # no particular table


def distractor_file(seed: int) -> bytes:
    """The sheet as the PNG that :func:`qsgm.grasp.distractors.load_distractors` reads."""
    return encode_sheet(draw_sheet(seed))


def draw_sheet(seed: int) -> NDArray[np.uint8]:
    """Draw the things; the same seed gives the same sheet.

    Returns:
        (512, 768, 4) BGR times opacity, and opacity, of few levels; a tile of 128 px each.
    """
    rows, columns = TILES_HW
    tiles = [_draw_tile(seed, index) for index in range(rows * columns)]
    return np.vstack([np.hstack(tiles[row * columns :][:columns]) for row in range(rows)])


def encode_sheet(sheet: NDArray[np.uint8]) -> bytes:
    """A sheet (H, W, 4) BGRA as PNG without filters, which packs few levels best."""
    height, width = sheet.shape[:2]
    rgba = sheet[..., [2, 1, 0, 3]].reshape(height, 4 * width)
    rows = np.pad(rgba, ((0, 0), (1, 0)))  # a row's first byte is its filter
    header = struct.pack(">II5B", width, height, 8, 6, 0, 0, 0)
    body = zlib.compress(rows.tobytes(), 9)
    chunks = ((b"IHDR", header), (b"IDAT", body), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(kind, content) for kind, content in chunks)


def _draw_tile(seed: int, index: int) -> NDArray[np.uint8]:
    """One thing (128, 128, 4) in a light of its own."""
    rng = np.random.default_rng((seed, index))
    drawn = draw_object(rng, _GREY, kind=OBJECT_KINDS[index % len(OBJECT_KINDS)])
    tile = draw_alone(drawn, random_light(rng), TILE_PX)
    few = np.empty_like(tile)
    few[..., :3] = _coarser(tile[..., :3], COLOUR_BITS)
    few[..., 3] = _coarser(tile[..., 3], OPACITY_BITS)
    few[few[..., 3] == 0] = 0
    return few


def _coarser(values: NDArray[np.uint8], bits: int) -> NDArray[np.uint8]:
    """Bytes rounded to 2^bits evenly spaced levels, 0 and 255 among them."""
    step = 255 / (2**bits - 1)
    coarser: NDArray[np.uint8] = np.rint(np.rint(values / step) * step).astype(np.uint8)
    return coarser


def _chunk(kind: bytes, content: bytes) -> bytes:
    checksum = zlib.crc32(kind + content)
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)
