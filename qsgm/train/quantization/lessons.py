"""What quantization asks of a calibration set."""

from typing import Protocol

import numpy as np

from qsgm.task import Inputs, Lesson


class Lessons(Protocol):
    """Lessons to calibrate on, one at a time."""

    def __len__(self) -> int: ...

    @property
    def sha256(self) -> str:
        """Digest of everything in it."""
        ...

    def lesson(self, i: int, rng: np.random.Generator, count: int) -> Lesson:
        """The i-th lesson with `count` samples, to be fine-tuned on."""
        ...

    def samples(self, i: int, rng: np.random.Generator, count: int) -> Inputs:
        """Inputs (N, H, W, C) as the device makes them of the i-th lesson."""
        ...
