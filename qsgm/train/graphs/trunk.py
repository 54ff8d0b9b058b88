"""The network with constant weights: samples to features, and to activated outputs."""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, TensorProto

from qsgm.errors import QsgmError
from qsgm.network import NONE, ONE, area
from qsgm.sgm.int8 import U8_ZERO, around_zero_point
from qsgm.task import Heads
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.train.graphs.layers import features_dtype, normalized
from qsgm.train.graphs.loss import activate
from qsgm.train.model.arrays import FoldedNet, on_pixels
from qsgm.train.quantization.trunk import QuantizedLayer


def trunk_model(net: FoldedNet, last_frozen: int) -> ModelProto:
    """`samples` (N, H, W, C) to `features` (N, P, C), position by position.

    Samples are u8 pixels or float32 numbers, as the network has them. The features are the output
    of layer `last_frozen`: u8 where the network has steps for it, else float32. For 0, where
    nothing is frozen, they are the samples.
    """
    graph = Graph("trunk")
    x, op = declare_samples(graph, net), graph.within("trunk")
    if last_frozen > 0:
        x = op.Transpose(x, perm=(0, 3, 1, 2))
        frozen = net
        if net.network.input_kind == "pixels":
            x = op.Cast(x, to=TensorProto.FLOAT)
            if net.network.layer(1).padding == NONE:
                # Not normalised in the graph: that takes a third as long again as the whole trunk.
                frozen = on_pixels(net)
            else:
                x = normalized(op, x)
        for number in range(1, last_frozen + 1):
            x = constant_layer(graph, frozen, number, x)
        x = op.Transpose(rounded(op, net, last_frozen, x), perm=(0, 2, 3, 1))
    report_features(graph, net, last_frozen, x)
    return graph.model()


def int8_trunk_model(
    net: FoldedNet, layers: Mapping[int, QuantizedLayer], last_frozen: int
) -> ModelProto:
    """The frozen layers in integers: `samples` to u8 `features` with the same steps.

    Args:
        net: with steps for layer `last_frozen`.
        layers: all up to `last_frozen`, by number.
        last_frozen: at least 1.
    """
    graph = Graph("trunk")
    x = graph.within("trunk").Transpose(declare_samples(graph, net), perm=(0, 3, 1, 2))
    for number in range(1, last_frozen + 1):
        x = int8_layer(graph.within(f"layer{number}"), net, number, layers[number], x)
    x = graph.within("trunk").Transpose(x, perm=(0, 2, 3, 1))
    report_features(graph, net, last_frozen, x)
    return graph.model()


def declare_samples(graph: Graph, net: FoldedNet) -> Value:
    """The input `samples` (N, H, W, C)."""
    dtype = np.uint8 if net.network.input_kind == "pixels" else np.float32
    return graph.input("samples", dtype, ("samples", *net.network.input_shape))


def report_features(graph: Graph, net: FoldedNet, last_frozen: int, maps: Value) -> None:
    """Declare the output `features` (N, P, C), from maps (N, H, W, C)."""
    op, dtype, network = graph.within("trunk"), features_dtype(net, last_frozen), net.network
    shape = network.positions_before(last_frozen + 1), network.layer(last_frozen + 1).into
    features = op.Reshape(maps, op.shape(-1, *shape))
    graph.output("features", features, dtype, ("samples", *shape))


def rounded(op: Ops, net: FoldedNet, last_frozen: int, x: Value) -> Value:
    """Maps (N, C, H, W) as u8 codes, where the network has steps for them."""
    if last_frozen not in net.feature_steps:
        return x
    steps = net.feature_steps[last_frozen]
    zero_point = op.constant(np.zeros(len(steps)), np.uint8)
    return op.QuantizeLinear(x, op.constant(steps), zero_point, axis=1)


def int8_layer(op: Ops, net: FoldedNet, number: int, layer: QuantizedLayer, x: Value) -> Value:
    """u8 maps (N, Ci, H, W) to u8 maps: what ONNX Runtime makes one QLinearConv of, and a pool.

    ReLU costs no node: rounding to u8 clips at zero.
    """
    scale, one = op.constant(layer.scale), net.network.layer(number)
    weight = op.constant(around_zero_point(layer.weight), np.uint8)
    zero_point = op.constant(np.full(len(layer.weight), U8_ZERO), np.uint8)
    padding = {} if one.padding == NONE else {"pads": [*one.padding, *one.padding]}
    summed = op.Conv(
        from_u8(op, x),
        op.DequantizeLinear(weight, scale, zero_point, axis=0),
        op.DequantizeLinear(op.constant(layer.bias, np.int32), scale, axis=0),
        kernel_shape=one.kernel,
        strides=one.stride,
        **padding,
    )
    codes = as_u8(op, summed)
    if layer.pool_gain is None:
        return codes
    gain = op.constant(layer.pool_gain[:, None, None])
    if net.network.pools_all(number):  # sums of codes are exact in float32
        return as_u8(op, op.Mul(op.ReduceSum(from_u8(op, codes), op.shape(2, 3), keepdims=1), gain))
    mean = op.AveragePool(from_u8(op, codes), kernel_shape=one.pool, strides=one.pool_stride)
    return as_u8(op, op.Mul(mean, op.Mul(gain, op.constant(float(area(one.pool))))))


def as_u8(op: Ops, x: Value) -> Value:
    """Round to u8 codes with scale 1 and zero point 0; what is below zero becomes 0."""
    return op.QuantizeLinear(x, op.constant(1.0), op.constant(0, np.uint8))


def from_u8(op: Ops, codes: Value) -> Value:
    """The codes as float32, which the runtime takes for what it is: integers."""
    return op.DequantizeLinear(codes, op.constant(1.0), op.constant(0, np.uint8))


def network_model(net: FoldedNet, heads: Heads) -> ModelProto:
    """`frame` (H, W, C) of any size to `heatmap` (O, rows, cols) of activated outputs.

    A frame as large as a sample gives one row and column. Every layer's weights are initializers,
    `weight{k}` (Co, Ci, kh, kw) and `bias{k}`; see :func:`initializer_offsets`.
    """
    graph = Graph("network")
    pixels = net.network.input_kind == "pixels"
    shape = ("height", "width", net.network.input_shape[2])
    frame = graph.input("frame", np.uint8 if pixels else np.float32, shape)
    op = graph.within("frame")
    x = op.Unsqueeze(op.Transpose(frame, perm=(2, 0, 1)), op.shape(0))
    if pixels:
        x = normalized(op, op.Cast(x, to=TensorProto.FLOAT))
    for number in range(1, len(net.layers) + 1):
        x = constant_layer(graph, net, number, x)
    heatmap = op.Squeeze(activate(op, heads, x), op.shape(0))
    graph.output("heatmap", heatmap, np.float32, (net.network.outputs, "rows", "cols"))
    return graph.model()


def constant_layer(graph: Graph, net: FoldedNet, number: int, x: Value) -> Value:
    """Convolution, ReLU and average pool of layer `number` on (N, Ci, H, W)."""
    layer, op = net.network.layer(number), graph.within(f"layer{number}")
    arrays = net.layers[number - 1]
    weight = graph.initializer(f"weight{number}", arrays.weight)
    bias = graph.initializer(f"bias{number}", arrays.bias)
    padding = {} if layer.padding == NONE else {"pads": [*layer.padding, *layer.padding]}
    x = op.Conv(x, weight, bias, kernel_shape=layer.kernel, strides=layer.stride, **padding)
    x = op.Relu(x) if layer.relu else x
    if layer.pool == ONE:
        return x
    strides = {} if layer.pool_stride == ONE else {"strides": layer.pool_stride}
    return op.AveragePool(x, kernel_shape=layer.pool, **strides)


def initializer_offsets(model_bytes: bytes) -> dict[str, tuple[int, int]]:
    """Where each initializer's raw bytes lie in a serialized model: name to (offset, bytes).

    With these a device can exchange weights in the file without the onnx package. Raises
    QsgmError unless every initializer is found exactly once, with its data in raw_data.
    """
    model = ModelProto.FromString(model_bytes)
    offsets = {}
    for tensor in model.graph.initializer:
        # The whole tensor holds its name, so it occurs once even if two hold equal numbers.
        whole, raw = tensor.SerializeToString(), tensor.raw_data
        inside = whole.rfind(raw) if raw else -1
        if inside < 0 or model_bytes.count(whole) != 1:
            raise QsgmError(
                f"initializer {tensor.name!r} cannot be located in the model's bytes: its data must"
                " be in raw_data; save the model as onnx serializes it, without external data"
            )
        offsets[tensor.name] = model_bytes.index(whole) + inside, len(raw)
    return offsets
