"""Small random networks, their weights, heads and data, for tests that hold on any of them."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from qsgm.blocks import Blocks
from qsgm.network import InputKind, Layer, Network, Pair
from qsgm.sgm.float import FoldedConv, FoldedSgm
from qsgm.task import Head, Heads
from qsgm.train.model.arrays import FoldedNet

LARGEST = 9  # side of an input
# Any network of two to four layers, and shallow and deep ones along one axis and two.
Shape = dict[str, Any]
SHAPES: dict[str, Shape] = {
    "2 to 4 layers": {},
    "3 layers, 1-D": {"depth": 3, "rows": True},
    "3 layers, 2-D": {"depth": 3, "rows": False},
    "12 layers, 1-D": {"depth": 12, "rows": True},
    "12 layers, 2-D": {"depth": 12, "rows": False},
}
# A network with a side beyond this may have blocks that go sample by sample.
MANY = 24
SHALLOW = 4  # layers; with more most have to leave maps their size


@dataclass(frozen=True)
class Case:
    """A network with weights, heads for its outputs, and a seed for whatever else is drawn."""

    net: FoldedNet
    heads: Heads
    seed: int

    @property
    def network(self) -> Network:
        return self.net.network

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng(self.seed)

    def features(self, number: int, count: int) -> np.ndarray:
        """What a layer may see of so many samples: (N, P, C)."""
        shape = count, self.network.positions_before(number), self.network.layer(number).into
        if number == 1 and self.network.input_kind == "pixels":
            return self.rng.integers(0, 256, shape, np.uint8)
        return self.rng.normal(size=shape).astype(np.float32)

    def samples(self, count: int) -> np.ndarray:
        """Inputs (N, H, W, C) of the whole network."""
        return self.features(1, count).reshape(count, *self.network.input_shape)

    def labels(self, count: int) -> np.ndarray:
        """Labels (N, L) that the heads may have."""
        return labels_of(self.heads, count, self.rng)

    def sgms(self) -> dict[int, FoldedSgm]:
        """An SGM with random weights behind every layer but the last."""
        return {k: self.sgm(k) for k in range(1, self.network.depth)}

    def sgm(self, number: int) -> FoldedSgm:
        rng, channels = np.random.default_rng([self.seed, number]), self.network.layer(number).out
        kernel, convs = self.network.sgm_kernel(number), []
        for into, out in ((channels + self.network.outputs, 5), (5, channels)):
            weight = rng.normal(size=(out, into, *kernel)) / np.sqrt(into * kernel[0] * kernel[1])
            bias = rng.normal(size=out) / 4
            convs.append(FoldedConv(weight.astype(np.float32), bias.astype(np.float32)))
        return FoldedSgm(number, self.network.after(number), tuple(convs))


def labels_of(heads: Heads, count: int, rng: np.random.Generator) -> np.ndarray:
    """Zeros and ones for log loss, classes for cross entropy, any value that can be reached."""
    parts = []
    for head in heads:
        shape = count, head.channels
        if head.kind == "cross_entropy":
            parts.append(np.eye(head.channels)[rng.integers(head.channels, size=count)])
        elif head.kind == "log_loss":
            parts.append(rng.integers(0, 2, shape))
        else:
            parts.append(rng.uniform(head.label_low, 1, shape))
    return np.concatenate(parts, axis=1).astype(np.float32)


@st.composite
def heads(draw: st.DrawFn, most: int = 3) -> Heads:
    """One to three heads; those behind a log loss may count only where that says so."""
    found: list[Head] = []
    for number in range(draw(st.integers(1, most))):
        kind, activation = draw(
            st.sampled_from(
                [
                    ("log_loss", "sigmoid"),
                    ("squared", "tanh"),
                    ("squared", "sigmoid"),
                    ("cross_entropy", "softmax"),
                ]
            )
        )
        channels = draw(st.integers(2 if kind == "cross_entropy" else 1, 4))
        weight, smoothing = draw(st.sampled_from([1.0, 0.3, 2.5])), 0.0
        if kind != "squared":
            smoothing = draw(st.sampled_from([0.0, 0.05, 0.4]))
        flags = [place for place, one in enumerate(flat(found)) if one.kind == "log_loss"]
        where = draw(st.sampled_from([None, *flags]))
        found.append(Head(f"h{number}", kind, channels, activation, weight, smoothing, where))
    return tuple(found)


def flat(found: list[Head]) -> list[Head]:
    """The head of every label."""
    return [head for head in found for _ in range(head.channels)]


@st.composite
def layers(draw: st.DrawFn, side: Pair, into: int, *, first: bool) -> Layer:
    """A layer for maps of this size; along a side of 1 it does nothing."""
    kernel, stride, padding, pool, pool_stride = [], [], [], [], []
    for length in side:
        wide = draw(st.integers(1, min(4, length)))
        pad = draw(st.integers(0, (wide - 1) // 2)) if length > 1 and not first else 0
        step = draw(st.integers(1, 3)) if length > 1 else 1
        seen = (length + 2 * pad - wide) // step + 1
        window = draw(st.sampled_from([1, 1, min(2, seen), min(3, seen), seen]))
        kernel.append(wide)
        stride.append(step)
        padding.append(pad)
        pool.append(window)
        pool_stride.append(draw(st.integers(1, window)))
    return Layer(
        into,
        draw(st.integers(1, 5)),
        (kernel[0], kernel[1]),
        (stride[0], stride[1]),
        (padding[0], padding[1]),
        draw(st.booleans()),
        (pool[0], pool[1]),
        (pool_stride[0], pool_stride[1]),
    )


@st.composite
def keeping(draw: st.DrawFn, side: Pair, into: int) -> Layer:
    """A layer that leaves maps their size: were there none, a deep network would soon have 1x1."""
    half = [min(draw(st.integers(0, 1)), (length - 1) // 2) for length in side]
    kernel, padding = (2 * half[0] + 1, 2 * half[1] + 1), (half[0], half[1])
    return Layer(into, draw(st.integers(2, 5)), kernel, padding=padding, relu=draw(st.booleans()))


@st.composite
def networks(
    draw: st.DrawFn,
    outputs: int,
    kinds: tuple[InputKind, ...] = ("pixels", "numbers"),
    *,
    relu: bool = False,
    padded_first: bool = True,
    depth: int | None = None,
    rows: bool | None = None,
) -> Network:
    """Layers on maps, rectangles or rows; the last sees all that is left.

    Two to four, or `depth`; with `rows` in one dimension, or not. With `relu` all layers but the
    last have one.
    """
    deep = depth is not None and depth > SHALLOW
    heights = {True: [1], False: [*range(2, LARGEST + 1)], None: [1, *range(2, LARGEST + 1)]}
    height = draw(st.sampled_from(heights[rows]))
    side: Pair = (height, MANY if deep else draw(st.sampled_from([*range(2, LARGEST + 1), MANY])))
    shape = (*side, draw(st.integers(1, 3)))
    into, found = shape[2], []
    for number in range(draw(st.integers(1, 3)) if depth is None else depth - 1):
        first = number == 0 and not padded_first
        keeps = deep and not first and draw(st.integers(0, 3)) > 0
        layer = draw(keeping(side, into) if keeps else layers(side, into, first=first))
        if relu:
            layer = Layer(**{**vars(layer), "relu": True})
        found.append(layer)
        side, into = layer.pooled(layer.convolved(side)), layer.out
    if draw(st.booleans()):
        found.append(Layer(into, outputs, side, relu=False))
    else:
        found.append(Layer(into, outputs, relu=False, pool=side))
    return Network(shape, tuple(found), draw(st.sampled_from(kinds)))


@st.composite
def cases(
    draw: st.DrawFn,
    kinds: tuple[InputKind, ...] = ("pixels", "numbers"),
    *,
    relu: bool = False,
    padded_first: bool = True,
    depth: int | None = None,
    rows: bool | None = None,
) -> Case:
    """A network with weights of about the size that keeps activations at one."""
    some = draw(heads())
    outputs = sum(head.channels for head in some)
    shape = {"depth": depth, "rows": rows}
    network = draw(networks(outputs, kinds, relu=relu, padded_first=padded_first, **shape))
    seed = draw(st.integers(0, 2**32 - 1))
    rng, folded = np.random.default_rng(seed), []
    for layer in network.layers:
        weight = rng.normal(size=(layer.out, layer.into, *layer.kernel)) / np.sqrt(layer.window)
        bias = rng.normal(size=layer.out) / 3
        folded.append(FoldedConv(weight.astype(np.float32), bias.astype(np.float32)))
    return Case(FoldedNet(network, tuple(folded)), some, seed)


def blocks_of(draw: st.DrawFn, network: Network) -> Blocks:
    """Some of the last layers, in blocks."""
    layers = network.last(draw(st.integers(1, network.depth)))
    ends = [layers[0], *(k for k in layers[1:] if draw(st.booleans())), layers[-1] + 1]
    return Blocks(tuple(range(first, end) for first, end in pairwise(ends)))


def plain_layer(layer: Layer, weight: Tensor, bias: Tensor, x: Tensor) -> Tensor:
    """Maps (N, C, H, W) through a layer, as torch has it."""
    x = F.conv2d(x, weight, bias, layer.stride, layer.padding)
    x = F.relu(x) if layer.relu else x
    return F.avg_pool2d(x, layer.pool, layer.pool_stride)


def plain_maps(case: Case, samples: np.ndarray, last: int) -> Tensor:
    """Inputs (N, H, W, C) through the first layers in float64: (N, C', H', W')."""
    x = torch.from_numpy(samples).double().permute(0, 3, 1, 2)
    x = x / 127.5 - 1 if case.network.input_kind == "pixels" else x
    for layer, arrays in list(zip(case.network.layers, case.net.layers, strict=True))[:last]:
        weight, bias = (torch.from_numpy(a).double() for a in (arrays.weight, arrays.bias))
        x = plain_layer(layer, weight, bias, x)
    return x
