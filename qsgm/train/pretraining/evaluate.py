"""Whole fine-tuning runs on many tasks in torch: which rates work, and how well."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
import torch
from torch import Tensor

from qsgm.errors import QsgmError
from qsgm.grasp.angles import AngleEncoding, angle_error, decode_angle
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.graspnet import LAYERS, Loss
from qsgm.train.model.local import LayerState, local_step, loss_gradient, outputs
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.maml import MOMENTUM, apply_sgm
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states
from qsgm.tune.loop import rate_factor


@dataclass(frozen=True)
class Score:
    """Means over tasks, on their query crops."""

    objective: float  # Loss.per_task
    detection_accuracy: float
    angle_mae_deg: float


@dataclass(frozen=True)
class UpdateRule:
    """What fine-tunes the last layers: static SGMs, and how their gradients become steps."""

    sgms: Mapping[int, Sgm]  # by layer
    curvatures: Mapping[int, Curvature]
    rates: tuple[float, ...]  # of the tuned layers, at the start of a run
    loss: Loss

    def gradient_of(self, layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        """Gradient (T, B, P, C) on a layer's activation; labels (T, B, 3)."""
        if layer == LAYERS:
            return loss_gradient(self.loss, activation, labels[:, :, None])
        return apply_sgm(self.sgms[layer], activation, labels)


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
    batches = list(shuffled_batches(tasks.support, epochs, seed))
    for step, rows in enumerate(batches, start=1):
        features, labels = tasks.features[:, rows].float(), tasks.labels[:, rows]
        factor = rate_factor(step - 1, len(batches))
        rates = [torch.tensor(rate * factor) for rate in rule.rates]
        states = local_step(
            states, features, labels, rates, rule.gradient_of, MOMENTUM, rule.curvatures
        )
        if step % (len(batches) // epochs) == 0:
            yield states


def run_sgms(
    rule: UpdateRule,
    start: Sequence[tuple[Tensor, Tensor]],
    tasks: TaskSet,
    epochs: int,
    chunk: int = 8,
) -> Score:
    """Fine-tune every task's last layers, `chunk` tasks at once, and score the result."""
    scores = []
    for some in tasks.chunks(chunk):
        *_, states = fine_tune(rule, start, some, epochs)
        scores.append(score(states, some, rule.loss))
    return Score(*torch.cat(scores).mean(dim=0).tolist())


@torch.no_grad()
def score(states: Sequence[LayerState], tasks: TaskSet, loss: Loss) -> Tensor:
    """Objective, detection accuracy and angle error [deg] on the query crops; (T, 3)."""
    features, labels = tasks.features[:, tasks.support :].float(), tasks.labels[:, tasks.support :]
    raw = outputs(states, features)
    seen = loss.activate(raw.flatten(0, 1)).view(labels.shape)
    positive = labels[..., 0] > 0
    detection = ((seen[..., 0] > 0.5) == positive).float().mean(dim=1)
    error = _angle_error_deg(seen, labels, loss.encoding)
    angle = (error * positive).sum(dim=1) / positive.sum(dim=1)
    return torch.stack([loss.per_task(raw, labels), detection, angle], dim=1)


def _angle_error_deg(seen: Tensor, labels: Tensor, encoding: AngleEncoding) -> Tensor:
    """Between outputs and labels (T, N, 3): (T, N), modulo 180 degrees whatever the encoding."""
    predicted, true = (
        decode_angle(x[..., 1].numpy(), x[..., 2].numpy(), encoding) for x in (seen, labels)
    )
    return torch.from_numpy(np.degrees(angle_error(predicted, true))).to(seen.dtype)


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
