"""Camera frames in, pictures out. Whatever a user passes is either a frame or refused in one line.

The header is read before anything is decoded: it gives the size (a small file can declare an
image that fills the memory), and walking on to the end mark tells a truncated file from a whole
one. Decoders fill with grey what else is missing, and say so on stderr alone: that is listened to.
"""

import os
import re
import struct
import sys
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.files import read_file, write_bytes_atomic

MAX_SIDE_PX = 4096
MAX_FILE_BYTES = 200_000_000
# A decoder goes over the whole picture once for every scan of a progressive JPEG, however short.
MOST_SCANS = 100
STDIN = Path("-")
MIN_SIDE_PX = 128
# Room for the object's window and for windows beside it.
MIN_DEMONSTRATION_SIDE_PX = 256
# Standard deviation, in grey levels, of the channel that varies most. A flat picture stays below
# 1 through JPEG compression; a plain table with an object on it is above 5.
MIN_CONTRAST_LEVELS = 2.0

_PICTURE = "a PNG or JPEG file"
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_SIGNATURE = b"\xff\xd8\xff"
# A marker that ends a run of compressed data: not an escaped 0xFF, a restart or a fill byte.
_JPEG_NEXT_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
# Start-of-frame markers carry the size; C4, C8 and CC in the same range do not.
_JPEG_FRAME_STARTS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
_JPEG_SEQUENTIAL = frozenset([0xC0, 0xC1])
_JPEG_WITHOUT_LENGTH = frozenset([0x01, *range(0xD0, 0xD8)])
_JPEG_SCAN = 0xDA
_JPEG_END = 0xD9
# What a sensor gives, where a file has 16 bits.
_SENSOR_BITS = (10, 12, 14, 16)
# Lines of libpng, libjpeg, FFmpeg and OpenCV's decoders on stderr.
_COMPLAINT = re.compile(
    rb"libpng |Corrupt JPEG|Premature end of JPEG|Inconsistent progression|Invalid SOS|"
    rb"Unsupported|Unknown Adobe|Warning: unknown JFIF|\[[\w,]+ @ 0x|Truncating packet|"
    rb"Unexpected element|\[ *(?:WARN|ERROR):.*(?:grfmt|loadsave|cap[._]|obsensor)"
)
# Those after which the picture is not what was taken. Some cameras pad; that does no harm.
_DAMAGE = re.compile(
    rb"libpng error|Premature end|Inconsistent progression|"
    rb"Corrupt JPEG data: (?![1-8] extraneous bytes before marker 0xd9)"
)
_stderr_lock = threading.Lock()  # one thread at a time may lay something in its place


class _Header(NamedTuple):
    height: int
    width: int
    ended: bool = True  # whether the end mark is there


def read_frame(path: Path) -> NDArray[np.uint8]:
    """Read a PNG or JPEG as a frame.

    Grey pictures get three equal channels, an alpha channel is dropped, and of 16-bit channels the
    high byte of the bits that the brightest pixel takes stays: of 10, 12, 14 or 16. A JPEG's
    orientation tag applies.

    Args:
        path: the file; `-` is what is piped in.

    Returns:
        (H, W, 3) BGR, sides between 128 and 4096 px.

    Raises:
        QsgmError: there is no such file, or it is not a whole picture of a usable size.
    """
    if path == STDIN and sys.stdin is not None:
        data = sys.stdin.buffer.read(MAX_FILE_BYTES)
    else:
        data = read_file(path, MAX_FILE_BYTES, _PICTURE)
    return decode_frame(data, path)


def decode_frame(data: bytes, path: Path) -> NDArray[np.uint8]:
    """What :func:`read_frame` makes of a file's bytes; `path` is for the message."""
    header = _header(path, data)
    _check_size(path, header.height, header.width, MIN_SIDE_PX)
    if not header.ended:
        data += bytes([0xFF, _JPEG_END])
    decoded = None
    with decoding() as complaints:
        try:
            flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
            decoded = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flags)
        except (cv2.error, MemoryError):
            pass
    if decoded is None or any(map(_DAMAGE.match, complaints)):
        raise _damaged(path)
    frame = _in_eight_bits(decoded)
    _check_size(path, len(frame), len(frame[0]), MIN_SIDE_PX)
    return frame


def check_frame(frame: object, margin_px: int = 0) -> NDArray[np.uint8]:
    """A frame as everything here takes it, its pixels in one piece.

    Raises:
        QsgmError: it is something else than (H, W, 3) BGR of bytes, or larger than 4096 px beside
            its margins.
    """
    if not isinstance(frame, np.ndarray):
        got = type(frame).__name__
    elif frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        got = f"an array of {frame.dtype} {frame.shape}"
    else:
        height, width = (max(side - 2 * margin_px, min(side, 1)) for side in frame.shape[:2])
        _check_size("the frame", height, width, 1)
        return np.ascontiguousarray(frame)
    raise QsgmError(
        f"the frame is {got}: expected a numpy array of uint8 (height, width, 3), BGR as OpenCV "
        "has it; read it with `qsgm.read_frame` or convert it"
    )


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
    height, width = check_frame(frame).shape[:2]
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
        QsgmError: the place cannot be written to, or its name is that of another format.
    """
    check_png_name(path)
    encoded = cv2.imencode(".png", image)[1]
    write_bytes_atomic(path, encoded.tobytes())


def check_png_name(path: Path) -> None:
    """Refuse a name under which nobody would look for a PNG.

    Raises:
        QsgmError: it does not end in `.png`.
    """
    if path.suffix.lower() != ".png":
        raise QsgmError(f"cannot write {path}: pictures are PNG; pass a name that ends in .png")


@contextmanager
def decoding() -> Iterator[list[bytes]]:
    """What decoders say on stderr while this block runs; what others say there is passed on."""
    lines: list[bytes] = []
    with _stderr_lock:
        try:
            kept = os.dup(2)
        except OSError:  # there is none to be listened to
            yield lines
            return
        reading, writing = os.pipe()
        os.set_blocking(reading, False)
        os.set_blocking(writing, False)
        try:
            os.dup2(writing, 2)
            yield lines
        finally:
            os.dup2(kept, 2)
            os.close(writing)
            with os.fdopen(reading, "rb") as pipe:
                said = (pipe.read() or b"").splitlines(keepends=True)
            lines += [line for line in said if _COMPLAINT.match(line)]
            os.write(kept, b"".join(line for line in said if not _COMPLAINT.match(line)))
            os.close(kept)


def _in_eight_bits(decoded: NDArray[np.generic]) -> NDArray[np.uint8]:
    """The high byte of however many bits a sensor gave."""
    pixels = np.asarray(decoded)
    if pixels.dtype != np.uint16:
        return np.asarray(pixels, dtype=np.uint8)
    bits = next(bits for bits in _SENSOR_BITS if pixels.max() < 1 << bits)
    return np.asarray(pixels >> (bits - 8), dtype=np.uint8)


def _header(path: Path, data: bytes) -> _Header:
    """What the header says of a file that is whole, but perhaps for a JPEG's end mark."""
    if not data:
        raise QsgmError(f"{path} is empty: expected a PNG or JPEG file; take the frame again")
    if data.startswith(_PNG_SIGNATURE):
        header = _png_header(data)
    elif data.startswith(_JPEG_SIGNATURE):
        header = _jpeg_header(data)
    else:
        raise QsgmError(f"{path} is not a PNG or JPEG picture; convert it to one of them")
    if header is None:
        raise _damaged(path)
    return header


def png_chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Kinds and bodies of a PNG's chunks, up to the first one that is not intact."""
    position = len(_PNG_SIGNATURE)
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        kind_and_body = memoryview(data)[position + 4 : position + 8 + length]
        checksum = data[position + 8 + length : position + 12 + length]
        if checksum != zlib.crc32(kind_and_body).to_bytes(4, "big"):
            return
        yield bytes(kind_and_body[:4]), kind_and_body[4:]
        position += 12 + length


def _png_header(data: bytes) -> _Header | None:
    """None unless the header comes first, once, and every chunk up to the end mark is intact."""
    header = None
    for kind, body in png_chunks(data):
        # Of two headers decoders take one, and this might take the other.
        if (kind == b"IHDR") != (header is None) or (kind == b"IHDR" and len(body) != 13):
            return None
        if kind == b"IHDR":
            width, height = struct.unpack_from(">II", body)
            header = _Header(height, width)
        if kind == b"IEND":
            return header
    return None


def _jpeg_header(data: bytes) -> _Header | None:
    """None unless a single header is followed by scans; only sequential ones may lack the end."""
    header, sequential, scans, position = None, False, 0, 2
    while found := _JPEG_NEXT_MARKER.search(data, position):
        marker, position = data[found.start() + 1], found.end()
        if marker == _JPEG_END:
            return header._replace(ended=True) if header and scans else None
        if marker in _JPEG_WITHOUT_LENGTH:
            continue
        if position + 7 > len(data):
            return None
        if marker in _JPEG_FRAME_STARTS:
            if header is not None:
                return None
            height, width = struct.unpack_from(">HH", data, position + 3)
            header = _Header(height, width, ended=False)
            sequential = marker in _JPEG_SEQUENTIAL
        scans += marker == _JPEG_SCAN
        if scans > (MOST_SCANS if header is not None else 0):
            return None
        # After a scan header the search above runs through the compressed data to what follows.
        position += struct.unpack_from(">H", data, position)[0]
    return header if scans and sequential else None


def _check_size(what: Path | str, height: int, width: int, least: int) -> None:
    if min(height, width) < least:
        raise QsgmError(
            f"{what} is {width}x{height} px: expected at least {least} px on each side, "
            f"since that is what the network looks at; take a larger frame"
        )
    if max(height, width) > MAX_SIDE_PX:
        raise QsgmError(
            f"{what} is {width}x{height} px: expected at most {MAX_SIDE_PX} px on each side, as "
            f"12 megapixels have; scale it down"
        )


def _damaged(path: Path) -> QsgmError:
    return QsgmError(
        f"{path} is truncated or damaged: expected a whole PNG or JPEG; copy or take it again"
    )
