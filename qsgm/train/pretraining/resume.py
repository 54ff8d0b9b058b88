"""Unfinished pretraining, kept beside its output so that the same command goes on with it.

The file is a SHA-256 digest and behind it what torch wrote: bytes that have changed are noticed,
and an unfinished pretraining that is damaged counts as none.
"""

import hashlib
from io import BytesIO
from math import isfinite
from pathlib import Path
from time import perf_counter
from typing import Any

import torch

from qsgm.files import read_file, write_bytes_atomic

LARGEST_BYTES = 2**30
_DIGEST_BYTES = hashlib.sha256().digest_size


class Partial:
    """What is done so far: a dictionary in a file that belongs to one seed and configuration."""

    def __init__(
        self, path: Path, identity: dict[str, Any], data: dict[str, Any], spent_s: float = 0.0
    ) -> None:
        self.path, self.identity, self.data = path, identity, data
        self.resumed = bool(data)
        self._began = perf_counter() - spent_s

    @staticmethod
    def open(output: Path, identity: dict[str, Any]) -> "Partial":
        """Take up `<output>.partial` if whole and of the same identity, else start from nothing."""
        path = output.with_name(output.name + ".partial")
        return Partial(path, identity, *_read(path, identity))

    @property
    def seconds(self) -> float:
        """Time spent so far, before interruptions too."""
        return perf_counter() - self._began

    def save(self, **parts: Any) -> None:
        """Add or replace parts; `None` drops one."""
        self.data |= parts
        self.data = {name: part for name, part in self.data.items() if part is not None}
        buffer = BytesIO()
        whole = {"identity": self.identity, "data": self.data, "seconds": self.seconds}
        torch.save(whole, buffer)
        body = buffer.getvalue()
        write_bytes_atomic(self.path, hashlib.sha256(body).digest() + body)

    def remove(self) -> None:
        """Forget it all; the output is written."""
        self.path.unlink(missing_ok=True)


def _read(path: Path, identity: dict[str, Any]) -> tuple[dict[str, Any], float]:
    """Data and seconds that :meth:`Partial.save` wrote; none if it is not exactly that."""
    try:
        content = read_file(path, LARGEST_BYTES, "an unfinished pretraining")
        digest, body = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if hashlib.sha256(body).digest() == digest:
            saved = torch.load(BytesIO(body), map_location="cpu", weights_only=True)
            if saved["identity"] == identity and isfinite(saved["seconds"]):
                return dict(saved["data"]), float(saved["seconds"])
    except Exception:  # someone else's file, whatever is wrong with it
        return {}, 0.0
    return {}, 0.0
