"""The SGM, and local updates by it against torch's own backward pass (`SgmLayer`)."""

import pytest
import torch
from sgm_layer import SgmLayer
from torch import Tensor, nn

from qsgm.grasp.network import GRASPNET
from qsgm.train.model.local import LayerState, local_step
from qsgm.train.model.sgm import Sgm

BATCH, LAYER = 6, 5
SGM_LAYERS = range(1, 6)
CHANNELS = GRASPNET.layer(LAYER).out


def test_parameter_counts_are_the_papers() -> None:
    counts = [sum(p.numel() for p in Sgm(GRASPNET, layer).parameters()) for layer in SGM_LAYERS]
    assert counts == [1400, 1400, 5104, 624, 624]


@pytest.mark.parametrize("layer", SGM_LAYERS)
@pytest.mark.parametrize("hidden", [None, (5,), (64, 64)])
def test_a_gradient_has_its_activations_shape(layer: int, hidden: tuple[int, ...] | None) -> None:
    activation = torch.randn(2, GRASPNET.layer(layer).out, 7, 6)
    assert Sgm(GRASPNET, layer, hidden)(activation, torch.randn(2, 3)).shape == activation.shape


@pytest.mark.parametrize("hidden", [None, (64, 64)])
def test_a_local_update_equals_autograd_through_the_sgm_layer(
    hidden: tuple[int, ...] | None,
) -> None:
    torch.manual_seed(1)
    sgm, conv = Sgm(GRASPNET, LAYER, hidden).eval(), nn.Conv2d(16, CHANNELS, 1)
    last = nn.Conv2d(CHANNELS, 3, 1)
    features, labels = torch.randn(BATCH, 16, 1, 1).relu(), torch.randn(BATCH, 3)
    last.weight.requires_grad_(False)

    behind = SgmLayer(sgm)(conv(features).relu(), labels)
    last(behind).square().mean().backward()

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == 6:
            return torch.zeros_like(activation)
        maps = activation[0].transpose(1, 2)[..., None]
        return sgm(maps, labels[0]).flatten(2).transpose(1, 2)[None]

    states = [
        LayerState.start(one.weight.detach().flatten(1).T[None], one.bias.detach()[None])
        for one in (conv, last)
    ]
    rates = [torch.tensor(1.0), torch.tensor(0.0)]
    seen = features.flatten(2).transpose(1, 2)[None]
    with torch.no_grad():
        updated = local_step(GRASPNET, states, seen, labels[None], rates, gradient_of)[0]
        weight, bias = (parameter - parameter.grad for parameter in conv.parameters())
    torch.testing.assert_close(updated.weight[0], weight.flatten(1).T, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(updated.bias[0], bias, rtol=1e-5, atol=1e-5)
