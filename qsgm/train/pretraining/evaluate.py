"""Whole fine-tuning runs on many tasks in torch: which rates work, and how well."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
import torch
from torch import Tensor

from qsgm.blocks import Blocks
from qsgm.errors import QsgmError
from qsgm.manifest import OptimizerName
from qsgm.schedule import rate_factor
from qsgm.task import Task
from qsgm.train.heads import activate, error, meta_objective
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.local import (
    GradientOf,
    LayerState,
    group_gradients,
    local_gradients,
    local_step,
    outputs,
)
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.maml import apply_sgm
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states


@dataclass(frozen=True)
class Score:
    """On query samples."""

    objective: float  # see :func:`qsgm.train.heads.meta_objective`
    scores: Mapping[str, Any]  # by the task's own names


@dataclass(frozen=True)
class UpdateRule:
    """What fine-tunes the last layers: static SGMs, and how their gradients become steps."""

    sgms: Mapping[int, Sgm]  # by layer
    curvatures: Mapping[int, Curvature]
    rates: tuple[float, ...]  # of the tuned layers, at the start of a run
    task: Task
    blocks: Blocks | None = None  # those layers in groups; None: each on its own
    optimizer: OptimizerName = "sgd"  # Adam bends no gradient, and takes each layer on its own

    def gradient_of(self, layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        """Gradient (T, B, P, C) on a layer's activation; labels (T, B, L)."""
        if layer == self.task.network.depth:
            return error(self.task.heads, activation, labels[:, :, None])
        return apply_sgm(self.sgms[layer], activation, labels)


class AdamMoments:
    """Adam as torch and the device have it: number by number, so that no task knows of another."""

    def __init__(self, states: Sequence[LayerState]) -> None:
        self._states = [LayerState.start(one.weight.clone(), one.bias.clone()) for one in states]
        groups = [{"params": [one.weight, one.bias], "lr": 0.0} for one in self._states]
        self._adam = torch.optim.Adam(groups)

    def step(
        self, gradients: Iterable[tuple[Tensor, Tensor]], rates: Sequence[float]
    ) -> list[LayerState]:
        """The states after one more step, which are the same numbers' places every time."""
        groups, found = self._adam.param_groups, [*gradients]
        for state, given, group, rate in zip(self._states, found, groups, rates, strict=True):
            state.weight.grad, state.bias.grad = given
            group["lr"] = rate
        self._adam.step()
        return self._states


@torch.no_grad()
def fine_tune(
    rule: UpdateRule,
    start: Sequence[tuple[Tensor, Tensor]],
    tasks: TaskSet,
    epochs: int,
    seed: int = 0,
) -> Iterator[list[LayerState]]:
    """Fine-tune the last layers of every task at once; yields their states after every epoch."""
    states = start_states(start, len(tasks))
    adam = AdamMoments(states) if rule.optimizer == "adam" else None
    batches = list(shuffled_batches(tasks.support, epochs, seed))
    for step, rows in enumerate(batches, start=1):
        features, labels = tasks.features[:, rows].float(), tasks.labels[:, rows]
        factor = rate_factor(step - 1, len(batches))
        rates = [rate * factor for rate in rule.rates]
        states = _step(rule, states, features, labels, rates, adam)
        if step % (len(batches) // epochs) == 0:
            yield states


def _step(
    rule: UpdateRule,
    states: list[LayerState],
    features: Tensor,
    labels: Tensor,
    rates: Sequence[float],
    adam: AdamMoments | None,
) -> list[LayerState]:
    """One step of every task, by SGD where there are no moments of Adam."""
    network, bent = rule.task.network, rule.curvatures
    gradient_of: GradientOf = rule.gradient_of
    if adam is not None:
        return adam.step(local_gradients(network, states, features, labels, gradient_of), rates)
    if rule.blocks is not None:
        groups = rule.blocks.groups
        found = group_gradients(network, groups, states, features, labels, gradient_of)
        gradient_of = _known(found)
    scalars = [torch.tensor(rate) for rate in rates]
    return local_step(network, states, features, labels, scalars, gradient_of, bent)


def _known(gradients: Mapping[int, Tensor]) -> GradientOf:
    """Gradients that have been computed already, by layer."""
    return lambda layer, _activation, _labels: gradients[layer]


def run_sgms(
    rule: UpdateRule,
    start: Sequence[tuple[Tensor, Tensor]],
    tasks: TaskSet,
    epochs: int,
    chunk: int = 8,
) -> Score:
    """Fine-tune every task's last layers, `chunk` tasks at once, and score the result."""
    return mean_score(run_each(rule, start, tasks, epochs, chunk))


def run_each(
    rule: UpdateRule,
    start: Sequence[tuple[Tensor, Tensor]],
    tasks: TaskSet,
    epochs: int,
    chunk: int = 8,
) -> list[Score]:
    """Every task's score after a run of its own."""
    scores = []
    for some in tasks.chunks(chunk):
        *_, states = fine_tune(rule, start, some, epochs)
        scores += score(states, some, rule.task)
    return scores


@torch.no_grad()
def score(states: Sequence[LayerState], tasks: TaskSet, task: Task) -> list[Score]:
    """Every task's score on its query samples."""
    features, labels = tasks.features[:, tasks.support :].float(), tasks.labels[:, tasks.support :]
    raw = outputs(task.network, states, features)
    objectives = meta_objective(task.heads, raw, labels).tolist()
    seen = activate(task.heads, raw)
    return [
        Score(objective, dict(task.scores(one.numpy(), known.numpy())))
        for objective, one, known in zip(objectives, seen, labels, strict=True)
    ]


def mean_score(scores: Sequence[Score]) -> Score:
    """The mean of every figure."""
    names = scores[0].scores
    return Score(
        float(np.mean([score.objective for score in scores])),
        {name: float(np.mean([score.scores[name] for score in scores])) for name in names},
    )


def best_rates(scores: Mapping[tuple[float, ...], Score]) -> tuple[float, ...]:
    """The first rates whose objective is finite and within a hundredth of the lowest.

    Of rates that do about as well the lower ones, listed first, are further from those at which
    some other object's run blows up.

    Raises:
        QsgmError: there is none.
    """
    objectives = {rates: score.objective for rates, score in scores.items()}
    finite = {rates: value for rates, value in objectives.items() if isfinite(value)}
    if not finite:
        raise QsgmError(
            f"pretraining failed: all {len(scores)} trial runs with the new SGMs diverged;"
            " pass another --seed, or lower the rates in PretrainConfig"
        )
    bound = 1.01 * min(finite.values())
    return next(rates for rates, value in finite.items() if value <= bound)
