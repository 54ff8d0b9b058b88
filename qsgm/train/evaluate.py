"""Whole fine-tuning runs on many tasks in torch: which rates work, and how well."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isfinite

import numpy as np
import torch
from torch import Tensor

from qsgm.angles import AngleEncoding, angle_error, decode_angle
from qsgm.errors import QsgmError
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


@torch.no_grad()
def score(states: Sequence[LayerState], tasks: TaskSet, loss: Loss) -> Tensor:
    """Loss, detection accuracy and angle error [deg] on the query crops; (T, 3)."""
    features, labels = tasks.features[:, tasks.support :].float(), tasks.labels[:, tasks.support :]
    raw = outputs(states, features)
    losses = loss.per_sample(raw.flatten(0, 1), labels.flatten(0, 1)).view(labels.shape[:2])
    seen = loss.activate(raw.flatten(0, 1)).view(labels.shape)
    positive = labels[..., 0] > 0
    detection = ((seen[..., 0] > 0.5) == positive).float().mean(dim=1)
    error = _angle_error_deg(seen, labels, loss.encoding)
    angle = (error * positive).sum(dim=1) / positive.sum(dim=1)
    return torch.stack([losses.mean(dim=1), detection, angle], dim=1)


def _angle_error_deg(seen: Tensor, labels: Tensor, encoding: AngleEncoding) -> Tensor:
    """Between outputs and labels (T, N, 3): (T, N), modulo 180 degrees whatever the encoding."""
    predicted, true = (
        decode_angle(x[..., 1].numpy(), x[..., 2].numpy(), encoding) for x in (seen, labels)
    )
    return torch.from_numpy(np.degrees(angle_error(predicted, true))).to(seen.dtype)


def best_rates(scores: Mapping[tuple[float, ...], Score]) -> tuple[float, ...]:
    """The rates whose run ended with the lowest finite loss.

    Raises:
        QsgmError: there is none.
    """
    finite = {rates: score.loss for rates, score in scores.items() if isfinite(score.loss)}
    if not finite:
        raise QsgmError(
            f"pretraining failed: all {len(scores)} trial runs with the new SGMs diverged;"
            " pass another --seed, or lower the rates in PretrainConfig"
        )
    return min(finite, key=lambda rates: finite[rates])
