"""The network with constant weights: crops to features, a whole frame to its heatmap."""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, TensorProto

from qsgm.errors import QsgmError
from qsgm.grasp.angles import AngleEncoding
from qsgm.sgm.int8 import U8_ZERO, around_zero_point
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.train.graphs.layers import CROP_SIDE, features_dtype, input_side, normalized
from qsgm.train.graphs.loss import activate
from qsgm.train.model.fold import FoldedNet, on_pixels
from qsgm.train.quantization.trunk import QuantizedLayer


def trunk_model(net: FoldedNet, last_frozen: int) -> ModelProto:
    """`crops` uint8 (N, 128, 128, 3) BGR to `features` (N, P, C), position by position.

    The features are the output of layer `last_frozen`: u8 where the network has steps for it, else
    float32. For 0, where nothing is frozen, they are the pixels, u8.
    """
    graph = Graph("trunk")
    x, op = declare_crops(graph), graph.within("trunk")
    if last_frozen > 0:
        x = op.Cast(op.Transpose(x, perm=(0, 3, 1, 2)), to=TensorProto.FLOAT)
        # Not normalised in the graph: that would take a third as long again as the whole trunk.
        frozen = on_pixels(net)
        for number in range(1, last_frozen + 1):
            x = constant_layer(graph, frozen, number, x)
        x = op.Transpose(rounded(op, net, last_frozen, x), perm=(0, 2, 3, 1))
    report_features(graph, net, last_frozen, x)
    return graph.model()


def int8_trunk_model(
    net: FoldedNet, layers: Mapping[int, QuantizedLayer], last_frozen: int
) -> ModelProto:
    """The same in integers, from `crops` to u8 `features` with the same steps.

    Args:
        net: with steps for layer `last_frozen`.
        layers: all up to `last_frozen`, by number.
        last_frozen: at least 1.
    """
    graph = Graph("trunk")
    x = graph.within("trunk").Transpose(declare_crops(graph), perm=(0, 3, 1, 2))
    for number in range(1, last_frozen + 1):
        x = int8_layer(graph.within(f"layer{number}"), layers[number], x)
    x = graph.within("trunk").Transpose(x, perm=(0, 2, 3, 1))
    report_features(graph, net, last_frozen, x)
    return graph.model()


def declare_crops(graph: Graph) -> Value:
    """The input `crops`, uint8 (N, 128, 128, 3) BGR."""
    return graph.input("crops", np.uint8, ("crops", CROP_SIDE, CROP_SIDE, 3))


def report_features(graph: Graph, net: FoldedNet, last_frozen: int, maps: Value) -> None:
    """Declare the output `features` (N, P, C), from maps (N, H, W, C)."""
    op, dtype = graph.within("trunk"), features_dtype(net, last_frozen)
    shape = input_side(net, last_frozen + 1) ** 2, net.layers[last_frozen].weight.shape[1]
    graph.output("features", op.Reshape(maps, op.shape(-1, *shape)), dtype, ("crops", *shape))


def rounded(op: Ops, net: FoldedNet, last_frozen: int, x: Value) -> Value:
    """Maps (N, C, H, W) as u8 codes, where the network has steps for them."""
    if last_frozen not in net.feature_steps:
        return x
    steps = net.feature_steps[last_frozen]
    zero_point = op.constant(np.zeros(len(steps)), np.uint8)
    return op.QuantizeLinear(x, op.constant(steps), zero_point, axis=1)


def int8_layer(op: Ops, layer: QuantizedLayer, x: Value) -> Value:
    """u8 maps (N, Ci, H, W) to u8 maps: what ONNX Runtime makes one QLinearConv of, and a pool.

    ReLU costs no node: rounding to u8 clips at zero.
    """
    scale = op.constant(layer.scale)
    weight = op.constant(around_zero_point(layer.weight), np.uint8)
    zero_point = op.constant(np.full(len(layer.weight), U8_ZERO), np.uint8)
    summed = op.Conv(
        from_u8(op, x),
        op.DequantizeLinear(weight, scale, zero_point, axis=0),
        op.DequantizeLinear(op.constant(layer.bias, np.int32), scale, axis=0),
        kernel_shape=layer.weight.shape[2:],
        strides=(layer.stride, layer.stride),
    )
    codes = as_u8(op, summed)
    if layer.pool_gain is None:
        return codes
    # Of a crop, the pool covers the whole map. Sums of codes are exact in float32.
    total = op.ReduceSum(from_u8(op, codes), op.shape(2, 3), keepdims=1)
    return as_u8(op, op.Mul(total, op.constant(layer.pool_gain[:, None, None])))


def as_u8(op: Ops, x: Value) -> Value:
    """Round to u8 codes with scale 1 and zero point 0; what is below zero becomes 0."""
    return op.QuantizeLinear(x, op.constant(1.0), op.constant(0, np.uint8))


def from_u8(op: Ops, codes: Value) -> Value:
    """The codes as float32, which the runtime takes for what it is: integers."""
    return op.DequantizeLinear(codes, op.constant(1.0), op.constant(0, np.uint8))


def network_model(net: FoldedNet, encoding: AngleEncoding) -> ModelProto:
    """`frame` uint8 (H, W, 3) BGR to `heatmap` (3, rows, cols): quality, sine, cosine.

    Every layer's weights are the initializers `weight{k}` (Co, Ci, kh, kw) and `bias{k}`; see
    :func:`initializer_offsets`.
    """
    graph = Graph("network")
    frame = graph.input("frame", np.uint8, ("height", "width", 3))
    op = graph.within("frame")
    planes = op.Unsqueeze(op.Transpose(frame, perm=(2, 0, 1)), op.shape(0))
    x = normalized(op, op.Cast(planes, to=TensorProto.FLOAT))
    for number in range(1, len(net.layers) + 1):
        x = constant_layer(graph, net, number, x)
    heatmap = op.Squeeze(op.Concat(*activate(op, x, encoding), axis=1), op.shape(0))
    graph.output("heatmap", heatmap, np.float32, (3, "rows", "cols"))
    return graph.model()


def constant_layer(graph: Graph, net: FoldedNet, number: int, x: Value) -> Value:
    """Convolution, ReLU and average pool of layer `number` on (N, Ci, H, W)."""
    layer, op = net.layers[number - 1], graph.within(f"layer{number}")
    weight = graph.initializer(f"weight{number}", layer.weight)
    bias = graph.initializer(f"bias{number}", layer.bias)
    kernel = layer.weight.shape[2:]
    x = op.Conv(x, weight, bias, kernel_shape=kernel, strides=(layer.stride, layer.stride))
    x = op.Relu(x) if layer.relu else x
    return op.AveragePool(x, kernel_shape=(layer.pool, layer.pool)) if layer.pool > 1 else x


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
