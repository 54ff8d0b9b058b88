"""Measure, without training: what gradient each SGM should give, and gives in float and in int8."""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto

from qsgm.blocks import single_layers
from qsgm.errors import QsgmError
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import QuantizedSgm
from qsgm.task import Heads
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.train.graphs.layers import (
    Batch,
    Pass,
    TunedLayer,
    declare_batch,
    declare_features,
    declare_layers,
    gradient_before,
    summed_gradients,
    through_activation,
    weight_gradients,
)
from qsgm.train.graphs.loss import activate, loss_and_error
from qsgm.train.graphs.optimizers import value_of
from qsgm.train.graphs.sgm import (
    clipped_fraction,
    float_sgm,
    int8_sgm,
    scaled_inputs,
    sgm_inputs,
    underflow_fraction,
)
from qsgm.train.graphs.step import forward_all, sgms_behind
from qsgm.train.model.arrays import FoldedNet


def probe_model(
    net: FoldedNet,
    tuned: int,
    float_sgms: Mapping[int, FoldedSgm],
    int8_sgms: Mapping[int, QuantizedSgm],
    heads: Heads,
) -> ModelProto:
    """Gradients on every tuned layer's activation but the last one's, each sample's own.

    Inputs are those of :mod:`qsgm.train.graphs.step` without rates and moments. Outputs for every
    SGM's layer k: `activation{k}`, `true{k}`, `float{k}`, `int8{k}`, each (B, P, C);
    `update_true{k}` and so on, the gradients of the layer's weight and bias that these lead to,
    each (C, K + 1), the bias's last, summed over the batch; `clipped{k}` and `underflow{k}`, the
    fractions of the int8 SGM's inputs that lay outside its ranges, and that were rounded to 0.

    Raises:
        QsgmError: fewer than two layers are tuned, so that there is no SGM, or one is missing.
    """
    if tuned < 2:
        raise QsgmError(
            f"cannot probe the SGMs of {tuned} tuned layers: the last layer has none; choose more"
        )
    blocks = single_layers(net.network.last(tuned))
    sgms_behind(blocks, float_sgms), sgms_behind(blocks, int8_sgms)
    graph = Graph("probe")
    layers = declare_layers(graph, net, tuned)
    batch = declare_batch(graph, net, tuned)
    passes = forward_all(graph, layers, batch.features)
    truth = probe_truth(graph, layers, passes, batch, heads)
    for layer, done in zip(layers[:-1], passes[:-1], strict=True):
        number = layer.number
        given = probe_sgm(graph, layer, done, batch, float_sgms[number], int8_sgms[number])
        probe_updates(graph, layer, done, {"true": truth[number], **given})
    return graph.model()


def head_model(net: FoldedNet, tuned: int, heads: Heads) -> ModelProto:
    """`features` (N, P, C) and the tuned layers to `outputs` (N, O), activated."""
    graph = Graph("head")
    layers = declare_layers(graph, net, tuned)
    passes = forward_all(graph, layers, declare_features(graph, net, tuned))
    op = graph.within("head")
    outputs = activate(op, heads, passes[-1].after)
    graph.output("outputs", outputs, np.float32, ("samples", net.network.outputs))
    return graph.model()


def probe_truth(
    graph: Graph, layers: list[TunedLayer], passes: list[Pass], batch: Batch, heads: Heads
) -> dict[int, Value]:
    """Declare `true{k}` of every layer but the last; returns them by layer."""
    truth = {}
    op = graph.within("truth")
    _, gradient = loss_and_error(op, heads, passes[-1].after, batch.labels)
    for layer, done, before in list(zip(layers[1:], passes[1:], layers, strict=False))[::-1]:
        op = graph.within(f"layer{layer.number}/back")
        gradient = gradient_before(op, layer, through_activation(op, layer, done, gradient))
        report_maps(op, f"true{before.number}", gradient, before)
        truth[before.number] = gradient
    return truth


def probe_sgm(
    graph: Graph,
    layer: TunedLayer,
    done: Pass,
    batch: Batch,
    float_one: FoldedSgm,
    int8_one: QuantizedSgm,
) -> dict[str, Value]:
    """Declare `activation{k}`, `float{k}`, `int8{k}`, `clipped{k}` of a layer; both gradients."""
    number = layer.number
    op = graph.within(f"layer{number}/float")
    seen = sgm_inputs(op, done.after, layer.after_side, batch.labels, layer.network.outputs)
    report_maps(op, f"activation{number}", done.after, layer)
    floating = float_sgm(op, float_one, seen)
    report_maps(op, f"float{number}", floating, layer)
    op = graph.within(f"layer{number}/int8")
    int8 = int8_sgm(op, int8_one, seen)
    report_maps(op, f"int8{number}", int8, layer)
    clipped = clipped_fraction(op, int8_one, scaled_inputs(op, int8_one, seen))
    graph.output(f"clipped{number}", clipped, np.float32, ())
    underflow = underflow_fraction(op, int8_one, seen)
    graph.output(f"underflow{number}", underflow, np.float32, ())
    return {"float": floating, "int8": int8}


def report_maps(op: Ops, name: str, rows: Value, layer: TunedLayer) -> None:
    """Declare rows (B * P, C) behind a layer as an output, crop by crop: (B, P, C)."""
    positions = layer.positions_after
    maps = op.Reshape(rows, op.shape(-1, positions, layer.layer.out))
    op.graph.output(name, maps, np.float32, ("batch", positions, layer.layer.out))


def probe_updates(
    graph: Graph, layer: TunedLayer, done: Pass, gradients: Mapping[str, Value]
) -> None:
    """Declare `update_true{k}` and so on: what a layer would make of each of its gradients."""
    for name, gradient in gradients.items():
        op = graph.within(f"layer{layer.number}/update_{name}")
        dz = through_activation(op, layer, done, gradient)
        found = weight_gradients(op, layer, summed_gradients(op, done, dz))
        d_weight, d_bias = value_of(op, found.weight), value_of(op, found.bias)
        update = op.Concat(d_weight, op.Transpose(d_bias, perm=(1, 0)), axis=1)
        shape = layer.layer.out, layer.layer.window + 1
        graph.output(f"update_{name}{layer.number}", update, np.float32, shape)
