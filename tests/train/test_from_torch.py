"""A trained sequence of torch's own layers is taken as it is, or refused part by part."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor, nn

from qsgm import QsgmError
from qsgm.train.model.from_torch import from_torch
from qsgm.train.model.net import ConvNet, as_seen


def trained(module: nn.Sequential, shape: tuple[int, ...]) -> nn.Sequential:
    """Norms that have seen something, in eval mode."""
    torch.manual_seed(0)
    with torch.no_grad():
        for _ in range(3):
            module(2 * torch.randn(8, *shape) + 1)
    return module.eval()


def answers(net: ConvNet, inputs: Tensor) -> Tensor:
    with torch.no_grad():
        return net.double()(as_seen(net.network, inputs).double()).flatten(1)


@st.composite
def planar(draw: st.DrawFn) -> tuple[nn.Sequential, tuple[int, int, int]]:
    """A network of two convolutions and one or two dense layers on maps of any sides."""
    channels, height, width = (
        draw(st.integers(1, 3)),
        draw(st.integers(9, 14)),
        draw(st.integers(9, 14)),
    )
    kernel = draw(st.tuples(st.integers(1, 3), st.integers(1, 3)))
    stride = draw(st.tuples(st.integers(1, 2), st.integers(1, 2)))
    padding = tuple(min(draw(st.integers(0, 1)), side - 1) for side in kernel)
    first = [nn.Conv2d(channels, 4, kernel, stride, padding, bias=draw(st.booleans()))]
    if draw(st.booleans()):
        first.append(nn.BatchNorm2d(4, affine=draw(st.booleans())))
    first.append(nn.ReLU())
    if draw(st.booleans()):
        first.append(nn.AvgPool2d(2, stride=draw(st.integers(1, 2))))
    second = [nn.Conv2d(4, 5, 2), nn.BatchNorm2d(5), nn.ReLU(), nn.Dropout(0.5)]
    if draw(st.booleans()):
        tail = [nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(5, 3)]
    else:
        with torch.no_grad():
            size = nn.Sequential(*first, *second)(torch.zeros(2, channels, height, width))
        tail = [nn.Flatten(), nn.Linear(size[0].numel(), 6), nn.ReLU(), nn.Linear(6, 3)]
    return nn.Sequential(nn.Sequential(*first), *second, *tail), (height, width, channels)


@given(planar())
def test_a_planar_network_answers_as_it_did(
    made: tuple[nn.Sequential, tuple[int, int, int]],
) -> None:
    module, (height, width, channels) = made
    module = trained(module, (channels, height, width))
    net = from_torch(module, (height, width, channels))
    inputs = torch.randn(3, height, width, channels, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        expected = module.double()(inputs.permute(0, 3, 1, 2).double())
    torch.testing.assert_close(answers(net, inputs), expected, rtol=1e-5, atol=1e-6)


def test_a_network_along_one_axis_answers_as_it_did() -> None:
    module = nn.Sequential(
        nn.Conv1d(6, 8, 5, stride=2, padding=2),
        nn.BatchNorm1d(8),
        nn.ReLU(),
        nn.AvgPool1d(2),
        nn.Conv1d(8, 4, 3),
        nn.ReLU(),
        nn.AdaptiveAvgPool1d(1),
        nn.Flatten(),
        nn.Linear(4, 7),
    )
    module = trained(module, (6, 60))
    net = from_torch(module, (1, 60, 6))
    inputs = torch.randn(5, 1, 60, 6)
    with torch.no_grad():
        expected = module.double()(inputs[:, 0].permute(0, 2, 1).double())
    torch.testing.assert_close(answers(net, inputs), expected, rtol=1e-5, atol=1e-6)


def test_a_norm_without_a_relu_behind_it_is_folded_into_its_layer() -> None:
    module = trained(
        nn.Sequential(nn.Conv2d(2, 3, 4), nn.ReLU(), nn.Conv2d(3, 2, 1), nn.BatchNorm2d(2)),
        (2, 4, 4),
    )
    net = from_torch(module, (4, 4, 2))
    inputs = torch.randn(3, 4, 4, 2)
    with torch.no_grad():
        expected = module(inputs.permute(0, 3, 1, 2)).flatten(1).double()
    torch.testing.assert_close(answers(net, inputs), expected, rtol=1e-5, atol=1e-6)


def test_everything_that_cannot_be_taken_is_named_at_once() -> None:
    module = nn.Sequential(
        nn.Conv2d(2, 4, 3, groups=2), nn.GELU(), nn.MaxPool2d(2), nn.Flatten(), nn.Linear(4, 2)
    )
    with pytest.raises(QsgmError) as refused:
        from_torch(module, (4, 4, 2))
    for part in ("0: Conv2d with groups", "1: GELU", "2: MaxPool2d"):
        assert part in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "parts",
    [
        [nn.ReLU(), nn.Conv2d(2, 1, 4)],
        [nn.Conv2d(2, 1, 4), nn.ReLU(), nn.BatchNorm2d(1)],
        [nn.Conv2d(2, 1, 3)],  # gives a map
        [nn.Conv2d(3, 1, 4)],  # takes other channels
        [nn.Flatten(), nn.Linear(7, 1)],
    ],
    ids=["starts with a ReLU", "norm behind ReLU", "map left", "other channels", "other inputs"],
)
def test_parts_that_do_not_fit_are_refused(parts: list[nn.Module]) -> None:
    with pytest.raises(QsgmError):
        from_torch(nn.Sequential(*parts), (4, 4, 2))
