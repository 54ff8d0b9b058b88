"""`signalled.py SIGNAL NUMBER ARGUMENTS`: qsgm, and a signal when a module is looked for.

The number is how many look-ups there are before it; one that is never reached is no signal.
"""

import os
import signal
import sys
from collections.abc import Sequence
from types import ModuleType

from qsgm.cli import main


class Finder:
    """Finds nothing; counts."""

    def __init__(self, name: str, left: int) -> None:
        self.name, self.left = name, left

    def find_spec(self, _: str, path: Sequence[str] | None, target: ModuleType | None) -> None:  # noqa: ARG002
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.Signals[self.name])


name, number, *arguments = sys.argv[1:]
sys.meta_path.insert(0, Finder(name, int(number)))  # type: ignore[arg-type]
sys.argv = ["qsgm", *arguments]
main()
