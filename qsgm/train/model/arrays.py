"""A network without batchnorm as plain arrays, which is what graphs are built of.

No torch in here: whoever builds or slims graphs does without it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from qsgm.network import Network
from qsgm.sgm.float import FloatArray, FoldedConv

# A pixel is seen as value / range - 1.
PIXEL_RANGE = 127.5
PIXEL_SCALE = 1 / PIXEL_RANGE
PIXEL_OFFSET = -1.0


@dataclass(frozen=True)
class FoldedNet:
    """All layers; the first takes pixels in [-1, 1]."""

    network: Network
    layers: tuple[FoldedConv, ...]
    # By layer, (Co,): what one step of each channel stands for where its output is kept in u8, see
    # :mod:`qsgm.train.quantization.trunk`. Features of a layer that is not here are float32.
    feature_steps: Mapping[int, FloatArray] = field(default_factory=dict)


@dataclass(frozen=True)
class CurvatureArrays:
    """What a layer's gradient is multiplied by; see :mod:`qsgm.train.model.curvature`."""

    window: FloatArray  # (kh * kw, kh * kw)
    into: FloatArray  # (Ci, Ci)
    out: FloatArray  # (Co, Co)
    bias: FloatArray  # (Co, Co)


# No layer has a curvature: plain gradient descent.
FLAT_ARRAYS: Mapping[int, CurvatureArrays] = MappingProxyType({})


def on_pixels(net: FoldedNet) -> FoldedNet:
    """A network that takes raw pixel values, 0 to 255: its first layer normalises them.

    For one whose first layer is not padded: every window then sees the same offset. Only where that
    layer is frozen; tuned it sees pixels in [-1, 1], as in pretraining, since the same rate means
    other steps on raw pixels.
    """
    first = net.layers[0]
    weight = first.weight.astype(np.float64)
    bias = first.bias + PIXEL_OFFSET * weight.sum(axis=(1, 2, 3))
    absorbed = FoldedConv((weight * PIXEL_SCALE).astype(np.float32), bias.astype(np.float32))
    return replace(net, layers=(absorbed, *net.layers[1:]))
