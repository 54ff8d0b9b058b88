"""Static SGMs (paper section 3.2): trained beforehand, or random, they stay as they are.

A layer's gradient comes from its activation and the label alone, during the forward pass.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.interface import ForwardPass
from qsgm.train.pretraining.maml import apply_sgm


class StaticSgms:
    """One SGM behind every hidden tuned layer, by layer; batchnorm is an affine map from here."""

    def __init__(self, sgms: Mapping[int, Sgm]) -> None:
        self.sgms = {layer: sgm.eval() for layer, sgm in sgms.items()}

    @torch.no_grad()
    def gradients(self, weights: Mapping[int, Tensor], batch: ForwardPass) -> Mapping[int, Tensor]:
        del weights  # that they are not needed is the point
        return {
            layer: apply_sgm(self.sgms[layer], activation, batch.labels)
            for layer, activation in batch.hidden().items()
        }


class LabelFreeSgm(Sgm):
    """An SGM whose label channels are 0 whatever the label, in training and after (section 4.2)."""

    def forward(self, activation: Tensor, labels: Tensor) -> Tensor:
        return super().forward(activation, torch.zeros_like(labels))
