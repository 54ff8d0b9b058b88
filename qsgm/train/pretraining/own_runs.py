"""Pretraining, second stage, gone on with: SGMs regress true gradients along runs of their own.

Along backpropagation's runs an SGM never meets where its own errors lead. There it answers at
random, activations run away, and at rates that backpropagation profits from, every run is lost. So
runs are driven by the SGMs as they are so far, true gradients are looked at on the way, and SGMs
learn from all looks together; then again (Ross et al. 2011 have it for imitation). At first
backpropagation drives, all layers moving.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from qsgm.schedule import rate_factor
from qsgm.task import Task
from qsgm.train.heads import error
from qsgm.train.model.local import GradientOf, local_step, true_gradients
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.maml import apply_sgm
from qsgm.train.pretraining.matching import Examples, MatchingConfig, fit_sgm, joined
from qsgm.train.pretraining.rates import Start
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states

# Activations beyond this, in units of the untouched network's largest, are of a run that is lost.
LOST_ACTIVATION = 20.0


@dataclass(frozen=True)
class OwnRunsConfig:
    """Sizes and rates; no rounds, no own runs."""

    rounds: int = 0  # the first one is backpropagation's
    tasks: int = 32
    epochs: int = 20
    look_every: int = 4  # steps
    fit: MatchingConfig = field(
        default_factory=lambda: MatchingConfig(fit_steps=500, fit_batch=512, peak_rate=5e-3)
    )


def learn_along_own_runs(
    sgms: Mapping[int, Sgm],
    start: Start,
    tasks: TaskSet,
    rates: Sequence[float],
    task: Task,
    config: OwnRunsConfig,
    seed: int,
    after_step: Callable[[], None],
) -> None:
    """Teach the SGMs behind the tuned layers but the last, in place.

    Args:
        sgms: by layer, in eval mode; so they are in the end.
        start: of the tuned layers.
        tasks: as the first of these sees them.
        rates: of these layers, at a run's start.
        task: gives network and loss.
        config: sizes.
        seed: of everything drawn at random.
        after_step: told of every step of every fit.
    """
    some = next(tasks.chunks(config.tasks))
    seen: dict[int, list[Examples]] = {layer: [] for layer in sgms}
    for number in range(config.rounds):
        driving = sgms if number else {}
        for layer, looks in looks_along(driving, start, some, rates, task, config, seed + number):
            seen[layer].append(looks)
        for layer, sgm in sgms.items():
            fit_sgm(sgm, joined(seen[layer]), config.fit, seed + number, after_step)


@torch.no_grad()
def looks_along(
    sgms: Mapping[int, Sgm],
    start: Start,
    tasks: TaskSet,
    rates: Sequence[float],
    task: Task,
    config: OwnRunsConfig,
    seed: int,
) -> list[tuple[int, Examples]]:
    """By layer, what its SGM would have to answer along runs that SGMs drive, or true gradients."""
    network, found = task.network, list[tuple[int, Examples]]()
    states, bounds = start_states(start, len(tasks)), dict[int, Tensor]()
    batches = [*shuffled_batches(tasks.support, config.epochs, seed)]
    for step, rows in enumerate(batches):
        features, labels = tasks.features[:, rows].float(), tasks.labels[:, rows]
        looking = step % config.look_every == 0
        activations, true = dict[int, Tensor](), dict[int, Tensor]()
        if looking or not sgms:
            true = true_gradients(network, states, features, labels, task.heads)
        gradient_of = _driven_by(sgms, true, activations, task)
        now = [torch.tensor(rate * rate_factor(step, len(batches))) for rate in rates]
        states = local_step(network, states, features, labels, now, gradient_of)
        for layer in network.last(len(start))[:-1] if looking else ():
            bound = bounds.setdefault(layer, LOST_ACTIVATION * activations[layer].abs().max())
            found.append((layer, _look(activations[layer], labels, true[layer], bound)))
    return found


def _driven_by(
    sgms: Mapping[int, Sgm], true: Mapping[int, Tensor], seen: dict[int, Tensor], task: Task
) -> GradientOf:
    """Gradients of these SGMs, or true ones; activations are kept in `seen`."""

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        seen[layer] = activation
        if layer == task.network.depth:
            return error(task.heads, activation, labels[:, :, None])
        return apply_sgm(sgms[layer], activation, labels) if sgms else true[layer]

    return gradient_of


def _look(activation: Tensor, labels: Tensor, true: Tensor, bound: Tensor) -> Examples:
    """Samples (M, ...) of the tasks (T, B, ...) that are not lost."""
    kept = true.isfinite().all(dim=(1, 2, 3)) & (activation.abs().amax(dim=(1, 2, 3)) < bound)
    return Examples(*(one[kept].flatten(0, 1) for one in (activation, labels, true)))
