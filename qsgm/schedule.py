"""What meta-training and the device must share: batches, momentum, how rates change over a run."""

from collections.abc import Iterator
from itertools import pairwise
from math import log

import numpy as np
from numpy.typing import NDArray

BATCH = 32
MOMENTUM = 0.9  # of SGD
SHORT_RUN_STEPS, LONG_RUN_STEPS = 75, 500  # 3 and 20 epochs over 800 samples

# (steps, factor): what runs of some lengths multiply their learning rates with, the shortest first.
Gains = tuple[tuple[int, float], ...]


def short_run(gain: float) -> Gains:
    """Gains of a task whose lengths nobody says: `gain` up to 75 steps, 1 from 500 on."""
    return ((SHORT_RUN_STEPS, gain), (LONG_RUN_STEPS, 1.0))


def gain_over(gains: Gains, steps: int) -> float:
    """Factor on the learning rates of a run of this length, geometric between known lengths.

    A short run has to take large steps, and is over before these could lead it astray. A run that
    is shorter or longer than all known ones takes what the nearest of them does.
    """
    if not gains:
        return 1.0
    if steps <= gains[0][0]:
        return gains[0][1]
    for (short, first), (long, second) in pairwise(gains):
        if steps <= long:
            shortness = log(long / steps) / log(long / short)
            return float(second * (first / second) ** shortness)
    return gains[-1][1]


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
