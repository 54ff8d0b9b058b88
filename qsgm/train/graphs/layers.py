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

from qsgm.network import NONE, ONE, Layer, Network, Pair, area
from qsgm.train.graphs.build import Graph, Ops, Product, Value
from qsgm.train.graphs.optimizers import Gradient, value_of
from qsgm.train.model.arrays import PIXEL_OFFSET, PIXEL_SCALE, CurvatureArrays, FoldedNet

# Windows of one sample, above which a block with an SGM goes sample by sample. GraspNet's layers 1
# and 2 are quicker so; layer 3, with 169, adds a fifth to a step of four layers, which then takes a
# quarter of the memory. Layer 4 has 25, and a sample's product reads all weights anew: a step of
# three layers would take twice as long.
MANY_WINDOWS = 100
# Times the smallest normal float32 this is above 1.
STEEP = 1e38
ALMOST_ZERO = 1e-30

FloatArray = NDArray[np.float32]


@dataclass(frozen=True)
class TunedLayer:
    """A layer that is trained: its place in the network, and its weights as inputs of the graph."""

    network: Network
    number: int
    weight: Value  # (Co, kh * kw * Ci)
    bias: Value  # (Co,)
    features: DTypeLike | None  # what it reads, if it is the first tuned layer
    steps: FloatArray | None  # (kh * kw * Ci,), where its windows are codes: what one stands for

    @property
    def layer(self) -> Layer:
        return self.network.layer(self.number)

    @property
    def side(self) -> Pair:
        """Sides of its input map."""
        return self.network.before(self.number)

    @property
    def after_side(self) -> Pair:
        """Sides of the map behind its pool."""
        return self.network.after(self.number)

    @property
    def positions(self) -> int:
        """Windows in its input map."""
        return self.network.windows(self.number)

    @property
    def positions_after(self) -> int:
        """Positions in the map behind its pool."""
        return self.network.positions_after(self.number)

    @property
    def many_windows(self) -> bool:
        """Whether the windows of a batch are too many to be in memory at once."""
        return self.positions > MANY_WINDOWS

    @property
    def is_product(self) -> bool:
        """Whether its windows are its input's positions as they are."""
        layer = self.layer
        return (layer.kernel, layer.stride, layer.padding) == (ONE, ONE, NONE)


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
    """Gradients of a layer's parameters."""

    weight: Gradient  # (Co, K)
    bias: Gradient  # (1, Co)


def declare_layers(graph: Graph, net: FoldedNet, tuned: int) -> list[TunedLayer]:
    """The last `tuned` layers, their weights and biases declared as inputs."""
    layers, numbers = [], net.network.last(tuned)
    for number in numbers:
        layer = net.network.layer(number)
        weight = graph.input(f"weight{number}", np.float32, (layer.out, layer.window))
        bias = graph.input(f"bias{number}", np.float32, (layer.out,))
        features, steps = None, None
        if number == numbers[0]:
            features = features_dtype(net, number - 1)
            if number - 1 in net.feature_steps:
                steps = np.tile(net.feature_steps[number - 1], area(layer.kernel))
        layers.append(TunedLayer(net.network, number, weight, bias, features, steps))
    return layers


def declare_features(graph: Graph, net: FoldedNet, tuned: int) -> Value:
    """Input of the first tuned layer, for all samples: (N, P, C), see :func:`features_dtype`."""
    number = net.network.last(tuned)[0]
    maps = net.network.positions_before(number), net.network.layer(number).into
    return graph.input("features", features_dtype(net, number - 1), ("samples", *maps))


def features_dtype(net: FoldedNet, last_frozen: int) -> DTypeLike:
    """uint8 for pixels, and for the output of a layer that has steps; else float32."""
    if last_frozen == 0:
        return np.uint8 if net.network.input_kind == "pixels" else np.float32
    return np.uint8 if last_frozen in net.feature_steps else np.float32


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
    return op.Reshape(x, op.shape(-1, layer.layer.into)) if layer.is_product else x


def normalized(op: Ops, pixels: Value) -> Value:
    """Pixel values 0 to 255 to [-1, 1]."""
    return op.Add(op.Mul(pixels, op.constant(PIXEL_SCALE)), op.constant(PIXEL_OFFSET))


def declare_batch(graph: Graph, net: FoldedNet, tuned: int) -> Batch:
    """All samples' features and labels as inputs, and `rows`, which picks a batch."""
    features = declare_features(graph, net, tuned)
    labels = graph.input("labels", np.float32, ("samples", net.network.outputs))
    rows = graph.input("rows", np.int64, ("batch",))
    op = graph.within("batch")
    size = op.Cast(op.Size(rows), to=TensorProto.FLOAT)
    return Batch(op.Gather(features, rows, axis=0), op.Gather(labels, rows, axis=0), size)


def gather_windows(op: Ops, x: Value, side: Pair, kernel: Pair, stride: Pair) -> Value:
    """All windows of maps (B, H * W, C) of this size: (B, rows, columns, kh * kw, C)."""
    # Stored as a sum of three small tensors, which the runtime folds when it loads.
    (height, width), (tall, wide) = side, kernel
    down = np.arange(0, height - tall + 1, stride[0])
    right = np.arange(0, width - wide + 1, stride[1])
    row = op.constant(width * down[:, None, None], np.int64)
    column = op.constant(right[:, None], np.int64)
    taps = (width * np.arange(tall)[:, None] + np.arange(wide)).ravel()
    offset = op.constant(taps, np.int64)
    return op.Gather(x, op.Add(op.Add(row, column), offset), axis=1)


def cut_windows(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """The windows (B * P, K) that a layer sees of its input (B * P_in, Ci) or (B, P_in, Ci)."""
    if layer.is_product:
        return x
    one, (height, width) = layer.layer, layer.side
    up, left = one.padding
    maps = op.Reshape(x, op.shape(-1, height * width, one.into))
    if one.padding != NONE:
        maps = op.Reshape(maps, op.shape(-1, height, width, one.into))
        maps = op.Pad(maps, op.shape(0, up, left, 0, 0, up, left, 0))
        height, width = height + 2 * up, width + 2 * left
        maps = op.Reshape(maps, op.shape(-1, height * width, one.into))
    windows = gather_windows(op, maps, (height, width), one.kernel, one.stride)
    return op.Reshape(windows, op.shape(-1, one.window))


def forward(op: Ops, layer: TunedLayer, x: Value) -> Pass:
    """Input (B * P_in, Ci), or features, through convolution, ReLU and pool."""
    seen, weight = cut_windows(op, layer, as_seen(op, layer, x)), layer.weight
    if layer.steps is not None:
        weight = op.Mul(weight, op.constant(layer.steps))
    active = op.Gemm(seen, weight, layer.bias, transB=1)
    if layer.layer.relu:
        active = op.Relu(active)
    if layer.layer.pool == ONE:
        return Pass(seen, active, active)
    maps = as_maps(op, layer, active)
    if layer.network.pools_all(layer.number):
        return Pass(seen, active, op.ReduceMean(maps, op.shape(1), keepdims=0))
    pooled = op.MatMul(op.constant(pool_shares(layer)), maps)
    return Pass(seen, active, op.Reshape(pooled, op.shape(-1, layer.layer.out)))


def pool_shares(layer: TunedLayer) -> FloatArray:
    """What each position in front of a pool has in each one behind it, (P', P)."""
    (height, width), (tall, wide) = layer.network.convolved(layer.number), layer.layer.pool
    shares = np.zeros((*layer.after_side, height, width), np.float32)
    for row, column in np.ndindex(*layer.after_side):
        down, right = (
            at * step for at, step in zip((row, column), layer.layer.pool_stride, strict=True)
        )
        shares[row, column, down : down + tall, right : right + wide] = 1 / (tall * wide)
    return shares.reshape(layer.positions_after, height * width)


def as_maps(op: Ops, layer: TunedLayer, x: Value) -> Value:
    """Rows (B * P, Co) of a layer's output in front of its pool, sample by sample: (B, P, Co)."""
    return op.Reshape(x, op.shape(-1, layer.positions, layer.layer.out))


def through_activation(op: Ops, layer: TunedLayer, done: Pass, gradient: Value) -> Value:
    """A gradient on the layer's activation (B * P', C) carried back through it: (B * P, C)."""
    channels = layer.layer.out
    if layer.network.pools_all(layer.number):
        share = op.Mul(gradient, op.constant(1 / layer.positions))
        gradient = at_every_position(op, share, layer.positions, channels)
    elif layer.layer.pool != ONE:
        maps = op.Reshape(gradient, op.shape(-1, layer.positions_after, channels))
        spread = op.MatMul(op.constant(pool_shares(layer).T), maps)
        gradient = op.Reshape(spread, op.shape(-1, channels))
    if layer.layer.relu:
        gradient = op.Mul(gradient, is_positive(op, done.active))
    return gradient


def at_every_position(op: Ops, x: Value, positions: int, channels: int) -> Value:
    """Rows (B, C), each so many times: (B * P, C)."""
    return op.Reshape(op.Tile(x, op.shape(1, positions)), op.shape(-1, channels))


def is_positive(op: Ops, x: Value) -> Value:
    """1 where a number is above zero, else 0, in float32.

    Nothing lies between in a sigmoid so steep. It takes one node where Greater and Cast take two;
    Where in the place of Cast and a product takes three times as long. OpenVINO reads a beta of 0
    as the default, 0.5: so it is a number that adds nothing.
    """
    return op.HardSigmoid(x, alpha=STEEP, beta=-ALMOST_ZERO)


def summed_gradients(op: Ops, done: Pass, dz: Value) -> Gradients:
    """Gradients summed over the batch: dz^T @ windows, column sums of dz (B * P, C)."""
    bias = op.ReduceSum(dz, op.shape(0), keepdims=1)
    return Gradients(Product(dz, done.windows, turned=True), bias)


def weight_gradients(op: Ops, layer: TunedLayer, summed: Gradients) -> Gradients:
    """Gradients in the weights' own units, where windows are codes that stand for steps."""
    if layer.steps is None:
        return summed
    weight = op.Mul(value_of(op, summed.weight), op.constant(layer.steps))
    return Gradients(weight, summed.bias)


def preconditioned_gradients(
    op: Ops, layer: TunedLayer, summed: Gradients, curvature: CurvatureArrays
) -> Gradients:
    """:func:`weight_gradients` along the curvature, as `Curvature.precondition` has them."""
    window, into = curvature.window, curvature.into
    if layer.steps is not None:  # where they cost no node
        into = layer.steps[: len(into), None] * into
    d_weight, channels = value_of(op, summed.weight), layer.layer.out
    if layer.layer.kernel == ONE:  # one position: its factor goes with another matrix
        windows = op.MatMul(d_weight, op.constant(window[0, 0] * into))
    else:
        maps = op.Reshape(d_weight, op.shape(channels, len(window), len(into)))
        windows = op.MatMul(op.constant(window.T), op.MatMul(maps, op.constant(into)))
        windows = op.Reshape(windows, op.shape(channels, layer.layer.window))
    d_bias = value_of(op, summed.bias)
    out = op.constant(curvature.out.T)
    return Gradients(Product(out, windows), Product(d_bias, op.constant(curvature.bias)))


def gradient_before(op: Ops, layer: TunedLayer, dz: Value) -> Value:
    """dz (B * P, C) carried back to the layer's input: (B * P_in, Ci)."""
    if layer.is_product:
        return op.Gemm(dz, layer.weight)
    one, (height, width) = layer.layer, layer.network.convolved(layer.number)
    weight = op.Reshape(layer.weight, op.shape(-1, *one.kernel, one.into))
    maps = op.Reshape(dz, op.shape(-1, height, width, one.out))
    unseen = [  # rows and columns that no window reaches
        (side + 2 * pad - kernel) % stride
        for side, pad, kernel, stride in zip(
            layer.side, one.padding, one.kernel, one.stride, strict=True
        )
    ]
    padding = {} if one.padding == NONE else {"pads": [*one.padding, *one.padding]}
    before = op.ConvTranspose(
        op.Transpose(maps, perm=(0, 3, 1, 2)),
        op.Transpose(weight, perm=(0, 3, 1, 2)),
        kernel_shape=one.kernel,
        strides=one.stride,
        output_padding=unseen,
        **padding,
    )
    return op.Reshape(op.Transpose(before, perm=(0, 2, 3, 1)), op.shape(-1, one.into))
