"""The network and its SGMs with more channels and random weights, to see what width costs.

Time does not depend on what the numbers are, as long as they are ordinary ones: weights are drawn
so that activations keep their size from layer to layer, and ranges are those of random inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from onnx import ModelProto

from qsgm.bundle import Bundle
from qsgm.network import Network
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm, float_trace
from qsgm.sgm.int8 import ActivationBits, QuantizedSgm, SgmRanges, quantize_sgm
from qsgm.task import Heads, label_span
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.sgm import sgm_gradient
from qsgm.train.graphs.step import AnySgm
from qsgm.train.model.arrays import CurvatureArrays, FoldedNet
from qsgm.train.quantization.trunk import QuantizedLayer, feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_samples
from qsgm.weights import to_step_layout

SEED = 0
RANGE_CROPS, RANGE_INPUTS = 4, 200  # random ones, to take ranges of


@dataclass(frozen=True)
class WideNet:
    """A network with steps for u8 features, and its layers that can be frozen in int8."""

    net: FoldedNet
    int8_trunk: Mapping[int, QuantizedLayer]

    def start(self, layers: Sequence[int]) -> dict[str, FloatArray]:
        """Weights (Co, kh * kw * Ci) and biases (Co,) of these layers, by input of a step."""
        chosen = {number: self.net.layers[number - 1] for number in layers}
        weights = {f"weight{k}": to_step_layout(layer.weight) for k, layer in chosen.items()}
        return weights | {f"bias{k}": layer.bias for k, layer in chosen.items()}


def wide_net(network: Network, width: int) -> WideNet:
    """A :func:`random_net` that takes its steps and its int8 layers from random crops."""
    net, rng = random_net(wider(network, width)), np.random.default_rng(SEED)
    crops = rng.integers(0, 256, (RANGE_CROPS, *network.input_shape), np.uint8)
    ranges = dict(observe_samples(net, crops))
    return WideNet(replace(net, feature_steps=feature_steps(ranges)), quantize_trunk(net, ranges))


def wider(network: Network, width: int) -> Network:
    """Every layer's output so many times as wide, but the last one's: those are the answers."""
    last = network.depth - 1
    layers = [
        replace(
            layer,
            into=layer.into * (width if k > 0 else 1),
            out=layer.out * (width if k < last else 1),
        )
        for k, layer in enumerate(network.layers)
    ]
    return replace(network, layers=tuple(layers))


def random_net(network: Network) -> FoldedNet:
    """Random weights and no biases."""
    rng = np.random.default_rng(SEED)
    return FoldedNet(
        network,
        tuple(
            FoldedConv(
                random_weight(rng, layer.out, layer.into, layer.kernel),
                np.zeros(layer.out, np.float32),
            )
            for layer in network.layers
        ),
    )


def random_weight(
    rng: np.random.Generator, out: int, into: int, kernel: tuple[int, int]
) -> FloatArray:
    """(out, into, kh, kw); behind a ReLU it keeps the size of activations (He 2015)."""
    deviation = np.sqrt(2 / (into * kernel[0] * kernel[1]))
    return rng.normal(0, deviation, (out, into, *kernel)).astype(np.float32)


def random_sgm(network: Network, layer: int, hidden: Sequence[int]) -> FoldedSgm:
    """An SGM behind a layer, with hidden convolutions as wide as these."""
    rng = np.random.default_rng([SEED, layer])
    channels, kernel = network.layer(layer).out, network.sgm_kernel(layer)
    convs = [
        FoldedConv(random_weight(rng, out, into, kernel), np.zeros(out, np.float32))
        for into, out in pairwise((channels + network.outputs, *hidden, channels))
    ]
    return FoldedSgm(layer, network.after(layer), tuple(convs))


def hidden_channels(bundle: Bundle, layer: int, width: int) -> list[int]:
    """Channels of the hidden convolutions of a bundle's SGM, so many times as many."""
    return [width * len(conv.bias) for conv in bundle.float_sgm(layer).convs[:-1]]


def random_curvature(network: Network, number: int) -> CurvatureArrays:
    """Matrices of the right sides for a layer, as many numbers as meta-learned ones."""
    layer, rng = network.layer(number), np.random.default_rng(SEED)
    sides = (layer.kernel[0] * layer.kernel[1], layer.into, layer.out, layer.out)
    near = (np.eye(side) + 0.01 * rng.standard_normal((side, side)) for side in sides)
    return CurvatureArrays(*(matrix.astype(np.float32) for matrix in near))


def quantized(sgm: FoldedSgm, bits: ActivationBits, heads: Heads) -> QuantizedSgm:
    """With the ranges of random labels, and of activations from 0 to 1."""
    channels, (lowest, highest) = len(sgm.convs[-1].bias), label_span(heads)
    low = np.concatenate([np.zeros(channels, np.float32), lowest])
    high = np.concatenate([np.ones(channels, np.float32), highest])
    rng = np.random.default_rng([SEED, sgm.layer])
    shape = (RANGE_INPUTS, sgm.side[0] * sgm.side[1], len(low))
    _, hidden = float_trace(sgm, rng.uniform(low, high, shape).astype(np.float32))
    tops = tuple(maps.max(axis=(0, 1)) for maps in hidden)
    return quantize_sgm(sgm, SgmRanges(low, high, tops), bits)


def sgm_model(sgm: AnySgm, network: Network) -> ModelProto:
    """An SGM alone: `activation` (B * P, C) and `labels` (B, L) to `gradient` (B * P, C)."""
    graph, channels, labels = Graph("sgm"), network.layer(sgm.layer).out, network.outputs
    op = graph.within(f"layer{sgm.layer}")
    activation = graph.input("activation", np.float32, ("rows", channels))
    label = graph.input("labels", np.float32, ("batch", labels))
    gradient = sgm_gradient(op, sgm, activation, label, labels)
    graph.output("gradient", gradient, np.float32, ("rows", channels))
    return graph.model()
