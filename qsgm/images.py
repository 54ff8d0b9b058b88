"""Camera frames in, pictures out. Whatever a user passes is either a frame or refused in one line.

The header is read before anything is decoded: it gives the size (a small file can declare an
image that fills the memory), and walking on to the end mark tells a truncated file from a whole
one, which image decoders, depending on version and format, fill with grey or report on stderr.
"""

import re
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.files import write_bytes_atomic

MAX_SIDE_PX = 4096
MAX_FILE_BYTES = 200_000_000
MIN_SIDE_PX = 128
# Room for the object's window and for windows beside it.
MIN_DEMONSTRATION_SIDE_PX = 256
# Standard deviation, in grey levels, of the channel that varies most. A flat picture stays below
# 1 through JPEG compression; a plain table with an object on it is above 5.
MIN_CONTRAST_LEVELS = 2.0

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SIGNATURE = b"\xff\xd8\xff"
# A marker that ends a run of compressed data: not an escaped 0xFF, a restart or a fill byte.
_JPEG_NEXT_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
# Start-of-frame markers carry the size; C4, C8 and CC in the same range do not.
_JPEG_FRAME_STARTS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD8)])
_JPEG_END = 0xD9


def read_frame(path: Path) -> NDArray[np.uint8]:
    """Read a PNG or JPEG as a frame.

    Grey pictures get three equal channels, an alpha channel is dropped, and 16-bit channels keep
    their high byte (full range is assumed, as PNG defines it). A JPEG's orientation tag applies.

    Args:
        path: the file.

    Returns:
        (H, W, 3) BGR, sides between 128 and 4096 px.

    Raises:
        QsgmError: there is no such file, or it is not a whole picture of a usable size.
    """
    data = _read_bytes(path)
    _check_size(path, *_declared_size(path, data))
    try:
        decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        decoded = None
    if decoded is None:
        raise _damaged(path)
    frame = np.asarray(decoded, dtype=np.uint8)
    _check_size(path, *frame.shape[:2])
    return frame


def read_demonstration(path: Path) -> NDArray[np.uint8]:
    """Read a frame that can serve as a demonstration: large enough and not flat.

    Returns:
        (H, W, 3) BGR, sides between 256 and 4096 px.

    Raises:
        QsgmError: as :func:`read_frame` and :func:`check_demonstration`.
    """
    frame = read_frame(path)
    check_demonstration(frame, path)
    return frame


def check_demonstration(frame: NDArray[np.uint8], path: Path) -> None:
    """Refuse a frame (H, W, 3) that nothing can be learnt from; `path` is for the message.

    Raises:
        QsgmError: the frame is smaller than 256x256 px or has no contrast.
    """
    height, width = frame.shape[:2]
    if min(height, width) < MIN_DEMONSTRATION_SIDE_PX:
        raise QsgmError(
            f"{path} is {width}x{height} px, too small for a demonstration: expected about "
            f"640x480 (at least {MIN_DEMONSTRATION_SIDE_PX} on each side) with the object spanning "
            f"60 to 110 px; take a larger frame"
        )
    contrast = float(cv2.meanStdDev(frame)[1].max())  # takes no memory, unlike numpy's
    if contrast < MIN_CONTRAST_LEVELS:
        raise QsgmError(
            f"{path} shows one flat colour (its contrast is {contrast:.1f} of 255 levels): "
            f"expected an object at the centre of the frame; check the camera and take it again"
        )


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture (H, W, 3) BGR or (H, W) grey as PNG; it appears whole or not at all.

    Raises:
        QsgmError: the place cannot be written to.
    """
    encoded = cv2.imencode(".png", image)[1]
    write_bytes_atomic(path, encoded.tobytes())


def _read_bytes(path: Path) -> bytes:
    try:
        if path.is_dir():
            raise QsgmError(f"{path} is a folder: expected one PNG or JPEG file; pass a file in it")
        if not path.exists():
            raise QsgmError(f"{path} does not exist: expected a PNG or JPEG file; check the name")
        if not path.is_file():
            raise QsgmError(f"{path} is not a regular file: expected a PNG or JPEG; save it first")
        if path.stat().st_size > MAX_FILE_BYTES:
            raise QsgmError(
                f"{path} has {path.stat().st_size / 1e6:.0f} MB: expected a frame of at most "
                f"{MAX_FILE_BYTES / 1e6:.0f} MB; save it smaller"
            )
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a name with a null byte
        reason = getattr(error, "strerror", None) or str(error)
        raise QsgmError(
            f"cannot read {path}: {reason.lower()}; expected a PNG or JPEG file that can be read"
        ) from error


def _declared_size(path: Path, data: bytes) -> tuple[int, int]:
    """Height and width [px] from the header of a file that is whole."""
    if not data:
        raise QsgmError(f"{path} is empty: expected a PNG or JPEG file; take the frame again")
    if data.startswith(_PNG_SIGNATURE):
        size = _png_size(data)
    elif data.startswith(_JPEG_SIGNATURE):
        size = _jpeg_size(data)
    else:
        raise QsgmError(f"{path} is not a PNG or JPEG picture; convert it to one of them")
    if size is None:
        raise _damaged(path)
    return size


def _png_size(data: bytes) -> tuple[int, int] | None:
    """Height and width, or None unless every chunk up to the end mark is there and intact."""
    size = None
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        kind_and_body = memoryview(data)[position + 4 : position + 8 + length]
        checksum = data[position + 8 + length : position + 12 + length]
        if checksum != zlib.crc32(kind_and_body).to_bytes(4, "big"):
            return None
        kind = bytes(kind_and_body[:4])
        if kind == b"IHDR" and length == 13:
            width, height = struct.unpack_from(">II", kind_and_body, 4)
            size = (height, width)
        if kind == b"IEND":
            return size
        position += 12 + length
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Height and width, or None unless the segments lead to the end mark."""
    size = None
    position = 2
    while found := _JPEG_NEXT_MARKER.search(data, position):
        marker, position = data[found.start() + 1], found.end()
        if marker == _JPEG_END:
            return size
        if marker in _JPEG_WITHOUT_LENGTH:
            continue
        if position + 7 > len(data):
            return None
        if marker in _JPEG_FRAME_STARTS:
            size = struct.unpack_from(">HH", data, position + 3)
        # After a scan header the search above runs through the compressed data to what follows.
        position += struct.unpack_from(">H", data, position)[0]
    return None


def _check_size(path: Path, height: int, width: int) -> None:
    if min(height, width) < MIN_SIDE_PX:
        raise QsgmError(
            f"{path} is {width}x{height} px: expected at least {MIN_SIDE_PX} px on each side, "
            f"since that is what the network looks at; take a larger frame"
        )
    if max(height, width) > MAX_SIDE_PX:
        raise QsgmError(
            f"{path} is {width}x{height} px: expected at most {MAX_SIDE_PX} px on each side, as "
            f"12 megapixels have; scale it down"
        )


def _damaged(path: Path) -> QsgmError:
    return QsgmError(
        f"{path} is truncated or damaged: expected a whole PNG or JPEG; copy or take it again"
    )
