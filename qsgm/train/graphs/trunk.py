"""The network with constant weights: crops to features, a whole frame to its heatmap."""

import numpy as np
from onnx import ModelProto, TensorProto

from qsgm.angles import AngleEncoding
from qsgm.errors import QsgmError
from qsgm.train.fold import FoldedNet, on_pixels
from qsgm.train.graphs.build import Graph, Value
from qsgm.train.graphs.layers import CROP_SIDE, input_side, normalized
from qsgm.train.graphs.loss import activate


def trunk_model(net: FoldedNet, last_frozen: int) -> ModelProto:
    """`crops` uint8 (N, 128, 128, 3) BGR to `features` (N, P, C), position by position.

    The features are the output of layer `last_frozen`; for 0, where nothing is, the pixels, uint8.
    """
    graph = Graph("trunk")
    crops = graph.input("crops", np.uint8, ("crops", CROP_SIDE, CROP_SIDE, 3))
    op = graph.within("trunk")
    shape = input_side(net, last_frozen + 1) ** 2, net.layers[last_frozen].weight.shape[1]
    if last_frozen == 0:
        graph.output(
            "features", op.Reshape(crops, op.shape(-1, *shape)), np.uint8, ("crops", *shape)
        )
        return graph.model()
    x = op.Cast(op.Transpose(crops, perm=(0, 3, 1, 2)), to=TensorProto.FLOAT)
    # Not normalised in the graph: that would take a third as long again as the whole trunk.
    frozen = on_pixels(net)
    for number in range(1, last_frozen + 1):
        x = constant_layer(graph, frozen, number, x)
    features = op.Reshape(op.Transpose(x, perm=(0, 2, 3, 1)), op.shape(-1, *shape))
    graph.output("features", features, np.float32, ("crops", *shape))
    return graph.model()


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
