"""Measure, without training: what gradient each SGM should give, and gives in float and in int8."""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto

from qsgm.angles import AngleEncoding
from qsgm.errors import QsgmError
from qsgm.train.fold import FoldedNet, FoldedSgm
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.layers import (
    Batch,
    Pass,
    TunedLayer,
    declare_batch,
    declare_features,
    declare_layers,
)
from qsgm.train.graphs.loss import activate, loss_and_error
from qsgm.train.graphs.sgm import (
    clipped_fraction,
    float_sgm,
    int8_sgm,
    scaled_inputs,
    sgm_inputs,
)
from qsgm.train.graphs.step import backward, forward_all, sgms_behind
from qsgm.train.graspnet import Loss
from qsgm.train.quantize import QuantizedSgm


def probe_model(
    net: FoldedNet,
    tuned: int,
    float_sgms: Mapping[int, FoldedSgm],
    int8_sgms: Mapping[int, QuantizedSgm],
    loss: Loss,
) -> ModelProto:
    """Gradients on the activation behind every SGM, each sample's own.

    Inputs are those of :mod:`qsgm.train.graphs.step` without rates and moments. Outputs for every
    SGM's layer k: `true{k}`, `float{k}`, `int8{k}`, each (B, C), and `clipped{k}`, the fraction of
    the int8 SGM's inputs that lay outside its ranges.

    Raises:
        QsgmError: fewer than two layers are tuned, so that there is no SGM, or one is missing.
    """
    if tuned < 2:
        raise QsgmError(
            f"cannot probe the SGMs of {tuned} tuned layers: the last layer has none; choose 2 or 3"
        )
    graph = Graph("probe")
    layers = declare_layers(graph, net, tuned)
    sgms_behind(layers, float_sgms), sgms_behind(layers, int8_sgms)
    batch = declare_batch(graph, net, tuned)
    passes = forward_all(graph, layers, batch.features)
    probe_truth(graph, layers, passes, batch, loss)
    for layer, done in zip(layers[:-1], passes[:-1], strict=True):
        number = layer.number
        probe_sgm(graph, done, batch, float_sgms[number], int8_sgms[number])
    return graph.model()


def head_model(net: FoldedNet, tuned: int, encoding: AngleEncoding) -> ModelProto:
    """`features` (N, P, C) and the tuned layers to `outputs` (N, 3): quality, sine, cosine."""
    graph = Graph("head")
    layers = declare_layers(graph, net, tuned)
    passes = forward_all(graph, layers, declare_features(graph, net, tuned))
    op = graph.within("head")
    activated = activate(op, op.Squeeze(passes[-1].after, op.shape(1)), encoding)
    graph.output("outputs", op.Concat(*activated, axis=1), np.float32, ("crops", 3))
    return graph.model()


def probe_truth(
    graph: Graph, layers: list[TunedLayer], passes: list[Pass], batch: Batch, loss: Loss
) -> None:
    """Declare `true{k}` of every layer but the last."""
    op = graph.within("truth")
    raw = op.Squeeze(passes[-1].after, op.shape(1))
    _, error = loss_and_error(op, loss, raw, batch.labels)
    gradients = backward(graph, layers, passes, op.Unsqueeze(error, op.shape(1)))
    for layer, gradient in zip(layers[:-1], gradients[:-1], strict=True):
        flat = op.Squeeze(gradient, op.shape(1))
        graph.output(f"true{layer.number}", flat, np.float32, ("batch", layer.channels))


def probe_sgm(
    graph: Graph, done: Pass, batch: Batch, float_one: FoldedSgm, int8_one: QuantizedSgm
) -> None:
    """Declare `float{k}`, `int8{k}` and `clipped{k}` of one layer."""
    number, shape = float_one.layer, ("batch", len(float_one.convs[-1].bias))
    op = graph.within(f"layer{number}/float")
    seen = sgm_inputs(op, done.after, batch)
    graph.output(f"float{number}", float_sgm(op, float_one, seen), np.float32, shape)
    op = graph.within(f"layer{number}/int8")
    scaled = scaled_inputs(op, int8_one, seen)
    graph.output(f"int8{number}", int8_sgm(op, int8_one, scaled), np.float32, shape)
    graph.output(f"clipped{number}", clipped_fraction(op, scaled), np.float32, ())
