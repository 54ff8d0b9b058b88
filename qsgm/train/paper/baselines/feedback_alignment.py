"""Feedback alignment (Lillicrap et al., 2016).

Backpropagation with fixed random matrices in the place of transposed weights: backward weights need
not be forward weights. All activations and the output error are needed as before.
"""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from qsgm.network import Network
from qsgm.train.paper.baselines.interface import ForwardPass, carry_back_all


class FeedbackAlignment:
    """Gradients carried back by `feedback` (K, C) of every tuned layer but the first, by layer."""

    def __init__(self, feedback: Mapping[int, Tensor]) -> None:
        self.feedback = feedback

    def gradients(self, weights: Mapping[int, Tensor], batch: ForwardPass) -> Mapping[int, Tensor]:
        del weights  # that they are not needed is the point
        return carry_back_all(self.feedback, batch)


def random_feedback(
    network: Network, start: Sequence[tuple[Tensor, Tensor]], seed: int
) -> dict[int, Tensor]:
    """Normal matrices with the spread of each layer's starting weight (K, C).

    At another spread, a layer's learning rate would not mean what it means in backpropagation.
    """
    generator = torch.Generator().manual_seed(seed)
    return {
        layer: weight.std() * torch.randn(weight.shape, generator=generator)
        for layer, (weight, _) in zip(network.last(len(start)), start, strict=True)
    }
