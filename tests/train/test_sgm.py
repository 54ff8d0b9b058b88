"""The SGM as a layer: nothing forward, its own gradient backward, and what its teacher is told."""

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.grasp.network import GRASPNET
from qsgm.train.model.local import LayerState, local_step
from qsgm.train.model.sgm import Sgm, SgmLayer, Teacher

BATCH, LAYER = 6, 5
SGM_LAYERS = range(1, 6)
CHANNELS = GRASPNET.layer(LAYER).out


class Case:
    """A convolution, the SGM's place behind it, and a rest with a mean loss."""

    def __init__(self, hidden: tuple[int, ...] | None = (12, 9)) -> None:
        torch.manual_seed(0)
        self.conv, self.rest = nn.Conv2d(4, CHANNELS, 3), nn.Conv2d(CHANNELS, 2, 1)
        self.sgm = Sgm(GRASPNET, LAYER, hidden).eval()
        self.x, self.labels = torch.randn(BATCH, 4, 5, 5), torch.randn(BATCH, 3)
        self.told: list[tuple[Tensor, Tensor]] = []

    def teach(self, synthetic: Tensor, true: Tensor) -> None:
        self.told.append((synthetic, true))
        F.mse_loss(synthetic, true).backward()

    def loss(self, layer: SgmLayer | None) -> Tensor:
        activation = self.conv(self.x)
        behind = activation if layer is None else layer(activation, self.labels)
        return self.rest(behind).square().sum(dim=(1, 2, 3)).mean()


def gradients(module: nn.Module) -> list[Tensor | None]:
    return [None if p.grad is None else p.grad.clone() for p in module.parameters()]


def test_parameter_counts_are_the_papers() -> None:
    counts = [sum(p.numel() for p in Sgm(GRASPNET, layer).parameters()) for layer in SGM_LAYERS]
    assert counts == [1400, 1400, 5104, 624, 624]


@pytest.mark.parametrize("layer", SGM_LAYERS)
@pytest.mark.parametrize("hidden", [None, (5,), (64, 64)])
def test_a_gradient_has_its_activations_shape(layer: int, hidden: tuple[int, ...] | None) -> None:
    activation = torch.randn(2, GRASPNET.layer(layer).out, 7, 6)
    assert Sgm(GRASPNET, layer, hidden)(activation, torch.randn(2, 3)).shape == activation.shape


@pytest.mark.parametrize("teacher", [None, lambda *_: None])
def test_forward_changes_no_bit(teacher: Teacher | None) -> None:
    case = Case()
    activation = torch.randn(BATCH, CHANNELS, 3, 3)
    activation[0, 0, 0, :] = torch.tensor([-0.0, float("inf"), 1e-45])
    behind = SgmLayer(case.sgm, teacher)(activation, case.labels)
    assert torch.equal(behind.view(torch.int32), activation.view(torch.int32))


def test_what_lies_before_trains_on_the_synthetic_gradient_over_the_batch() -> None:
    case = Case()
    case.loss(SgmLayer(case.sgm)).backward()
    got, rest = gradients(case.conv), gradients(case.rest)

    activation = case.conv(case.x)
    injected = case.sgm(activation.detach(), case.labels).detach() / BATCH
    expected = torch.autograd.grad(activation, list(case.conv.parameters()), injected)
    for one, other in zip(got, expected, strict=True):
        assert one is not None
        torch.testing.assert_close(one, other, rtol=0, atol=0)
    # What lies behind never notices the SGM.
    case.rest.zero_grad()
    case.loss(None).backward()
    for one, other in zip(rest, gradients(case.rest), strict=True):
        torch.testing.assert_close(one, other)


def test_the_teacher_is_told_every_samples_own_true_gradient() -> None:
    case = Case()
    case.loss(SgmLayer(case.sgm, case.teach)).backward()
    ((synthetic, true),) = case.told
    activation = case.conv(case.x).detach()
    torch.testing.assert_close(synthetic, case.sgm(activation, case.labels))
    for i in range(BATCH):  # of one sample's loss alone
        one = activation[i : i + 1].clone().requires_grad_()
        (expected,) = torch.autograd.grad(case.rest(one).square().sum(), one)
        torch.testing.assert_close(true[i : i + 1], expected, rtol=1e-5, atol=1e-5)


def test_only_the_teacher_gives_the_sgm_gradients() -> None:
    alone, taught = Case(), Case()
    alone.loss(SgmLayer(alone.sgm)).backward()
    taught.loss(SgmLayer(taught.sgm, taught.teach)).backward()
    assert gradients(alone.sgm) == [None] * len(list(alone.sgm.parameters()))
    _, true = taught.told[0]
    objective = F.mse_loss(taught.sgm(taught.conv(taught.x).detach(), taught.labels), true)
    expected = torch.autograd.grad(objective, list(taught.sgm.parameters()))
    for one, other in zip(gradients(taught.sgm), expected, strict=True):
        assert one is not None
        torch.testing.assert_close(one, other)
    for one, other in zip(gradients(alone.conv), gradients(taught.conv), strict=True):
        assert one is not None
        torch.testing.assert_close(one, other)


def test_before_another_sgm_a_teacher_is_told_that_ones_gradient() -> None:
    case, behind = Case(), Sgm(GRASPNET, LAYER).eval()
    activation = torch.randn(BATCH, CHANNELS, 1, 1, requires_grad=True)
    told = SgmLayer(case.sgm, lambda _, incoming: case.told.append((incoming, incoming)))
    case.rest(SgmLayer(behind)(told(activation, case.labels), case.labels)).mean().backward()
    expected = behind(activation.detach(), case.labels)
    torch.testing.assert_close(case.told[0][0], expected.detach())


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
        updated = local_step(
            GRASPNET, states, seen, labels[None], rates, gradient_of, momentum=0.9
        )[0]
        weight, bias = (parameter - parameter.grad for parameter in conv.parameters())
    torch.testing.assert_close(updated.weight[0], weight.flatten(1).T, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(updated.bias[0], bias, rtol=1e-5, atol=1e-5)
