"""A whole training step as one graph, block by block; one block is backpropagation.

Inputs: `features` (N, P, C) and `labels` (N, L) of all samples; `rows` (B,), the batch; one scalar
`rate{k}` per layer; and the state, in which `weight{k}` (Co, kh * kw * Ci) and `bias{k}` are the
layer's and everything else starts at zero. All are float32, but for `rows`, int64, and features,
which are u8 codes or pixels. Which inputs are state shows in the outputs' names.
Outputs: every state under its name with `_next`; `loss`, the batch's mean before the update.
"""

from collections.abc import Mapping

import numpy as np
from onnx import ModelProto, numpy_helper

from qsgm.blocks import Blocks
from qsgm.errors import QsgmError
from qsgm.network import area
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import QuantizedSgm
from qsgm.task import Heads
from qsgm.train.graphs.build import Graph, Value
from qsgm.train.graphs.layers import (
    Batch,
    Gradients,
    Pass,
    TunedLayer,
    declare_batch,
    declare_layers,
    forward,
    gradient_before,
    preconditioned_gradients,
    summed_gradients,
    through_activation,
    weight_gradients,
)
from qsgm.train.graphs.loss import loss_and_error
from qsgm.train.graphs.optimizers import Gradient, Optimizer, Rule, plus
from qsgm.train.graphs.sgm import sgm_gradient
from qsgm.train.model.arrays import FLAT_ARRAYS, CurvatureArrays, FoldedNet

AnySgm = FoldedSgm | QuantizedSgm


def step_model(
    net: FoldedNet,
    blocks: Blocks,
    sgms: Mapping[int, AnySgm],
    heads: Heads,
    optimizer: Optimizer,
    curvatures: Mapping[int, CurvatureArrays] = FLAT_ARRAYS,
) -> ModelProto:
    """A feed-forward step: every block updates itself before the next one runs.

    Args:
        net: gives the geometry; its weights are inputs of the graph.
        blocks: which of the last layers are trained, and how far true gradients are carried back.
        sgms: by layer, float or int8; one behind every block but the last.
        heads: give the last block its gradient.
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
        if group[-1] not in used:
            gradients, x = last_block(graph, block, heads, x, batch)
        elif any(layer.many_windows for layer in block):
            gradients, x = block_by_crops(graph, block, used[group[-1]], x, batch)
        else:
            gradients, x = whole_block(graph, block, used[group[-1]], x, batch)
        for layer, summed in list(zip(block, gradients, strict=True))[::-1]:
            update_layer(graph, layer, summed, curvatures, optimizer, rule)
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


def last_block(
    graph: Graph, block: list[TunedLayer], heads: Heads, x: Value, batch: Batch
) -> tuple[list[Gradients], Value]:
    """Gradients from the loss, which is declared as an output; and the raw outputs (B, O)."""
    op = graph.within(f"layer{block[-1].number}")
    passes = forward_all(graph, block, x)
    mean, error = loss_and_error(op, heads, passes[-1].after, batch.labels)
    graph.output("loss", mean, np.float32, ())
    return carried_back(graph, block, passes, op.Div(error, batch.size)), passes[-1].after


def whole_block(
    graph: Graph, block: list[TunedLayer], sgm: AnySgm, x: Value, batch: Batch
) -> tuple[list[Gradients], Value]:
    """Gradients from the SGM behind a block; and what the block gives, (B * P', C)."""
    op, last = graph.within(f"layer{block[-1].number}"), block[-1]
    passes = forward_all(graph, block, x)
    gradient = sgm_gradient(op, sgm, passes[-1].after, batch.labels, last.network.outputs)
    # Divided by the batch here, where the gradient is smallest: the rest is sums.
    return carried_back(graph, block, passes, op.Div(gradient, batch.size)), passes[-1].after


def block_by_crops(
    graph: Graph, block: list[TunedLayer], sgm: AnySgm, x: Value, batch: Batch
) -> tuple[list[Gradients], Value]:
    """A block's gradients with one sample's windows in memory at a time.

    With an SGM behind it a block asks nothing of the layers behind, and its gradients are sums over
    crops: what has to be there for all of them is no more than what it reads and gives.
    Backpropagation comes back to every crop's windows.
    """
    first, last = block[0], block[-1]
    body = Graph("crop", graph)
    sums = [declare_sums(body, layer) for layer in block]
    maps = area(first.side), first.layer.into
    crop = body.input(f"input{first.number}", first.features or np.float32, maps)
    label = body.input(f"label{first.number}", np.float32, (first.network.outputs,))
    add_crop(body, block, sgm, sums, crop, label)
    op = graph.within(f"layer{last.number}")
    zero = numpy_helper.from_array(np.zeros(1, np.float32))  # tract has another default
    nothing = [
        op.ConstantOfShape(op.shape(*shape), value=zero)
        for layer in block
        for shape in gradient_shapes(layer)
    ]
    crops = op.Reshape(x, op.shape(-1, *maps)) if first.features is None else x
    found, (after,) = op.one_by_one(body, nothing, [crops, batch.labels])
    means = [op.Div(total, batch.size) for total in found]
    gradients = [Gradients(*pair) for pair in zip(means[::2], means[1::2], strict=True)]
    return gradients, op.Reshape(after, op.shape(-1, last.layer.out))


def gradient_shapes(layer: TunedLayer) -> tuple[tuple[int, int], tuple[int, int]]:
    """Shapes of the gradients of a layer's weight and bias."""
    return (layer.layer.out, layer.layer.window), (1, layer.layer.out)


def declare_sums(body: Graph, layer: TunedLayer) -> tuple[Value, Value]:
    """Sums of a layer's gradients over the crops before this one."""
    weight, bias = gradient_shapes(layer)
    return (
        body.input(f"weight_sum{layer.number}", np.float32, weight),
        body.input(f"bias_sum{layer.number}", np.float32, bias),
    )


def add_crop(
    body: Graph,
    block: list[TunedLayer],
    sgm: AnySgm,
    sums: list[tuple[Value, Value]],
    crop: Value,  # (P, Ci)
    label: Value,  # (L,)
) -> None:
    """Declare the sums with this crop's gradients, and what the block gives for it, (P', C)."""
    last = block[-1]
    op = body.within(f"layer{last.number}")
    passes = forward_all(body, block, crop)
    labels = op.Reshape(label, op.shape(-1, last.network.outputs))
    gradient = sgm_gradient(op, sgm, passes[-1].after, labels, last.network.outputs)
    found = carried_back(body, block, passes, gradient)
    for layer, so_far, one in zip(block, sums, found, strict=True):
        totals = plus(op, one.weight, so_far[0], 1.0), plus(op, one.bias, so_far[1], 1.0)
        for name, total, shape in zip(so_far, totals, gradient_shapes(layer), strict=True):
            body.output(f"{name}_next", total, np.float32, shape)
    shape = last.positions_after, last.layer.out
    body.output(f"after{last.number}", passes[-1].after, np.float32, shape)


def carried_back(
    graph: Graph, block: list[TunedLayer], passes: list[Pass], gradient: Value
) -> list[Gradients]:
    """All these layers' gradients, from the one (B * P', C) on the last one's activation.

    It is carried back with the weights as they were.
    """
    found = []
    for layer, done in list(zip(block, passes, strict=True))[::-1]:
        op = graph.within(f"layer{layer.number}")
        dz = through_activation(op, layer, done, gradient)
        found.append(summed_gradients(op, done, dz))
        if layer is not block[0]:
            gradient = gradient_before(op, layer, dz)
    return found[::-1]


def update_layer(
    graph: Graph,
    layer: TunedLayer,
    summed: Gradients,
    curvatures: Mapping[int, CurvatureArrays],
    optimizer: Optimizer,
    rule: Rule,
) -> None:
    """One layer's update."""
    op = graph.within(f"layer{layer.number}")
    if layer.number in curvatures:
        gradients = preconditioned_gradients(op, layer, summed, curvatures[layer.number])
    else:
        gradients = weight_gradients(op, layer, summed)
    rate = op.graph.input(f"rate{layer.number}", np.float32, ())

    def update(value: Value, kind: str, gradient: Gradient, shape: tuple[int, int]) -> Value:
        names = [f"{kind}_{moment}{layer.number}" for moment in optimizer.moments]
        moments = [op.graph.input(name, np.float32, shape) for name in names]
        next_value, next_moments = rule(op, value, moments, gradient, rate)
        for name, result in zip(names, next_moments, strict=True):
            op.graph.output(f"{name}_next", result, np.float32, shape)
        return next_value

    shapes = gradient_shapes(layer)
    weight = update(layer.weight, "weight", gradients.weight, shapes[0])
    op.graph.output(f"{layer.weight}_next", weight, np.float32, shapes[0])
    bias = op.Squeeze(update(layer.bias, "bias", gradients.bias, shapes[1]), op.shape(0))
    op.graph.output(f"{layer.bias}_next", bias, np.float32, (layer.layer.out,))
