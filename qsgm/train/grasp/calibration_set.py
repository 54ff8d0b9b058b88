"""The calibration set: demonstration frames in a folder, and the manifest that vouches for them."""

import json
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.files import is_plain, read_file, sha256
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import GraspTask
from qsgm.images import MAX_FILE_BYTES, check_demonstration, decode_frame
from qsgm.train.grasp.task import frame_lesson, shipped_things

MANIFEST = "manifest.json"
FORMAT, VERSION = "qsgm-calibration", 1
MANIFEST_BYTES = 4_000_000


@dataclass(frozen=True)
class _Entry:
    """What the manifest says of one frame: a name in the same folder, its digest, its object."""

    file: str
    sha256: str
    center_px: tuple[float, float]


class CalibrationSet:
    """The frames that a folder's manifest lists; each is read when its turn comes."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / MANIFEST
        try:
            what = f"a calibration set that `qsgm draw-calibration -o {folder}` made"
            self.manifest_bytes = read_file(path, MANIFEST_BYTES, what)
            self._entries = _entries(json.loads(self.manifest_bytes))
        except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
            raise QsgmError(
                f'{path} is damaged: expected {{"frames": [{{"file", "sha256", "center_px"}}]}};'
                " make it again with `qsgm draw-calibration`"
            ) from error
        if not self._entries:
            raise QsgmError(f"{path} lists no frames: there is nothing to calibrate on")

    def __len__(self) -> int:
        return len(self._entries)

    def __getitem__(self, i: int) -> Demonstration:
        entry = self._entries[i]
        path = self.folder / entry.file
        data = read_file(path, MAX_FILE_BYTES, "a frame")
        image = decode_frame(data, path)
        check_demonstration(image, path)
        if sha256(data) != entry.sha256:
            raise QsgmError(
                f"{path} is not the frame the manifest describes (its sha256"
                " differs); restore it or make the set again with `qsgm draw-calibration`"
            )
        (x, y), (height, width) = entry.center_px, image.shape[:2]
        if x >= width or y >= height:
            raise QsgmError(
                f"{self.folder / MANIFEST} has the object of {entry.file} at ({x:g}, {y:g}) px,"
                f" outside its frame of {width}x{height}; correct its center_px"
            )
        return Demonstration(image, entry.center_px)


@dataclass(frozen=True)
class CalibrationLessons:
    """The frames of a calibration set as lessons."""

    frames: CalibrationSet
    task: GraspTask

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def sha256(self) -> str:
        """Digest of the manifest, and so of every frame."""
        return sha256(self.frames.manifest_bytes)

    def lesson(self, i: int, rng: np.random.Generator, count: int) -> GraspLesson:
        """Crops of a frame, with other things on them as the device has them."""
        shown = self.frames[i]
        return frame_lesson(shown.frame, rng, count, self.task, shown.center_px)

    def samples(self, i: int, rng: np.random.Generator, count: int) -> NDArray[np.uint8]:
        """Crops (N, 128, 128, 3) of a frame, as the device cuts them."""
        return crop_source([self.frames[i]], shipped_things(), rng, count).cut(np.arange(count))


def _entries(manifest: Any) -> list[_Entry]:
    """Every frame's entry; the manifest may name its format and version.

    Raises ValueError, KeyError, TypeError, ArithmeticError or RecursionError for a damaged one.
    """
    if not isinstance(manifest, dict):
        raise TypeError("not a JSON object")
    named = manifest.get("format", FORMAT), manifest.get("version", VERSION)
    if named != (FORMAT, VERSION):
        raise ValueError(f"another format: {named!r}")
    return [
        _entry(**{name: f[name] for name in _Entry.__annotations__}) for f in manifest["frames"]
    ]


def _entry(file: Any, sha256: Any, center_px: Any) -> _Entry:
    if not is_plain(file):
        raise ValueError(f"not a plain file name: {file!r}")
    if not isinstance(sha256, str):
        raise TypeError(f"no digest: {sha256!r}")
    x, y = center_px
    for value in (x, y):
        if type(value) not in (int, float) or not isfinite(value) or value < 0:
            raise ValueError(f"no place in a frame: {center_px!r}")
    return _Entry(file, sha256, (x, y))
