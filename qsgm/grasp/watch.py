"""Objects looked for in frame after frame: of a camera, a video file, or pictures.

    for seen in watch("belt.avi", [load_object(Path("mug")), load_object(Path("cup"))]):
        for sight in seen.sights:
            print(seen.number, sight.name, sight.detection.found, sight.detection.center_px)

Whoever has frames of his own calls `locate` on each: an object may be used by several threads at
once.
"""

import glob
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.files import new_file
from qsgm.grasp.pictures import Picture, draw_objects
from qsgm.grasp.sights import Sight, look_for_each, named_places
from qsgm.grasp.tuned import TunedObject
from qsgm.images import MAX_SIDE_PX, check_frame, decoding, read_frame

PICTURES = (".png", ".jpg", ".jpeg")
# Where nothing says how fast frames come.
FRAME_RATE = 10.0
# An AVI file counts its bytes in 32 bits, and not every reader takes the last of them for a sign.
MOST_VIDEO_BYTES = 2_000_000_000
_EXPECTED = (
    "a camera's number, a video file (AVI, MP4, MOV, MKV, WebM), a picture, or a folder or glob of "
    "pictures"
)
# How those begin. A playlist, which FFmpeg reads too, could name any file or host.
_VIDEO = re.compile(
    rb"RIFF....AVI |....(?:ftyp|moov|mdat|wide|free|skip)|\x1a\x45\xdf\xa3", re.DOTALL
)
_PICTURE = re.compile(rb"\x89PNG|\xff\xd8\xff")
# FFmpeg first; what OpenCV brings along reads MJPG in AVI where there is no FFmpeg.
_FILE_READERS = (cv2.CAP_FFMPEG, cv2.CAP_OPENCV_MJPEG)


@dataclass(frozen=True)
class Stream:
    """Frames as they come, each with its number and the second at which it was taken."""

    frames: Iterator[tuple[int, float, NDArray[np.uint8]]]
    rate: float | None  # frames a second, where that is known


@dataclass(frozen=True)
class Watched:
    """What was seen in one frame."""

    number: int  # of the frame in its stream, from 0
    seconds: float  # of a video since its start; else since the stream was opened
    latency_ms: float  # from the frame in memory to the answers
    frame: NDArray[np.uint8]
    sights: tuple[Sight, ...]  # one for each object

    def to_json(self) -> dict[str, Any]:
        """A line of `qsgm watch`."""
        entries = [entry for one in self.sights for entry in one.to_json()]
        return {
            "frame": self.number,
            "seconds": round(self.seconds, 3),
            "latency_ms": round(self.latency_ms, 2),
            "objects": [{k: v for k, v in one.items() if k != "candidates"} for one in entries],
        }

    def picture(self) -> Picture:
        """The frame, as large as it is, with what was seen in it."""
        return draw_objects(self.frame, named_places(self.sights), enlarged=False)


def watch(
    source: str | int | Path | Stream,
    objects: Sequence[TunedObject],
    every: int = 1,
    limit: int | None = None,
    any_distance: bool = False,
) -> Iterator[Watched]:
    """Look for objects in every frame of a source, one after the other.

    Args:
        source: as :func:`open_stream` takes it, or what that gives.
        objects: to look for.
        every: look at one frame in so many.
        limit: at so many frames at most.
        any_distance: where one is not found, look more closely and at half to twice the
            distance, too.

    Raises:
        QsgmError: there is no such source, or a frame cannot be used.
    """
    stream = source if isinstance(source, Stream) else open_stream(source, every)
    for number, seconds, frame in islice(stream.frames, limit):
        start = time.perf_counter()
        sights = look_for_each(objects, frame, any_distance=any_distance)
        yield Watched(number, seconds, 1e3 * (time.perf_counter() - start), frame, sights)
        del frame, sights  # else they were kept while the next frame is decoded


def open_stream(source: str | int | Path, every: int = 1) -> Stream:
    """Open a source of frames.

    Args:
        source: a camera's number, a video file, a picture, or a folder or glob of pictures, which
            are taken in the order of their names, numbers in them by their value.
        every: keep one frame in so many.

    Raises:
        QsgmError: there is no such source, or it is of another kind.
    """
    text, path = str(source), Path(source) if not isinstance(source, int) else None
    try:
        if path is None or (text.isdecimal() and not path.exists()):
            return _captured(int(text), (cv2.CAP_ANY,), f"camera {text}", every)
        if path.is_dir():
            pictures = [one for one in path.iterdir() if one.suffix.lower() in PICTURES]
            return _pictures(pictures, source, every)
        if path.is_file():
            with path.open("rb") as file:
                start = file.read(16)
            if _VIDEO.match(start):
                return _captured(str(path.resolve()), _FILE_READERS, str(path), every)
            return _pictures([path] if _PICTURE.match(start) else [], source, every)
        return _pictures([Path(one) for one in glob.glob(text)], source, every)  # noqa: PTH207
    except (OSError, ValueError, OverflowError, cv2.error) as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error)).lower().split())
        raise QsgmError(f"cannot read {source}: {reason}; expected {_EXPECTED}") from error


@contextmanager
def new_video(path: Path, rate: float | None) -> Iterator[Callable[[Picture], bool]]:
    """Write a video, MJPG in AVI; it appears whole when the block ends, or not at all.

    Yields:
        What takes each frame (H, W, 3) BGR, and says whether there is room for more; those of
        another size than the first are scaled.

    Raises:
        QsgmError: the place cannot be written to, or there was no frame.
    """
    check_video_name(path)
    writers: list[cv2.VideoWriter] = []
    frames, size = 0, (0, 0)

    def write(picture: Picture) -> bool:
        nonlocal frames, size
        if not writers:
            size = picture.shape[1], picture.shape[0]
            kind, codec = cv2.CAP_OPENCV_MJPEG, cv2.VideoWriter.fourcc(*"MJPG")
            writers.append(cv2.VideoWriter(str(new), kind, codec, rate or FRAME_RATE, size))
            if not writers[0].isOpened():
                raise QsgmError(f"cannot write {path}: this OpenCV has no MJPG; leave -o out")
        if picture.shape[1::-1] != size:
            picture = np.asarray(cv2.resize(picture, size), dtype=np.uint8)
        writers[0].write(picture)
        frames += 1
        return new.stat().st_size < MOST_VIDEO_BYTES

    with new_file(path) as new:
        try:
            yield write
        finally:
            for writer in writers:
                writer.release()
        _check_written(path, new, frames)


def check_video_name(path: Path) -> None:
    """Refuse a name under which nobody would look for an AVI.

    Raises:
        QsgmError: it does not end in `.avi`.
    """
    if path.suffix.lower() != ".avi":
        raise QsgmError(f"cannot write {path}: videos are AVI; pass a name that ends in .avi")


def _check_written(path: Path, new: Path, frames: int) -> None:
    """OpenCV does not say that a disk is full: the file has to be as long as it says itself."""
    data = b""
    if new.is_file():
        with new.open("rb") as file:
            data = file.read(8)
    if frames == 0 or len(data) < 8 or new.stat().st_size < int.from_bytes(data[4:], "little") + 8:
        raise QsgmError(
            f"cannot write {path}: {frames} frames did not make a whole video; pass a place with "
            "room for it"
        )


def _captured(source: int | str, readers: Sequence[int], name: str, every: int) -> Stream:
    """Frames that OpenCV reads."""
    for reader in readers:
        with decoding():  # what it complains of is said in one line
            capture = cv2.VideoCapture(source, reader)
        if capture.isOpened():
            break
    else:
        raise QsgmError(f"cannot open {name}: expected {_EXPECTED} that can be read; check it")
    sides = [capture.get(k) for k in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
    if max(sides) > MAX_SIDE_PX:
        raise QsgmError(
            f"{name} has frames of {sides[0]:.0f}x{sides[1]:.0f} px: expected at most "
            f"{MAX_SIDE_PX} px on each side; scale them down"
        )
    rate = capture.get(cv2.CAP_PROP_FPS)
    known = rate if 0 < rate < 1000 else None
    frames = _frames(capture, name, every, known if isinstance(source, str) else None)
    return Stream(frames, known and known / every)


def _frames(
    capture: cv2.VideoCapture, name: str, every: int, rate: float | None
) -> Iterator[tuple[int, float, NDArray[np.uint8]]]:
    number, start = 0, time.monotonic()
    try:
        while True:
            there, frame = False, None
            with decoding(), suppress(cv2.error, MemoryError):
                there, frame = capture.read() if number % every == 0 else (capture.grab(), None)
            if not there:
                break
            seconds = time.monotonic() - start if rate is None else number / rate
            if frame is not None:
                yield number, seconds, check_frame(frame)
            number += 1
    finally:
        capture.release()
    if number == 0:
        raise QsgmError(f"{name} holds no frame that can be read; expected {_EXPECTED}")


def _pictures(paths: Sequence[Path], source: object, every: int) -> Stream:
    if not paths:
        raise QsgmError(f"there are no frames at {source}: expected {_EXPECTED}; check the name")
    ordered, start = sorted(paths, key=_by_number), time.monotonic()
    chosen = list(enumerate(ordered))[::every]
    return Stream(
        ((number, time.monotonic() - start, read_frame(path)) for number, path in chosen), None
    )


def _by_number(path: Path) -> list[tuple[int, str]]:
    """Its name, such that 10 comes after 9."""
    parts = re.split(r"(\d+)", path.name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]
