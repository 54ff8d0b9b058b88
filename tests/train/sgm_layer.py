"""An SGM as a layer of a network, as the paper has it: an oracle that leaves the work to torch."""

from typing import Any

import torch
from torch import Tensor, nn

from qsgm.train.model.sgm import Sgm


class SgmLayer(nn.Module):
    """Forward a no-op; backward its synthetic gradient takes the place of the incoming one.

    The network's loss has to be a mean over the samples.
    """

    def __init__(self, sgm: Sgm) -> None:
        super().__init__()
        self.sgm = sgm

    def forward(self, activation: Tensor, labels: Tensor) -> Tensor:
        with torch.no_grad():
            synthetic = self.sgm(activation, labels)
        # In a tuple, so that autograd does not take the SGM for a part of the network's graph.
        return _Substitute.apply(activation, (synthetic,))


class _Substitute(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, activation: Tensor, synthetic: tuple[Tensor]) -> Tensor:
        (ctx.synthetic,) = synthetic
        return activation.view_as(activation)

    @staticmethod
    def backward(ctx: Any, incoming: Tensor) -> tuple[Tensor, None]:
        return ctx.synthetic / len(incoming), None
