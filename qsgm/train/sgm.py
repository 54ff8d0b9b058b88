"""Synthetic gradient modules (paper section 3.2) in torch.

An SGM sees a layer's activation and the label, each label value filling a channel of its own,
and answers with the gradient of every sample's loss with respect to that activation. Two
convolutions with batchnorm and ReLU between: (C + 3) -> hidden -> C, 3x3 behind layers 1-3,
1x1 behind layers 4 and 5. The last layer has none: its gradient comes from the loss.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.train.graspnet import CHANNELS, LAYERS

LABEL_CHANNELS = 3
SGM_LAYERS = tuple(range(1, LAYERS))
KERNEL_BEHIND_LAYER = {1: 3, 2: 3, 3: 3, 4: 1, 5: 1}


class Sgm(nn.Module):
    """The module behind layer `layer`; with `hidden=None` as wide as the layer, as in the paper."""

    def __init__(self, layer: int, hidden: int | None = None) -> None:
        super().__init__()
        channels, kernel = CHANNELS[layer], KERNEL_BEHIND_LAYER[layer]
        hidden = hidden or channels
        self.conv1 = nn.Conv2d(channels + LABEL_CHANNELS, hidden, kernel, padding=kernel // 2)
        self.norm = nn.BatchNorm2d(hidden)
        self.conv2 = nn.Conv2d(hidden, channels, kernel, padding=kernel // 2)

    def forward(self, activation: Tensor, labels: Tensor) -> Tensor:
        """Activation (N, C, H, W) and labels (N, 3) to its gradient (N, C, H, W)."""
        filled = labels[:, :, None, None].expand(-1, -1, *activation.shape[2:])
        hidden = F.relu(self.norm(self.conv1(torch.cat([activation, filled], dim=1))))
        result: Tensor = self.conv2(hidden)
        return result
