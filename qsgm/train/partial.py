"""Unfinished pretraining, kept beside its output so that the same command goes on with it."""

import pickle
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from qsgm.files import write_bytes_atomic


class Partial:
    """What is done so far: a dictionary in a file that belongs to one seed and configuration."""

    def __init__(self, path: Path, identity: dict[str, Any], data: dict[str, Any]) -> None:
        self.path, self.identity, self.data = path, identity, data
        self.resumed = bool(data)

    @staticmethod
    def open(output: Path, identity: dict[str, Any]) -> "Partial":
        """Take up `<output>.partial` if it is of the same identity, else start from nothing."""
        path = output.with_name(output.name + ".partial")
        try:
            saved = torch.load(path, map_location="cpu", weights_only=True)
        except (OSError, RuntimeError, pickle.UnpicklingError, EOFError):
            saved = None
        same = isinstance(saved, dict) and saved.get("identity") == identity
        return Partial(path, identity, saved["data"] if same else {})

    def save(self, **parts: Any) -> None:
        """Add or replace parts; `None` drops one."""
        self.data |= parts
        self.data = {name: part for name, part in self.data.items() if part is not None}
        buffer = BytesIO()
        torch.save({"identity": self.identity, "data": self.data}, buffer)
        write_bytes_atomic(self.path, buffer.getvalue())

    def remove(self) -> None:
        """Forget it all; the output is written."""
        self.path.unlink(missing_ok=True)
