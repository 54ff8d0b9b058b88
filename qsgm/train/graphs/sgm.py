"""A static SGM in a graph, in float and in int8.

Both take what the SGM sees, concatenated, as (B, Ci), and answer with gradients (B, C): behind
layers 4 and 5 a crop has one position, so a 1x1 convolution is a matrix product.
"""

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.train.fold import FloatArray, FoldedConv, FoldedSgm
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.graphs.layers import Batch
from qsgm.train.quantize import CLIP_TOLERANCE_STEPS, U8_MAX, QuantizedProduct, QuantizedSgm


def sgm_gradient(op: Ops, sgm: FoldedSgm | QuantizedSgm, after: Value, batch: Batch) -> Value:
    """The gradient (B, 1, C) that the SGM gives for an activation (B, 1, C)."""
    seen = sgm_inputs(op, after, batch)
    if isinstance(sgm, QuantizedSgm):
        gradient = int8_sgm(op, sgm, scaled_inputs(op, sgm, seen))
    else:
        gradient = float_sgm(op, sgm, seen)
    return op.Unsqueeze(gradient, op.shape(1))


def sgm_inputs(op: Ops, after: Value, batch: Batch) -> Value:
    """Activation (B, 1, C) and label side by side: (B, Ci)."""
    return op.Concat(op.Squeeze(after, op.shape(1)), batch.labels, axis=1)


def float_sgm(op: Ops, sgm: FoldedSgm, seen: Value) -> Value:
    """Products with ReLU between. Raises QsgmError for kernels larger than 1x1."""
    x = float_product(op, sgm, sgm.convs[0], seen)
    for conv in sgm.convs[1:]:
        x = float_product(op, sgm, conv, op.Relu(x))
    return x


def float_product(op: Ops, sgm: FoldedSgm, conv: FoldedConv, x: Value) -> Value:
    """x (B, I) to (B, O)."""
    if conv.weight.shape[2:] != (1, 1):
        raise QsgmError(
            f"the SGM behind layer {sgm.layer} is not 1x1: only layers 4 and 5 have one"
        )
    return op.Gemm(x, op.constant(conv.weight[:, :, 0, 0]), op.constant(conv.bias), transB=1)


def scaled_inputs(op: Ops, sgm: QuantizedSgm, seen: Value) -> Value:
    """Inputs (B, Ci) with each channel's calibrated range spread over 0..255, not rounded yet."""
    return op.Mul(op.Sub(seen, op.constant(sgm.input_low)), op.constant(sgm.input_gain))


def int8_sgm(op: Ops, sgm: QuantizedSgm, scaled: Value) -> Value:
    """Integer products (QGemm); the last one's sum leaves as float, so it needs no scale.

    ReLU costs no node: rounding to u8 clips at zero.
    """
    x = scaled
    for product in sgm.products:
        x = int8_product(op, product, as_u8(op, x))
    return x


def as_u8(op: Ops, x: Value) -> Value:
    """Round to u8 with scale 1 and zero point 0, and back: what the runtime turns into integers."""
    scale, zero_point = op.constant(1.0), op.constant(0, np.uint8)
    return op.DequantizeLinear(op.QuantizeLinear(x, scale, zero_point), scale, zero_point)


def int8_product(op: Ops, product: QuantizedProduct, x: Value) -> Value:
    """x (B, I) to (B, O), both planes added as float.

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
    """Share of scaled inputs (B, Ci) further outside 0..255 than rounding explains; a scalar."""
    middle, reach = U8_MAX / 2, U8_MAX / 2 + CLIP_TOLERANCE_STEPS
    outside = op.Greater(op.Abs(op.Sub(scaled, op.constant(middle))), op.constant(reach))
    ones = op.Where(outside, op.constant(1.0), op.constant(0.0))
    return op.ReduceMean(ones, keepdims=0)
