"""One tuned layer in a graph: the arithmetic of :mod:`qsgm.train.local`.

Activations are position-major, (B, P, C). A convolution is a gather of windows (im2col) and one
matrix product, and its weight gradient is another product with the same windows: a Conv whose
weight is an input, or a Conv for the gradient, takes several times as long in ONNX Runtime.
"""

from dataclasses import dataclass

import numpy as np
from onnx import TensorProto

from qsgm.errors import QsgmError
from qsgm.train.fold import FoldedLayer, FoldedNet
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.train.graspnet import LAYERS
from qsgm.weights import to_step_layout

CROP_SIDE = 128
TUNABLE = (1, 2, 3)  # how many of the last layers a graph can train


@dataclass(frozen=True)
class TunedLayer:
    """A layer that is trained: its geometry, and its weights as inputs of the graph."""

    number: int
    folded: FoldedLayer
    side: int  # its input map is side x side
    weight: Value  # (Co, kh * kw * Ci)
    bias: Value  # (Co,)

    @property
    def kernel(self) -> int:
        return int(self.folded.weight.shape[2])

    @property
    def width(self) -> int:
        """Length of one window: kh * kw * Ci."""
        return int(self.folded.weight[0].size)

    @property
    def channels(self) -> int:
        return len(self.folded.bias)

    @property
    def positions(self) -> int:
        """Windows in its input map, which its pool, if any, averages to one."""
        return output_side(self.side, self.kernel, self.folded.stride) ** 2


@dataclass(frozen=True)
class Batch:
    """The crops of one step, picked by `rows` from all crops."""

    features: Value  # (B, P, C)
    labels: Value  # (B, 3)
    share: Value  # 1 / B


@dataclass(frozen=True)
class Pass:
    """What a layer's forward pass leaves for its update."""

    windows: Value  # (B * P, K)
    before: Value  # (B, P, Co), before ReLU
    after: Value  # (B, P', Co), behind ReLU and pool


def output_side(side: int, kernel: int, stride: int) -> int:
    """Side of the map that a convolution without padding makes of a square one."""
    return (side - kernel) // stride + 1


def input_side(net: FoldedNet, number: int) -> int:
    """Side of the map that layer `number` sees of a crop."""
    side = CROP_SIDE
    for layer in net.layers[: number - 1]:
        side = output_side(side, layer.weight.shape[2], layer.stride) - layer.pool + 1
    return side


def first_tuned(tuned: int) -> int:
    """The number of the first of the last `tuned` layers.

    Raises QsgmError for more than three: further ahead maps are larger than one position.
    """
    if tuned not in TUNABLE:
        raise QsgmError(f"cannot tune the last {tuned} layers: choose 1, 2 or 3")
    return LAYERS - tuned + 1


def declare_layers(graph: Graph, net: FoldedNet, tuned: int) -> list[TunedLayer]:
    """The last `tuned` layers, their weights and biases declared as inputs."""
    layers = []
    for number in range(first_tuned(tuned), LAYERS + 1):
        folded = net.layers[number - 1]
        shape = to_step_layout(folded.weight).shape
        weight = graph.input(f"weight{number}", np.float32, shape)
        bias = graph.input(f"bias{number}", np.float32, shape[:1])
        layers.append(TunedLayer(number, folded, input_side(net, number), weight, bias))
    return layers


def declare_features(graph: Graph, net: FoldedNet, tuned: int) -> Value:
    """Input of the first tuned layer, for all crops: (N, P, C)."""
    number = first_tuned(tuned)
    channels = net.layers[number - 1].weight.shape[1]
    return graph.input("features", np.float32, ("crops", input_side(net, number) ** 2, channels))


def declare_batch(graph: Graph, net: FoldedNet, tuned: int) -> Batch:
    """All crops' features and labels as inputs, and `rows`, which picks a batch."""
    features = declare_features(graph, net, tuned)
    labels = graph.input("labels", np.float32, ("crops", 3))
    rows = graph.input("rows", np.int64, ("batch",))
    op = graph.within("batch")
    share = op.Reciprocal(op.Cast(op.Size(rows), to=TensorProto.FLOAT))
    return Batch(op.Gather(features, rows, axis=0), op.Gather(labels, rows, axis=0), share)


def cut_windows(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """The windows (B * P, K) that a layer sees of its input (B, P_in, Ci)."""
    if layer.kernel > 1:
        # Stored as a sum of two small tensors, which the runtime folds when it loads.
        side, stride = layer.side, layer.folded.stride
        start = np.arange(0, side - layer.kernel + 1, stride)
        base = (start[:, None] * side + start).reshape(-1, 1)
        step = np.arange(layer.kernel)
        offset = (step[:, None] * side + step).reshape(1, -1)
        index = op.Add(op.constant(base, np.int64), op.constant(offset, np.int64))
        x = op.Gather(x, index, axis=1)
    return op.Reshape(x, op.shape(-1, layer.width))


def forward(op: Ops, layer: TunedLayer, x: Value) -> Pass:
    """Input (B, P_in, Ci) through convolution, ReLU and pool."""
    seen = cut_windows(op, layer, x)
    flat = op.Gemm(seen, layer.weight, layer.bias, transB=1)
    before = op.Reshape(flat, op.shape(-1, layer.positions, layer.channels))
    after = op.Relu(before) if layer.folded.relu else before
    if layer.folded.pool > 1:  # of a crop, the pool covers the whole map
        after = op.ReduceMean(after, axes=[1], keepdims=1)
    return Pass(seen, before, after)


def through_activation(op: Ops, layer: TunedLayer, done: Pass, gradient: Value) -> Value:
    """A gradient on the layer's activation (B, P', C) carried back to `before`: (B * P, C)."""
    if layer.folded.pool > 1:
        gradient = op.Mul(gradient, op.constant(1 / layer.positions))
    if layer.folded.relu:
        gradient = op.Where(op.Greater(done.before, op.constant(0.0)), gradient, op.constant(0.0))
    return op.Reshape(gradient, op.shape(-1, layer.channels))


def weight_gradients(op: Ops, done: Pass, dz: Value) -> tuple[Value, Value]:
    """Gradients of weight and bias, summed over all rows of dz (B * P, C)."""
    return op.Gemm(dz, done.windows, transA=1), op.ReduceSum(dz, op.shape(0), keepdims=0)


def gradient_before(op: Ops, layer: TunedLayer, dz: Value) -> Value:
    """dz (B, C) of a 1x1 layer on one position, carried back to its input (B, 1, Ci)."""
    assert (layer.kernel, layer.positions) == (1, 1), "only 1x1 layers are carried back"
    return op.Unsqueeze(op.Gemm(dz, layer.weight), op.shape(1))
