"""A whole training step as one graph, block by block; one block is backpropagation.

Inputs: `features` (N, P, C) and `labels` (N, 3) of all crops; `rows` (B,), the batch; one scalar
`rate{k}` per layer; and the state, in which `weight{k}` (Co, kh * kw * Ci) and `bias{k}` are the
layer's and everything else starts at zero. All are float32, but for `rows`, int64, and features,
which are u8 codes or pixels. Which inputs are state shows in the outputs' names.
Outputs: every state under its name with `_next`; `loss`, the batch's mean before the update.
"""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto

from qsgm.blocks import Blocks
from qsgm.errors import QsgmError
from qsgm.folded import FoldedSgm
from qsgm.quantize import QuantizedSgm
from qsgm.train.curvature import FLAT, Curvature
from qsgm.train.fold import FoldedNet
from qsgm.train.graphs.build import Graph, Ops, Value
from qsgm.train.graphs.layers import (
    Batch,
    Pass,
    TunedLayer,
    bent_gradients,
    declare_batch,
    declare_layers,
    forward,
    gradient_before,
    through_activation,
    weight_gradients,
)
from qsgm.train.graphs.loss import loss_and_error
from qsgm.train.graphs.optimizers import Gradient, Optimizer, Rule
from qsgm.train.graphs.sgm import sgm_gradient
from qsgm.train.graspnet import Loss

AnySgm = FoldedSgm | QuantizedSgm


def step_model(
    net: FoldedNet,
    blocks: Blocks,
    sgms: Mapping[int, AnySgm],
    loss: Loss,
    optimizer: Optimizer,
    curvatures: Mapping[int, Curvature] = FLAT,
) -> ModelProto:
    """A feed-forward step: every block updates itself before the next one runs.

    Args:
        net: gives the geometry; its weights are inputs of the graph.
        blocks: which of the last layers are trained, and how far true gradients are carried back.
        sgms: by layer, float or int8; one behind every block but the last.
        loss: gives the last block its gradient.
        optimizer: updates each parameter.
        curvatures: by layer, where gradients are bent before the optimizer sees them.

    Raises:
        QsgmError: an SGM is missing.
    """
    graph = Graph("step")
    layers = {layer.number: layer for layer in declare_layers(graph, net, len(blocks.layers))}
    used = sgms_behind(blocks, sgms)
    batch = declare_batch(graph, net, len(blocks.layers))
    rule = optimizer.rule(graph)
    x = batch.features
    for group in blocks.groups:
        block = [layers[number] for number in group]
        passes = forward_all(graph, block, x)
        op, x = graph.within(f"layer{group[-1]}"), passes[-1].after
        if group[-1] in used:
            gradient = sgm_gradient(op, used[group[-1]], block[-1].after_side, x, batch)
        else:
            gradient = report_loss(op, loss, x, batch)
        # Divided by the batch here, where the gradient is smallest: the rest is sums.
        shared = op.Div(gradient, batch.size)
        update_block(graph, block, passes, shared, curvatures, optimizer, rule)
    return graph.model()


def sgms_behind(blocks: Blocks, sgms: Mapping[int, AnySgm]) -> dict[int, AnySgm]:
    """The SGM behind every block but the last. Raises QsgmError where one is missing."""
    if missing := [number for number in blocks.sgm_layers if number not in sgms]:
        raise QsgmError(
            f"no SGM for layers {missing}: tuning {blocks} needs one behind each of"
            f" {[*blocks.sgm_layers]}"
        )
    return {number: sgms[number] for number in blocks.sgm_layers}


def forward_all(graph: Graph, layers: list[TunedLayer], x: Value) -> list[Pass]:
    """All these layers' forward passes, kept for the way back."""
    passes = []
    for layer in layers:
        passes.append(forward(graph.within(f"layer{layer.number}"), layer, x))
        x = passes[-1].after
    return passes


def report_loss(op: Ops, loss: Loss, raw: Value, batch: Batch) -> Value:
    """Declare the output `loss`; return each sample's error, d loss / d raw outputs (B, 3)."""
    mean, error = loss_and_error(op, loss, raw, batch.labels)
    op.graph.output("loss", mean, np.float32, ())
    return error


def update_block(
    graph: Graph,
    layers: list[TunedLayer],
    passes: list[Pass],
    gradient: Value,
    curvatures: Mapping[int, Curvature],
    optimizer: Optimizer,
    rule: Rule,
) -> None:
    """All these layers' updates, from the gradient (B * P', C) on the last one's activation.

    It is carried back with the weights as they were.
    """
    for layer, done in list(zip(layers, passes, strict=True))[::-1]:
        op = graph.within(f"layer{layer.number}")
        dz = through_activation(op, layer, done, gradient)
        if layer.number in curvatures:
            gradients = bent_gradients(op, layer, done, dz, curvatures[layer.number])
        else:
            gradients = weight_gradients(op, layer, done, dz)
        update_layer(op, layer, *gradients, optimizer, rule)
        if layer is not layers[0]:
            gradient = gradient_before(op, layer, dz)


def update_layer(
    op: Ops,
    layer: TunedLayer,
    d_weight: Gradient,
    d_bias: Gradient,
    optimizer: Optimizer,
    rule: Rule,
) -> None:
    """One layer's update from the gradients (Co, K) and (1, Co) of its weight and bias."""
    rate = op.graph.input(f"rate{layer.number}", np.float32, ())

    def update(value: Value, kind: str, gradient: Gradient, shape: tuple[int, int]) -> Value:
        names = [f"{kind}_{moment}{layer.number}" for moment in optimizer.moments]
        moments = [op.graph.input(name, np.float32, shape) for name in names]
        next_value, next_moments = rule(op, value, moments, gradient, rate)
        for name, result in zip(names, next_moments, strict=True):
            op.graph.output(f"{name}_next", result, np.float32, shape)
        return next_value

    weight = update(layer.weight, "weight", d_weight, (layer.channels, layer.width))
    op.graph.output(f"{layer.weight}_next", weight, np.float32, (layer.channels, layer.width))
    bias = op.Squeeze(update(layer.bias, "bias", d_bias, (1, layer.channels)), op.shape(0))
    op.graph.output(f"{layer.bias}_next", bias, np.float32, (layer.channels,))
