"""One tuned layer in a graph: the arithmetic of :mod:`qsgm.train.local`.

Activations are position-major, (B, P, C). A convolution is a gather of windows (im2col) and one
matrix product, and its weight gradient is another product with the same windows: a Conv whose
weight is an input, or a Conv for the gradient, takes several times as long in ONNX Runtime. Back
to a layer's input it is the other way round: ConvTranspose takes a fifth to a half of the time of
gathering or scattering the windows' gradients.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike
from onnx import TensorProto

from qsgm.blocks import tuned_layers
from qsgm.train.curvature import Curvature
from qsgm.train.fold import PIXEL_OFFSET, PIXEL_SCALE, FoldedLayer, FoldedNet
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.weights import to_step_layout

CROP_SIDE = 128


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
    def before_side(self) -> int:
        """Of the map that its convolution makes of a crop."""
        return output_side(self.side, self.kernel, self.folded.stride)

    @property
    def positions(self) -> int:
        """Windows in its input map."""
        return self.before_side**2

    @property
    def after_side(self) -> int:
        """Of the map behind its pool, which of a crop covers the whole map."""
        return 1 if self.folded.pool > 1 else self.before_side


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


def declare_layers(graph: Graph, net: FoldedNet, tuned: int) -> list[TunedLayer]:
    """The last `tuned` layers, their weights and biases declared as inputs."""
    layers = []
    for number in tuned_layers(tuned):
        folded = net.layers[number - 1]
        shape = to_step_layout(folded.weight).shape
        weight = graph.input(f"weight{number}", np.float32, shape)
        bias = graph.input(f"bias{number}", np.float32, shape[:1])
        layers.append(TunedLayer(number, folded, input_side(net, number), weight, bias))
    return layers


def declare_features(graph: Graph, net: FoldedNet, tuned: int) -> Value:
    """Input of the first tuned layer, for all crops: (N, P, C), see :func:`features_dtype`."""
    number = tuned_layers(tuned)[0]
    shape = ("crops", input_side(net, number) ** 2, net.layers[number - 1].weight.shape[1])
    return graph.input("features", features_dtype(net, number - 1), shape)


def features_dtype(net: FoldedNet, last_frozen: int) -> DTypeLike:
    """uint8 for pixels, and for the output of a layer that has steps; else float32."""
    return np.uint8 if last_frozen == 0 or last_frozen in net.feature_steps else np.float32


def as_seen(op: Ops, net: FoldedNet, features: Value, tuned: int) -> Value:
    """Features as the first tuned layer sees them: float32, pixels in [-1, 1]."""
    number = tuned_layers(tuned)[0]
    if features_dtype(net, number - 1) != np.uint8:
        return features
    codes = op.Cast(features, to=TensorProto.FLOAT)
    if number == 1:
        return normalized(op, codes)
    # DequantizeLinear with a step per channel would make a training step a fifth longer. This is
    # as quick as float32 features: the runtime writes out steps for every position when it loads.
    steps = net.feature_steps[number - 1]
    positions = input_side(net, number) ** 2
    return op.Mul(codes, op.Expand(op.constant(steps), op.shape(positions, len(steps))))


def normalized(op: Ops, pixels: Value) -> Value:
    """Pixel values 0 to 255 to [-1, 1]."""
    return op.Add(op.Mul(pixels, op.constant(PIXEL_SCALE)), op.constant(PIXEL_OFFSET))


def declare_batch(graph: Graph, net: FoldedNet, tuned: int) -> Batch:
    """All crops' features and labels as inputs, and `rows`, which picks a batch."""
    features = declare_features(graph, net, tuned)
    labels = graph.input("labels", np.float32, ("crops", 3))
    rows = graph.input("rows", np.int64, ("batch",))
    op = graph.within("batch")
    share = op.Reciprocal(op.Cast(op.Size(rows), to=TensorProto.FLOAT))
    seen = as_seen(op, net, op.Gather(features, rows, axis=0), tuned)
    return Batch(seen, op.Gather(labels, rows, axis=0), share)


def gather_windows(op: Ops, x: Value, side: int, kernel: int, stride: int) -> Value:
    """All windows of square maps (B, side * side, C): (B, rows, columns, kernel * kernel, C)."""
    # Stored as a sum of three small tensors, which the runtime folds when it loads.
    start, step = np.arange(0, side - kernel + 1, stride), np.arange(kernel)
    row = op.constant(side * start[:, None, None], np.int64)
    column = op.constant(start[:, None], np.int64)
    offset = op.constant((side * step[:, None] + step).ravel(), np.int64)
    return op.Gather(x, op.Add(op.Add(row, column), offset), axis=1)


def cut_windows(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """The windows (B * P, K) that a layer sees of its input (B, P_in, Ci)."""
    if layer.kernel > 1:
        x = gather_windows(op, x, layer.side, layer.kernel, layer.folded.stride)
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


def bend(
    op: Ops, layer: TunedLayer, curvature: Curvature, d_weight: Value, d_bias: Value
) -> tuple[Value, Value]:
    """Gradients (Co, K) and (Co,) along the layer's curvature, as `Curvature.bend` has them."""
    window, into, out, bias = (matrix.numpy() for matrix in curvature.matrices)
    if layer.kernel == 1:  # one position: its factor goes with another matrix
        windows = op.MatMul(d_weight, op.constant(window[0, 0] * into))
    else:
        maps = op.Reshape(d_weight, op.shape(layer.channels, len(window), len(into)))
        windows = op.MatMul(op.constant(window.T), op.MatMul(maps, op.constant(into)))
        windows = op.Reshape(windows, op.shape(layer.channels, layer.width))
    return op.MatMul(op.constant(out.T), windows), op.MatMul(d_bias, op.constant(bias))


def gradient_before(op: Ops, layer: TunedLayer, dz: Value) -> Value:
    """dz (B * P, C) carried back to the layer's input: (B, P_in, Ci)."""
    into, kernel, side = layer.folded.weight.shape[1], layer.kernel, layer.side
    as_input = op.shape(-1, side**2, into)
    if kernel == 1:
        return op.Reshape(op.Gemm(dz, layer.weight), as_input)
    weight = op.Reshape(layer.weight, op.shape(-1, kernel, kernel, into))
    maps = op.Reshape(dz, op.shape(-1, layer.before_side, layer.before_side, layer.channels))
    unseen = (side - kernel) % layer.folded.stride  # rows that no window reaches
    before = op.ConvTranspose(
        op.Transpose(maps, perm=(0, 3, 1, 2)),
        op.Transpose(weight, perm=(0, 3, 1, 2)),
        kernel_shape=(kernel, kernel),
        strides=(layer.folded.stride, layer.folded.stride),
        output_padding=(unseen, unseen),
    )
    return op.Reshape(op.Transpose(before, perm=(0, 2, 3, 1)), as_input)
