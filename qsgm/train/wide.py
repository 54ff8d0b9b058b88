"""The network and its SGMs with more channels and random weights, to see what width costs (host).

Time does not depend on what the numbers are, as long as they are ordinary ones: weights are drawn
so that activations keep their size from layer to layer, and ranges are those of random inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch
from onnx import ModelProto

from qsgm.bundle import Bundle
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm, float_trace
from qsgm.sgm.int8 import (
    LABEL_HIGH,
    LABEL_LOW,
    LABELS,
    ActivationBits,
    QuantizedSgm,
    SgmRanges,
    quantize_sgm,
)
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.layers import CROP_SIDE
from qsgm.train.graphs.sgm import sgm_gradient
from qsgm.train.graphs.step import AnySgm
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.fold import FoldedLayer, FoldedNet
from qsgm.train.model.graspnet import CHANNELS, KERNELS, LAYERS, POOL, POOL_AFTER_LAYER, STRIDES
from qsgm.train.model.sgm import KERNEL_BEHIND_LAYER
from qsgm.train.quantization.trunk import QuantizedLayer, feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_crops
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


def wide_net(width: int) -> WideNet:
    """A :func:`random_net` that takes its steps and its int8 layers from random crops."""
    net, rng = random_net(width), np.random.default_rng(SEED)
    crops = rng.integers(0, 256, (RANGE_CROPS, CROP_SIDE, CROP_SIDE, 3), np.uint8)
    ranges = dict(observe_crops(net, crops))
    return WideNet(replace(net, feature_steps=feature_steps(ranges)), quantize_trunk(net, ranges))


def random_net(width: int) -> FoldedNet:
    """Every layer's output so many times as wide, but the last one's: those are the answers."""
    rng = np.random.default_rng(SEED)
    channels = (CHANNELS[0], *(width * count for count in CHANNELS[1:-1]), CHANNELS[-1])
    return FoldedNet(
        tuple(
            FoldedLayer(
                random_weight(rng, channels[number], channels[number - 1], KERNELS[number - 1]),
                np.zeros(channels[number], np.float32),
                STRIDES[number - 1],
                relu=number < LAYERS,
                pool=POOL if number == POOL_AFTER_LAYER else 1,
            )
            for number in range(1, LAYERS + 1)
        )
    )


def random_weight(rng: np.random.Generator, out: int, into: int, kernel: int) -> FloatArray:
    """(out, into, kernel, kernel); behind a ReLU it keeps the size of activations (He 2015)."""
    deviation = np.sqrt(2 / (into * kernel**2))
    return rng.normal(0, deviation, (out, into, kernel, kernel)).astype(np.float32)


def wide_sgms(
    bundle: Bundle, layers: Sequence[int], width: int, hidden: int
) -> dict[int, FoldedSgm]:
    """SGMs for a :func:`wide_net`, their hidden convolutions `hidden` times as wide as a bundle's.

    Args:
        bundle: whose SGMs are widened.
        layers: behind which they stand.
        width: of the network.
        hidden: 1: what the bundle has.
    """
    sgms = {}
    for layer in layers:
        shipped = [len(conv.bias) for conv in bundle.float_sgm(layer).convs[:-1]]
        widths = [hidden * count for count in shipped]
        sgms[layer] = random_sgm(layer, width * CHANNELS[layer], widths)
    return sgms


def random_sgm(layer: int, channels: int, hidden: Sequence[int]) -> FoldedSgm:
    """An SGM behind a layer of so many channels, with hidden convolutions as wide as these."""
    rng = np.random.default_rng([SEED, layer])
    convs = [
        FoldedConv(
            random_weight(rng, out, into, KERNEL_BEHIND_LAYER[layer]), np.zeros(out, np.float32)
        )
        for into, out in pairwise((channels + LABELS, *hidden, channels))
    ]
    return FoldedSgm(layer, tuple(convs))


def random_curvature(net: FoldedNet, layer: int) -> Curvature:
    """Of the right sides for a layer: it bends as many numbers as a meta-learned one."""
    out, into, kernel, _ = net.layers[layer - 1].weight.shape
    generator = torch.Generator().manual_seed(SEED)
    matrices = (
        torch.eye(side) + 0.01 * torch.randn(side, side, generator=generator)
        for side in (kernel**2, into, out, out)
    )
    return Curvature(*matrices)


def quantized(sgm: FoldedSgm, bits: ActivationBits) -> QuantizedSgm:
    """With the ranges of random labels, and of activations from 0 to 1."""
    channels = len(sgm.convs[-1].bias)
    low = np.concatenate([np.zeros(channels, np.float32), LABEL_LOW])
    high = np.concatenate([np.ones(channels, np.float32), LABEL_HIGH])
    rng = np.random.default_rng([SEED, sgm.layer])
    shape = (RANGE_INPUTS, sgm.kernel**2, len(low))
    _, hidden = float_trace(sgm, rng.uniform(low, high, shape).astype(np.float32))
    highest = tuple(maps.max(axis=(0, 1)) for maps in hidden)
    return quantize_sgm(sgm, SgmRanges(low, high, highest), bits)


def sgm_model(sgm: AnySgm, channels: int, side: int) -> ModelProto:
    """An SGM alone: `activation` (B * P, C) and `labels` (B, 3) to `gradient` (B * P, C)."""
    graph = Graph("sgm")
    op = graph.within(f"layer{sgm.layer}")
    activation = graph.input("activation", np.float32, ("rows", channels))
    labels = graph.input("labels", np.float32, ("batch", LABELS))
    gradient = sgm_gradient(op, sgm, side, activation, labels)
    graph.output("gradient", gradient, np.float32, ("rows", channels))
    return graph.model()
