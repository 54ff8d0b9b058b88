"""Layers that keep their batchnorm, trained by SGMs: the paper's own setting (section 3.2).

A layer is updated by the gradient its SGM makes of its activation and the label. The true gradients
are carried back beside, for SGMs that follow them. In one backward pass through several SGMs in a
row, what reaches one is the next one's synthetic gradient. Here autograd goes back one layer at a
time, so that all can follow the truth.
"""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.schedule import MOMENTUM
from qsgm.task import Heads, Task
from qsgm.train.heads import per_sample
from qsgm.train.model.fold import folded_start
from qsgm.train.model.net import ConvNet, maps_of
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.evaluate import Score, score
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states

RATE = 1e-1  # paper section 4.2: of network and SGMs, in pretraining and fine-tuning
Criterion = Callable[[Tensor, Tensor], Tensor]  # (synthetic, true) -> what an SGM lowers


@dataclass(frozen=True)
class CutPass:
    """A batch through layers that autograd sees one at a time; mappings are by layer number."""

    outputs: Mapping[int, Tensor]  # (N, C, H, W), each with its own layer's graph
    true: Mapping[int, Tensor]  # gradient of the summed loss on each output
    labels: Tensor  # (N, L)


class Driver(Protocol):
    """Makes the gradients on the hidden layers' outputs."""

    def gradients(self, seen: CutPass) -> Mapping[int, Tensor]:
        """By layer, in the shape of its output (N, C, H, W)."""
        ...


class FollowingSgms:
    """SGMs that answer, then take a step towards the true gradient; for one run.

    Args:
        sgms: by layer; they are changed.
        criterion: l2 or l1 (section 4.2).
    """

    def __init__(self, sgms: Mapping[int, Sgm], criterion: Criterion = F.mse_loss) -> None:
        self.sgms = {layer: sgm.train() for layer, sgm in sgms.items()}
        self.criterion = criterion
        parameters = [p for sgm in self.sgms.values() for p in sgm.parameters()]
        self.optimizer = torch.optim.SGD(parameters, RATE, momentum=MOMENTUM)

    def gradients(self, seen: CutPass) -> Mapping[int, Tensor]:
        guess = {k: self.sgms[k](x.detach(), seen.labels) for k, x in _hidden(seen).items()}
        self.optimizer.zero_grad()
        for layer, gradient in guess.items():
            self.criterion(gradient, seen.true[layer]).backward()
        self.optimizer.step()
        return {layer: gradient.detach() for layer, gradient in guess.items()}


class FixedSgms:
    """SGMs that answer and stay as they are."""

    def __init__(self, sgms: Mapping[int, Sgm]) -> None:
        self.sgms = {layer: sgm.eval() for layer, sgm in sgms.items()}

    @torch.no_grad()
    def gradients(self, seen: CutPass) -> Mapping[int, Tensor]:
        return {layer: self.sgms[layer](x, seen.labels) for layer, x in _hidden(seen).items()}


def cut_pass(layers: Mapping[int, nn.Module], x: Tensor, labels: Tensor, heads: Heads) -> CutPass:
    """Run the last layers on maps (N, C, H, W) and carry the true gradients back."""
    inputs: dict[int, Tensor] = {}
    outputs: dict[int, Tensor] = {}
    for number, layer in layers.items():
        inputs[number] = x.detach().requires_grad_()
        x = outputs[number] = layer(inputs[number])
    total = per_sample(heads, x[:, :, 0, 0], labels).sum()
    (gradient,) = torch.autograd.grad(total, x, retain_graph=True)
    true = {[*layers][-1]: gradient}
    for number in list(layers)[:0:-1]:
        (gradient,) = torch.autograd.grad(
            outputs[number], inputs[number], gradient, retain_graph=True
        )
        true[number - 1] = gradient
    return CutPass(outputs, true, labels)


def driven_step(
    layers: Mapping[int, nn.Module],
    seen: CutPass,
    driver: Driver,
    optimizer: torch.optim.Optimizer,
) -> None:
    """Update every layer by the driver's gradients, the last one by the loss's own."""
    last = [*layers][-1]
    given = {**driver.gradients(seen), last: seen.true[last]}
    optimizer.zero_grad()
    for number, layer in layers.items():
        own = list(layer.parameters())  # no further: what lies before is cut off
        seen.outputs[number].backward(given[number] / len(seen.labels), inputs=own)
    optimizer.step()


def tune_with_batchnorm(
    net: ConvNet,
    tuned: int,
    driver: Driver,
    tasks: TaskSet,
    epochs: int,
    task: Task,
    seed: int,
    momentum: float = 0.0,
) -> Score:
    """Fine-tune a copy of the last layers by SGD at 1e-1, batchnorm on batch statistics.

    The paper names the rate of fine-tuning and a momentum of 0.9 for pretraining alone. Static
    SGMs converge without momentum and mostly diverge with it.

    Args:
        net: not changed.
        tuned: how many of its layers.
        driver: where gradients come from.
        tasks: of one object; features are those behind the last frozen layer.
        epochs: passes over the support crops.
        task: gives loss and scores.
        seed: of the order of crops.
        momentum: of SGD.

    Returns:
        The score on the query crops, with batchnorm on its running statistics.
    """
    net = deepcopy(net)
    layers = last_layers(net, tuned)
    optimizer = torch.optim.SGD(_parameters(layers), RATE, momentum=momentum)
    first = net.network.last(tuned)[0]
    maps = maps_of(tasks.features[0].float(), net.network.before(first))
    for rows in shuffled_batches(tasks.support, epochs, seed):
        seen = cut_pass(layers, maps[rows], tasks.labels[0, rows], task.heads)
        driven_step(layers, seen, driver, optimizer)
    return score(start_states(folded_start(net.eval(), tuned), 1), tasks, task)[0]


def last_layers(net: ConvNet, count: int) -> dict[int, nn.Module]:
    """The last `count` layers by number, ready to train."""
    return {number: net.layers[number - 1].train() for number in net.network.last(count)}


def _parameters(layers: Mapping[int, nn.Module]) -> Sequence[nn.Parameter]:
    return [p for layer in layers.values() for p in layer.parameters()]


def _hidden(seen: CutPass) -> Mapping[int, Tensor]:
    return {layer: seen.outputs[layer] for layer in [*seen.outputs][:-1]}
