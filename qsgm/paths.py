"""Where things are when no flag says so: the shipped artifacts and the last tuned object."""

import os
import re
from importlib.resources import files
from pathlib import Path

from qsgm.errors import QsgmError
from qsgm.files import write_text_atomic


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


def object_folder(frame: Path) -> Path:
    """Where the object tuned on `frame` goes when ``-o`` is not given: named after the frame."""
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", frame.stem).strip("._") or "object"
    return _data_folder() / "objects" / name


def remember_object(folder: Path) -> None:
    """Make `folder` the object that ``qsgm predict`` uses when ``--object`` is not given.

    Raises:
        QsgmError: the user's data folder cannot be written.
    """
    write_text_atomic(_last_object_file(), f"{folder.resolve()}\n")


def last_object_folder() -> Path:
    """The object tuned last by this user, wherever it was written.

    Raises:
        QsgmError: nothing was tuned here yet, or it is gone.
    """
    try:
        text = _last_object_file().read_text(encoding="utf-8").strip()
    except (OSError, UnicodeDecodeError):
        text = ""
    if not text:
        raise QsgmError(
            "no object was tuned here yet: run `qsgm finetune object.png` first or pass --object"
        )
    folder = Path(text)
    if not _is_folder(folder):
        raise QsgmError(
            f"the object tuned last, {folder}, is gone: run `qsgm finetune` again or pass --object"
        )
    return folder


def _artifact(name: str, option: str, flag: Path | None) -> Path:
    """First of: the flag's folder, the installed copy, the folder in the checkout."""
    if flag is not None:
        if not _is_folder(flag):
            raise QsgmError(f"{option} {flag}: there is no such folder; check the name")
        return flag
    candidates = [_installed(name), _in_checkout(name)]
    for folder in candidates:
        if folder is not None and _is_folder(folder):
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


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:  # not allowed to look, name too long
        return False


def _last_object_file() -> Path:
    return _data_folder() / "last"


def _data_folder() -> Path:
    """The user's data folder, after the XDG base directory specification."""
    base = os.environ.get("XDG_DATA_HOME", "")
    if base and Path(base).is_absolute():  # the specification says to ignore relative ones
        return Path(base) / "qsgm"
    try:
        return Path.home() / ".local" / "share" / "qsgm"
    except RuntimeError as error:
        raise QsgmError(
            "this user has no home folder to keep tuned objects in; pass -o or --object, "
            "or set XDG_DATA_HOME"
        ) from error
