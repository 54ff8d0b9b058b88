"""Pretraining, fourth stage: SGMs in front of the meta-trained layers regress true gradients.

Those early layers, which have maps, learn slowly on the device, and what lies behind them soon is
what the late, meta-trained layers have become: their SGMs regress gradients carried back through
the late layers as those are before, during and after fine-tuning runs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from qsgm.network import Network
from qsgm.train.model.local import LayerState, columns, layer_forward, true_gradients
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.evaluate import UpdateRule, fine_tune
from qsgm.train.pretraining.maml import apply_sgm
from qsgm.train.pretraining.tasks import TaskSet, start_states

SLICE = 20  # crops whose windows are in memory at once


@dataclass(frozen=True)
class MapConfig:
    """Sizes and rates of the fourth stage."""

    tasks: int = 32
    crops_per_task: int = 120
    epochs: int = 30  # of the late layers' runs
    looks: tuple[int, ...] = (2, 8, 30)  # epochs after which those are looked at
    steps: int = 600
    tasks_per_step: int = 4
    crops_per_step: int = 8
    peak_rate: float = 1e-2


class MapMatching:
    """The fourth stage: what these SGMs see is computed as it is needed, and dropped."""

    def __init__(
        self,
        config: MapConfig,
        rule: UpdateRule,
        start: Sequence[tuple[Tensor, Tensor]],  # of all layers
        pixels: TaskSet,
        seed: int,
    ) -> None:
        self.config, self.rule, self.start, self.pixels = config, rule, start, pixels
        network = rule.task.network
        self.early = range(1, network.depth + 1 - len(rule.rates))
        self.behind = [self._late_states(some) for some in pixels.chunks(config.tasks_per_step)]
        torch.manual_seed(seed)
        self.sgms = {layer: Sgm(network, layer) for layer in self.early}
        self.generator = torch.Generator().manual_seed(seed)
        _, _, true = self._batch()
        self.unit = {layer: float(true[layer].square().mean().sqrt()) for layer in self.early}
        parameters = [p for sgm in self.sgms.values() for p in sgm.parameters()]
        self.optimizer = torch.optim.Adam(parameters)
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, config.peak_rate, total_steps=config.steps
        )

    def run(self, after_step: Callable[[dict[int, float]], None]) -> dict[int, Sgm]:
        """Train to the end; `after_step` gets each SGM's cosine on its last batch."""
        for _ in range(self.config.steps):
            after_step(self._step())
        return {layer: _scaled(sgm, self.unit[layer]).eval() for layer, sgm in self.sgms.items()}

    def _step(self) -> dict[int, float]:
        """One step of least squares for each SGM, relative to the batch's own gradients.

        Gradients are a thousandth of what fresh convolutions answer with, and shrink tenfold over a
        run: SGMs learn them in units of their own, and every batch weighs the same.
        """
        activations, labels, true = self._batch()
        loss, cosines = torch.zeros(()), {}
        for layer, sgm in self.sgms.items():
            guess, wanted = apply_sgm(sgm, activations[layer], labels), true[layer]
            wanted = wanted / self.unit[layer]
            loss = loss + (guess - wanted).square().mean() / wanted.square().mean()
            cosines[layer] = float(
                F.cosine_similarity(guess.detach().flatten(), wanted.flatten(), dim=0)
            )
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        return cosines

    @torch.no_grad()
    def _batch(self) -> tuple[dict[int, Tensor], Tensor, dict[int, Tensor]]:
        """Activations and true gradients of the early layers (T, B, P, C), and labels (T, B, L)."""
        group = self._draw(len(self.behind))
        moments = self.behind[group]
        late = moments[self._draw(len(moments))]
        first = group * self.config.tasks_per_step
        tasks = slice(first, first + len(late[0].bias))
        rows = torch.randperm(self.pixels.labels.shape[1], generator=self.generator)
        rows = rows[: self.config.crops_per_step]
        x = self.pixels.features[tasks][:, rows].float()
        labels = self.pixels.labels[tasks][:, rows]
        states = start_states(self.start[: len(self.early)], len(labels)) + late
        task = self.rule.task
        true = true_gradients(task.network, states, x, labels, task.heads)
        activations = {}
        for layer in self.early:
            windows = columns(task.network, layer, x)
            _, x = layer_forward(task.network, layer, states[layer - 1], windows)
            activations[layer] = x
        return activations, labels, true

    def _late_states(self, pixels: TaskSet) -> list[list[LayerState]]:
        """The late layers of some tasks, before, during and after a run of theirs."""
        tasks = behind(self.rule.task.network, self.start[: len(self.early)], pixels)
        late = self.start[len(self.early) :]
        moments = [start_states(late, len(tasks))]
        for epoch, states in enumerate(fine_tune(self.rule, late, tasks, self.config.epochs), 1):
            if epoch in self.config.looks:
                moments.append(states)
        return moments

    def _draw(self, count: int) -> int:
        return int(torch.randint(count, (1,), generator=self.generator))


@torch.no_grad()
def behind(
    network: Network, layers: Sequence[tuple[Tensor, Tensor]], tasks: TaskSet, first: int = 1
) -> TaskSet:
    """Tasks as they are seen from behind some of their layers, numbered from `first`."""
    features = []
    for one in tasks.chunks(1):
        slices = one.features.split(SLICE, dim=1)
        features.append(
            torch.cat([_forward(network, layers, x.float(), first) for x in slices], dim=1)
        )
    return TaskSet(torch.cat(features), tasks.labels, tasks.support)


def _forward(
    network: Network, layers: Sequence[tuple[Tensor, Tensor]], x: Tensor, first: int
) -> Tensor:
    """Features (1, N, P, C) through a few layers, numbered from `first`."""
    for number, state in enumerate(start_states(layers, 1), first):
        _, x = layer_forward(network, number, state, columns(network, number, x))
    return x


@torch.no_grad()
def _scaled(sgm: Sgm, factor: float) -> Sgm:
    """An SGM that gives its gradients times `factor`."""
    last = sgm.convs[-1]
    for parameter in last.parameters():
        parameter.mul_(factor)
    return sgm
