"""Something happens before every file operation of a block, half-way through every write, too."""

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from qsgm import files

_AUDITED = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir")
_listening: list[Callable[[], None]] = []


def _event() -> None:
    for heard in _listening:
        heard()


def _audit(event: str, _: Any) -> None:
    if _listening and event in _AUDITED:
        _event()


def _write_in_halves(path: Path, data: bytes) -> int:
    with path.open("wb") as file:
        file.write(data[: len(data) // 2])
        file.flush()
        _event()
        return file.write(data[len(data) // 2 :])


def _write_text(path: Path, text: str, encoding: str = "utf-8") -> int:
    return _write_in_halves(path, text.encode(encoding))


def watch() -> None:
    """From here on; what has been put in place stays until the process ends."""
    sys.addaudithook(_audit)
    fsync, exchange = os.fsync, files._exchange

    def eventful_fsync(descriptor: int) -> None:
        _event()
        fsync(descriptor)

    def eventful_exchange(one: Path, other: Path) -> bool:
        _event()
        done = exchange(one, other)
        _event()
        return done

    os.fsync = eventful_fsync
    files._exchange = eventful_exchange
    Path.write_bytes = _write_in_halves  # type: ignore[assignment, method-assign]
    Path.write_text = _write_text  # type: ignore[assignment, method-assign]


@contextmanager
def heard_by(act: Callable[[], None]) -> Iterator[None]:
    """Call `act` before every event in this block; what it does is no event itself."""

    def once() -> None:
        _listening.clear()
        try:
            act()
        finally:
            _listening.append(once)

    _listening.append(once)
    try:
        yield
    finally:
        _listening.clear()
