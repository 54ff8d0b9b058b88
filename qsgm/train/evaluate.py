"""Whole fine-tuning runs on many tasks in torch: which rates work, and how well."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import torch
from torch import Tensor

from qsgm.train.graspnet import LAYERS, Loss
from qsgm.train.local import LayerState, local_step, loss_gradient, outputs
from qsgm.train.maml import MOMENTUM, apply_sgm
from qsgm.train.sgm import Sgm
from qsgm.train.tasks import TaskSet, shuffled_batches, start_states
from qsgm.tuning import rate_factor


@dataclass(frozen=True)
class Score:
    """Means over tasks, on their query crops."""

    loss: float
    detection_accuracy: float
    angle_mae_deg: float


@torch.no_grad()
def run_sgms(
    start: Sequence[tuple[Tensor, Tensor]],
    sgms: Mapping[int, Sgm],
    rates: Sequence[float],
    tasks: TaskSet,
    epochs: int,
    loss: Loss,
    seed: int = 0,
) -> Score:
    """Fine-tune every task's last layers with static SGMs and score the result."""

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == LAYERS:
            return loss_gradient(loss, activation, labels[:, :, None])
        return apply_sgm(sgms[layer], activation, labels)

    scores = []
    for chunk in tasks.chunks(8):
        states = start_states(start, len(chunk))
        batches = list(shuffled_batches(chunk.support, epochs, seed))
        for step, rows in enumerate(batches):
            features, labels = chunk.features[:, rows].float(), chunk.labels[:, rows]
            now = [torch.tensor(rate * rate_factor(step, len(batches))) for rate in rates]
            states = local_step(states, features, labels, now, gradient_of, MOMENTUM)
        scores.append(score(states, chunk, loss))
    return Score(*torch.cat(scores).mean(dim=0).tolist())


def score(states: Sequence[LayerState], tasks: TaskSet, loss: Loss) -> Tensor:
    """Loss, detection accuracy and angle error [deg] on the query crops; (T, 3)."""
    features, labels = tasks.features[:, tasks.support :].float(), tasks.labels[:, tasks.support :]
    raw = outputs(states, features)
    losses = loss.per_sample(raw.flatten(0, 1), labels.flatten(0, 1)).view(labels.shape[:2])
    quality, sine, cosine = loss.activate(raw.flatten(0, 1)).view(labels.shape).unbind(-1)
    positive = labels[..., 0] > 0
    detection = ((quality > 0.5) == positive).float().mean(dim=1)
    turn = torch.atan2(sine, cosine) - torch.atan2(labels[..., 1], labels[..., 2])
    turn = torch.atan2(turn.sin(), turn.cos()).abs()
    factor = 2.0 if loss.encoding == "double" else 1.0
    angle = torch.rad2deg(turn / factor * positive).sum(dim=1) / positive.sum(dim=1)
    return torch.stack([losses.mean(dim=1), detection, angle], dim=1)


def best_rates(scores: Mapping[tuple[float, ...], Score]) -> tuple[float, ...]:
    """The rates whose run ended with the lowest finite loss."""
    finite = {rates: score.loss for rates, score in scores.items() if isfinite(score.loss)}
    return min(finite, key=lambda rates: finite[rates])
