"""Static SGMs in int8: u8 activations, s8 weights, int32 sums, float gradient out.

One u8 or s8 number is too coarse to keep a gradient's direction where gradients are small, so a
number may take two: a weight is 256 * coarse + fine, an activation 256 * high + low. Products of
such planes are u8 x s8 products all the same, and all but low * fine, too small to matter, are
computed. A weight always has two planes; an activation has one (8 bits) or two (16 bits). Graphs
hold s8 weights as u8 around a zero point, which is exact on every CPU (:func:`around_zero_point`).

Every channel has a scale of its own, and none of them costs anything at run time:

1. Inputs. Channel i is mapped from [low, high] onto the codes 0..255 or 0..65535 by an affine map,
   rounded and clipped. Its inverse is folded into the first product: W' = W * step, b' = b + W low.
2. Hidden. ReLU commutes with positive factors, so a channel's step divides its row of the product
   before it and multiplies its column of the product behind it.
3. All u8 tensors are then left with zero point 0, an int32 bias has exactly its product's scale,
   and the gradient needs no scale at all: it leaves the last product as float.
4. Of 16 bits, three are headroom: ranges are widened to eight times what calibration saw, so that
   activations unlike any in the calibration set do not clip.

Where SGMs see maps kernels are padded, so that zero needs a code of its own: there [low, high] is
widened until it has one (:func:`with_zero`). Weights are in their windows' order, (kh, kw, I).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.network import ONE, Pair, area
from qsgm.sgm.float import FloatArray, FoldedSgm, padded_windows
from qsgm.weights import to_step_layout

ActivationBits = Literal[8, 16]
WeightBits = Literal[4, 6, 8, 16]  # fewer than 16 leave the fine plane empty
ACTIVATION_BITS: tuple[ActivationBits, ...] = get_args(ActivationBits)
WEIGHT_BITS: tuple[WeightBits, ...] = get_args(WeightBits)
U8_MAX = 255
# One step of a coarse (high) plane in steps of the fine (low) one.
PLANE_STEPS = 256
HALF_PLANE = PLANE_STEPS // 2
# Of weights, where they are held as u8.
U8_ZERO = 128
# Half of int32; the other half is the products' and more than they can fill.
BIAS_LIMIT = 2**30
# Below this a product with the scale may become subnormal, which some CPUs flush to zero.
SMALLEST_SCALE = 1e-30
# An input counts as clipped once clipping costs it more than rounding would have.
CLIP_TOLERANCE_STEPS = 0.5
# Closer to 0 than half a step, an input is rounded to it.
UNDERFLOW_STEPS = 0.5

Float64Array = NDArray[np.float64]


@dataclass(frozen=True)
class Codes:
    """How an activation becomes u8 planes."""

    top: int  # the largest code
    headroom: int  # what calibration saw is widened by this
    high_step: int  # one step of the first plane in codes
    # Taken off every code before it is rounded. With half a step of the high plane taken off,
    # rounding gives that plane, the remainder is -128 to 128, and the low plane's zero point adds
    # the half again. (At 128 it clips: one code in 65536, at ties only.)
    shift: int


CODES: dict[ActivationBits, Codes] = {
    8: Codes(U8_MAX, headroom=1, high_step=1, shift=0),
    16: Codes(PLANE_STEPS**2 - 1, headroom=8, high_step=PLANE_STEPS, shift=HALF_PLANE),
}


@dataclass(frozen=True)
class SgmRanges:
    """What calibration saw of one SGM: the span of each input and hidden channel."""

    input_low: FloatArray  # (Ci,), the last ones of the label
    input_high: FloatArray  # (Ci,)
    hidden_high: tuple[FloatArray, ...]  # (H,) of each hidden tensor, after ReLU

    def widened(self, headroom: int, labels: int) -> "SgmRanges":
        """Ranges so many times as wide, but for the label's.

        They start at zero then, or below, and no channel has less than the typical one: where there
        are codes to spare, a channel that calibration saw silent or quiet may become loud.
        """
        if headroom == 1:
            return self
        low, high = self.input_low.copy(), self.input_high.copy()
        low[:-labels] = headroom * np.minimum(low[:-labels], 0)
        high[:-labels] = headroom * at_least_typical(high[:-labels])
        hidden = tuple(headroom * at_least_typical(tensor) for tensor in self.hidden_high)
        return SgmRanges(low, high, hidden)


def at_least_typical(high: FloatArray) -> FloatArray:
    """High ends (C,), none below the median of those above zero."""
    above = high[high > SMALLEST_SCALE]
    return np.maximum(high, np.median(above)) if len(above) else high


@dataclass(frozen=True)
class QuantizedProduct:
    """u8 windows to float (O): high @ coarse.T * coarse_scale + (rest + bias) * scale.

    The rest is high @ fine.T, and low @ coarse.T where activations have two planes. All sums are in
    int32.
    """

    coarse: NDArray[np.int8]  # (O, I)
    fine: NDArray[np.int8]  # (O, I)
    scale: FloatArray  # (O,)
    bias: NDArray[np.int32]  # (O,)

    @property
    def coarse_scale(self) -> FloatArray:
        """What one step of the coarse product stands for, (O,); exact."""
        return self.scale * np.float32(PLANE_STEPS)


@dataclass(frozen=True)
class QuantizedSgm:
    """The SGM behind layer `layer`, ready for integers: code = round((x - low) * gain)."""

    layer: int
    side: Pair  # of the maps behind that layer
    kernel: Pair  # of all its windows
    bits: ActivationBits  # of inputs and hidden tensors
    input_low: FloatArray  # (Ci,)
    input_gain: FloatArray  # (Ci,), codes per unit
    products: tuple[QuantizedProduct, ...]  # ReLU between
    dead_inputs: tuple[int, ...]  # channels that calibration saw constant
    dead_hidden: tuple[tuple[int, ...], ...]  # channels that it never saw above zero, per tensor

    @property
    def codes(self) -> Codes:
        """How inputs and hidden tensors become codes."""
        return CODES[self.bits]

    @property
    def shifted_low(self) -> FloatArray:
        """The inputs (Ci,) whose shifted code is 0."""
        return self.input_low + np.float32(self.codes.shift) / self.input_gain


def quantize_sgm(
    sgm: FoldedSgm, seen: SgmRanges, bits: ActivationBits = 16, weight_bits: WeightBits = 16
) -> QuantizedSgm:
    """Fold all tensors' channel scales into the weights and round those.

    Args:
        sgm: in float.
        seen: what calibration saw, widened here by the headroom that `bits` leave.
        bits: of inputs and hidden tensors.
        weight_bits: of weights.

    Raises:
        QsgmError: the ranges do not fit the SGM.
    """
    check_ranges(sgm, seen)
    codes = CODES[bits]
    ranges = seen.widened(codes.headroom, sgm.labels)
    low = ranges.input_low.astype(np.float32)
    span = live_span(ranges.input_high.astype(np.float64) - low)
    if sgm.kernel != ONE:
        low, span = with_zero(low, span, codes.top)
    # The weights absorb the very gains that the graph will use, rounded to float32 as they are.
    gain = (codes.top / span).astype(np.float32)
    # What one code of each tensor's channels stands for.
    steps = [1 / gain.astype(np.float64)]
    steps += [live_span(high.astype(np.float64)) / codes.top for high in ranges.hidden_high]
    products = quantize_products(sgm, low, steps, codes, weight_bits)
    return QuantizedSgm(
        sgm.layer, sgm.side, sgm.kernel, bits, low, gain, products, *dead_channels(seen)
    )


def quantize_products(
    sgm: FoldedSgm, low: FloatArray, steps: Sequence[Float64Array], codes: Codes, bits: WeightBits
) -> tuple[QuantizedProduct, ...]:
    """Every convolution in integers.

    Args:
        sgm: in float.
        low: (Ci,), the inputs whose code is 0.
        steps: what one code of the inputs' and of each hidden tensor's channels stands for.
        codes: how these tensors become planes.
        bits: of weights.
    """
    weights = [to_step_layout(conv.weight).astype(np.float64) for conv in sgm.convs]
    biases = [conv.bias.astype(np.float64) for conv in sgm.convs]
    taps = area(sgm.kernel)  # a window holds every channel so many times
    biases[0] += weights[0] @ np.tile(low.astype(np.float64), taps)
    high_steps = [np.tile(codes.high_step * step, taps) for step in steps]
    # The gradient stays what it is.
    outs = [*steps[1:], np.ones(len(biases[-1]))]
    shifts = [codes.shift] * len(steps[1:]) + [0]
    return tuple(
        quantize_product(weight * into / out[:, None], bias / out - shift, bits)
        for weight, bias, into, out, shift in zip(
            weights, biases, high_steps, outs, shifts, strict=True
        )
    )


def with_zero(low: FloatArray, span: Float64Array, top: int) -> tuple[FloatArray, Float64Array]:
    """Low ends and spans of ranges, no smaller than these, in which 0 is exactly a code 0..top.

    Activations behind a ReLU get the code 0 for it, labels from -1 to 1 the code top // 2.
    """
    low, high = np.minimum(low, 0), np.maximum(low + span, 0)
    code = np.floor(-low * top / (high - low))
    below = code > 0  # less than a step below zero is nothing that the codes could tell from zero
    low = np.where(below, low, 0).astype(np.float32)
    return low, np.where(below, -low * top / np.maximum(code, 1), high)


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


def live_span(span: Float64Array) -> Float64Array:
    """Give channels that were constant the median span of the others.

    A channel silent in calibration may wake up on the device: with a span of zero it would
    either vanish or clip at once.
    """
    dead = span < SMALLEST_SCALE
    typical = 1.0 if dead.all() else float(np.median(span[~dead]))
    return np.where(dead, typical, span)


def dead_channels(seen: SgmRanges) -> tuple[tuple[int, ...], tuple[tuple[int, ...], ...]]:
    """Inputs that calibration saw constant, and of each hidden tensor those never above zero."""
    inputs = np.flatnonzero(seen.input_high.astype(np.float64) - seen.input_low < SMALLEST_SCALE)
    hidden = (np.flatnonzero(high < SMALLEST_SCALE) for high in seen.hidden_high)
    return tuple(map(int, inputs)), tuple(tuple(map(int, dead)) for dead in hidden)


def quantize_product(
    weight: Float64Array, bias: Float64Array, bits: WeightBits = 16
) -> QuantizedProduct:
    """Round weight (O, I) to so many bits with a symmetric scale per row, the bias to int32."""
    # Weights are counted in steps of the fine plane; without one they are whole coarse steps. With
    # 127 more than 127 * 256 the coarse plane would overflow.
    step = 1 if bits == 16 else PLANE_STEPS
    top = PLANE_STEPS * (2 ** (min(bits, 8) - 1) - 1)
    scale = row_scales(weight, bias, top)
    exact = scale.astype(np.float64)
    whole = step * np.rint(weight / (step * exact[:, None]))
    coarse = np.floor((whole + HALF_PLANE) / PLANE_STEPS)
    fine = whole - PLANE_STEPS * coarse  # -128 to 127
    rounded_bias = np.rint(bias / exact).astype(np.int32)
    return QuantizedProduct(coarse.astype(np.int8), fine.astype(np.int8), scale, rounded_bias)


def row_scales(weight: Float64Array, bias: Float64Array, top: int) -> FloatArray:
    """What one step of each row of weights (O, ...) and of its bias (O,) stands for, (O,).

    The largest weight is `top` steps. A bias far larger than its row would overflow: such a row
    gets a coarser scale. Its weights lose precision that the bias drowns anyway.
    """
    largest = np.abs(weight).reshape(len(weight), -1).max(axis=1)
    scale = np.maximum(largest / top, np.abs(bias) / BIAS_LIMIT)
    large_enough: FloatArray = np.maximum(scale, SMALLEST_SCALE).astype(np.float32)
    return large_enough


def constants(q: QuantizedSgm) -> dict[str, NDArray[Any]]:
    """Everything a graph holds of an int8 SGM that depends on its ranges, by initializer name.

    With 16 bits `low_step` is a step of the low plane, and `low_zero` its zero point.
    """
    named: dict[str, NDArray[Any]] = {"low": q.shifted_low, "gain": q.input_gain}
    if q.bits == 16:
        named |= {"low_step": np.array(1, np.float32), "low_zero": np.array(HALF_PLANE, np.uint8)}
    for i, product in enumerate(q.products):
        named |= product_constants(i, product, area(q.kernel), np.float32(1))
    return {f"sgm{q.layer}/{name}": array for name, array in named.items()}


def constants_of_two_planes(q: QuantizedSgm) -> dict[str, NDArray[Any]]:
    """Constants of an 8 bit SGM for a 16 bit one's graph, where it gives the same gradients.

    Its codes become the high plane, and the low plane's steps are so long that it is zero. With it
    calibrations of 8 bits can be tried on a bundle of 16; but underflow is then counted in steps of
    16 bits.
    """
    assert q.bits == 8, "only a single plane is one of two"
    step = np.float32(PLANE_STEPS)
    named: dict[str, NDArray[Any]] = {
        "low": q.input_low,
        "gain": step * q.input_gain,
        "low_step": np.array(1 / SMALLEST_SCALE, np.float32),
        "low_zero": np.array(0, np.uint8),
    }
    for i, product in enumerate(q.products):
        last = product is q.products[-1]
        named |= product_constants(i, product, area(q.kernel), np.float32(1) if last else step)
    return {f"sgm{q.layer}/{name}": array for name, array in named.items()}


def product_constants(
    i: int, product: QuantizedProduct, taps: int, step: np.float32
) -> dict[str, NDArray[Any]]:
    """Constants of the i-th product, whose results are times `step`, by name.

    A window's channels of one tap lie together, first the fine plane's, then the coarse one's.
    """
    return {
        f"{i}/weight": around_zero_point(side_by_side(product.fine, product.coarse, taps)),
        f"{i}/scale": step * product.scale,
        f"{i}/bias": product.bias,
    }


def around_zero_point(weight: NDArray[np.int8]) -> NDArray[np.uint8]:
    """s8 weights as u8 with the zero point :data:`U8_ZERO`.

    x86 CPUs without VNNI add pairs of u8 s8 products in 16 bits, which saturate: an emulated
    Haswell gave gradients down to a cosine of 0.994 to those of a CPU with VNNI. u8 by u8 is exact
    on all of them.
    """
    return (weight.astype(np.int16) + U8_ZERO).astype(np.uint8)


def side_by_side(a: NDArray[np.int8], b: NDArray[np.int8], taps: int) -> NDArray[np.int8]:
    """Weights (O, I) of two planes of a window, tap by tap: (O, 2 * I)."""
    planes = [plane.reshape(len(plane), taps, -1) for plane in (a, b)]
    return np.concatenate(planes, axis=2).reshape(len(a), -1)


def integer_forward(q: QuantizedSgm, inputs: FloatArray) -> tuple[FloatArray, float]:
    """The SGM in integer arithmetic, rounding wherever and however ONNX Runtime's QGemm does.

    Args:
        q: the quantized SGM.
        inputs: float32 (N, P, Ci): activation and label side by side, at P positions.

    Returns:
        Gradients float32 (N, P, C), and the fraction of inputs that lay outside their range.
    """
    gradient, _, clipped = integer_trace(q, inputs)
    return gradient, clipped


def integer_trace(
    q: QuantizedSgm, inputs: FloatArray
) -> tuple[FloatArray, list[list[NDArray[np.uint8]]], float]:
    """:func:`integer_forward` and, between its results, the hidden planes, u8 (N, P, H)."""
    scaled = (inputs - q.shifted_low) * q.input_gain
    middle, reach = clipping_bounds(q.codes)
    outside = np.abs(scaled - np.float32(middle)) > reach
    frame = to_planes((0 - q.shifted_low) * q.input_gain, q.bits)
    planes = to_planes(scaled, q.bits)
    windows = [
        padded_windows(x, q.side, q.kernel, zero) for x, zero in zip(planes, frame, strict=True)
    ]
    hidden = []
    for product in q.products[:-1]:
        # ReLU is the clipping at zero: a u8 with zero point 0 holds nothing below it.
        hidden.append(to_planes(integer_product(product, windows), q.bits))
        silence = np.zeros_like(product.bias)
        windows = [padded_windows(x, q.side, q.kernel, silence) for x in hidden[-1]]
    return integer_product(q.products[-1], windows), hidden, float(outside.mean())


def underflow_fraction(q: QuantizedSgm, inputs: FloatArray) -> float:
    """Fraction of the inputs (N, P, Ci) other than 0 that is rounded to 0's code."""
    size = np.abs(inputs)
    small = (size > 0) & (size * q.input_gain < UNDERFLOW_STEPS)
    return float(small.sum() / max(1, np.count_nonzero(size)))


def clipping_bounds(codes: Codes) -> tuple[float, float]:
    """Middle of the shifted codes, and how far from it a number counts as clipped."""
    return codes.top / 2 - codes.shift, codes.top / 2 + CLIP_TOLERANCE_STEPS


def to_planes(x: FloatArray, bits: ActivationBits) -> list[NDArray[np.uint8]]:
    """Shifted codes to their planes, high before low: rounded half to even, then clipped."""
    if bits == 8:
        return [to_u8(x)]
    high = to_u8(x / np.float32(PLANE_STEPS))
    return [high, to_u8(x - np.float32(PLANE_STEPS) * high, HALF_PLANE)]


def to_u8(x: FloatArray, zero_point: int = 0) -> NDArray[np.uint8]:
    """QuantizeLinear with scale 1: round half to even, add the zero point, clip."""
    rounded: NDArray[np.uint8] = np.clip(np.rint(x) + zero_point, 0, U8_MAX).astype(np.uint8)
    return rounded


def integer_product(product: QuantizedProduct, planes: Sequence[NDArray[np.uint8]]) -> FloatArray:
    """Planes u8 (..., I) to float32 (..., O): every sum exact, rounded from there on.

    That is five times in float32: both sums, their products with the scales, added. The sums are
    integers in float64, which holds them as exactly as int32 does and has the quicker product.
    """
    high, *low = (plane.astype(np.float64) for plane in planes)
    coarse_weight = product.coarse.T.astype(np.float64)
    coarse, rest = high @ coarse_weight, high @ product.fine.T.astype(np.float64) + product.bias
    for plane in low:
        rest += plane @ coarse_weight
    scaled = coarse.astype(np.float32) * product.coarse_scale
    return scaled + rest.astype(np.float32) * product.scale
