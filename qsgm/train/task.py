"""What a task provides on the host, beside what the device needs."""

from typing import Protocol

import numpy as np

from qsgm.task import Array, Inputs, Lesson, Task


class DrawnTask(Task, Protocol):
    """A task of which lessons can be drawn: what pretraining takes."""

    def example(self, rng: np.random.Generator, count: int) -> tuple[Inputs, Array]:
        """Inputs (N, H, W, C) and labels (N, L) that the network itself is pretrained on.

        One thing shown, or class of things; everything random comes from `rng`.
        """
        ...

    def lesson(self, rng: np.random.Generator, count: int) -> Lesson:
        """A lesson of `count` samples, as a device may meet one."""
        ...
