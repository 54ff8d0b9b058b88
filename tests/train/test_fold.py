"""Folding leaves every function as it was, and refuses what it cannot fold."""

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional as F

from qsgm import QsgmError
from qsgm.grasp.network import GRASPNET
from qsgm.train.model.arrays import on_pixels
from qsgm.train.model.fold import fold_net, fold_sgm, net_fold_error, run_folded, sgm_fold_error
from qsgm.train.model.net import ConvNet, as_seen
from qsgm.train.model.sgm import Sgm


def shake_norms(module: nn.Module, seed: int) -> None:
    """Give every batchnorm statistics and weights far from where they start; set eval mode."""
    generator = torch.Generator().manual_seed(seed)
    for norm in module.modules():
        if isinstance(norm, nn.BatchNorm2d):
            size = norm.num_features
            norm.running_mean = torch.randn(size, generator=generator)
            norm.running_var = 0.05 + 3 * torch.rand(size, generator=generator)
            norm.weight.data = torch.randn(size, generator=generator)
            norm.bias.data = torch.randn(size, generator=generator)
    module.eval()


def shaken_net(seed: int) -> ConvNet:
    torch.manual_seed(seed)
    net = ConvNet(GRASPNET)
    shake_norms(net, seed)
    return net


def random_crops(seed: int, count: int = 4) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (count, 128, 128, 3), generator=generator, dtype=torch.uint8)


@pytest.mark.parametrize("seed", range(5))
def test_folded_network_equals_the_unfolded_one(seed: int) -> None:
    net, crops = shaken_net(seed), random_crops(seed)
    with torch.no_grad():
        expected = net(as_seen(GRASPNET, crops))
        got = run_folded(fold_net(net), crops)
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=1e-5)
    assert net_fold_error(net, fold_net(net), crops) == float((got - expected).abs().max())


@pytest.mark.parametrize("seed", range(3))
def test_the_first_layer_can_take_raw_pixels(seed: int) -> None:
    net, crops = shaken_net(seed), random_crops(seed)
    folded = fold_net(net)
    on_raw = on_pixels(folded)
    assert on_raw.layers[1:] == folded.layers[1:]
    weight, bias = (
        torch.tensor(array) for array in (on_raw.layers[0].weight, on_raw.layers[0].bias)
    )
    got = F.relu(F.conv2d(crops.permute(0, 3, 1, 2).float(), weight, bias, stride=2))
    with torch.no_grad():
        expected = net.between(as_seen(GRASPNET, crops), 1, 1)
    torch.testing.assert_close(got, expected, rtol=1e-5, atol=2e-5)


@pytest.mark.parametrize("layer", range(1, 6))
@pytest.mark.parametrize("hidden", [None, (7,), (9, 6), (5, 8, 4)])
def test_folded_sgm_equals_the_unfolded_one(layer: int, hidden: tuple[int, ...] | None) -> None:
    torch.manual_seed(layer)
    sgm = Sgm(GRASPNET, layer, hidden)
    shake_norms(sgm, layer)
    activation, labels = 3 * torch.randn(8, GRASPNET.layer(layer).out, 5, 5), torch.randn(8, 3)
    folded = fold_sgm(sgm)
    assert folded.layer == layer
    assert len(folded.convs) == len(sgm.hidden) + 1
    scale = float(sgm(activation, labels).detach().abs().max())
    assert sgm_fold_error(sgm, folded, activation, labels) < 1e-5 * max(1, scale)


def test_batchnorm_is_folded_with_its_running_statistics_even_in_training_mode() -> None:
    net = shaken_net(0)
    expected = fold_net(net)
    net.train()
    got = fold_net(net)
    assert net.training
    for one, other in zip(got.layers, expected.layers, strict=True):
        np.testing.assert_array_equal(one.weight, other.weight)
        np.testing.assert_array_equal(one.bias, other.bias)


def test_parameter_counts_are_the_papers() -> None:
    layers = [sum(p.numel() for p in layer.parameters()) for layer in ConvNet(GRASPNET).layers]
    assert layers == [624, 1624, 3248, 6448, 304, 51]


def test_folded_layers_keep_geometry_and_drop_two_numbers_per_channel() -> None:
    folded = fold_net(ConvNet(GRASPNET))
    geometry = folded.network.layers
    assert [layer.stride for layer in geometry] == [(2, 2)] * 4 + [(1, 1)] * 2
    assert [layer.padding for layer in geometry] == [(0, 0)] * 6
    assert [layer.relu for layer in geometry] == [True] * 5 + [False]
    assert [layer.pool for layer in geometry] == [(1, 1)] * 3 + [(5, 5)] + [(1, 1)] * 2
    sizes = [layer.weight.size + layer.bias.size for layer in folded.layers]
    assert sizes == [624 - 16, 1624 - 16, 3248 - 32, 6448 - 32, 304 - 32, 51]
    assert all(layer.weight.dtype == layer.bias.dtype == np.float32 for layer in folded.layers)


@pytest.mark.parametrize("bad", [0.0, -1.0, float("nan"), float("inf")])
def test_a_variance_that_is_not_finite_and_positive_is_refused(bad: float) -> None:
    net = ConvNet(GRASPNET)
    net.layers[2].norm.running_var[3] = bad
    with pytest.raises(QsgmError, match="layer 3: batchnorm's running statistics"):
        fold_net(net)


def test_weights_that_are_not_finite_are_refused() -> None:
    net = ConvNet(GRASPNET)
    net.layers[5].conv.weight.data[0, 0] = float("nan")
    with pytest.raises(QsgmError, match="layer 6 has weights that are not finite"):
        fold_net(net)


def test_a_batchnorm_that_no_convolution_can_absorb_is_refused() -> None:
    net = ConvNet(GRASPNET)
    net.add_module("stray", nn.BatchNorm2d(3))
    with pytest.raises(QsgmError, match="'stray' does not stand behind a convolution"):
        fold_net(net)
