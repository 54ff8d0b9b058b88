"""Static SGMs in int8: u8 activations, weights of two s8 planes, int32 biases, float gradient out.

Every channel has a scale of its own, and none of them costs anything at run time:

1. Inputs. Channel i is mapped from [low, high] onto 0..255 by an affine map, rounded and clipped.
   Its inverse is folded into the first product: W' = W * (high - low) / 255, b' = b + W low.
2. Hidden. ReLU commutes with positive factors, so hidden_high / 255 of each channel divides its
   row of the product before it and multiplies its column of the product behind it.
3. All u8 tensors are then left with scale 1 and zero point 0, an int32 bias has exactly its
   weight row's scale, and the gradient needs no scale at all: it leaves the last product as float.
4. Folded-in scales spread a row's weights so far apart that one s8 plane would cost more than all
   activations' rounding together. A second plane holds what the first one rounded away.

Behind layers 1 to 3 kernels are padded, so that zero needs a code of its own: there [low, high] is
widened until it has one (:func:`with_zero`). Weights are in their windows' order, (kh, kw, I).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.train.fold import FloatArray, FoldedSgm
from qsgm.weights import to_step_layout

U8_MAX = 255
S8_MAX = 127
# How many steps of the fine plane make one of the coarse plane. Rounding leaves half a step at
# most, so the fine plane never holds more than 127: nothing clips.
FINE_STEPS = 2 * S8_MAX
# Half of int32; the other half is the products' and more than they can fill.
BIAS_LIMIT = 2**30
# Below this a product with the scale may become subnormal, which some CPUs flush to zero.
SMALLEST_SCALE = 1e-30
# An input counts as clipped once clipping costs it more than rounding would have.
CLIP_TOLERANCE_STEPS = 0.5

Float64Array = NDArray[np.float64]
Number = TypeVar("Number", np.uint8, np.float32)


@dataclass(frozen=True)
class SgmRanges:
    """What calibration saw of one SGM: the span of each input and hidden channel."""

    input_low: FloatArray  # (Ci,)
    input_high: FloatArray  # (Ci,)
    hidden_high: tuple[FloatArray, ...]  # (H,) of each hidden tensor, after ReLU


@dataclass(frozen=True)
class QuantizedProduct:
    """u8 windows (I) -> float (O): (x @ weight.T + bias) * scale + (x @ fine.T) * fine_scale.

    Both sums are in int32. Together the planes give a weight 16 bits, sign included, while each
    takes part in a u8 x s8 product. The bias can do with the coarse scale: what rounding costs
    it, once per row, is far less than what rounding costs the row's inputs.
    """

    weight: NDArray[np.int8]  # (O, I), coarse
    fine: NDArray[np.int8]  # (O, I), what rounding to the coarse plane left
    scale: FloatArray  # (O,)
    bias: NDArray[np.int32]  # (O,)

    @property
    def fine_scale(self) -> FloatArray:
        """What one step of the fine plane stands for, (O,)."""
        return self.scale / np.float32(FINE_STEPS)


@dataclass(frozen=True)
class QuantizedSgm:
    """The SGM behind layer `layer`, ready for integers: u8 = round((x - low) * gain)."""

    layer: int
    kernel: int  # side of all its windows
    input_low: FloatArray  # (Ci,)
    input_gain: FloatArray  # (Ci,), u8 steps per unit
    products: tuple[QuantizedProduct, ...]  # ReLU between
    dead_inputs: tuple[int, ...]  # channels that calibration saw constant
    dead_hidden: tuple[tuple[int, ...], ...]  # channels that it never saw above zero, per tensor


def quantize_sgm(sgm: FoldedSgm, ranges: SgmRanges) -> QuantizedSgm:
    """Fold all tensors' channel scales into the weights and round those.

    Raises QsgmError for ranges that do not fit the SGM.
    """
    check_ranges(sgm, ranges)
    low = ranges.input_low.astype(np.float32)
    span, dead_inputs = live_span(ranges.input_high.astype(np.float64) - low)
    if sgm.kernel > 1:
        low, span = with_zero(low, span)
    hidden = [live_span(high.astype(np.float64)) for high in ranges.hidden_high]

    weights = [to_step_layout(conv.weight).astype(np.float64) for conv in sgm.convs]
    biases = [conv.bias.astype(np.float64) for conv in sgm.convs]
    taps = sgm.kernel**2  # a window holds every channel so many times
    biases[0] += weights[0] @ np.tile(low.astype(np.float64), taps)
    # The weights absorb the very gains that the graph will use, rounded to float32 as they are.
    gain = (U8_MAX / span).astype(np.float32)
    # What one step of each tensor's channels stands for; the gradient stays what it is.
    steps = [1 / gain.astype(np.float64), *(high / U8_MAX for high, _ in hidden)]
    steps.append(np.ones(len(weights[-1])))
    products = (
        quantize_product(weight * np.tile(into, taps) / out[:, None], bias / out)
        for weight, bias, into, out in zip(weights, biases, steps, steps[1:], strict=False)
    )
    dead_hidden = tuple(dead for _, dead in hidden)
    return QuantizedSgm(sgm.layer, sgm.kernel, low, gain, tuple(products), dead_inputs, dead_hidden)


def with_zero(low: FloatArray, span: Float64Array) -> tuple[FloatArray, Float64Array]:
    """Low ends and spans of ranges, no smaller than these, in which 0 is exactly a u8 code.

    Activations behind a ReLU get the code 0 for it, labels from -1 to 1 the code 127.
    """
    low, high = np.minimum(low, 0), np.maximum(low + span, 0)
    code = np.floor(-low * U8_MAX / (high - low))
    below = code > 0  # less than a step below zero is nothing that int8 could tell from zero
    low = np.where(below, low, 0).astype(np.float32)
    return low, np.where(below, -low * U8_MAX / np.maximum(code, 1), high)


def check_ranges(sgm: FoldedSgm, ranges: SgmRanges) -> None:
    """Raise QsgmError unless the ranges fit the SGM's shapes, are finite and not reversed."""
    inputs, hidden = sgm.convs[0].weight.shape[1], [len(conv.bias) for conv in sgm.convs[:-1]]
    got = shapes([ranges.input_low, ranges.input_high, *ranges.hidden_high])
    if got != [(inputs,), (inputs,), *((width,) for width in hidden)]:
        raise QsgmError(
            f"ranges for the SGM behind layer {sgm.layer} have shapes {got}, expected"
            f" {inputs} inputs twice and {hidden} hidden channels; calibrate again"
        )
    spans = np.concatenate([ranges.input_high - ranges.input_low, *ranges.hidden_high])
    if not np.isfinite(spans).all() or spans.min() < 0:
        raise QsgmError(
            f"ranges for the SGM behind layer {sgm.layer} must be finite with low <= high"
            f" and hidden_high >= 0, got spans from {spans.min():g} to {spans.max():g};"
            " calibrate again"
        )


def shapes(arrays: Sequence[FloatArray]) -> list[tuple[int, ...]]:
    """Every array's shape."""
    return [array.shape for array in arrays]


def live_span(span: Float64Array) -> tuple[Float64Array, tuple[int, ...]]:
    """Give channels that were constant the median span of the others, and name them.

    A channel silent in calibration may wake up on the device: with a span of zero it would
    either vanish or clip at once.
    """
    dead = span < SMALLEST_SCALE
    typical = 1.0 if dead.all() else float(np.median(span[~dead]))
    return np.where(dead, typical, span), tuple(int(i) for i in np.flatnonzero(dead))


def quantize_product(weight: Float64Array, bias: Float64Array) -> QuantizedProduct:
    """Round weight (O, I) to two s8 planes with one symmetric scale per row, the bias to int32.

    A bias far larger than its row would overflow: such a row gets a coarser scale. Its weights
    lose precision that the bias drowns anyway.
    """
    scale = np.maximum(np.abs(weight).max(axis=1) / S8_MAX, np.abs(bias) / BIAS_LIMIT)
    scale = np.maximum(scale, SMALLEST_SCALE).astype(np.float32)
    exact = scale.astype(np.float64)
    steps = weight / exact[:, None]
    coarse = np.rint(steps)
    fine = np.rint((steps - coarse) * FINE_STEPS)
    rounded_bias = np.rint(bias / exact).astype(np.int32)
    return QuantizedProduct(coarse.astype(np.int8), fine.astype(np.int8), scale, rounded_bias)


def integer_forward(q: QuantizedSgm, inputs: FloatArray) -> tuple[FloatArray, float]:
    """The SGM in integer arithmetic, rounding wherever and however ONNX Runtime's QGemm does.

    Args:
        q: the quantized SGM.
        inputs: float32 (N, P, Ci): activation and label side by side, at P positions of a square.

    Returns:
        Gradients float32 (N, P, C), and the fraction of inputs that lay outside their range.
    """
    gradient, _, clipped = integer_trace(q, inputs)
    return gradient, clipped


def integer_trace(
    q: QuantizedSgm, inputs: FloatArray
) -> tuple[FloatArray, list[NDArray[np.uint8]], float]:
    """:func:`integer_forward` with the hidden tensors, u8 (N, P, H), between its results."""
    scaled = (inputs - q.input_low) * q.input_gain
    outside = (scaled < -CLIP_TOLERANCE_STEPS) | (scaled > U8_MAX + CLIP_TOLERANCE_STEPS)
    zero = to_u8((0 - q.input_low) * q.input_gain)
    x, hidden = padded_windows(to_u8(scaled), q.kernel, zero), []
    for product in q.products[:-1]:
        # ReLU is the clipping at zero: a u8 with zero point 0 holds nothing below it.
        hidden.append(to_u8(integer_product(product, x)))
        x = padded_windows(hidden[-1], q.kernel, np.zeros_like(product.bias))
    return integer_product(q.products[-1], x), hidden, float(outside.mean())


def to_u8(x: FloatArray) -> NDArray[np.uint8]:
    """Round half to even, then clip: scale 1, zero point 0."""
    return np.clip(np.rint(x), 0, U8_MAX).astype(np.uint8)


def padded_windows(x: NDArray[Number], kernel: int, frame: NDArray[Any]) -> NDArray[Number]:
    """Every position's window (N, P, kernel * kernel * C) of square maps (N, P, C).

    Around the maps every position holds `frame` (C,). For 1x1 they are returned as they are.
    """
    if kernel == 1:
        return x
    count, positions, channels = x.shape
    side, pad = round(positions**0.5), kernel // 2
    framed = np.tile(frame.astype(x.dtype), (count, side + 2 * pad, side + 2 * pad, 1))
    framed[:, pad:-pad, pad:-pad] = x.reshape(count, side, side, channels)
    windows = np.lib.stride_tricks.sliding_window_view(framed, (kernel, kernel), axis=(1, 2))
    return windows.transpose(0, 1, 2, 4, 5, 3).reshape(count, positions, -1)


def integer_product(product: QuantizedProduct, x: NDArray[np.uint8]) -> FloatArray:
    """u8 (..., I) to float32 (..., O): each plane's sum exact, rounded from there on.

    That is four times in float32: both sums, their products with the scales, added. The sums are
    integers in float64, which holds them as exactly as int32 does and has the quicker product.
    """
    wide = x.astype(np.float64)
    coarse = wide @ product.weight.T.astype(np.float64) + product.bias
    fine = wide @ product.fine.T.astype(np.float64)
    scaled = coarse.astype(np.float32) * product.scale
    return scaled + fine.astype(np.float32) * product.fine_scale
