"""Synthetic gradient modules (paper section 3.2) in torch.

An SGM sees a layer's activation and the label, each label value filling a channel of its own,
and answers with the gradient of every sample's loss with respect to that activation. It is a
stack of convolutions with batchnorm and ReLU between: (C + L) -> hidden ... -> C, 3x3 where the
layer gives maps, else 1x1. One hidden convolution as wide as the layer is the paper's
SGM; two wider ones are the default here (the README's design notes say why). The last layer has
none: its gradient comes from the loss.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

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


# (synthetic, true): per-sample gradients (N, C, H, W); the synthetic one carries the SGM's graph
Teacher = Callable[[Tensor, Tensor], None]


class SgmLayer(nn.Module):
    """An SGM as a layer of a network, as the paper has it.

    Forward it is a no-op. Backward it puts its synthetic gradient in the place of the incoming
    one, so that everything before it trains on that. With a teacher it can learn from the
    incoming gradient: the true one, as long as no SGM follows.
    """

    def __init__(self, sgm: Sgm, teacher: Teacher | None = None) -> None:
        super().__init__()
        self.sgm, self.teacher = sgm, teacher

    def forward(self, activation: Tensor, labels: Tensor) -> Tensor:
        """Activation (N, C, H, W), returned as it is, and labels (N, L).

        The network's loss has to be a mean over the N samples.
        """
        with torch.enable_grad():
            synthetic = self.sgm(activation.detach(), labels)
        # In a tuple, so that autograd does not take the SGM for a part of the network's graph.
        result: Tensor = _Substitute.apply(activation, (synthetic,), self.teacher)  # type: ignore[no-untyped-call]
        return result


class _Substitute(torch.autograd.Function):
    """Identity whose gradient is the synthetic one, of a batch's mean loss."""

    @staticmethod
    def forward(
        ctx: Any, activation: Tensor, synthetic: tuple[Tensor], teacher: Teacher | None
    ) -> Tensor:
        ctx.synthetic, ctx.teacher = synthetic[0], teacher
        return activation.view_as(activation)

    @staticmethod
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, None, None]:
        batch = len(incoming)
        if ctx.teacher is not None:
            with torch.enable_grad():
                ctx.teacher(ctx.synthetic, incoming.detach() * batch)
        return ctx.synthetic.detach() / batch, None, None
