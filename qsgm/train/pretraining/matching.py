"""Pretraining, second stage: SGMs regress true gradients along backpropagation runs.

Supervised and quick. Alone it is not enough: errors that do not average out lead the tuned layers
where no backpropagation run went, which the third stage, MAML, repairs. Started from random SGMs
instead, that one mostly meets runs that blew up.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from qsgm.task import Task
from qsgm.train.model.local import LayerState, local_step, true_gradients
from qsgm.train.model.net import maps_of, positions_of
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states


@dataclass(frozen=True)
class MatchingConfig:
    """Sizes and rates of the second stage."""

    epochs: int = 6
    record_every: int = 2
    fit_steps: int = 3000
    fit_batch: int = 2048
    peak_rate: float = 1e-2


@dataclass(frozen=True)
class Examples:
    """What an SGM is to learn: activation (M, P, C), label (M, L) -> true gradient (M, P, C)."""

    activations: Tensor
    labels: Tensor
    gradients: Tensor


@torch.no_grad()
def record_examples(
    tasks: TaskSet,
    start: Sequence[tuple[Tensor, Tensor]],
    rates: Sequence[float],
    task: Task,
    config: MatchingConfig,
    seed: int,
) -> dict[int, Examples]:
    """Run backpropagation on every task and keep what each SGM would have seen."""
    layers = task.network.last(len(start))[:-1]
    seen: dict[int, list[Examples]] = {layer: [] for layer in layers}
    for chunk in tasks.chunks(8):
        states = start_states(start, len(chunk))
        batches = shuffled_batches(chunk.support, config.epochs, seed)
        for number, rows in enumerate(batches):
            features, labels = chunk.features[:, rows].float(), chunk.labels[:, rows]
            states, activations, gradients = backprop_step(states, features, labels, rates, task)
            if number % config.record_every == 0:
                for layer in layers:
                    looks = activations[layer], labels, gradients[layer]
                    seen[layer].append(Examples(*(one.flatten(0, 1) for one in looks)))
    return {layer: joined(parts) for layer, parts in seen.items()}


def fit_sgm(
    sgm: Sgm,
    examples: Examples,
    config: MatchingConfig,
    seed: int,
    after_step: Callable[[], None],
) -> Sgm:
    """Least squares on the true gradients (paper section 4.2: l2), scaled to unit size."""
    generator = torch.Generator().manual_seed(seed)
    size = examples.gradients.square().mean().sqrt()
    optimizer = torch.optim.Adam(sgm.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.peak_rate, total_steps=config.fit_steps
    )
    sgm.train()
    for _ in range(config.fit_steps):
        rows = torch.randint(len(examples.labels), (config.fit_batch,), generator=generator)
        maps = maps_of(examples.activations[rows], sgm.side)
        guess = positions_of(sgm(maps, examples.labels[rows]))
        loss = ((guess - examples.gradients[rows]) / size).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        after_step()
    return sgm.eval()


def backprop_step(
    states: list[LayerState], features: Tensor, labels: Tensor, rates: Sequence[float], task: Task
) -> tuple[list[LayerState], dict[int, Tensor], dict[int, Tensor]]:
    """One step on true gradients; also every layer's activation and gradient."""
    network = task.network
    gradients = true_gradients(network, states, features, labels, task.heads)
    activations: dict[int, Tensor] = {}

    def gradient_of(layer: int, activation: Tensor, _: Tensor) -> Tensor:
        activations[layer] = activation
        return gradients[layer]

    rate_tensors = [torch.tensor(rate) for rate in rates]
    states = local_step(network, states, features, labels, rate_tensors, gradient_of)
    return states, activations, gradients


def joined(parts: Sequence[Examples]) -> Examples:
    """All of them in a row."""
    names = ("activations", "labels", "gradients")
    return Examples(*(torch.cat([getattr(one, name) for one in parts]) for name in names))
