"""Ranges for u8 features and the int8 trunk: the frozen layers on the calibration set's crops.

They stay as they are while other layers are tuned, so crops are enough: no run is needed. Values
are looked at and dropped; one frame is in memory at a time.
"""

from collections.abc import Iterator

import numpy as np
import torch

from qsgm.progress import Progress
from qsgm.task import Inputs
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import run_folded_layer
from qsgm.train.model.net import as_seen
from qsgm.train.quantization.lessons import Lessons
from qsgm.train.quantization.trunk import LayerRange

SAMPLES = 200  # of each lesson


def observe_trunk(
    net: FoldedNet, lessons: Lessons, seed: int, watch: Progress
) -> dict[int, LayerRange]:
    """Ranges of every layer that can be frozen, 1 to 5, by number.

    Args:
        net: the untouched network, on pixels in [-1, 1].
        lessons: the calibration set.
        seed: of the crops.
        watch: told about every frame.

    Raises:
        QsgmError: a frame cannot be used.
    """
    total: dict[int, LayerRange] = {}
    for i in range(len(lessons)):
        watch("features", i, len(lessons))
        samples = lessons.samples(i, np.random.default_rng([seed, i]), SAMPLES)
        for number, seen in observe_samples(net, samples):
            total[number] = join(total[number], seen) if number in total else seen
    watch("features", len(lessons), len(lessons))
    return total


def observe_samples(net: FoldedNet, samples: Inputs) -> Iterator[tuple[int, LayerRange]]:
    """Number and range of every layer with a ReLU but the last, on samples (N, H, W, C)."""
    x = as_seen(net.network, torch.from_numpy(samples))
    for number in range(1, net.network.depth):
        convolved, x = run_folded_layer(net, number, x)
        if net.network.layer(number).relu:
            yield number, LayerRange(*(maps.amax((0, 2, 3)).numpy() for maps in (convolved, x)))


def join(one: LayerRange, other: LayerRange) -> LayerRange:
    """What covers both."""
    return LayerRange(
        np.maximum(one.convolved, other.convolved), np.maximum(one.pooled, other.pooled)
    )
