"""A static SGM in a graph, in float and in int8.

Both take what the SGM sees, a map position by position, (B, P, Ci), and answer with gradients
(B, P, C). Behind layers 4 and 5 a crop has one position, so a 1x1 convolution is a matrix product.
Behind layers 1 to 3 they differ: in float the weights are constants, so that a Conv is quickest;
ONNX Runtime has no integer Conv with a float result, so int8 cuts windows for a matrix product.
"""

import numpy as np
from numpy.typing import NDArray

from qsgm.train.fold import FloatArray, FoldedSgm
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.graphs.layers import Batch, gather_windows
from qsgm.train.quantize import CLIP_TOLERANCE_STEPS, U8_MAX, QuantizedProduct, QuantizedSgm


def sgm_gradient(
    op: Ops, sgm: FoldedSgm | QuantizedSgm, side: int, after: Value, batch: Batch
) -> Value:
    """The gradient (B, P, C) that the SGM gives for an activation of as many, P = side * side."""
    seen = sgm_inputs(op, after, side, batch)
    if isinstance(sgm, QuantizedSgm):
        return int8_sgm(op, sgm, side, seen)
    return float_sgm(op, sgm, side, seen)


def sgm_inputs(op: Ops, after: Value, side: int, batch: Batch) -> Value:
    """Activation (B, P, C) and label, the same at every position, side by side: (B, P, Ci)."""
    labels = op.Unsqueeze(batch.labels, op.shape(1))
    return op.Concat(after, op.Expand(labels, op.shape(1, side**2, 1)), axis=2)


def float_sgm(op: Ops, sgm: FoldedSgm, side: int, seen: Value) -> Value:
    """Inputs (B, P, Ci) through all convolutions, with ReLU between: (B, P, C)."""
    inputs, channels = sgm.convs[0].weight.shape[1], len(sgm.convs[-1].bias)
    if sgm.kernel == 1:
        x = op.Reshape(seen, op.shape(-1, inputs))
        for i, conv in enumerate(sgm.convs):
            weight, bias = op.constant(conv.weight[:, :, 0, 0]), op.constant(conv.bias)
            x = op.Gemm(op.Relu(x) if i else x, weight, bias, transB=1)
        return op.Reshape(x, op.shape(-1, side**2, channels))
    x = op.Transpose(op.Reshape(seen, op.shape(-1, side, side, inputs)), perm=(0, 3, 1, 2))
    for i, conv in enumerate(sgm.convs):
        weight, bias = op.constant(conv.weight), op.constant(conv.bias)
        x = op.Conv(op.Relu(x) if i else x, weight, bias, pads=[sgm.kernel // 2] * 4)
    return op.Reshape(op.Transpose(x, perm=(0, 2, 3, 1)), op.shape(-1, side**2, channels))


def int8_sgm(op: Ops, sgm: QuantizedSgm, side: int, seen: Value) -> Value:
    """Integer products (QGemm); the last one's sum leaves as float, so it needs no scale.

    ReLU costs no node: rounding to u8 clips at zero. Padding is real zeros in front of the first
    product, where they have a code of their own, and the code 0 in front of the others.
    """
    x = op.Reshape(seen, op.shape(-1, len(sgm.input_low)))
    x = as_u8(op, scaled_inputs(op, sgm, padded(op, x, side, sgm.kernel, len(sgm.input_low))))
    for product in sgm.products[:-1]:
        hidden = as_u8(op, int8_product(op, product, u8_windows(op, x, side, sgm.kernel, product)))
        x = padded(op, hidden, side, sgm.kernel, len(product.bias))
    last = sgm.products[-1]
    gradient = int8_product(op, last, u8_windows(op, x, side, sgm.kernel, last))
    return op.Reshape(gradient, op.shape(-1, side**2, len(last.bias)))


def padded(op: Ops, x: Value, side: int, kernel: int, channels: int) -> Value:
    """Positions (B * P, C) of square maps with zeros around them, (B, P', C); for 1x1 as they are.

    Numbers of either type: of float32 a real zero, of u8 the code 0.
    """
    if kernel == 1:
        return x
    pad = kernel // 2
    maps = op.Reshape(x, op.shape(-1, side, side, channels))
    framed = op.Pad(maps, op.shape(0, pad, pad, 0, 0, pad, pad, 0))
    return op.Reshape(framed, op.shape(-1, (side + 2 * pad) ** 2, channels))


def scaled_inputs(op: Ops, sgm: QuantizedSgm, seen: Value) -> Value:
    """Inputs (..., Ci) with each channel's calibrated range spread over 0..255, not rounded yet."""
    return op.Mul(op.Sub(seen, op.constant(sgm.input_low)), op.constant(sgm.input_gain))


def as_u8(op: Ops, x: Value) -> Value:
    """Round to u8 with scale 1 and zero point 0."""
    return op.QuantizeLinear(x, op.constant(1.0), op.constant(0, np.uint8))


def u8_windows(op: Ops, x: Value, side: int, kernel: int, product: QuantizedProduct) -> Value:
    """Windows (B * P, K) of :func:`padded` u8 maps, as what the runtime turns into integers."""
    if kernel > 1:
        windows = gather_windows(op, x, side + 2 * (kernel // 2), kernel, stride=1)
        x = op.Reshape(windows, op.shape(-1, product.weight.shape[1]))
    return op.DequantizeLinear(x, op.constant(1.0), op.constant(0, np.uint8))


def int8_product(op: Ops, product: QuantizedProduct, x: Value) -> Value:
    """Windows (B * P, I) to (B * P, O), both planes added as float.

    The bias has the coarse plane's scale, exactly: the input's scale is 1.
    """
    bias, scale = op.constant(product.bias, np.int32), op.constant(product.scale)
    bias = op.DequantizeLinear(bias, scale, axis=0)
    coarse = op.Gemm(x, s8_plane(op, product.weight, product.scale), bias, transB=1)
    fine = op.Gemm(x, s8_plane(op, product.fine, product.fine_scale), transB=1)
    return op.Add(coarse, fine)


def s8_plane(op: Ops, plane: NDArray[np.int8], scale: FloatArray) -> Value:
    """Weights (O, I) with a scale per row, as the runtime wants to see them.

    Weights and zero points are not shared between planes, equal or not: where the runtime makes
    them u8 (see :mod:`qsgm.runtime`) it refuses to convert the same constant twice.
    """
    name = f"{op.scope}/s8_plane_{len(op.graph.constants)}"
    weight = op.graph.initializer(name, plane)
    no_offset = op.graph.initializer(f"{name}_zero_point", np.zeros_like(plane[:, 0]))
    return op.DequantizeLinear(weight, op.constant(scale), no_offset, axis=0)


def clipped_fraction(op: Ops, scaled: Value) -> Value:
    """Share of scaled inputs further outside 0..255 than rounding explains; a scalar."""
    middle, reach = U8_MAX / 2, U8_MAX / 2 + CLIP_TOLERANCE_STEPS
    outside = op.Greater(op.Abs(op.Sub(scaled, op.constant(middle))), op.constant(reach))
    ones = op.Where(outside, op.constant(1.0), op.constant(0.0))
    return op.ReduceMean(ones, keepdims=0)
