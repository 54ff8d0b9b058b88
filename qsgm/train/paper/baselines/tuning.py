"""Fine-tune a set of tasks with any baseline, and score what came of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from qsgm.network import Network
from qsgm.schedule import MOMENTUM, rate_factor
from qsgm.task import Task
from qsgm.train.model.local import LayerState, through_activation, weight_gradients
from qsgm.train.paper.baselines.interface import Baseline, ForwardPass, forward_pass
from qsgm.train.pretraining.evaluate import Score, score
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches

# A parameter group per layer, as torch.optim has them -> what updates them
MakeOptimizer = Callable[[list[dict[str, Any]]], torch.optim.Optimizer]


def sgd(groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
    """SGD with momentum 0.9."""
    return torch.optim.SGD(groups, momentum=MOMENTUM)


def adam(groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
    """Adam with torch's moments."""
    return torch.optim.Adam(groups)


def constant_rate(step: int, steps: int) -> float:
    """The paper's rates: they stay what they are."""
    del step, steps
    return 1.0


@dataclass(frozen=True)
class Recipe:
    """How to fine-tune."""

    optimizer: MakeOptimizer
    rates: tuple[float, ...]  # one per tuned layer
    epochs: int
    # What all rates are multiplied with in step i of n: the device's linear decay, or constant.
    factor: Callable[[int, int], float] = rate_factor


def run_baseline(
    tasks: TaskSet,
    start: Sequence[tuple[Tensor, Tensor]],
    baseline: Baseline,
    recipe: Recipe,
    task: Task,
    seed: int,
) -> list[Score]:
    """Fine-tune all tasks, side by side and independent of each other, and score them.

    Args:
        tasks: T tasks; features are those behind the last frozen layer.
        start: weight (K, C) and bias (C,) of the tuned layers, in order, the same for all tasks.
        baseline: one that learns has to be new.
        recipe: optimizer, rates, epochs.
        task: gives loss and scores.
        seed: of the order of crops.

    Returns:
        Every task's score on its query crops; a run that diverged shows in its objective.
    """
    return score(tuned_states(tasks, start, baseline, recipe, task, seed), tasks, task)


@torch.no_grad()
def tuned_states(
    tasks: TaskSet,
    start: Sequence[tuple[Tensor, Tensor]],
    baseline: Baseline,
    recipe: Recipe,
    task: Task,
    seed: int,
) -> list[LayerState]:
    """What :func:`run_baseline` scores: the tuned layers, their momenta left out."""
    network = task.network
    states = _states(network, start, len(tasks))
    optimizer = recipe.optimizer(_groups(states, recipe.rates))
    batches = list(shuffled_batches(tasks.support, recipe.epochs, seed))
    for step, rows in enumerate(batches):
        features, labels = tasks.features[:, rows].float(), tasks.labels[:, rows]
        batch = forward_pass(network, states, features, labels, task.heads)
        weights = {layer: state.weight for layer, state in states.items()}
        given = {**baseline.gradients(weights, batch), network.depth: batch.output_error}
        _set_gradients(states, batch, given)
        for group, rate in zip(optimizer.param_groups, recipe.rates, strict=True):
            group["lr"] = rate * recipe.factor(step, len(batches))
        optimizer.step()
    return list(states.values())


def _states(
    network: Network, start: Sequence[tuple[Tensor, Tensor]], tasks: int
) -> dict[int, LayerState]:
    """A start of its own for every task, by layer; the optimizer updates it in place."""
    return {
        layer: LayerState.start(weight.repeat(tasks, 1, 1), bias.repeat(tasks, 1))
        for layer, (weight, bias) in zip(network.last(len(start)), start, strict=True)
    }


def _groups(states: Mapping[int, LayerState], rates: Sequence[float]) -> list[dict[str, Any]]:
    return [
        {"params": [state.weight, state.bias], "lr": rate}
        for state, rate in zip(states.values(), rates, strict=True)
    ]


def _set_gradients(
    states: Mapping[int, LayerState], batch: ForwardPass, given: Mapping[int, Tensor]
) -> None:
    """Every layer's own gradients, from the one it was given on its activation."""
    for layer, state in states.items():
        dz = through_activation(batch.network, layer, batch.before[layer], given[layer])
        state.weight.grad, state.bias.grad = weight_gradients(batch.columns[layer], dz)
