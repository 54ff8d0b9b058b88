"""GraspNet (paper section 3.1, "The Model") and its loss, in torch.

Six convolutions, each but the last with batchnorm and ReLU; 5x5 average pooling after the fourth.
A 128x128 crop gives one output, a 480x640 frame a heatmap of 23x33: the same network, fully
convolutional. The pool's kind is not stated in the paper; this one averages.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.grasp.angles import AngleEncoding

LAYERS = 6
CHANNELS = (3, 8, 8, 16, 16, 16, 3)
KERNELS = (5, 5, 5, 5, 1, 1)
STRIDES = (2, 2, 2, 2, 1, 1)
POOL_AFTER_LAYER = 4
POOL = 5
# Keeps logits bounded, and with them the gradients' tails.
LABEL_SMOOTHING = 0.05
ANGLE_WEIGHT = 1.0
# Under the root of a task's angle loss, whose slope at zero would have no end.
SMALLEST_ANGLE_LOSS = 1e-4


class Layer(nn.Module):
    """Convolution, then batchnorm and ReLU (all but the last layer), then the pool (layer 4)."""

    def __init__(self, number: int) -> None:
        super().__init__()
        shape = CHANNELS[number - 1], CHANNELS[number], KERNELS[number - 1], STRIDES[number - 1]
        self.conv = nn.Conv2d(*shape)
        self.norm = nn.BatchNorm2d(CHANNELS[number]) if number < LAYERS else None
        self.pool = nn.AvgPool2d(POOL, stride=1) if number == POOL_AFTER_LAYER else None

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv(x)
        if self.norm is not None:
            x = F.relu(self.norm(x))
        return x if self.pool is None else self.pool(x)


class GraspNet(nn.Module):
    """Images (N, 3, H, W), BGR in [-1, 1], to raw outputs (N, 3, rows, cols).

    The outputs are the quality logit and the two angle channels before their activation.
    """

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(Layer(number) for number in range(1, LAYERS + 1))

    def forward(self, x: Tensor) -> Tensor:
        return self.between(x, 1, LAYERS)

    def between(self, x: Tensor, first: int, last: int) -> Tensor:
        """Run layers `first` to `last`, both included, counted from 1."""
        for layer in self.layers[first - 1 : last]:
            x = layer(x)
        return x


def normalize(crops: Tensor) -> Tensor:
    """Pixels (N, H, W, 3), uint8 BGR, to the network's input (N, 3, H, W) in [-1, 1]."""
    return crops.permute(0, 3, 1, 2).float() / 127.5 - 1.0


@dataclass(frozen=True)
class Loss:
    """Log loss on quality plus l2 on both angle channels of the positives (paper section 3.1)."""

    encoding: AngleEncoding = "double"
    label_smoothing: float = LABEL_SMOOTHING
    angle_weight: float = ANGLE_WEIGHT

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

    def per_task(self, raw: Tensor, labels: Tensor) -> Tensor:
        """What meta-training lowers, from raw outputs and labels (T, N, 3) to (T,).

        Mean log loss on quality plus the root of the positives' mean squared angle error, so that
        a tenth of it gone counts the same at a fine object as at a poor one. The plain loss listens
        to round objects, whose angle cannot be learnt, and hardly to what is nearly right.
        """
        flat = labels.flatten(0, 1)
        quality = labels[..., 0]
        both = self.per_sample(raw.flatten(0, 1), flat).view(quality.shape)
        angle = (self.activate(raw.flatten(0, 1))[:, 1:] - flat[:, 1:]).square().sum(dim=1)
        angle = angle.view(quality.shape) * quality
        detection = both - self.angle_weight * angle
        error = angle.sum(dim=1) / quality.sum(dim=1).clamp(min=1.0)
        return detection.mean(dim=1) + self.angle_weight * (error + SMALLEST_ANGLE_LOSS).sqrt()

    def __call__(self, raw: Tensor, labels: Tensor) -> Tensor:
        """Mean loss of a batch."""
        return self.per_sample(raw, labels).mean()
