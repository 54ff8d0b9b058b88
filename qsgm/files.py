"""Nothing half-written: files and folders appear under their name only when complete.

Both are written beside their destination and renamed. A finished folder lists what it holds in
``SHA256SUMS``; a folder is replaced only if everything in it is listed there, so that whatever a
user put into an output folder, and every folder qsgm did not write, survives a wrong ``-o``.
"""

import hashlib
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from qsgm.errors import QsgmError

LISTING = "SHA256SUMS"


def write_text_atomic(path: Path, text: str) -> None:
    """Write a UTF-8 file; see :func:`write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode("utf-8"))


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write a file so that its name shows the old content or the new, never a part.

    Folders on the way are made. A link is followed, so that it stays a link.

    Raises:
        QsgmError: the place cannot be written to, or is something else than a file.
    """
    final = path.resolve()
    temporary = _beside(final, "partial")
    try:
        if final.exists() and not final.is_file():
            raise QsgmError(f"cannot write {path}: it exists and is not a file; pass another name")
        final.parent.mkdir(parents=True, exist_ok=True)
        with temporary.open("xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(final)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        _remove_quietly(temporary)


@contextmanager
def new_folder(path: Path, marker: str) -> Iterator[Path]:
    """Fill a temporary folder that becomes `path` when the block ends without an exception.

    Args:
        path: the folder to make. It may be absent, empty, or an earlier output of this kind.
        marker: name of a file that every folder of this kind holds and no other kind does, such as
            ``object.json``. The block has to write it.

    Yields:
        An empty folder on the same disk.

    Raises:
        QsgmError: `path` holds something that qsgm did not write, or cannot be written.
    """
    check_replaceable(path, marker)
    temporary = _beside(path.resolve(), "partial")
    try:
        temporary.mkdir(parents=True)
        yield temporary
        replace_folder(temporary, path, marker)
    except OSError as error:
        raise _cannot_write(path, error) from error
    finally:
        _remove_quietly(temporary)


def replace_folder(temporary: Path, final: Path, marker: str) -> None:
    """List the content of `temporary`, then give it the name `final`.

    Raises:
        QsgmError: `final` holds something that qsgm did not write, or cannot be replaced; it is
            then as it was before.
    """
    if not (temporary / marker).is_file():
        raise ValueError(f"{temporary} cannot become {final}: {marker} was not written")
    check_replaceable(final, marker)
    final = final.resolve()
    old = _beside(final, "old")
    try:
        _write_listing(temporary)
        if final.exists():
            final.rename(old)
        try:
            temporary.rename(final)
        except OSError:
            if old.exists():
                old.rename(final)
            raise
    except OSError as error:
        raise _cannot_write(final, error) from error
    _remove_quietly(old)


def check_replaceable(path: Path, marker: str) -> None:
    """Refuse a folder that holds anything qsgm did not write; absent and empty ones pass.

    Raises:
        QsgmError: names what stands in the way.
    """
    try:
        if not path.exists():
            return
        if not path.is_dir():
            raise QsgmError(f"cannot write {path}: expected a folder or a new name, got a file")
        listed = {LISTING, *_listed(path)}
        foreign = next((name for name in _entries(path) if name not in listed), None)
        empty = next(_entries(path), None) is None
    except OSError as error:
        raise _cannot_write(path, error) from error
    if foreign is not None:
        raise QsgmError(
            f"will not replace the folder {path}: qsgm did not write {foreign!r} in it; "
            f"pass a new or an empty folder"
        )
    if not empty and not (path / marker).is_file():
        raise QsgmError(
            f"will not replace the folder {path}: it holds another kind of output (no {marker}); "
            f"pass a new or an empty folder"
        )


def _entries(folder: Path) -> Iterator[str]:
    """Relative names of everything below a folder that is not itself a plain folder.

    Those right in it come first, and no folder is looked into before its turn: whoever stops at
    the first name does not walk a whole disk.
    """
    waiting = [folder]
    for place in waiting:
        for item in sorted(place.iterdir()):
            if item.is_dir() and not item.is_symlink():
                waiting.append(item)
            else:
                yield item.relative_to(folder).as_posix()


def _listed(folder: Path) -> set[str]:
    """Relative names that a folder's listing gives; none without a listing."""
    try:
        lines = (folder / LISTING).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError):
        return set()
    return {name for _, separator, name in (line.partition("  ") for line in lines) if separator}


def _write_listing(folder: Path) -> None:
    """Write the listing in the format of ``sha256sum``, so that ``sha256sum -c`` checks it."""
    lines = [
        f"{hashlib.sha256((folder / name).read_bytes()).hexdigest()}  {name}\n"
        for name in sorted({*_entries(folder)} - {LISTING})
    ]
    (folder / LISTING).write_text("".join(lines), encoding="utf-8")


def _beside(path: Path, kind: str) -> Path:
    """An unused hidden name in the same folder, hence on the same disk."""
    if not path.name:
        raise QsgmError(f"cannot write {path}: it has no name of its own; pass a place below it")
    return path.with_name(f".{path.name}.{secrets.token_hex(4)}.{kind}")


def _remove_quietly(path: Path) -> None:
    """Clean up; a failure here must not hide what went wrong before, or undo what went well."""
    with suppress(OSError):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def _cannot_write(path: Path, error: OSError) -> QsgmError:
    reason = (error.strerror or str(error)).lower()
    return QsgmError(f"cannot write {path}: {reason}; pass a place that can be written to")
