"""Pretraining, third stage: unrolled MAML with the static SGMs as the update rule.

Every outer step takes a few tasks, lets the SGMs train the tuned layers for some steps exactly as
the device will, and differentiates through all of them (second order): what counts is the loss on
crops held back, not how well a single gradient is matched. Learned are the SGMs, the start of the
tuned layers, one rate per layer and each layer's curvature. Every run has a length of its own, as
short as an epoch on the device or as long as twenty, and its rates decay over it as they do there.
Runs go on from one outer step to the next (truncated backpropagation through time), so that the
SGMs meet every state from the first step to the last.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import cos, log, pi
from typing import Any

import torch
from torch import Tensor, nn

from qsgm.schedule import BATCH, rate_factor
from qsgm.task import Task
from qsgm.train.heads import error, meta_objective
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.local import LayerState, local_step, outputs, true_gradients
from qsgm.train.model.net import maps_of, positions_of
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.tasks import TaskSet

# A run whose query loss is beyond this has blown up.
LOST = 4.0


@dataclass(frozen=True)
class MamlConfig:
    """Sizes and rates of the third stage."""

    outer_steps: int = 2000
    tasks_per_step: int = 6
    unroll: int = 16
    runs_per_task_slot: int = 5  # runs kept going, per task of an outer step
    run_lengths: tuple[int, ...] = (25, 75, 150, 300, 500)  # steps; 25 is an epoch on the device
    sgm_rate: float = 1e-3
    start_rate: float = 1e-4
    log_rate_rate: float = 3e-3
    curvature_rate: float = 1e-3
    # Looking ahead a few steps only, meta-training would raise the rates without end.
    largest_rate_change: float = 3.0
    matching_weight: float = 0.1
    largest_gradient: float = 1.0
    warm_up: int = 50


@dataclass(eq=False)  # found again by identity
class Run:
    """One task on its way: its tuned layers' states, `None` before the first step."""

    task: int
    length: int  # steps after which its rates have decayed to nothing
    states: list[LayerState] | None = None
    age: int = 0


@dataclass(frozen=True)
class OuterFigures:
    """What one outer step saw, means over its tasks."""

    query_loss: float
    cosine: dict[int, float]  # by layer: synthetic to true gradient
    rates: tuple[float, ...]


class MetaTraining:
    """The third stage as a state that can be saved, resumed and advanced step by step."""

    def __init__(
        self,
        config: MamlConfig,
        task: Task,
        tasks: TaskSet,
        start: Sequence[tuple[Tensor, Tensor]],
        sgms: Mapping[int, Sgm],
        rates: Sequence[float],
        seed: int,
    ) -> None:
        self.config, self.task, self.tasks, self.sgms = config, task, tasks, dict(sgms)
        self.start = [tuple(nn.Parameter(t.clone()) for t in layer) for layer in start]
        self.log_rates = nn.Parameter(torch.tensor(rates).log())
        self.first_log_rates = self.log_rates.detach().clone()
        self.curvatures = {
            number: _parameters(Curvature.identity(task.network.layer(number)))
            for number in task.network.last(len(start))
        }
        self.generator = torch.Generator().manual_seed(seed)
        count = config.tasks_per_step * config.runs_per_task_slot
        self.runs = [self._fresh() for _ in range(count)]
        for sgm in self.sgms.values():
            sgm.eval()  # static: batchnorm is an affine map from here on
        self.optimizer = torch.optim.Adam(
            [
                {"params": self._sgm_parameters(), "lr": config.sgm_rate},
                {"params": [p for layer in self.start for p in layer], "lr": config.start_rate},
                {"params": [self.log_rates], "lr": config.log_rate_rate},
                {"params": self._curvature_parameters(), "lr": config.curvature_rate},
            ]
        )
        self.schedule = torch.optim.lr_scheduler.LambdaLR(self.optimizer, self._rate_factor)
        self.step = 0

    def run(self, after_step: Callable[[int, OuterFigures], None]) -> None:
        """Train to the end; `after_step` gets the step's number and figures."""
        while self.step < self.config.outer_steps:
            figures = self.outer_step()
            self.step += 1
            after_step(self.step, figures)

    def outer_step(self) -> OuterFigures:
        """Unroll a few runs, differentiate through them, learn."""
        order = torch.randperm(len(self.runs), generator=self.generator).tolist()
        chosen = [self.runs[i] for i in order[: self.config.tasks_per_step]]
        unrolled = _Unrolled(self, chosen)
        for _ in range(self.config.unroll):
            unrolled.advance(self.generator)
        query = unrolled.query_loss()
        along = unrolled.way + self.config.matching_weight * unrolled.mismatch
        self._learn((query + along / self.config.unroll).mean())
        self._keep(chosen, unrolled.states, query)
        return OuterFigures(
            float(query.detach().mean()),
            {layer: total / self.config.unroll for layer, total in unrolled.cosine.items()},
            tuple(self.log_rates.detach().exp().tolist()),
        )

    def learnt_curvatures(self) -> dict[int, Curvature]:
        """Each layer's curvature as it is now, without its history."""
        return {
            layer: Curvature(*(matrix.detach().clone() for matrix in one.matrices))
            for layer, one in self.curvatures.items()
        }

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later; runs under way are not kept, they start afresh."""
        return {
            "step": self.step,
            "sgms": {layer: sgm.state_dict() for layer, sgm in self.sgms.items()},
            "start": [tuple(p.detach() for p in layer) for layer in self.start],
            "log_rates": self.log_rates.detach(),
            "curvatures": [p.detach() for p in self._curvature_parameters()],
            "optimizer": self.optimizer.state_dict(),
            "schedule": self.schedule.state_dict(),
            "generator": self.generator.get_state(),
        }

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state`."""
        self.step = state["step"]
        for layer, sgm in self.sgms.items():
            sgm.load_state_dict(state["sgms"][layer])
        with torch.no_grad():
            for parameters, saved in zip(self.start, state["start"], strict=True):
                for parameter, value in zip(parameters, saved, strict=True):
                    parameter.copy_(value)
            self.log_rates.copy_(state["log_rates"])
            for matrix, saved in zip(
                self._curvature_parameters(), state["curvatures"], strict=True
            ):
                matrix.copy_(saved)
        self.optimizer.load_state_dict(state["optimizer"])
        self.schedule.load_state_dict(state["schedule"])
        self.generator.set_state(state["generator"])

    def _learn(self, objective: Tensor) -> None:
        self.optimizer.zero_grad()
        objective.backward()
        parameters = [p for group in self.optimizer.param_groups for p in group["params"]]
        size = nn.utils.clip_grad_norm_(parameters, self.config.largest_gradient)
        if torch.isfinite(size):  # a run that blew up teaches nothing; it is restarted below
            self.optimizer.step()
            self._bound_rates()
        self.schedule.step()

    @torch.no_grad()
    def _bound_rates(self) -> None:
        reach = log(self.config.largest_rate_change)
        low, high = self.first_log_rates - reach, self.first_log_rates + reach
        self.log_rates.copy_(self.log_rates.clamp(low, high))

    def _keep(self, chosen: list[Run], states: list[LayerState], query: Tensor) -> None:
        """Store where each run has got to; a new one takes the place of what is done or lost."""
        for i, run in enumerate(chosen):
            run.states = [state.of_task(i) for state in states]
            run.age += self.config.unroll
            sound = all(torch.isfinite(state.weight).all() for state in run.states)
            if run.age >= run.length or not sound or not query[i] < LOST:
                self.runs[self.runs.index(run)] = self._fresh()

    def _fresh(self) -> Run:
        task = int(torch.randint(len(self.tasks), (1,), generator=self.generator))
        lengths = self.config.run_lengths
        return Run(task, lengths[int(torch.randint(len(lengths), (1,), generator=self.generator))])

    def _sgm_parameters(self) -> list[nn.Parameter]:
        return [p for sgm in self.sgms.values() for p in sgm.parameters()]

    def _rate_factor(self, step: int) -> float:
        """Linear warm-up, then a cosine down to a twentieth."""
        warm = min(1.0, (step + 1) / self.config.warm_up)
        return warm * (0.525 + 0.475 * cos(pi * step / self.config.outer_steps))

    def _curvature_parameters(self) -> list[Tensor]:
        return [matrix for one in self.curvatures.values() for matrix in one.matrices]


class _Unrolled:
    """A few runs advanced together, with the graph that leads back to what is meta-trained."""

    def __init__(self, training: MetaTraining, chosen: list[Run]) -> None:
        self.training = training
        self.ages = [run.age for run in chosen]
        self.lengths = [run.length for run in chosen]
        rows = [run.task for run in chosen]
        self.features = training.tasks.features[rows].to(training.log_rates.dtype)  # (T, N, P, C)
        self.labels = training.tasks.labels[rows]  # (T, N, L)
        runs = [run.states or self._start() for run in chosen]
        self.states = [LayerState.joined(some) for some in zip(*runs, strict=True)]
        self.rates = training.log_rates.exp().unbind()
        self.way = torch.zeros(len(chosen))
        self.mismatch = torch.zeros(len(chosen))
        self.cosine = dict.fromkeys(training.sgms, 0.0)

    def advance(self, generator: torch.Generator) -> None:
        """One feed-forward step of every run, on a random batch of its support set."""
        features, labels = self._batch(generator)
        task = self.training.task
        with torch.no_grad():
            true = true_gradients(task.network, self.states, features, labels, task.heads)
        given: dict[int, Tensor] = {}

        def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
            if layer == task.network.depth:
                given[layer] = activation
                return error(task.heads, activation, labels[:, :, None])
            given[layer] = apply_sgm(self.training.sgms[layer], activation, labels)
            return given[layer]

        factor = self._rate_factors()
        self.states = local_step(
            task.network,
            self.states,
            features,
            labels,
            [rate * factor for rate in self.rates],
            gradient_of,
            self.training.curvatures,
        )
        self.ages = [age + 1 for age in self.ages]
        raw = given.pop(task.network.depth)[:, :, 0]
        self.way = self.way + meta_objective(task.heads, raw, labels)
        self._match(given, true)

    def query_loss(self) -> Tensor:
        """The objective (T,) on the crops held back."""
        support, task = self.training.tasks.support, self.training.task
        raw = outputs(task.network, self.states, self.features[:, support:])
        return meta_objective(task.heads, raw, self.labels[:, support:])

    def _match(self, given: dict[int, Tensor], true: dict[int, Tensor]) -> None:
        for layer, synthetic in given.items():
            wanted = true[layer]
            error = (synthetic - wanted).square().sum(dim=(1, 2, 3))
            size = wanted.square().sum(dim=(1, 2, 3)) + 1e-4
            self.mismatch = self.mismatch + error / size / len(given)
            self.cosine[layer] += float(
                nn.functional.cosine_similarity(
                    synthetic.detach().flatten(1), wanted.flatten(1)
                ).mean()
            )

    def _rate_factors(self) -> Tensor:
        """Where each run is in its rates' decay, (T,); one that is over stands still."""
        runs = zip(self.ages, self.lengths, strict=True)
        return torch.tensor([max(0.0, rate_factor(age, length)) for age, length in runs])

    def _batch(self, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        tasks, support = len(self.labels), self.training.tasks.support
        rows = torch.stack(
            [torch.randperm(support, generator=generator)[:BATCH] for _ in range(tasks)]
        )
        task = torch.arange(tasks)[:, None]
        return self.features[task, rows], self.labels[task, rows]

    def _start(self) -> list[LayerState]:
        return [LayerState.start(weight[None], bias[None]) for weight, bias in self.training.start]


def _parameters(curvature: Curvature) -> Curvature:
    return Curvature(*(nn.Parameter(matrix) for matrix in curvature.matrices))


def apply_sgm(sgm: Sgm, activation: Tensor, labels: Tensor) -> Tensor:
    """An SGM on the activations (T, B, P, C) of many tasks, maps row by row."""
    gradient = sgm(maps_of(activation.flatten(0, 1), sgm.side), labels.flatten(0, 1))
    return positions_of(gradient).reshape(activation.shape)
