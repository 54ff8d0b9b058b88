"""Fixed random matrices from the three outputs straight to every hidden layer's activation."""

from collections.abc import Mapping
from math import sqrt

import torch
from torch import Tensor

from qsgm.grasp.crops import CROP_PX
from qsgm.train.model.graspnet import CHANNELS, KERNELS, LAYERS, POOL, POOL_AFTER_LAYER, STRIDES


def random_projections(seed: int) -> dict[int, Tensor]:
    """A matrix (3, P, C) for each of the layers 1 to 5.

    Uniform within ±sqrt(6 / (P C)): what torch's `kaiming_uniform_` makes of that shape, which is
    how Frenkel et al. (2019) draw them.
    """
    generator = torch.Generator().manual_seed(seed)
    projections = {}
    for layer, positions in _positions().items():
        shape = CHANNELS[LAYERS], positions, CHANNELS[layer]
        bound = sqrt(6 / (positions * CHANNELS[layer]))
        projections[layer] = bound * (2 * torch.rand(shape, generator=generator) - 1)
    return projections


def project(
    signal: Tensor, projections: Mapping[int, Tensor], like: Mapping[int, Tensor]
) -> dict[int, Tensor]:
    """A signal (T, B, 3) projected to the shape of each activation (T, B, P, C) in `like`."""
    return {layer: torch.einsum("tbo,opc->tbpc", signal, projections[layer]) for layer in like}


def _positions() -> dict[int, int]:
    """Positions P of a crop's activation behind each hidden layer."""
    positions, side = {}, CROP_PX
    for layer in range(1, LAYERS):
        side = (side - KERNELS[layer - 1]) // STRIDES[layer - 1] + 1
        if layer == POOL_AFTER_LAYER:
            side -= POOL - 1
        positions[layer] = side**2
    return positions
