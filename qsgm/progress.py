"""How long work tells its progress."""

import itertools
from collections.abc import Callable, Mapping
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


def counted(watch: Progress, stage: str, of: int) -> Callable[..., None]:
    """A function that tells, whenever it is called, that one more of so many is done.

    It takes figures worth showing, or nothing.
    """
    numbers = itertools.count(1)

    def tell(figures: Mapping[str, float] = NO_FIGURES) -> None:
        watch(stage, next(numbers), of, figures)

    return tell
