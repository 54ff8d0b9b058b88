"""Whole fine-tuning runs on many tasks in torch: which rates work, and how well."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from qsgm.train.graspnet import LAYERS, Loss
from qsgm.train.local import LayerState, local_step, loss_gradient, outputs
from qsgm.train.maml import BATCH, MOMENTUM, apply_sgm
from qsgm.train.sgm import Sgm
from qsgm.train.tasks import TaskSet, start_states


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
    rate_tensors = [torch.tensor(rate) for rate in rates]
    for chunk in tasks.chunks(8):
        generator = torch.Generator().manual_seed(seed)
        states = start_states(start, len(chunk))
        for _ in range(epochs):
            for rows in torch.randperm(chunk.support, generator=generator).split(BATCH):
                features, labels = chunk.features[:, rows].float(), chunk.labels[:, rows]
                states = local_step(states, features, labels, rate_tensors, gradient_of, MOMENTUM)
        scores.append(score(states, chunk, loss))
    return torch_mean(scores)


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


def torch_mean(scores: Sequence[Tensor]) -> Score:
    """Mean over the tasks of all chunks."""
    return Score(*torch.cat(list(scores)).mean(dim=0).tolist())


def best_rates(
    candidates: Iterable[tuple[float, ...]], run: Callable[[tuple[float, ...]], Score]
) -> tuple[float, ...]:
    """The candidate whose run ends with the lowest finite loss."""
    scored = [(run(rates).loss, rates) for rates in candidates]
    finite = [entry for entry in scored if entry[0] == entry[0]]
    return min(finite)[1]
