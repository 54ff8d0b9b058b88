"""Pretraining, first stage: the network learns its task on drawn examples, by backpropagation.

Every batch shows examples never drawn before, so there is nothing to memorise and no epoch.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from qsgm.train.heads import mean_loss
from qsgm.train.model.net import ConvNet, as_seen
from qsgm.train.pretraining.tasks import ExampleStream
from qsgm.train.task import DrawnTask


@dataclass(frozen=True)
class BackboneConfig:
    """Sizes and rates of the first stage."""

    steps: int = 1800
    frames_per_batch: int = 8
    crops_per_frame: int = 24
    peak_rate: float = 4e-3
    weight_decay: float = 1e-4
    loader_processes: int = 2


class BackboneTraining:
    """The first stage as a state that can be saved, resumed and advanced step by step."""

    def __init__(self, config: BackboneConfig, task: DrawnTask, seed: int, device: str) -> None:
        torch.manual_seed(seed)
        self.config, self.task, self.seed, self.device = config, task, seed, device
        self.net = in_memory_format(ConvNet(task.network).to(device), torch.channels_last)
        self.optimizer = torch.optim.AdamW(
            self.net.parameters(), config.peak_rate, weight_decay=config.weight_decay
        )
        self.schedule = torch.optim.lr_scheduler.OneCycleLR(
            self.optimizer, config.peak_rate, total_steps=config.steps, pct_start=0.1
        )
        self.step = 0

    def run(self, after_step: Callable[[int, float], None]) -> ConvNet:
        """Train to the end; `after_step` gets the step's number and its loss."""
        self.net.train()
        for crops, labels in self._batches():
            known = labels.flatten(0, 1).to(self.device)
            loss = mean_loss(self.task.heads, self._outputs(crops), known)
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
        parts = (self.net, self.optimizer, self.schedule)
        return {"step": self.step, "parts": [part.state_dict() for part in parts]}

    def resume(self, state: dict[str, Any]) -> None:
        """Go on from :meth:`state`; the batches to come are those an unbroken run would see."""
        self.step = state["step"]
        net, optimizer, schedule = state["parts"]
        self.net.load_state_dict(net)
        self.optimizer.load_state_dict(optimizer)
        self.schedule.load_state_dict(schedule)

    def _outputs(self, crops: Tensor) -> Tensor:
        x = as_seen(self.task.network, crops.flatten(0, 1).to(self.device))
        outputs: Tensor = self.net(x.contiguous(memory_format=torch.channels_last))[:, :, 0, 0]
        return outputs

    def _batches(self) -> Iterator[tuple[Tensor, Tensor]]:
        frames = self.config.steps * self.config.frames_per_batch
        stream = ExampleStream(self.task, self.seed, frames, self.config.crops_per_frame)
        rest = torch.utils.data.Subset(
            stream, range(self.step * self.config.frames_per_batch, frames)
        )
        return iter(
            DataLoader(
                rest,
                batch_size=self.config.frames_per_batch,
                num_workers=self.config.loader_processes,
                prefetch_factor=4 if self.config.loader_processes else None,
            )
        )


def in_memory_format(net: ConvNet, memory_format: torch.memory_format) -> ConvNet:
    """A network with its weights laid out otherwise; torch's types do not know the call."""
    net.to(memory_format=memory_format)  # type: ignore[call-overload]
    return net
