"""The frozen layers in int8: u8 maps in, u8 maps out, s8 weights, int32 biases.

Graphs hold the weights as those of SGMs: see :func:`qsgm.sgm.int8.around_zero_point`.

As in the SGMs every channel has a scale of its own at no cost. A channel's value is its step times
its u8 code, and the weights absorb the steps of the maps on both sides. All maps are then left
with scale 1 and zero point 0, a bias has exactly its weight row's scale, and rounding to u8 is the
ReLU. The codes behind a layer are what the graphs that tune the layers behind it take as features,
whether they come from here or from the same layers in float.

The first layer sees pixels, 0 to 255, whose mean is far from zero. Their offset is therefore taken
out behind the rounding, into the bias: what rounding did to a weight then errs on pixels in
[-1, 1], as the network was trained on.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.network import NONE, ONE, Network, area
from qsgm.sgm.float import FloatArray
from qsgm.sgm.int8 import U8_MAX, live_span, row_scales
from qsgm.train.model.arrays import PIXEL_OFFSET, PIXEL_SCALE, FoldedNet

S8_MAX = 127
# An object on the device may excite a channel more than any of the calibration set did.
HEADROOM = 1.25


@dataclass(frozen=True)
class LayerRange:
    """What calibration saw of a layer: the largest value of each channel, (C,), behind ReLU."""

    convolved: FloatArray  # in front of the pool
    pooled: FloatArray  # behind it; without a pool the same


@dataclass(frozen=True)
class QuantizedLayer:
    """u8 maps (N, Ci, H, W) to u8 maps: round((x * weight + bias) * scale), clipped to 0..255."""

    weight: NDArray[np.int8]  # (Co, Ci, kh, kw)
    scale: FloatArray  # (Co,)
    bias: NDArray[np.int32]  # (Co,)
    # (Co,), where a pool follows: its codes are those summed over a window, times this, rounded.
    pool_gain: FloatArray | None


def feature_steps(ranges: Mapping[int, LayerRange]) -> dict[int, FloatArray]:
    """By layer, what one step of each channel stands for where its output is kept in u8."""
    return {number: u8_steps(seen.pooled) for number, seen in ranges.items()}


def u8_steps(high: FloatArray) -> FloatArray:
    """What one u8 step of each channel stands for, given its largest value, (C,).

    A channel that calibration never saw above zero gets the median of the others.
    """
    return (HEADROOM / U8_MAX * live_span(high.astype(np.float64))).astype(np.float32)


def quantize_trunk(net: FoldedNet, ranges: Mapping[int, LayerRange]) -> dict[int, QuantizedLayer]:
    """The layers that can be frozen, in int8, by number: up to the first without a ReLU.

    Args:
        net: on pixels in [-1, 1].
        ranges: of layer 1 and those behind it, see
            :func:`qsgm.train.quantization.trunk_ranges.observe_trunk`.
    """
    if not has_int8_trunk(net.network):
        return {}
    # A channel's value is `step` times what its code has above `zero`.
    step, zero = np.full(net.layers[0].weight.shape[1], PIXEL_SCALE), -PIXEL_OFFSET / PIXEL_SCALE
    layers: dict[int, QuantizedLayer] = {}
    for number, seen in sorted(ranges.items()):
        if number != len(layers) + 1:  # what lies before it has no codes
            break
        folded, layer = net.layers[number - 1], net.network.layer(number)
        # The weights absorb the very steps that the graphs use, rounded to float32 as they are.
        out, pooled = (u8_steps(high).astype(np.float64) for high in (seen.convolved, seen.pooled))
        steps = step[:, None, None] / out[:, None, None, None]
        weight, scale, bias = round_rows(folded.weight * steps, folded.bias / out)
        shift = np.rint(zero * weight.sum(axis=(1, 2, 3), dtype=np.int32)).astype(np.int32)
        gain = None if layer.pool == ONE else (out / pooled / area(layer.pool)).astype(np.float32)
        layers[number] = QuantizedLayer(weight, scale, bias - shift, gain)
        step, zero = pooled, 0.0
    return layers


def has_int8_trunk(network: Network) -> bool:
    """Whether the frozen layers can run in integers.

    Pixels are codes already, other inputs are not; and a first layer that is padded sees zeros
    where pixels have no code for one.
    """
    return network.input_kind == "pixels" and network.layer(1).padding == NONE


def round_rows(
    weight: NDArray[np.float64], bias: NDArray[np.float64]
) -> tuple[NDArray[np.int8], FloatArray, NDArray[np.int32]]:
    """Weight (Co, Ci, kh, kw) in s8, the scale of each of its rows (Co,), bias (Co,) in int32."""
    scale = row_scales(weight, bias, S8_MAX)
    exact = scale.astype(np.float64)
    rounded = np.rint(weight / exact[:, None, None, None]).astype(np.int8)
    return rounded, scale, np.rint(bias / exact).astype(np.int32)
