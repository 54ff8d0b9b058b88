"""A whole training step as one graph: layer-local, or by backpropagation as the baseline.

Inputs: `features` (N, P, C) and `labels` (N, 3) of all crops; `rows` (B,), the batch; one scalar
`rate{k}` per layer; and the state, in which `weight{k}` (Co, kh * kw * Ci) and `bias{k}` are the
layer's and everything else starts at zero (all float32; which inputs are state shows in the
outputs' names).
Outputs: every state under its name with `_next`; `loss`, the batch's mean before the update.
"""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto

from qsgm.errors import QsgmError
from qsgm.train.fold import FoldedNet, FoldedSgm
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.train.graphs.layers import (
    Batch,
    Pass,
    TunedLayer,
    declare_batch,
    declare_layers,
    forward,
    gradient_before,
    through_activation,
    weight_gradients,
)
from qsgm.train.graphs.loss import loss_and_error
from qsgm.train.graphs.optimizers import Optimizer, Rule
from qsgm.train.graphs.sgm import sgm_gradient
from qsgm.train.graspnet import Loss
from qsgm.train.quantize import QuantizedSgm

AnySgm = FoldedSgm | QuantizedSgm


def step_model(
    net: FoldedNet, tuned: int, sgms: Mapping[int, AnySgm], loss: Loss, optimizer: Optimizer
) -> ModelProto:
    """A feed-forward step: every layer updates itself before the next one runs.

    Args:
        net: gives the geometry; its weights are inputs of the graph.
        tuned: how many of the last layers are trained, 1 to 3.
        sgms: by layer, float or int8; one for each tuned layer but the last.
        loss: gives the last layer its gradient.
        optimizer: updates each parameter.

    Raises:
        QsgmError: for another number of layers, or an SGM too few.
    """
    graph = Graph("local_step")
    layers = declare_layers(graph, net, tuned)
    used = sgms_behind(layers, sgms)
    batch = declare_batch(graph, net, tuned)
    rule = optimizer.rule(graph)
    x = batch.features
    for layer in layers[:-1]:
        op = graph.within(f"layer{layer.number}")
        done = forward(op, layer, x)
        gradient = sgm_gradient(op, used[layer.number], done.after, batch)
        update_layer(op, layer, done, gradient, batch, optimizer, rule)
        x = done.after
    op = graph.within(f"layer{layers[-1].number}")
    done = forward(op, layers[-1], x)
    error = report_loss(op, loss, done, batch)
    update_layer(op, layers[-1], done, error, batch, optimizer, rule)
    return graph.model()


def backprop_step_model(net: FoldedNet, tuned: int, loss: Loss, optimizer: Optimizer) -> ModelProto:
    """The same step with true gradients, carried back through all tuned layers."""
    graph = Graph("backprop_step")
    layers = declare_layers(graph, net, tuned)
    batch = declare_batch(graph, net, tuned)
    rule = optimizer.rule(graph)
    passes = forward_all(graph, layers, batch.features)
    error = report_loss(graph.within("loss"), loss, passes[-1], batch)
    gradients = backward(graph, layers, passes, error)
    for layer, done, gradient in zip(layers, passes, gradients, strict=True):
        op = graph.within(f"layer{layer.number}")
        update_layer(op, layer, done, gradient, batch, optimizer, rule)
    return graph.model()


def sgms_behind(layers: list[TunedLayer], sgms: Mapping[int, AnySgm]) -> dict[int, AnySgm]:
    """The SGM of every tuned layer but the last. Raises QsgmError where one is missing."""
    numbers = [layer.number for layer in layers[:-1]]
    if missing := [number for number in numbers if number not in sgms]:
        raise QsgmError(f"no SGM for layers {missing}: tuning needs one behind each of {numbers}")
    return {number: sgms[number] for number in numbers}


def forward_all(graph: Graph, layers: list[TunedLayer], x: Value) -> list[Pass]:
    """All tuned layers' forward passes, kept for :func:`backward`."""
    passes = []
    for layer in layers:
        passes.append(forward(graph.within(f"layer{layer.number}"), layer, x))
        x = passes[-1].after
    return passes


def backward(
    graph: Graph, layers: list[TunedLayer], passes: list[Pass], error: Value
) -> list[Value]:
    """Every layer's gradient on its activation (B, P', C), each sample's own."""
    gradients = [error]
    for layer, done in list(zip(layers, passes, strict=True))[:0:-1]:
        op = graph.within(f"layer{layer.number}/back")
        dz = through_activation(op, layer, done, gradients[0])
        gradients.insert(0, gradient_before(op, layer, dz))
    return gradients


def report_loss(op: Ops, loss: Loss, last: Pass, batch: Batch) -> Value:
    """Declare the output `loss`; return each sample's error, d loss / d raw outputs (B, 1, 3)."""
    mean, error = loss_and_error(op, loss, op.Squeeze(last.after, op.shape(1)), batch.labels)
    op.graph.output("loss", mean, np.float32, ())
    return op.Unsqueeze(error, op.shape(1))


def update_layer(
    op: Ops,
    layer: TunedLayer,
    done: Pass,
    gradient: Value,
    batch: Batch,
    optimizer: Optimizer,
    rule: Rule,
) -> None:
    """One layer's update from each sample's gradient on its activation (B, P', C)."""
    # Divided by the batch here, where the gradient is smallest: the rest is sums.
    dz = through_activation(op, layer, done, op.Mul(gradient, batch.share))
    d_weight, d_bias = weight_gradients(op, done, dz)
    rate = op.graph.input(f"rate{layer.number}", np.float32, ())
    for value, kind, d_value in ((layer.weight, "weight", d_weight), (layer.bias, "bias", d_bias)):
        shape = (layer.channels, layer.width) if kind == "weight" else (layer.channels,)
        names = [f"{kind}_{moment}{layer.number}" for moment in optimizer.moments]
        moments = [op.graph.input(name, np.float32, shape) for name in names]
        next_value, next_moments = rule(op, value, moments, d_value, rate)
        for name, result in zip([value, *names], [next_value, *next_moments], strict=True):
            op.graph.output(f"{name}_next", result, np.float32, shape)
