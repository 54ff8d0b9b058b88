"""Pretraining, first stage: GraspNet learns drawn objects, by backpropagation.

It learns two things at once. Its outputs say whether anything lies at a window's middle, and how.
And what layer 5 gives has to tell one object from others: a linear classifier that is fitted to
crops of a demonstration, in closed form, has to hold in another scene (Bertinetto et al. 2019,
*Meta-learning with differentiable closed-form solvers*). Every batch shows objects never drawn
before, so there is nothing to memorise and no epoch.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader

from qsgm.train.graspnet import CHANNELS, LAYERS, GraspNet, Loss, normalize
from qsgm.train.tasks import EpisodeStream

Batch = tuple[Tensor, Tensor, Tensor, Tensor]  # the parts of qsgm.train.tasks.Example, stacked


@dataclass(frozen=True)
class BackboneConfig:
    """Sizes and rates of the first stage."""

    steps: int = 1400
    episodes_per_batch: int = 8
    crops_per_episode: int = 24
    telling_apart_weight: float = 0.5
    peak_rate: float = 4e-3
    weight_decay: float = 1e-4
    loader_processes: int = 2


class TellApart(nn.Module):
    """How well a classifier of layer 5's outputs, fitted to a demonstration, holds elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self.log_ridge = nn.Parameter(torch.zeros(()))
        self.log_sharpness = nn.Parameter(torch.tensor(4.0).log())

    def forward(self, features: Tensor, mine: Tensor) -> Tensor:
        """Log loss on the second half of each episode's crops.

        Args:
            features: (T, n, C).
            mine: (T, n), 1 where the object is at the middle.
        """
        half = features.shape[1] // 2
        x = torch.cat([features, torch.ones_like(features[..., :1])], dim=-1)
        fitted, wanted = x[:, :half], 2 * mine[:, :half] - 1
        ridge = self.log_ridge.exp() * torch.eye(x.shape[-1])
        gram = fitted.transpose(1, 2) @ fitted + ridge
        weights = torch.linalg.solve(gram, fitted.transpose(1, 2) @ wanted[..., None])
        logits = self.log_sharpness.exp() * (x[:, half:] @ weights)[..., 0]
        return F.binary_cross_entropy_with_logits(logits, mine[:, half:])


class BackboneTraining:
    """The first stage as a state that can be saved, resumed and advanced step by step."""

    def __init__(self, config: BackboneConfig, loss: Loss, seed: int, device: str) -> None:
        torch.manual_seed(seed)
        self.config, self.loss, self.seed, self.device = config, loss, seed, device
        self.net = in_memory_format(GraspNet().to(device), torch.channels_last)
        self.tell_apart = TellApart()
        self.optimizer = torch.optim.AdamW(
            [*self.net.parameters(), *self.tell_apart.parameters()],
            config.peak_rate,
            weight_decay=config.weight_decay,
        )
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, config.peak_rate, total_steps=config.steps, pct_start=0.1
        )
        self.step = 0

    def run(self, after_step: Callable[[int, float], None]) -> GraspNet:
        """Train to the end; `after_step` gets the step's number and its loss."""
        self.net.train()
        for batch in self._batches():
            loss = self._objective(batch)
            self.optimizer.zero_grad()
            loss.backward()
            self.optimizer.step()
            self.schedule.step()
            self.step += 1
            after_step(self.step, loss.item())
        self.net.eval()
        return self.net

    def state(self) -> dict[str, Any]:
        """Everything needed to go on later."""
        parts = (self.net, self.tell_apart, self.optimizer, self.schedule)
        return {"step": self.step, "parts": [part.state_dict() for part in parts]}

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state`; the batches to come are those an unbroken run would see."""
        self.step = state["step"]
        net, tell_apart, optimizer, schedule = state["parts"]
        self.net.load_state_dict(net)
        self.tell_apart.load_state_dict(tell_apart)
        self.optimizer.load_state_dict(optimizer)
        self.schedule.load_state_dict(schedule)

    def _objective(self, batch: Batch) -> Tensor:
        crops, labels, weights, mine = batch
        x = normalize(crops.flatten(0, 1).to(self.device))
        features = self.net.between(x.contiguous(memory_format=torch.channels_last), 1, LAYERS - 1)
        raw = self.net.between(features, LAYERS, LAYERS)[:, :, 0, 0]
        weights = weights.flatten().to(self.device)
        losses = self.loss.per_sample(raw, labels.flatten(0, 1).to(self.device))
        anything = (losses * weights).sum() / weights.sum()
        by_episode = features[:, :, 0, 0].view(*mine.shape, CHANNELS[LAYERS - 1]).cpu()
        apart = self.tell_apart(by_episode, mine).to(self.device)
        objective: Tensor = anything + self.config.telling_apart_weight * apart
        return objective

    def _batches(self) -> Iterator[Batch]:
        config = self.config
        episodes = config.steps * config.episodes_per_batch
        stream = EpisodeStream(self.seed, episodes, config.crops_per_episode, self.loss.encoding)
        done = self.step * config.episodes_per_batch
        return iter(
            DataLoader(
                torch.utils.data.Subset(stream, range(done, episodes)),
                batch_size=config.episodes_per_batch,
                num_workers=config.loader_processes,
                prefetch_factor=4 if config.loader_processes else None,
            )
        )


def in_memory_format(net: GraspNet, memory_format: torch.memory_format) -> GraspNet:
    """The same network with its weights laid out otherwise; torch's types do not know the call."""
    net.to(memory_format=memory_format)  # type: ignore[call-overload]
    return net
