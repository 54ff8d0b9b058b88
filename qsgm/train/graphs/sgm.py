"""A static SGM in a graph, in float and in int8.

Both take what the SGM sees, a row per sample and position, (B * P, Ci), and answer with gradients
(B * P, C). Where a sample has one position a 1x1 convolution is a matrix product. Where it has maps
they differ: in float the weights are constants, so that a Conv is quickest;
ONNX Runtime has no integer Conv with a float result, so int8 cuts windows for a matrix product.
"""

import numpy as np

from qsgm.network import ONE, Pair, area
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import (
    PLANE_STEPS,
    U8_ZERO,
    UNDERFLOW_STEPS,
    QuantizedProduct,
    QuantizedSgm,
    clipping_bounds,
    constants,
)
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.graphs.layers import at_every_position, gather_windows

# Places of the planes of a weight.
FINE, COARSE = range(2)


def sgm_gradient(
    op: Ops, sgm: FoldedSgm | QuantizedSgm, after: Value, labels: Value, count: int
) -> Value:
    """The gradient (B * P, C) for an activation of as many, and labels (B, L), L = `count`."""
    seen = sgm_inputs(op, after, sgm.side, labels, count)
    return int8_sgm(op, sgm, seen) if isinstance(sgm, QuantizedSgm) else float_sgm(op, sgm, seen)


def sgm_inputs(op: Ops, after: Value, side: Pair, labels: Value, count: int) -> Value:
    """Activation (B * P, C) and label, the same at every position: side by side, (B * P, Ci)."""
    if area(side) > 1:
        labels = at_every_position(op, labels, area(side), count)
    return op.Concat(after, labels, axis=1)


def float_sgm(op: Ops, sgm: FoldedSgm, seen: Value) -> Value:
    """Inputs (B * P, Ci) through all convolutions, with ReLU between: (B * P, C)."""
    inputs, channels = sgm.convs[0].weight.shape[1], len(sgm.convs[-1].bias)
    x = seen
    if sgm.kernel == ONE:
        for i, conv in enumerate(sgm.convs):
            weight, bias = op.constant(conv.weight[:, :, 0, 0]), op.constant(conv.bias)
            x = op.Gemm(op.Relu(x) if i else x, weight, bias, transB=1)
        return x
    x = op.Transpose(op.Reshape(seen, op.shape(-1, *sgm.side, inputs)), perm=(0, 3, 1, 2))
    pads = [side // 2 for side in sgm.kernel] * 2
    for i, conv in enumerate(sgm.convs):
        weight, bias = op.constant(conv.weight), op.constant(conv.bias)
        x = op.Conv(op.Relu(x) if i else x, weight, bias, pads=pads)
    return op.Reshape(op.Transpose(x, perm=(0, 2, 3, 1)), op.shape(-1, channels))


def int8_sgm(op: Ops, sgm: QuantizedSgm, seen: Value) -> Value:
    """Integer products (QGemm); the last one's sum leaves as float, so it needs no scale.

    ReLU costs no node: rounding to u8 clips at zero. Padding is real zeros in front of the first
    product, where they have a code of their own, and the code 0 in front of the others.
    """
    declare_constants(op, sgm)
    x = scaled_inputs(op, sgm, padded(op, seen, sgm.side, sgm.kernel, len(sgm.input_low)))
    planes = as_planes(op, sgm, x)
    for i, product in enumerate(sgm.products):
        if i > 0:
            planes = framed_planes(op, sgm, x, len(sgm.products[i - 1].bias))
        width = product.coarse.shape[1]
        widths = width, width * sgm.bits // 8
        high, both = (
            u8_windows(op, u8, sgm, width) for u8, width in zip(planes, widths, strict=True)
        )
        x = int8_product(op, f"sgm{sgm.layer}/{i}", product, sgm, high, both)
    return x


def padded(op: Ops, x: Value, side: Pair, kernel: Pair, channels: int) -> Value:
    """Positions (B * P, C) of maps with zeros around them, (B, P', C); for 1x1 as they are.

    Numbers of either type: of float32 a real zero, of u8 the code 0.
    """
    if kernel == ONE:
        return x
    up, left = (length // 2 for length in kernel)
    maps = op.Reshape(x, op.shape(-1, *side, channels))
    framed = op.Pad(maps, op.shape(0, up, left, 0, 0, up, left, 0))
    return op.Reshape(framed, op.shape(-1, area(framed_side(side, kernel)), channels))


def framed_side(side: Pair, kernel: Pair) -> Pair:
    """Sides of maps with as many zeros around them as a window reaches out."""
    height, width = (length + 2 * (reach // 2) for length, reach in zip(side, kernel, strict=True))
    return height, width


def declare_constants(op: Ops, sgm: QuantizedSgm) -> None:
    """Everything that depends on ranges, under its own name: another calibration exchanges it."""
    for name, array in constants(sgm).items():
        op.graph.initializer(name, array)


def scaled_inputs(op: Ops, sgm: QuantizedSgm, seen: Value) -> Value:
    """Inputs (..., Ci) as shifted codes, neither rounded nor clipped yet."""
    low, gain = f"sgm{sgm.layer}/low", f"sgm{sgm.layer}/gain"
    return op.Mul(op.Sub(seen, low), gain)


def as_planes(op: Ops, sgm: QuantizedSgm, x: Value) -> tuple[Value, Value]:
    """Shifted codes (..., C) to their high plane u8 (..., C), and to all planes side by side."""
    step, nothing = op.constant(float(sgm.codes.high_step)), op.constant(0, np.uint8)
    high = op.QuantizeLinear(x, step, nothing)
    if sgm.bits == 8:
        return high, high
    remainder = op.Sub(x, op.DequantizeLinear(high, step, nothing))
    low = op.QuantizeLinear(remainder, f"sgm{sgm.layer}/low_step", f"sgm{sgm.layer}/low_zero")
    return high, op.Concat(high, low, axis=-1)


def framed_planes(op: Ops, sgm: QuantizedSgm, hidden: Value, channels: int) -> tuple[Value, Value]:
    """The planes of hidden maps (B * P, C), with the code 0 around them where they are maps."""
    high, both = as_planes(op, sgm, hidden)
    return (
        padded(op, high, sgm.side, sgm.kernel, channels),
        padded(op, both, sgm.side, sgm.kernel, channels * sgm.bits // 8),
    )


def u8_windows(op: Ops, x: Value, sgm: QuantizedSgm, width: int) -> Value:
    """Windows (B * P, width) of :func:`padded` u8 maps, as what the runtime turns into integers."""
    if sgm.kernel != ONE:
        windows = gather_windows(op, x, framed_side(sgm.side, sgm.kernel), sgm.kernel, ONE)
        x = op.Reshape(windows, op.shape(-1, width))
    return op.DequantizeLinear(x, op.constant(1.0), op.constant(0, np.uint8))


def int8_product(
    op: Ops, name: str, product: QuantizedProduct, sgm: QuantizedSgm, high: Value, both: Value
) -> Value:
    """Windows of the high plane and of all planes to (B * P, O).

    `name` is what the product's constants begin with. The bias has the scale of what it is added
    to, exactly: that input's scale is 1.
    """
    # What the runtime folds has to be where it finds constants: outside of any loop.
    outside, weight, scale = op.outside(), f"{name}/weight", f"{name}/scale"
    coarse = weight_plane(outside, weight, product, area(sgm.kernel), COARSE)
    coarse_scale = outside.Mul(scale, op.constant(float(PLANE_STEPS)))
    first = op.Gemm(high, s8_weight(op, coarse, coarse_scale, product), transB=1)
    if sgm.bits == 8:
        weight = weight_plane(outside, weight, product, area(sgm.kernel), FINE)
    bias = op.DequantizeLinear(f"{name}/bias", scale, axis=0)
    rest = op.Gemm(both, s8_weight(op, weight, scale, product), bias, transB=1)
    return op.Add(first, rest)


def weight_plane(op: Ops, both: Value, product: QuantizedProduct, taps: int, plane: int) -> Value:
    """One plane (O, I) of a product's weights, of which both lie side by side, (O, 2 * I)."""
    rows, width = product.fine.shape
    planes = op.Reshape(both, op.shape(rows, taps, 2, width // taps))
    one = op.Slice(planes, op.shape(plane), op.shape(plane + 1), op.shape(2))
    return op.Reshape(one, op.shape(rows, width))


def s8_weight(op: Ops, weight: Value, scale: Value, product: QuantizedProduct) -> Value:
    """s8 weights, held as u8 around a zero point, with a scale per row."""
    zero_point = op.constant(np.full(len(product.bias), U8_ZERO), np.uint8)
    return op.DequantizeLinear(weight, scale, zero_point, axis=0)


def clipped_fraction(op: Ops, sgm: QuantizedSgm, scaled: Value) -> Value:
    """Share of scaled inputs further outside their codes than rounding explains; a scalar."""
    middle, reach = clipping_bounds(sgm.codes)
    outside = op.Greater(op.Abs(op.Sub(scaled, op.constant(middle))), op.constant(reach))
    return op.ReduceMean(as_float(op, outside), keepdims=0)


def underflow_fraction(op: Ops, sgm: QuantizedSgm, seen: Value) -> Value:
    """Share of the inputs other than 0 that is rounded to 0; a scalar."""
    size, nothing = op.Abs(seen), op.constant(0.0)
    there = op.Greater(size, nothing)
    below = op.Less(op.Mul(size, f"sgm{sgm.layer}/gain"), op.constant(UNDERFLOW_STEPS))
    lost = op.ReduceSum(as_float(op, op.And(there, below)), keepdims=0)
    count = op.ReduceSum(as_float(op, there), keepdims=0)
    return op.Div(lost, op.Max(count, op.constant(1.0)))


def as_float(op: Ops, flag: Value) -> Value:
    """1 where a flag is set, else 0."""
    return op.Where(flag, op.constant(1.0), op.constant(0.0))
