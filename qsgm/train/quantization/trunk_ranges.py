"""Ranges for u8 features and the int8 trunk: the frozen layers on the calibration set's crops.

They stay as they are while other layers are tuned, so crops are enough: no run is needed. Values
are looked at and dropped; one frame is in memory at a time.
"""

from collections.abc import Iterator

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from qsgm.grasp import source
from qsgm.train.model.fold import FoldedNet
from qsgm.train.model.graspnet import normalize
from qsgm.train.pretraining.tasks import shipped_things
from qsgm.train.quantization.calibration_set import CalibrationSet, Demonstration, Watch
from qsgm.train.quantization.trunk import LayerRange

CROPS = 200  # of each frame


def observe_trunk(
    net: FoldedNet, frames: CalibrationSet, seed: int, watch: Watch
) -> dict[int, LayerRange]:
    """Ranges of every layer that can be frozen, 1 to 5, by number.

    Args:
        net: the untouched network, on pixels in [-1, 1].
        frames: the calibration set.
        seed: of the crops.
        watch: told about every frame.

    Raises:
        QsgmError: a frame cannot be used.
    """
    total: dict[int, LayerRange] = {}
    for i in range(len(frames)):
        watch("features", i, len(frames))
        crops = calibration_crops(frames[i], np.random.default_rng([seed, i]))
        for number, seen in observe_crops(net, crops):
            total[number] = join(total[number], seen) if number in total else seen
    watch("features", len(frames), len(frames))
    return total


def calibration_crops(demonstration: Demonstration, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Crops (N, 128, 128, 3) of one frame, as the device cuts them."""
    shown = source.Demonstration(demonstration.image, demonstration.center_px)
    return source.crop_source([shown], shipped_things(), rng, CROPS).cut(np.arange(CROPS))


def observe_crops(net: FoldedNet, crops: NDArray[np.uint8]) -> Iterator[tuple[int, LayerRange]]:
    """Number and range of every layer but the last, in order, on crops (N, 128, 128, 3)."""
    x = normalize(torch.from_numpy(crops))
    for number, layer in enumerate(net.layers[:-1], 1):
        weight, bias = torch.from_numpy(layer.weight), torch.from_numpy(layer.bias)
        convolved = F.relu(F.conv2d(x, weight, bias, layer.stride))
        x = F.avg_pool2d(convolved, layer.pool, stride=1)
        yield number, LayerRange(*(maps.amax((0, 2, 3)).numpy() for maps in (convolved, x)))


def join(one: LayerRange, other: LayerRange) -> LayerRange:
    """What covers both."""
    return LayerRange(
        np.maximum(one.convolved, other.convolved), np.maximum(one.pooled, other.pooled)
    )
