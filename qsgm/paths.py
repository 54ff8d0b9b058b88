"""Where things are when no flag says so: the shipped artifacts and the last tuned object."""

import errno
import os
import re
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

from qsgm.errors import QsgmError
from qsgm.files import read_file, sha256, write_bytes_atomic

_LONGEST_NAME = 60  # letters of four bytes at most, where systems allow 255 bytes
_LONGEST_PATH = 10_000


def bundle_folder(flag: Path | None = None) -> Path:
    """The folder that ``--bundle`` names, else the shipped one.

    Raises:
        QsgmError: there is no such folder.
    """
    return _artifact("export", "--bundle", flag)


def calibration_folder(flag: Path | None = None) -> Path:
    """The folder that ``--calib`` names, else the shipped one.

    Raises:
        QsgmError: there is no such folder.
    """
    return _artifact("calib", "--calib", flag)


def objects_folder() -> Path:
    """Where this user's objects are, unless ``-o`` said otherwise. It may not exist yet.

    Raises:
        QsgmError: this user has no home folder.
    """
    return _data_folder() / "objects"


def object_folder(frame: Path) -> Path:
    """Where the object tuned on `frame` goes when ``-o`` is not given: named after the frame."""
    return folder_named(name_of(frame))


def folder_named(name: str) -> Path:
    """Where this user's object of that name is.

    Letters and digits of any script stay. Where the name has anything else in it, a short hash
    tells it from others that would come to the same.
    """
    kept = re.sub(r"[^\w.-]+", "_", name)[:_LONGEST_NAME].strip("._")
    if kept != name:
        digest = sha256(os.fsencode(name))[:8]
        kept = f"{kept}-{digest}" if kept else f"object-{digest}"
    return objects_folder() / kept


def name_of(frame: Path) -> str:
    """What an object is called after its frame."""
    return "stdin" if frame == Path("-") else frame.stem


def remember_object(folder: Path) -> None:
    """Make `folder` the object that ``qsgm predict`` uses when ``--object`` is not given.

    Raises:
        QsgmError: the user's data folder cannot be written.
    """
    write_bytes_atomic(_last_object_file(), os.fsencode(folder.resolve()) + b"\n")


def is_last_object(folder: Path) -> bool:
    """Whether ``qsgm predict`` uses this object when ``--object`` is not given, as far as known."""
    with suppress(QsgmError):  # this user has no data folder, or nobody may look
        return _last_object() == str(folder.resolve())
    return False


def forget_last_object() -> None:
    """Let ``qsgm predict`` ask for ``--object`` until another one is tuned.

    Raises:
        QsgmError: the user's data folder cannot be written.
    """
    write_bytes_atomic(_last_object_file(), b"")


def last_object_folder() -> Path:
    """The object tuned last by this user, wherever it was written.

    Raises:
        QsgmError: nothing was tuned here yet, or it is gone, or nobody may look.
    """
    text = _last_object()
    if not text:
        raise QsgmError(
            "no object was tuned here yet: run `qsgm finetune object.png` first or pass --object"
        )
    folder = Path(text)
    if not is_folder(folder):
        raise QsgmError(
            f"the object tuned last, {folder}, is gone: run `qsgm finetune` again or pass --object"
        )
    return folder


def _last_object() -> str:
    """The last object's folder as it was remembered; empty where there is none."""
    file = _last_object_file()
    try:
        there = file.exists()
    except OSError:  # not allowed to look: reading says so
        there = True
    content = read_file(file, _LONGEST_PATH, "the name of the last object") if there else b""
    return os.fsdecode(content.removesuffix(b"\n"))


def _artifact(name: str, option: str, flag: Path | None) -> Path:
    """First of: the flag's folder, the installed copy, the folder in the checkout."""
    if flag is not None:
        if not is_folder(flag):
            raise QsgmError(f"{option} {flag}: there is no such folder; check the name")
        return flag
    candidates = [_installed(name), _in_checkout(name)]
    for folder in candidates:
        if folder is not None and is_folder(folder):
            return folder
    raise QsgmError(
        f"this installation comes without {name}/ (neither beside the code nor in a checkout); "
        f"pass {option} DIR"
    )


def _installed(name: str) -> Path | None:
    folder = files("qsgm") / "artifacts" / name
    # A package that runs from a zip file has no folders to hand to ONNX Runtime.
    return folder if isinstance(folder, Path) else None


def _in_checkout(name: str) -> Path | None:
    top = Path(__file__).resolve().parent.parent
    return top / name if (top / "pyproject.toml").is_file() else None


def is_folder(path: Path) -> bool:
    """Whether a path names a folder.

    Raises:
        QsgmError: nobody may look.
    """
    try:
        return path.is_dir()
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            return False
        raise QsgmError(
            f"cannot look into {path}: {str(error.strerror).lower()}; pass a folder that can"
            " be read"
        ) from error


def _last_object_file() -> Path:
    return _data_folder() / "last"


def _data_folder() -> Path:
    """The user's data folder, after the XDG base directory specification."""
    base = os.environ.get("XDG_DATA_HOME", "")
    if base and Path(base).is_absolute():  # the specification says to ignore relative ones
        return Path(base) / "qsgm"
    with suppress(RuntimeError):
        if Path(os.environ.get("HOME", "/")).is_absolute():  # '' would be the root
            return Path.home() / ".local" / "share" / "qsgm"
    raise QsgmError(
        "this user has no home folder to keep tuned objects in; pass -o or --object, "
        "or set XDG_DATA_HOME"
    )
