"""A static SGM in a graph, in float and in int8.

Both take what the SGM sees, concatenated, as (B, Ci), and answer with gradients (B, C): behind
layers 4 and 5 a crop has one position, so a 1x1 convolution is a matrix product.
"""

import numpy as np

from qsgm.errors import QsgmError
from qsgm.train.fold import FoldedSgm
from qsgm.train.graphs.build import Ops, Value
from qsgm.train.graphs.layers import Batch
from qsgm.train.quantize import CLIP_TOLERANCE_STEPS, U8_MAX, QuantizedProduct, QuantizedSgm


def takes_last_error(sgm: FoldedSgm | QuantizedSgm) -> bool:
    """Whether the SGM sees each crop's last error beside its label."""
    return sgm.extra_channels > 3


def sgm_gradient(op: Ops, sgm: FoldedSgm | QuantizedSgm, after: Value, batch: Batch) -> Value:
    """The gradient (B, 1, C) that the SGM gives for an activation (B, 1, C)."""
    seen = sgm_inputs(op, sgm, after, batch)
    if isinstance(sgm, QuantizedSgm):
        gradient = int8_sgm(op, sgm, scaled_inputs(op, sgm, seen))
    else:
        gradient = float_sgm(op, sgm, seen)
    return op.Unsqueeze(gradient, op.shape(1))


def sgm_inputs(op: Ops, sgm: FoldedSgm | QuantizedSgm, after: Value, batch: Batch) -> Value:
    """Activation (B, 1, C), label and, if the SGM takes it, last error side by side: (B, Ci)."""
    seen = [op.Squeeze(after, op.shape(1)), batch.labels]
    if takes_last_error(sgm):
        assert batch.last_error is not None
        seen.append(batch.last_error)
    return op.Concat(*seen, axis=1)


def float_sgm(op: Ops, sgm: FoldedSgm, seen: Value) -> Value:
    """Product, ReLU, product. Raises QsgmError for kernels larger than 1x1."""
    if sgm.conv1_weight.shape[2:] != (1, 1):
        raise QsgmError(
            f"the SGM behind layer {sgm.layer} is not 1x1: only layers 4 and 5 have one"
        )
    weight1, weight2 = sgm.conv1_weight[:, :, 0, 0], sgm.conv2_weight[:, :, 0, 0]
    hidden = op.Gemm(seen, op.constant(weight1), op.constant(sgm.conv1_bias), transB=1)
    return op.Gemm(op.Relu(hidden), op.constant(weight2), op.constant(sgm.conv2_bias), transB=1)


def scaled_inputs(op: Ops, sgm: QuantizedSgm, seen: Value) -> Value:
    """Inputs (B, Ci) with each channel's calibrated range spread over 0..255, not rounded yet."""
    return op.Mul(op.Sub(seen, op.constant(sgm.input_low)), op.constant(sgm.input_gain))


def int8_sgm(op: Ops, sgm: QuantizedSgm, scaled: Value) -> Value:
    """Two integer products (QGemm); the second one's sum leaves as float, so it needs no scale."""
    hidden = op.Relu(int8_product(op, sgm.first, as_u8(op, scaled)))
    return int8_product(op, sgm.second, as_u8(op, hidden))


def as_u8(op: Ops, x: Value) -> Value:
    """Round to u8 with scale 1 and zero point 0, and back: what the runtime turns into integers."""
    scale, zero_point = op.constant(1.0), op.constant(0, np.uint8)
    return op.DequantizeLinear(op.QuantizeLinear(x, scale, zero_point), scale, zero_point)


def int8_product(op: Ops, product: QuantizedProduct, x: Value) -> Value:
    """x (B, I) to (B, O). The bias has the weight's scale, exactly: the input's scale is 1."""
    scale = op.constant(product.scale)
    no_offset = op.constant(np.zeros_like(product.weight[:, 0]), np.int8)
    weight = op.constant(product.weight, np.int8)
    bias = op.constant(product.bias, np.int32)
    return op.Gemm(
        x,
        op.DequantizeLinear(weight, scale, no_offset, axis=0),
        op.DequantizeLinear(bias, scale, axis=0),
        transB=1,
    )


def clipped_fraction(op: Ops, scaled: Value) -> Value:
    """Share of scaled inputs (B, Ci) further outside 0..255 than rounding explains; a scalar."""
    middle, reach = U8_MAX / 2, U8_MAX / 2 + CLIP_TOLERANCE_STEPS
    outside = op.Greater(op.Abs(op.Sub(scaled, op.constant(middle))), op.constant(reach))
    ones = op.Where(outside, op.constant(1.0), op.constant(0.0))
    return op.ReduceMean(ones, keepdims=0)
