"""Fixed random matrices from the outputs straight to every hidden layer's activation."""

from collections.abc import Mapping
from math import sqrt

import torch
from torch import Tensor

from qsgm.network import Network


def random_projections(network: Network, seed: int) -> dict[int, Tensor]:
    """A matrix (O, P, C) for each layer but the last.

    Uniform within ±sqrt(6 / (P C)): what torch's `kaiming_uniform_` makes of that shape, which is
    how Frenkel et al. (2019) draw them.
    """
    generator = torch.Generator().manual_seed(seed)
    projections = {}
    for layer in range(1, network.depth):
        positions, channels = network.positions_after(layer), network.layer(layer).out
        bound = sqrt(6 / (positions * channels))
        drawn = torch.rand((network.outputs, positions, channels), generator=generator)
        projections[layer] = bound * (2 * drawn - 1)
    return projections


def project(
    signal: Tensor, projections: Mapping[int, Tensor], like: Mapping[int, Tensor]
) -> dict[int, Tensor]:
    """A signal (T, B, O) projected to the shape of each activation (T, B, P, C) in `like`."""
    return {layer: torch.einsum("tbo,opc->tbpc", signal, projections[layer]) for layer in like}
