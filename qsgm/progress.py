"""How long work tells its progress."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol

NO_FIGURES: Mapping[str, float] = MappingProxyType({})


class Progress(Protocol):
    """Told about every step of long work."""

    def __call__(
        self, stage: str, done: int, of: int, figures: Mapping[str, float] = NO_FIGURES, /
    ) -> None:
        """A stage's name, how much of it is done, out of how much, and figures worth showing."""
        ...


def ignore(
    _stage: str, _done: int, _of: int, _figures: Mapping[str, float] = NO_FIGURES, /
) -> None:
    """Watch nothing."""
