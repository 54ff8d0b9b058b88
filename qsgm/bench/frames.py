"""A folder of demonstration frames: those its manifest lists, or every picture in it.

A manifest is a JSON list of objects, or an object with such a list as `frames`. Of each entry
`file` is needed; `mask` (white where the object is), `object` (what it is), `elongated` and
`orientation` (`unique`: it shows which way round it lies) are used if there.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.images import read_demonstration, read_frame

MANIFEST = "manifest.json"
PICTURES = (".png", ".jpg", ".jpeg")
MASK_SUFFIX = "_mask"


@dataclass(frozen=True)
class BenchFrame:
    """One demonstration to measure on."""

    path: Path
    mask_path: Path | None
    elongated: bool | None  # None: nobody said
    object_name: str | None = None
    unique: bool | None = None  # whether it shows which way round it lies

    @property
    def name(self) -> str:
        return self.path.stem

    def read(self) -> NDArray[np.uint8]:
        """The frame (H, W, 3) BGR."""
        return read_demonstration(self.path)

    def read_mask(self) -> NDArray[np.bool_]:
        """Where the object is: (H, W).

        Raises:
            QsgmError: there is no mask, or it does not fit the frame.
        """
        if self.mask_path is None:
            raise QsgmError(
                f"{self.path} has no mask beside it: expected {self.name}{MASK_SUFFIX}.png, white "
                f"where the object is; draw one or leave the frame out"
            )
        mask = cv2.cvtColor(read_frame(self.mask_path), cv2.COLOR_BGR2GRAY) > 127
        if not mask.any() or mask.all():
            raise QsgmError(f"{self.mask_path} is all one colour: expected white on the object")
        return np.asarray(mask)


def list_frames(folder: Path, limit: int | None = None) -> list[BenchFrame]:
    """The demonstrations of a folder, at most `limit` of them, evenly spread over the folder.

    Raises:
        QsgmError: there are none, or the manifest cannot be used.
    """
    if not folder.is_dir():
        raise QsgmError(f"--frames {folder}: there is no such folder; check the name")
    manifest = folder / MANIFEST
    frames = _from_manifest(folder, manifest) if manifest.is_file() else _from_pictures(folder)
    if not frames:
        raise QsgmError(f"--frames {folder}: expected PNG or JPEG frames in it, found none")
    return [frames[i] for i in spread(len(frames), limit)]


def spread(count: int, limit: int | None) -> list[int]:
    """At most `limit` of `count` numbers, evenly spread."""
    some = count if limit is None else min(limit, count)
    return [i * count // some for i in range(some)]


def groups_of(frames: Sequence[BenchFrame]) -> dict[str, list[int]]:
    """Places of all frames and, where a manifest says which they are, of the elongated ones."""
    elongated = [i for i, frame in enumerate(frames) if frame.elongated]
    groups = {"all": list(range(len(frames)))}
    return groups | {"elongated": elongated} if elongated else groups


def _from_manifest(folder: Path, path: Path) -> list[BenchFrame]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise QsgmError(f"{path} is not JSON; mend it or take it away") from error
    entries = content.get("frames") if isinstance(content, dict) else content
    if not isinstance(entries, list):
        raise QsgmError(f"{path}: expected a list of frames, or one under the key 'frames'")
    return [_from_entry(folder, path, entry) for entry in entries]


def _from_entry(folder: Path, manifest: Path, entry: Any) -> BenchFrame:
    if not isinstance(entry, dict) or not isinstance(entry.get("file"), str):
        raise QsgmError(f"{manifest}: expected frames with a key 'file', got {str(entry)[:80]}")
    path = folder / entry["file"]
    mask = folder / entry["mask"] if isinstance(entry.get("mask"), str) else _mask_beside(path)
    elongated, name, orientation = (
        entry.get(key) for key in ("elongated", "object", "orientation")
    )
    return BenchFrame(
        path,
        mask,
        elongated if isinstance(elongated, bool) else None,
        name if isinstance(name, str) else None,
        orientation == "unique" if isinstance(orientation, str) else None,
    )


def _from_pictures(folder: Path) -> list[BenchFrame]:
    pictures = sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)
    return [
        BenchFrame(path, _mask_beside(path), None)
        for path in pictures
        if not path.stem.endswith(MASK_SUFFIX)
    ]


def _mask_beside(path: Path) -> Path | None:
    mask = path.with_name(f"{path.stem}{MASK_SUFFIX}.png")
    return mask if mask.is_file() else None
