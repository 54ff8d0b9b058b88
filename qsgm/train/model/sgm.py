"""Synthetic gradient modules (paper section 3.2) in torch.

An SGM sees a layer's activation and the label, each label value filling a channel of its own,
and answers with the gradient of every sample's loss with respect to that activation. It is a
stack of convolutions with batchnorm and ReLU between: (C + L) -> hidden ... -> C, 3x3 where the
layer gives maps, else 1x1. One hidden convolution as wide as the layer is the paper's
SGM; two wider ones are the default here (`docs/design.md` says why). The last layer has
none: its gradient comes from the loss.
"""

from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.network import Network


class Sgm(nn.Module):
    """The module behind layer `layer`; without `hidden` widths, the paper's.

    Args:
        network: whose layer it is.
        layer: from 1 to the last but one.
        hidden: channels of each hidden convolution.
    """

    def __init__(self, network: Network, layer: int, hidden: Sequence[int] | None = None) -> None:
        super().__init__()
        self.layer, self.side = layer, network.after(layer)
        channels, kernel = network.layer(layer).out, network.sgm_kernel(layer)
        self.hidden = tuple(hidden or (channels,))
        padding = (kernel[0] // 2, kernel[1] // 2)
        widths = (channels + network.outputs, *self.hidden, channels)
        self.convs = nn.ModuleList(
            nn.Conv2d(into, out, kernel, padding=padding) for into, out in pairwise(widths)
        )
        self.norms = nn.ModuleList(nn.BatchNorm2d(width) for width in self.hidden)

    def forward(self, activation: Tensor, labels: Tensor) -> Tensor:
        """Activation (N, C, H, W) and labels (N, L) to its gradient (N, C, H, W)."""
        filled = labels[:, :, None, None].expand(-1, -1, *activation.shape[2:])
        x = torch.cat([activation, filled], dim=1)
        for conv, norm in zip(self.convs[:-1], self.norms, strict=True):
            x = F.relu(norm(conv(x)))
        gradient: Tensor = self.convs[-1](x)
        return gradient
