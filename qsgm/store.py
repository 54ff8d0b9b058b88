"""The user's tuned objects and networks: found by folder or name, described, removed, renamed."""

import json
import math
import shutil
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

from qsgm import paths
from qsgm.errors import QsgmError, as_text
from qsgm.files import is_plain, new_folder, remove_folder
from qsgm.grasp.task import NAME as GRASP
from qsgm.grasp.tuned import (
    MARGIN_PX,
    MOST_VIEWS,
    ObjectDescription,
    TunedObject,
    load_object,
    read_object,
)
from qsgm.manifest import NETWORK
from qsgm.samples.tuned import NetworkDescription, read_network, task_named_in
from qsgm.tables import number
from qsgm.task import heads_to_json
from qsgm.tuned_folder import DESCRIPTION

LONGEST_NAME = 200
_LIBRARIES = ("qsgm", "onnxruntime", "opencv", "numpy")
_MADE = (*_LIBRARIES, "bundle_sha256", "seed", "frames_sha256", "others_sha256")
Description = ObjectDescription | NetworkDescription


@dataclass(frozen=True)
class StoredObject:
    """An object's or a network's folder, and what it says of itself."""

    folder: Path
    about: Description | None  # None: it cannot be used
    problem: str | None  # why
    last: bool  # whether `predict` uses it without being told

    @property
    def name(self) -> str:
        """What the object is called; a folder's name where it does not say."""
        return as_text(self.folder.name) if self.about is None else self.about.name

    def to_json(self) -> dict[str, Any]:
        """One object of `qsgm objects list`."""
        about, taught = self.about, None
        made = {} if about is None else about.made
        frames, versions = made.get("frames_sha256"), {one: made.get(one) for one in _LIBRARIES}
        with suppress(OSError):
            # Renaming keeps it, and an object cannot be taught without it.
            taught = datetime.fromtimestamp((self.folder / NETWORK).stat().st_mtime)
        return {
            "name": self.name,
            "task": None if about is None else _task_of(about),
            "folder": str(self.folder),
            "taught": None if taught is None else taught.astimezone().isoformat(timespec="seconds"),
            "frames": len(frames) if isinstance(frames, list) else None,
            "scale": number(about.scale, 5) if isinstance(about, ObjectDescription) else None,
            "bytes": _bytes_in(self.folder),
            "patch": isinstance(about, ObjectDescription) and bool(about.views),
            "bundle_sha256": _text(made.get("bundle_sha256")),
            "versions": {one: _text(version) for one, version in versions.items()},
            "last": self.last,
            "problem": self.problem,
        }

    def details_json(self) -> dict[str, Any]:
        """The object of `qsgm objects show`: what reading its graph takes, and how it was made."""
        about = self.about
        if about is None:
            raise QsgmError(str(self.problem))
        looks = {}
        if isinstance(about, ObjectDescription):
            looks = {"views": len(about.views), "decision": about.decision is not None}
        made = {"made": {key: _plain(about.made.get(key)) for key in _MADE}}
        return self.to_json() | _reading(about) | looks | made


def stored_objects() -> list[StoredObject]:
    """All objects of this user, by name; those that cannot be used say why.

    Raises:
        QsgmError: this user has no home folder, or nobody may look.
    """
    place = paths.objects_folder()
    if not paths.is_folder(place):
        return []
    try:
        folders = [one for one in place.iterdir() if not one.name.startswith(".") and one.is_dir()]
    except OSError as error:
        raise QsgmError(f"cannot look into {place}: {str(error.strerror).lower()}") from error
    return sorted((stored_object(one) for one in folders), key=lambda one: one.name)


def stored_object(folder: Path) -> StoredObject:
    """What an object's folder says, without running anything."""
    last = paths.is_last_object(folder)
    try:
        return StoredObject(folder, described(folder)[0], None, last)
    except QsgmError as error:
        return StoredObject(folder, None, str(error), last)


def described(folder: Path) -> tuple[Description, bytes]:
    """What a folder says of its object or network, and the latter as an ONNX file; nothing runs.

    Raises:
        QsgmError: it is missing, altered, or something else.
    """
    return read_object(folder) if task_named_in(folder) is None else read_network(folder)


def find_object(given: Path, *, names_first: bool = False) -> Path:
    """The folder of an object that is given by its folder or, among this user's, by its name.

    Args:
        given: what has a separator in it is a folder; else a folder there comes before a name.
        names_first: a name comes before a folder.

    Raises:
        QsgmError: it is neither.
    """
    if given.name != str(given) or given.is_absolute():
        return given  # whoever reads it says what is wrong with it
    if not names_first and _holds_object(given):
        return given
    place = paths.objects_folder()
    for folder in (place / given, paths.folder_named(str(given)), given):
        if _holds_object(folder):
            return folder
    if paths.is_folder(given):
        return given
    raise QsgmError(
        f"there is no object {given}: expected the folder of one or the name of one of yours; see "
        "`qsgm objects list`"
    )


def find_objects(given: Sequence[Path]) -> list[Path]:
    """The folders of the objects asked for, see :func:`find_object`, or the last one's.

    Raises:
        QsgmError: one is not there, or none was asked for and none tuned.
    """
    return [find_object(one) for one in given] or [paths.last_object_folder()]


def load_objects(given: Sequence[Path], threads: int = 1) -> list[TunedObject]:
    """The objects asked for, see :func:`find_objects`.

    Raises:
        QsgmError: one cannot be used, or two have one name.
    """
    objects = [load_object(folder, threads) for folder in find_objects(given)]
    names = [one.description.name for one in objects]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise QsgmError(
            f"two of the objects are called {twice!r}, and answers would not say which is which: "
            "pass each once, or give one another name with `qsgm objects rename`"
        )
    return objects


def check_object(folder: Path) -> None:
    """Refuse a folder that no tuned object is in.

    Raises:
        QsgmError: says what was expected.
    """
    if not _holds_object(folder):
        raise QsgmError(
            f"{folder} is no object: expected a folder with {DESCRIPTION}; see `qsgm objects list`"
        )


def graph_of(folder: Path) -> tuple[bytes, dict[str, Any]]:
    """An object's network as an ONNX file, and what reading its answers takes.

    Raises:
        QsgmError: the object cannot be used.
    """
    about, network = described(folder)
    values = {"object": about.name, **_reading(about)}
    if isinstance(about, ObjectDescription):
        values["margin_px"] = MARGIN_PX if about.views else 0
    return network, values


def remove_object(folder: Path) -> None:
    """Remove an object, whole or not at all.

    Raises:
        QsgmError: it is none, it has something else in it, or it cannot be removed.
    """
    check_object(folder)
    last = paths.is_last_object(folder)
    remove_folder(folder, DESCRIPTION)
    if last:
        paths.forget_last_object()


def rename_object(folder: Path, name: str) -> Path:
    """Give an object another name, and its folder the one that goes with it.

    Whatever ends it, the object is there whole under the old name, the new one or, for a moment,
    both.

    Raises:
        QsgmError: it is no object, there is one of that name, or the place cannot be written to.
    """
    check_object(folder)
    if not (is_plain(name) and name.strip() and len(name) <= LONGEST_NAME):
        raise QsgmError(
            f"{name!r} cannot be a name: expected 1 to {LONGEST_NAME} letters of any script, no "
            "slash; pass another one"
        )
    new = folder.with_name(paths.folder_named(name).name)
    if new.exists() or new.is_symlink():
        raise QsgmError(f"there is a {name!r} at {new} already; pass another name or remove it")
    last = paths.is_last_object(folder)
    with new_folder(new, DESCRIPTION, replace=False) as copy:
        shutil.copytree(folder, copy, dirs_exist_ok=True)
        values = json.loads((copy / DESCRIPTION).read_bytes()) | {"name": name}
        (copy / DESCRIPTION).write_text(json.dumps(values, indent=1) + "\n")
        described(copy)  # damaged before, or replaced while it was copied
    if last:
        paths.remember_object(new)
    remove_folder(folder, DESCRIPTION)
    return new


def _holds_object(folder: Path) -> bool:
    try:
        return (folder / DESCRIPTION).is_file()
    except OSError:  # too long a name, or nobody may look
        return False


def _bytes_in(folder: Path) -> int:
    """Of all files right in a folder."""
    with suppress(OSError):
        return sum(one.stat().st_size for one in folder.iterdir() if one.is_file())
    return 0


def _task_of(about: Description) -> str:
    return about.task.name if isinstance(about, NetworkDescription) else GRASP


def _reading(about: Description) -> dict[str, Any]:
    """What one has to know to give its graph inputs and to understand the answers."""
    if isinstance(about, NetworkDescription):
        network, heads = about.task.network, about.task.heads
        sides = {"input_shape": [*network.input_shape], "input_kind": network.input_kind}
        return {**sides, "layers": network.depth, "heads": heads_to_json(heads)}
    return {
        "scale": number(about.scale, 5),
        "encoding": about.encoding,
        "offset_deg": number(math.degrees(about.offset_rad), 2),
    }


def _plain(value: object) -> object:
    """What may be shown of a value that anybody may have written."""
    if isinstance(value, list):
        return [_text(one) for one in value[:MOST_VIEWS]]
    return value if isinstance(value, int) else _text(value)


def _text(value: object) -> str | None:
    return as_text(value) if isinstance(value, str) else None
