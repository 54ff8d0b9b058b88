"""What a baseline is given of a batch, and what it has to yield.

A step runs all tuned layers forward, asks the baseline for the gradient on every layer's
activation, and updates all layers. Some baselines need no more than a layer's own activation and
the label, some the error at the outputs, some the weights behind: all of it is in reach here, and
each module says what it uses. Since every layer's activation comes from its weights before the
update, a step equals :func:`qsgm.train.model.local.local_step`, where layers update one by one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from qsgm.network import Network
from qsgm.task import Heads
from qsgm.train.heads import error
from qsgm.train.model.local import (
    LayerState,
    columns,
    layer_forward,
    to_input,
)


@dataclass(frozen=True)
class ForwardPass:
    """A batch on its way through the tuned layers; mappings are by layer number, in order."""

    network: Network
    columns: Mapping[int, Tensor]  # (T, B, P, K), what each layer sees of its input
    before: Mapping[int, Tensor]  # (T, B, P, C), pre-activations
    activations: Mapping[int, Tensor]  # (T, B, P, C), behind the pool
    labels: Tensor  # (T, B, L)
    output_error: Tensor  # (T, B, 1, L), gradient of each sample's loss on its raw outputs

    def hidden(self) -> Mapping[int, Tensor]:
        """The activations of all tuned layers but the last."""
        return {layer: x for layer, x in self.activations.items() if layer < self.network.depth}


class Baseline(Protocol):
    """Where the gradients of the hidden tuned layers come from.

    The last layer's is the loss's own in every system. A baseline that learns or remembers serves
    for one run; make a new one for the next.
    """

    def gradients(self, weights: Mapping[int, Tensor], batch: ForwardPass) -> Mapping[int, Tensor]:
        """Gradient of each sample's loss on every hidden tuned layer's activation.

        Args:
            weights: (T, K, C) of every tuned layer, as they were in the forward pass.
            batch: that pass.

        Returns:
            By layer, in the shape of its activation (T, B, P, C).
        """
        ...


@torch.no_grad()
def forward_pass(
    network: Network,
    states: Mapping[int, LayerState],
    features: Tensor,
    labels: Tensor,
    heads: Heads,
) -> ForwardPass:
    """Run features (T, B, P, C) through the tuned layers and compare with labels (T, B, L)."""
    seen: dict[int, Tensor] = {}
    before: dict[int, Tensor] = {}
    activations: dict[int, Tensor] = {}
    x = features
    for layer, state in states.items():
        seen[layer] = columns(network, layer, x)
        before[layer], x = layer_forward(network, layer, state, seen[layer])
        activations[layer] = x
    wrong = error(heads, x, labels[:, :, None])
    return ForwardPass(network, seen, before, activations, labels, wrong)


def carry_back(layer: int, weight: Tensor, batch: ForwardPass, gradient: Tensor) -> Tensor:
    """The gradient (T, B, P, C) on a layer's activation carried back to its input's.

    Args:
        layer: its number.
        weight: (T, K, C) or (K, C); its own gives the true gradient.
        batch: has to hold the activation of the layer before.
        gradient: on its activation.
    """
    return to_input(batch.network, layer, weight, batch.before[layer], gradient)


def carry_back_all(weights: Mapping[int, Tensor], batch: ForwardPass) -> dict[int, Tensor]:
    """The output error carried back, layer by layer, to every hidden tuned layer's activation."""
    gradients, gradient = {}, batch.output_error
    for layer in list(batch.activations)[:0:-1]:
        gradient = carry_back(layer, weights[layer], batch, gradient)
        gradients[layer - 1] = gradient
    return gradients
