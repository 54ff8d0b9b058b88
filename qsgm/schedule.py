"""What meta-training and the device must share: batches, momentum, how rates change over a run."""

from collections.abc import Iterator
from math import log

import numpy as np
from numpy.typing import NDArray

BATCH = 32
MOMENTUM = 0.9  # of SGD
SHORT_RUN_STEPS, LONG_RUN_STEPS = 75, 500  # 3 and 20 epochs over 800 samples


def short_run_factor(gain: float, steps: int) -> float:
    """Factor on the learning rates of a run of this length.

    `gain` up to 75 steps, 1 from 500 on, geometric between: a short run has to take large steps,
    and is over before these could lead it astray.
    """
    shortness = log(LONG_RUN_STEPS / max(1, steps)) / log(LONG_RUN_STEPS / SHORT_RUN_STEPS)
    return float(gain ** min(1.0, max(0.0, shortness)))


def rate_factor(step: int, steps: int) -> float:
    """Linear decay of all rates, from 1 at step 0 to 0 at step `steps`.

    A constant rate leaves the weights wandering about their optimum; this lets them settle.
    """
    return 1.0 - step / steps


def steps_per_epoch(count: int) -> int:
    """Batches of one pass over `count` samples."""
    return -(-count // BATCH)


def batches(count: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Rows of every batch of one epoch over `count` samples, shuffled; the last may be smaller."""
    order = rng.permutation(count)
    for start in range(0, count, BATCH):
        yield order[start : start + BATCH]
