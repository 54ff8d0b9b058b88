"""Nothing half-written: files and folders appear under their name only when complete.

Both are made in a hidden workshop beside their destination, written to the disk, and take their
name in one step, the old one's place where there is one. A kill or a power loss at any moment
leaves the old or the new; a workshop that it leaves behind is swept by whoever writes there next.
A finished folder lists what it holds in ``SHA256SUMS``; a folder is replaced only if everything in
it is listed there, so that whatever a user put into an output folder, and every folder qsgm did
not write, survives a wrong ``-o``.
"""

import errno
import hashlib
import io
import os
import re
import secrets
import shutil
import stat
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeGuard, TypeVar

from qsgm.errors import QsgmError

if sys.platform != "win32":
    import fcntl

Read = TypeVar("Read")
LISTING = "SHA256SUMS"
LISTING_BYTES = 4_000_000
_WORKSHOP = re.compile(r"\.qsgm-[0-9a-f]{16}")
_NEW, _OLD = "new", "old"
# How often others may come in between before that is an error.
_TRIES = 100
_PAUSE_S = 0.005
_OVERTAKEN = (errno.ENOENT, errno.ENOTEMPTY, errno.EEXIST)


def read_file(path: Path, most_bytes: int, expected: str) -> bytes:
    """Read a regular file that is not larger than a budget; everything else is refused at once.

    Args:
        path: the file.
        most_bytes: its budget, checked before it is read and while it is.
        expected: what should be there, for the message, such as "a PNG or JPEG file".

    Raises:
        QsgmError: there is no such file, it is none, too large, or cannot be read.
    """
    try:
        with io.BufferedReader(io.FileIO(path, opener=_open_harmlessly)) as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise QsgmError(f"{path} is not a regular file: expected {expected}; save it first")
            size = status.st_size
            # One byte more shows that it grew; files that the kernel makes up say they have none.
            data = file.read(size + 1) if size <= most_bytes else b""
            while data and size < len(data) <= most_bytes and (more := file.read(1 << 20)):
                data += more
    except FileNotFoundError as error:
        raise QsgmError(f"{path} does not exist: expected {expected}; check the name") from error
    except IsADirectoryError as error:
        raise QsgmError(f"{path} is a folder: expected {expected}; pass a file in it") from error
    except (OSError, ValueError, MemoryError) as error:  # ValueError: a name with a null byte
        raise QsgmError(
            f"cannot read {path}: {_reason(error)}; expected {expected} that can be read"
        ) from error
    if max(size, len(data)) > most_bytes:
        raise QsgmError(
            f"{path} has {max(size, len(data)) / 1e6:.7g} MB: expected {expected} of at most "
            f"{most_bytes / 1e6:.7g} MB; pass a smaller one"
        )
    return data


def read_whole(folder: Path, load: Callable[[], Read]) -> Read:
    """What `load` makes of a folder's files; once more where the folder was replaced meanwhile.

    Raises:
        QsgmError: `load` does, of a folder that stayed as it was.
    """
    for _ in range(_TRIES):
        before = _identity(folder)
        try:
            return load()
        except QsgmError:
            if before is None:  # a replacement in two steps may have been cut short
                _sweep(folder.parent)
            looks = range(3)  # one might fall between the end of a replacement and the next
            if all(_identity(folder) == before and not _is_between(folder) for _ in looks):
                raise
            time.sleep(_PAUSE_S)
    return load()


def _is_between(folder: Path) -> bool:
    """Whether a process has taken it away and not yet put another one in its place."""
    with suppress(OSError):
        others = folder.parent.glob(".qsgm-*")
        return any((workshop / _OLD / folder.name).exists() for workshop in others)
    return False


def sha256(data: bytes) -> str:
    """Digest in hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def is_plain(name: object) -> TypeGuard[str]:
    """Whether it names a file right in its folder, and fits into a line of a message."""
    return (
        isinstance(name, str)
        and name.isprintable()
        and not re.search(r"[/\\]", name)
        and name not in ("", ".", "..")
    )


def write_text_atomic(path: Path, text: str) -> None:
    """Write a UTF-8 file; see :func:`write_bytes_atomic`."""
    write_bytes_atomic(path, text.encode("utf-8"))


def write_bytes_atomic(path: Path, data: bytes) -> None:
    """Write a file so that its name shows the old content or the new, never a part.

    Folders on the way are made. A link is followed, so that it stays a link.

    Raises:
        QsgmError: the place cannot be written to, or is something else than a file.
    """
    with new_file(path) as new:
        new.write_bytes(data)


@contextmanager
def new_file(path: Path) -> Iterator[Path]:
    """Write a temporary file that becomes `path` when the block ends without an exception.

    For what cannot be had as bytes; see :func:`write_bytes_atomic`.

    Yields:
        A name on the same disk, with the same ending, that nothing has yet.

    Raises:
        QsgmError: the place cannot be written to, or is something else than a file.
    """
    final = _resolved(path)
    try:
        if final.exists() and not final.is_file():
            raise QsgmError(f"cannot write {path}: it exists and is not a file; pass another name")
        with _workshop(final.parent) as workshop:
            new = (workshop / _NEW).with_suffix(final.suffix)
            yield new
            _sync(new)
            new.replace(final)
            _sync(final.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error


@contextmanager
def new_folder(path: Path, marker: str, *, replace: bool = True) -> Iterator[Path]:
    """Fill a temporary folder that becomes `path` when the block ends without an exception.

    Args:
        path: the folder to make. It may be absent, empty, or an earlier output of this kind.
        marker: name of a file that every folder of this kind holds and no other kind does, such as
            ``object.json``. The block has to write it.
        replace: whether an earlier output may be replaced.

    Yields:
        An empty folder on the same disk.

    Raises:
        QsgmError: `path` holds something that qsgm did not write, or cannot be written.
    """
    check_replaceable(path, marker)
    final = _resolved(path)
    try:
        with _workshop(final.parent) as workshop:
            new = workshop / _NEW
            new.mkdir()
            yield new
            if not (new / marker).is_file():
                raise ValueError(f"{path} cannot be made: {marker} was not written")
            check_replaceable(path, marker)
            _write_listing(new)
            if replace:
                _take_place(new, final)
            else:
                new.rename(final)  # which fails where there is anything by now
            _sync(final.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error


def remove_folder(path: Path, marker: str) -> None:
    """Remove a folder that qsgm wrote: whole or not at all. Of a link, the link alone.

    Raises:
        QsgmError: it holds something else, or cannot be removed.
    """
    check_replaceable(path, marker)
    place = _resolved(path.parent) / path.name
    try:
        with _workshop(place.parent) as workshop:
            place.rename(workshop / _NEW)  # a workshop is cleared, or swept by whoever comes next
            _sync(place.parent)
    except OSError as error:
        raise _cannot_write(path, error) from error


def check_replaceable(path: Path, marker: str) -> None:
    """Refuse a folder that holds anything qsgm did not write; absent and empty ones pass.

    Raises:
        QsgmError: names what stands in the way.
    """
    final = _resolved(path)
    read_whole(final, lambda: _check_replaceable(path, final, marker))


def _check_replaceable(path: Path, final: Path, marker: str) -> None:
    try:
        if not final.exists():
            return
        if not final.is_dir():
            raise QsgmError(f"cannot write {path}: expected a folder or a new name, got a file")
        foreign, empty = _foreign_entry(final), next(_entries(final), None) is None
        reason = None
        if Path.cwd().is_relative_to(final):
            reason = "it is or holds the working folder"
        elif foreign is not None:
            reason = f"qsgm did not write {foreign!r} in it"
        elif not empty and not (final / marker).is_file():
            reason = f"it holds another kind of output (no {marker})"
    except OSError as error:
        raise _cannot_write(path, error) from error
    if reason is not None:
        raise QsgmError(
            f"will not replace the folder {path}: {reason}; pass a new or an empty folder"
        )


def _foreign_entry(folder: Path) -> str | None:
    """The first thing in a folder that its listing does not name."""
    try:
        text = read_file(folder / LISTING, LISTING_BYTES, "a listing").decode()
    except (QsgmError, UnicodeDecodeError):
        text = ""
    listed = {LISTING, *(line.partition("  ")[2] for line in text.splitlines())}
    return next((name for name in _entries(folder) if name not in listed), None)


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


def _write_listing(folder: Path) -> None:
    """Write the listing in the format of ``sha256sum``, and everything to the disk."""
    names = sorted({*_entries(folder)} - {LISTING})
    lines = [f"{sha256((folder / name).read_bytes())}  {name}\n" for name in names]
    (folder / LISTING).write_text("".join(lines), encoding="utf-8")
    for path in (folder, *folder.rglob("*")):
        _sync(path)


@contextmanager
def _workshop(place: Path) -> Iterator[Path]:
    """A hidden folder in `place`, which is made; it is this process's while the block runs."""
    _make_folder(place)
    _sweep(place)
    lock, there = None, False
    while not there:  # who sweeps may take it for a stale one until it is locked
        folder = place / f".qsgm-{secrets.token_hex(8)}"
        folder.mkdir()
        with suppress(OSError):  # a system without locks: nobody can sweep there either
            lock = _lock(folder, wait=True)
        there = folder.exists()
    try:
        yield folder
    finally:
        _clear(folder)
        if lock is not None:
            os.close(lock)


def _lock(folder: Path, *, wait: bool) -> int:
    """A descriptor that holds a folder's lock until it is closed or its process ends."""
    if sys.platform == "win32":
        raise OSError("folders have no locks here")
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        os.close(descriptor)
        raise
    return descriptor


def _sweep(place: Path) -> None:
    """Clear workshops whose processes are gone, however they ended: their locks are free."""
    with suppress(OSError):
        for folder in place.glob(".qsgm-*"):
            with suppress(OSError):
                if _WORKSHOP.fullmatch(folder.name):
                    lock = _lock(folder, wait=False)
                    _clear(folder)
                    os.close(lock)


def _clear(workshop: Path) -> None:
    """Bring back what was to be replaced and was not, and remove the rest.

    A failure here must not hide what went wrong before, or undo what went well.
    """
    with suppress(OSError):
        for old in (workshop / _OLD).glob("*"):
            if not (workshop.parent / old.name).exists():
                old.rename(workshop.parent / old.name)
        _sync(workshop.parent)
    shutil.rmtree(workshop, ignore_errors=True)


def _take_place(new: Path, final: Path) -> None:
    """Give a folder its name, or let it change places with what has that name.

    Others may do the same at the same time: the last one's stays.
    """
    for last in (*[False] * _TRIES, True):
        try:
            if not final.exists():
                new.rename(final)
            elif not _exchange(new, final):
                _replace_in_two_steps(new, final)
            return
        except OSError as error:
            if last or error.errno not in _OVERTAKEN:
                raise


def _exchange(one: Path, other: Path) -> bool:
    """Let two names change places in one step; False where the system cannot."""
    import ctypes

    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (AttributeError, TypeError, OSError):
        return False
    here, exchange = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    if rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0:
        return True
    code = ctypes.get_errno()
    if code in (errno.ENOSYS, errno.EINVAL, errno.ENOTSUP):
        return False
    raise OSError(code, os.strerror(code))


def _replace_in_two_steps(new: Path, final: Path) -> None:
    """Between the steps there is nothing under the name; whatever happens, the old comes back."""
    old = new.with_name(_OLD) / final.name
    shutil.rmtree(old, ignore_errors=True)  # of a try before, in whose place there is another's now
    old.parent.mkdir(exist_ok=True)
    try:
        final.rename(old)
        new.rename(final)
    finally:
        with suppress(OSError):
            if old.exists() and not final.exists():
                old.rename(final)


def _make_folder(path: Path) -> None:
    """Make a folder and those on the way to it, all of them on the disk."""
    if not path.is_dir():
        _make_folder(path.parent)
        path.mkdir(exist_ok=True)
        _sync(path.parent)


def _sync(path: Path) -> None:
    """Write a file or the names in a folder to the disk."""
    if sys.platform == "win32":  # where only what is open for writing can be
        return
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some cannot do this with folders
            raise
    finally:
        os.close(descriptor)


def _open_harmlessly(path: str, flags: int) -> int:
    """Open without waiting for a pipe's other end, or becoming a terminal's process."""
    harmless = (getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY"))  # not everywhere
    return os.open(path, flags | sum(harmless))


def _identity(folder: Path) -> tuple[int, ...] | None:
    """What differs between a folder and one that has replaced it; None without one."""
    try:
        status = folder.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino, status.st_mtime_ns


def _resolved(path: Path) -> Path:
    try:
        place = path.resolve()
        # Links in a circle, which from Python 3.13 on are resolved to themselves.
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            place.stat()
    except (OSError, RuntimeError, ValueError) as error:  # links in a circle; a null byte
        raise _cannot_write(path, error) from error
    return place


def _cannot_write(path: Path, error: Exception) -> QsgmError:
    return QsgmError(f"cannot write {path}: {_reason(error)}; pass a place that can be written to")


def _reason(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error) or type(error).__name__).lower()
