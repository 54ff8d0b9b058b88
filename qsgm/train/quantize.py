"""Static SGMs in int8: unsigned activations, signed weights, int32 biases, float gradient out.

Every channel has a scale of its own, and none of them costs anything at run time:

1. Inputs. Channel i is mapped from [low, high] onto 0..255 by an affine map, rounded and clipped.
   Its inverse is folded into the first product: W' = W * (high - low) / 255, b' = b + W low.
2. Hidden. ReLU commutes with positive factors, so hidden_high / 255 of each channel divides its
   row of the first product and multiplies its column of the second.
3. Both u8 tensors are then left with scale 1 and zero point 0, an int32 bias has exactly its
   weight row's scale, and the gradient needs no scale at all: it leaves the last product as float.

Case 1 is exact for 1x1 kernels only: a padded kernel needs x = 0 at the border, while a u8 zero
means x = low. Larger kernels are refused.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.train.fold import FloatArray, FoldedSgm

U8_MAX = 255
S8_MAX = 127
# Half of int32; the other half is the products' and more than they can fill.
BIAS_LIMIT = 2**30
# Below this a product with the scale may become subnormal, which some CPUs flush to zero.
SMALLEST_SCALE = 1e-30
# An input counts as clipped once clipping costs it more than rounding would have.
CLIP_TOLERANCE_STEPS = 0.5

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class SgmRanges:
    """What calibration saw of one SGM: the span of each input and hidden channel."""

    input_low: FloatArray  # (Ci,)
    input_high: FloatArray  # (Ci,)
    hidden_high: FloatArray  # (H,), after ReLU


@dataclass(frozen=True)
class QuantizedProduct:
    """u8 (N, I) -> float (N, O): (x @ weight.T + bias) * scale, the sum in int32."""

    weight: NDArray[np.int8]  # (O, I)
    scale: FloatArray  # (O,)
    bias: NDArray[np.int32]  # (O,)


@dataclass(frozen=True)
class QuantizedSgm:
    """The SGM behind layer `layer`, ready for integers: u8 = round((x - low) * gain)."""

    layer: int
    input_low: FloatArray  # (Ci,)
    input_gain: FloatArray  # (Ci,), u8 steps per unit
    first: QuantizedProduct
    second: QuantizedProduct
    dead_inputs: tuple[int, ...]  # channels that calibration saw constant
    dead_hidden: tuple[int, ...]  # channels that calibration never saw above zero

    @property
    def extra_channels(self) -> int:
        """Input channels beside the activation: 3 (label) or 6 (label and last error)."""
        return int(self.first.weight.shape[1] - self.second.weight.shape[0])


def quantize_sgm(sgm: FoldedSgm, ranges: SgmRanges) -> QuantizedSgm:
    """Fold both tensors' channel scales into the weights and round those.

    Raises QsgmError for kernels larger than 1x1 and for ranges that do not fit the SGM.
    """
    if sgm.conv1_weight.shape[2:] != (1, 1) or sgm.conv2_weight.shape[2:] != (1, 1):
        raise QsgmError(
            f"the SGM behind layer {sgm.layer} has a {sgm.conv1_weight.shape[2]}x"
            f"{sgm.conv1_weight.shape[3]} kernel: only 1x1 can be quantized (layers 4 and 5);"
            " leave it in float"
        )
    weight1 = sgm.conv1_weight[:, :, 0, 0].astype(np.float64)
    weight2 = sgm.conv2_weight[:, :, 0, 0].astype(np.float64)
    check_ranges(sgm, ranges)
    span, dead_inputs = live_span(ranges.input_high.astype(np.float64) - ranges.input_low)
    hidden, dead_hidden = live_span(ranges.hidden_high.astype(np.float64))

    # The weights absorb the very gains that the graph will use, rounded to float32 as they are.
    gain = (U8_MAX / span).astype(np.float32)
    low = ranges.input_low.astype(np.float32)
    hidden_step = hidden / U8_MAX
    bias1 = sgm.conv1_bias + weight1 @ low.astype(np.float64)
    first = quantize_product(weight1 / gain / hidden_step[:, None], bias1 / hidden_step)
    second = quantize_product(weight2 * hidden_step, sgm.conv2_bias.astype(np.float64))
    return QuantizedSgm(sgm.layer, low, gain, first, second, dead_inputs, dead_hidden)


def check_ranges(sgm: FoldedSgm, ranges: SgmRanges) -> None:
    """Raise QsgmError unless the ranges fit the SGM's shapes, are finite and not reversed."""
    hidden, inputs = sgm.conv1_weight.shape[:2]
    got = ranges.input_low.shape, ranges.input_high.shape, ranges.hidden_high.shape
    if got != ((inputs,), (inputs,), (hidden,)):
        raise QsgmError(
            f"ranges for the SGM behind layer {sgm.layer} have shapes {got}, expected"
            f" {inputs} inputs twice and {hidden} hidden channels; calibrate again"
        )
    spans = np.concatenate([ranges.input_high - ranges.input_low, ranges.hidden_high])
    if not np.isfinite(spans).all() or spans.min() < 0:
        raise QsgmError(
            f"ranges for the SGM behind layer {sgm.layer} must be finite with low <= high"
            f" and hidden_high >= 0, got spans from {spans.min():g} to {spans.max():g};"
            " calibrate again"
        )


def live_span(span: Float64Array) -> tuple[Float64Array, tuple[int, ...]]:
    """Give channels that were constant the median span of the others, and name them.

    A channel silent in calibration may wake up on the device: with a span of zero it would
    either vanish or clip at once.
    """
    dead = span < SMALLEST_SCALE
    typical = 1.0 if dead.all() else float(np.median(span[~dead]))
    return np.where(dead, typical, span), tuple(int(i) for i in np.flatnonzero(dead))


def quantize_product(weight: Float64Array, bias: Float64Array) -> QuantizedProduct:
    """Round weight (O, I) to s8 with one symmetric scale per row, and the bias to int32.

    A bias far larger than its row would overflow: such a row gets a coarser scale. Its weights
    lose precision that the bias drowns anyway.
    """
    scale = np.maximum(np.abs(weight).max(axis=1) / S8_MAX, np.abs(bias) / BIAS_LIMIT)
    scale = np.maximum(scale, SMALLEST_SCALE).astype(np.float32)
    exact = scale.astype(np.float64)
    rounded = np.rint(weight / exact[:, None]).astype(np.int8)
    return QuantizedProduct(rounded, scale, np.rint(bias / exact).astype(np.int32))


def integer_forward(q: QuantizedSgm, inputs: FloatArray) -> tuple[FloatArray, float]:
    """The SGM in integer arithmetic, rounding wherever and however ONNX Runtime's QGemm does.

    Args:
        q: the quantized SGM.
        inputs: float32 (N, Ci): activation, label and, if it takes one, last error.

    Returns:
        Gradients float32 (N, C), and the fraction of inputs that lay outside their range.
    """
    gradient, _, clipped = integer_trace(q, inputs)
    return gradient, clipped


def integer_trace(
    q: QuantizedSgm, inputs: FloatArray
) -> tuple[FloatArray, NDArray[np.uint8], float]:
    """:func:`integer_forward` with the hidden tensor, u8 (N, H), between its results."""
    scaled = (inputs - q.input_low) * q.input_gain
    outside = (scaled < -CLIP_TOLERANCE_STEPS) | (scaled > U8_MAX + CLIP_TOLERANCE_STEPS)
    # ReLU is the clipping at zero: a u8 with zero point 0 holds nothing below it.
    hidden = to_u8(integer_product(q.first, to_u8(scaled)))
    return integer_product(q.second, hidden), hidden, float(outside.mean())


def to_u8(x: FloatArray) -> NDArray[np.uint8]:
    """Round half to even, then clip: scale 1, zero point 0."""
    return np.clip(np.rint(x), 0, U8_MAX).astype(np.uint8)


def integer_product(product: QuantizedProduct, x: NDArray[np.uint8]) -> FloatArray:
    """u8 (N, I) to float32 (N, O): exact in int32, then one float32 product with the scale."""
    total = x.astype(np.int32) @ product.weight.T.astype(np.int32) + product.bias
    return total.astype(np.float32) * product.scale
