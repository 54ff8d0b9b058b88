"""One tuned layer in a graph: the arithmetic of :mod:`qsgm.train.model.local`.

Activations are matrices, (B * P, C): a row per crop and position. A convolution is a gather of
windows (im2col) and one matrix product, and its weight gradient is another product with the same
windows: a Conv whose weight is an input, or a Conv for the gradient, takes several times as long in
ONNX Runtime. Back to a layer's input it is the other way round: ConvTranspose takes a fifth to a
half of the time of gathering or scattering the windows' gradients.

At this size every node counts, about a microsecond each. Hence the order of ReLU and Reshape, which
lets the runtime put ReLU into the product, and products to which an optimizer adds.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray
from onnx import TensorProto

from qsgm.blocks import tuned_layers
from qsgm.train.graphs.build import Graph, Ops, Product, Value
from qsgm.train.graphs.optimizers import Gradient, value_of
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.fold import PIXEL_OFFSET, PIXEL_SCALE, FoldedLayer, FoldedNet
from qsgm.weights import to_step_layout

CROP_SIDE = 128
# Windows of one crop, above which a block with an SGM goes crop by crop. Layers 1 and 2 are quicker
# so; layer 3, with 169, adds a fifth to a step of four layers, which then takes a quarter of the
# memory. Layer 4 has 25, and a crop's product reads all weights anew: a step of three layers would
# take twice as long.
MANY_WINDOWS = 100
# Times the smallest normal float32 this is above 1.
STEEP = 1e38

FloatArray = NDArray[np.float32]


@dataclass(frozen=True)
class TunedLayer:
    """A layer that is trained: its geometry, and its weights as inputs of the graph."""

    number: int
    folded: FoldedLayer
    side: int  # its input map is side x side
    weight: Value  # (Co, kh * kw * Ci)
    bias: Value  # (Co,)
    features: DTypeLike | None  # what it reads, if it is the first tuned layer
    steps: FloatArray | None  # (kh * kw * Ci,), where its windows are codes: what one stands for

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

    @property
    def many_windows(self) -> bool:
        """Whether the windows of a batch are too many to be in memory at once."""
        return self.positions > MANY_WINDOWS

    @property
    def into(self) -> int:
        """Channels of its input."""
        return int(self.folded.weight.shape[1])


@dataclass(frozen=True)
class Batch:
    """The crops of one step, picked by `rows` from all crops."""

    features: Value  # (B, P, C), codes or pixels where they are u8
    labels: Value  # (B, 3)
    size: Value  # B, a float32 scalar


@dataclass(frozen=True)
class Pass:
    """What a layer's forward pass leaves for its update."""

    windows: Value  # (B * P, K)
    active: Value  # (B * P, Co), behind ReLU
    after: Value  # (B * P', Co), behind the pool


@dataclass(frozen=True)
class Gradients:
    """Of a layer's parameters."""

    weight: Gradient  # (Co, K)
    bias: Gradient  # (1, Co)


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
    layers, first = [], tuned_layers(tuned)[0]
    for number in tuned_layers(tuned):
        folded = net.layers[number - 1]
        shape = to_step_layout(folded.weight).shape
        weight = graph.input(f"weight{number}", np.float32, shape)
        bias = graph.input(f"bias{number}", np.float32, shape[:1])
        side, features, steps = input_side(net, number), None, None
        if number == first:
            features = features_dtype(net, number - 1)
            if number - 1 in net.feature_steps:
                steps = np.tile(net.feature_steps[number - 1], folded.weight[0, 0].size)
        layers.append(TunedLayer(number, folded, side, weight, bias, features, steps))
    return layers


def declare_features(graph: Graph, net: FoldedNet, tuned: int) -> Value:
    """Input of the first tuned layer, for all crops: (N, P, C), see :func:`features_dtype`."""
    number = tuned_layers(tuned)[0]
    shape = ("crops", input_side(net, number) ** 2, net.layers[number - 1].weight.shape[1])
    return graph.input("features", features_dtype(net, number - 1), shape)


def features_dtype(net: FoldedNet, last_frozen: int) -> DTypeLike:
    """uint8 for pixels, and for the output of a layer that has steps; else float32."""
    return np.uint8 if last_frozen == 0 or last_frozen in net.feature_steps else np.float32


def as_seen(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """A layer's input in float32: features (..., P, Ci) if it is the first, else rows as they are.

    Pixels are then in [-1, 1]. Codes stay what they are: it is quicker to give their steps to the
    weights, of which there are fewer.
    """
    if layer.features is None:
        return x
    if layer.features == np.uint8:
        x = op.Cast(x, to=TensorProto.FLOAT)
        x = normalized(op, x) if layer.number == 1 else x
    return op.Reshape(x, op.shape(-1, layer.into)) if layer.kernel == 1 else x


def normalized(op: Ops, pixels: Value) -> Value:
    """Pixel values 0 to 255 to [-1, 1]."""
    return op.Add(op.Mul(pixels, op.constant(PIXEL_SCALE)), op.constant(PIXEL_OFFSET))


def declare_batch(graph: Graph, net: FoldedNet, tuned: int) -> Batch:
    """All crops' features and labels as inputs, and `rows`, which picks a batch."""
    features = declare_features(graph, net, tuned)
    labels = graph.input("labels", np.float32, ("crops", 3))
    rows = graph.input("rows", np.int64, ("batch",))
    op = graph.within("batch")
    size = op.Cast(op.Size(rows), to=TensorProto.FLOAT)
    return Batch(op.Gather(features, rows, axis=0), op.Gather(labels, rows, axis=0), size)


def gather_windows(op: Ops, x: Value, side: int, kernel: int, stride: int) -> Value:
    """All windows of square maps (B, side * side, C): (B, rows, columns, kernel * kernel, C)."""
    # Stored as a sum of three small tensors, which the runtime folds when it loads.
    start, step = np.arange(0, side - kernel + 1, stride), np.arange(kernel)
    row = op.constant(side * start[:, None, None], np.int64)
    column = op.constant(start[:, None], np.int64)
    offset = op.constant((side * step[:, None] + step).ravel(), np.int64)
    return op.Gather(x, op.Add(op.Add(row, column), offset), axis=1)


def cut_windows(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """The windows (B * P, K) that a layer sees of its input (B * P_in, Ci) or (B, P_in, Ci)."""
    if layer.kernel == 1:
        return x
    maps = op.Reshape(x, op.shape(-1, layer.side**2, layer.into))
    windows = gather_windows(op, maps, layer.side, layer.kernel, layer.folded.stride)
    return op.Reshape(windows, op.shape(-1, layer.width))


def forward(op: Ops, layer: TunedLayer, x: Value) -> Pass:
    """Input (B * P_in, Ci), or features, through convolution, ReLU and pool."""
    seen, weight = cut_windows(op, layer, as_seen(op, layer, x)), layer.weight
    if layer.steps is not None:
        weight = op.Mul(weight, op.constant(layer.steps))
    active = op.Gemm(seen, weight, layer.bias, transB=1)
    if layer.folded.relu:
        active = op.Relu(active)
    if layer.folded.pool == 1:
        return Pass(seen, active, active)
    # Of a crop, the pool covers the whole map.
    return Pass(seen, active, op.ReduceMean(as_maps(op, layer, active), axes=[1], keepdims=0))


def as_maps(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """Rows (B * P, Co) of a layer's output in front of its pool, crop by crop: (B, P, Co)."""
    return op.Reshape(x, op.shape(-1, layer.positions, layer.channels))


def through_activation(op: Ops, layer: TunedLayer, done: Pass, gradient: Value) -> Value:
    """A gradient on the layer's activation (B * P', C) carried back through it: (B * P, C)."""
    if layer.folded.pool > 1:
        share = op.Mul(gradient, op.constant(1 / layer.positions))
        gradient = at_every_position(op, share, layer.positions, layer.channels)
    if layer.folded.relu:
        gradient = op.Mul(gradient, is_positive(op, done.active))
    return gradient


def at_every_position(op: Ops, x: Value, positions: int, channels: int) -> Value:
    """Rows (B, C), each so many times: (B * P, C)."""
    return op.Reshape(op.Tile(x, op.shape(1, positions)), op.shape(-1, channels))


def is_positive(op: Ops, x: Value) -> Value:
    """1 where a number is above zero, else 0, in float32.

    Nothing lies between in a sigmoid so steep. It takes one node where Greater and Cast take two;
    Where in the place of Cast and a product takes three times as long.
    """
    return op.HardSigmoid(x, alpha=STEEP, beta=0.0)


def summed_gradients(op: Ops, done: Pass, dz: Value) -> Gradients:
    """What the windows, as they are, and all rows of dz (B * P, C) come to."""
    bias = op.ReduceSum(dz, op.shape(0), keepdims=1)
    return Gradients(Product(dz, done.windows, turned=True), bias)


def weight_gradients(op: Ops, layer: TunedLayer, summed: Gradients) -> Gradients:
    """The same where windows are codes, of which a step stands for something."""
    if layer.steps is None:
        return summed
    weight = op.Mul(value_of(op, summed.weight), op.constant(layer.steps))
    return Gradients(weight, summed.bias)


def bent_gradients(
    op: Ops, layer: TunedLayer, summed: Gradients, curvature: Curvature
) -> Gradients:
    """:func:`weight_gradients` along the layer's curvature, as `Curvature.bend` has them."""
    window, into, out, bias = (matrix.numpy() for matrix in curvature.matrices)
    if layer.steps is not None:  # where they cost no node
        into = layer.steps[: len(into), None] * into
    d_weight = value_of(op, summed.weight)
    if layer.kernel == 1:  # one position: its factor goes with another matrix
        windows = op.MatMul(d_weight, op.constant(window[0, 0] * into))
    else:
        maps = op.Reshape(d_weight, op.shape(layer.channels, len(window), len(into)))
        windows = op.MatMul(op.constant(window.T), op.MatMul(maps, op.constant(into)))
        windows = op.Reshape(windows, op.shape(layer.channels, layer.width))
    d_bias = value_of(op, summed.bias)
    return Gradients(Product(op.constant(out.T), windows), Product(d_bias, op.constant(bias)))


def gradient_before(op: Ops, layer: TunedLayer, dz: Value) -> Value:
    """dz (B * P, C) carried back to the layer's input: (B * P_in, Ci)."""
    into, kernel, side = layer.into, layer.kernel, layer.side
    if kernel == 1:
        return op.Gemm(dz, layer.weight)
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
    return op.Reshape(op.Transpose(before, perm=(0, 2, 3, 1)), op.shape(-1, into))
