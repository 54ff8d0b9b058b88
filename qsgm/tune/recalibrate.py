"""New activation scales on the device, from the object's own crops: no labels, no onnx, no run.

What the int8 SGMs would see is known before the first step: activations of the untouched network,
and any label. The float SGMs, which a bundle holds as plain arrays, give what hidden channels make
of those; SGMs are then quantized again, and their constants take the place of the graphs' own.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.bundle import Bundle
from qsgm.sgm.float import FloatArray, FoldedSgm, float_trace
from qsgm.sgm.int8 import (
    LABEL_HIGH,
    LABEL_LOW,
    LABELS,
    ActivationBits,
    SgmRanges,
    constants,
    quantize_sgm,
)

# Activations grow while layers learn. 16 bits have their headroom for that.
GROWTH: dict[ActivationBits, float] = {8: 1.5, 16: 1.0}
# Of a negative, and of positives at every eighth of the circle that sine and cosine go round.
_ANGLES = np.arange(8) * np.pi / 4
ANY_LABEL = np.array(
    [[0, 0, 0], *([1, np.sin(angle), np.cos(angle)] for angle in _ANGLES)], np.float32
)
# Positions whose windows are in memory at once.
POSITIONS = 4096


def recalibrated(
    bundle: Bundle, activations: Mapping[int, FloatArray]
) -> dict[int, dict[str, NDArray[Any]]]:
    """Constants of the int8 SGMs behind some layers, for what these layers give on an object.

    Args:
        bundle: gives the float SGMs.
        activations: by layer, (N, P, C), of the object's crops.

    Returns:
        By layer, arrays by initializer name.
    """
    exchanged: dict[int, dict[str, NDArray[Any]]] = {}
    for layer, activation in activations.items():
        sgm, bits = bundle.float_sgm(layer), bundle.activation_bits(layer)
        ranges = grown(ranges_of(sgm, activation), GROWTH[bits])
        exchanged[layer] = constants(quantize_sgm(sgm, ranges, bits))
    return exchanged


def ranges_of(sgm: FoldedSgm, activation: FloatArray) -> SgmRanges:
    """What an SGM sees and holds if any of these activations (N, P, C) comes with any label."""
    count, positions, channels = activation.shape
    at_once = max(1, POSITIONS // positions)
    highs = [np.zeros(len(conv.bias), np.float32) for conv in sgm.convs[:-1]]
    for label in ANY_LABEL:
        seen = np.empty((count, positions, channels + len(label)), np.float32)
        seen[..., :channels], seen[..., channels:] = activation, label
        for first in range(0, count, at_once):
            _, hidden = float_trace(sgm, seen[first : first + at_once])
            highs = [
                np.maximum(high, tensor.max(axis=(0, 1)))
                for high, tensor in zip(highs, hidden, strict=True)
            ]
    return SgmRanges(
        np.concatenate([activation.min(axis=(0, 1)), LABEL_LOW]),
        np.concatenate([activation.max(axis=(0, 1)), LABEL_HIGH]),
        tuple(highs),
    )


def grown(ranges: SgmRanges, factor: float) -> SgmRanges:
    """Ranges with the high ends of activations and hidden tensors so many times as high."""
    high = ranges.input_high.copy()
    high[:-LABELS] *= factor
    hidden = tuple(factor * tensor for tensor in ranges.hidden_high)
    return replace(ranges, input_high=high, hidden_high=hidden)
