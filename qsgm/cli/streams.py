"""Standard streams, whatever they are connected to; imports nothing that takes time to load."""

import io
import os
import select
import sys
from contextlib import suppress
from typing import Any

from qsgm.errors import QsgmError, as_text

EXIT_NOBODY_READS = 141  # as of a process that SIGPIPE ends


class _Stdout(io.FileIO):
    """Standard output that says once, and in one line, that it cannot be written to."""

    def __init__(self) -> None:
        super().__init__(1, "w", closefd=False)
        self._broken = False

    def write(self, data: Any, /) -> int:
        if self._broken:
            return len(data)
        left = memoryview(data)
        try:
            while left:
                left = left[super().write(left) or 0 :]
                if left:  # part of it, or nothing yet where it does not block
                    select.select((), (self,), ())
            return len(data)
        except OSError as error:
            self._broken = True
            if isinstance(error, BrokenPipeError):
                raise SystemExit(EXIT_NOBODY_READS) from error
            raise QsgmError(
                f"cannot write to standard output: {str(error.strerror).lower()}; what was asked "
                "for is done, connect it to something else to read of it"
            ) from error


def use_streams() -> None:
    """Make standard streams safe to use: closed, full, in ASCII, or with nobody at the end.

    A closed one becomes the null device, lest the next file that is opened gets its number.
    """
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    if sys.stdout is not None:
        # Nothing in between: a buffer whose writing is interrupted does not know how much of it
        # went out, and says it again when the process ends.
        sys.stdout = io.TextIOWrapper(
            _Stdout(),
            encoding=sys.stdout.encoding,
            errors="backslashreplace",
            write_through=True,
        )


def complain(message: str) -> None:
    """One line on stderr, whatever a file's name may hold."""
    with suppress(OSError, ValueError):  # nobody listens
        print(as_text(message, 10_000), file=sys.stderr, flush=True)  # noqa: T201
