"""Losses in plain torch, which knows nothing of heads: what those are held against."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor
from torch.nn import functional as F

from qsgm.grasp.angles import AngleEncoding
from qsgm.grasp.task import GraspTask
from qsgm.task import Heads

ACTIVATIONS: Mapping[str, Callable[[Tensor], Tensor]] = {
    "sigmoid": torch.sigmoid,
    "tanh": torch.tanh,
    "softmax": lambda x: torch.softmax(x, dim=1),
}


@dataclass(frozen=True)
class GraspLoss:
    """Log loss on quality plus l2 on both angle channels of the positives (paper section 3.1)."""

    encoding: AngleEncoding = "double"
    label_smoothing: float = 0.05
    angle_weight: float = 1.0

    @property
    def heads(self) -> Heads:
        """The product's."""
        quality, *angle = GraspTask(self.encoding, self.label_smoothing).heads
        return quality, *(replace(head, weight=self.angle_weight) for head in angle)

    def activate(self, raw: Tensor) -> Tensor:
        """Raw outputs (N, 3, ...) to quality in (0, 1), sine and cosine."""
        cosine = torch.tanh(raw[:, 2]) if self.encoding == "double" else torch.sigmoid(raw[:, 2])
        return torch.stack([torch.sigmoid(raw[:, 0]), torch.tanh(raw[:, 1]), cosine], dim=1)

    def per_sample(self, raw: Tensor, labels: Tensor) -> Tensor:
        """Raw outputs (N, 3) and labels (N, 3) to losses (N,)."""
        target = labels[:, 0] * (1 - self.label_smoothing) + self.label_smoothing / 2
        quality = F.binary_cross_entropy_with_logits(raw[:, 0], target, reduction="none")
        angle = (self.activate(raw)[:, 1:] - labels[:, 1:]).square().sum(dim=1)
        return quality + self.angle_weight * labels[:, 0] * angle

    def __call__(self, raw: Tensor, labels: Tensor) -> Tensor:
        """Mean loss of a batch."""
        return self.per_sample(raw, labels).mean()


class Loss(Protocol):
    """Heads, and what they have to come to."""

    @property
    def heads(self) -> Heads: ...

    def per_sample(self, raw: Tensor, labels: Tensor) -> Tensor: ...

    def __call__(self, raw: Tensor, labels: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class HeadsLoss:
    """Any heads' loss by torch's own losses."""

    heads: Heads

    def activate(self, raw: Tensor) -> Tensor:
        """Raw outputs (N, O) as the user sees them."""
        parts = [
            ACTIVATIONS[h.activation](x) for h, x in zip(self.heads, self._split(raw), strict=True)
        ]
        return torch.cat(parts, dim=1)

    def per_sample(self, raw: Tensor, labels: Tensor) -> Tensor:
        """Raw outputs and labels (N, O) to losses (N,)."""
        total = torch.zeros(len(raw), dtype=raw.dtype)
        for head, x, known in zip(self.heads, self._split(raw), self._split(labels), strict=True):
            if head.kind == "cross_entropy":
                classes = known.argmax(dim=1)
                value = F.cross_entropy(
                    x, classes, reduction="none", label_smoothing=head.smoothing
                )
            elif head.kind == "log_loss":
                near, far = (
                    x.new_tensor(end) for end in (head.smoothing / 2, 1 - head.smoothing / 2)
                )
                target = torch.where(known > 0.5, far, near)
                value = F.binary_cross_entropy_with_logits(x, target, reduction="none")
                value = value.sum(dim=1)
            else:
                seen = ACTIVATIONS[head.activation](x)
                value = F.mse_loss(seen, known, reduction="none").sum(dim=1)
            counted = torch.ones_like(value) if head.where is None else labels[:, head.where]
            total = total + head.weight * torch.where(counted != 0, value, 0 * value)
        return total

    def __call__(self, raw: Tensor, labels: Tensor) -> Tensor:
        """Mean loss of a batch."""
        return self.per_sample(raw, labels).mean()

    def _split(self, x: Tensor) -> tuple[Tensor, ...]:
        return x.split([head.channels for head in self.heads], dim=1)
