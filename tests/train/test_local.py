"""The differentiable training steps against autograd through plain torch convolutions.

Both in float64: in float32 two right ways to add up thousands of positions differ by more than
some wrong ways do, and by how much is up to the CPU.
"""

import pytest
import torch
from losses import GraspLoss
from torch import Tensor
from torch.nn import functional as F

from qsgm.grasp.network import GRASPNET
from qsgm.train.heads import error
from qsgm.train.model.local import LayerState, local_step, outputs, true_gradients

TASKS, BATCH = 3, 5
SHAPES = {
    1: (8, 3, 5, 5),
    2: (8, 8, 5, 5),
    3: (16, 8, 5, 5),
    4: (16, 16, 5, 5),
    5: (16, 16, 1, 1),
    6: (3, 16, 1, 1),
}
SIDE = {1: 128, 2: 62, 3: 29, 4: 13, 5: 1, 6: 1}  # of the map that a layer sees of a crop
RATES = {1: 0.01, 2: 0.02, 3: 0.03, 4: 0.1, 5: 0.2, 6: 0.3}
LOSSES = [GraspLoss(), GraspLoss("paper", label_smoothing=0.0, angle_weight=2.0)]

DTYPE = torch.float64
ROUNDING = 1e-12  # of the largest entry

Weights = dict[int, tuple[Tensor, Tensor]]  # per layer: (Co, Ci, kh, kw) and (Co,)


def normal(*shape: int) -> Tensor:
    return torch.randn(shape, dtype=DTYPE)


def assert_equal(got: Tensor, expected: Tensor) -> None:
    """But for float64's rounding; sums cancel, so it counts against the largest entry."""
    assert got.dtype == expected.dtype == DTYPE  # float32 somewhere inside shows in the numbers
    assert got.shape == expected.shape
    largest = float(expected.abs().max())
    assert largest > 0
    assert float((got - expected).abs().max()) <= ROUNDING * largest


def random_weights(tuned: int) -> list[Weights]:
    """One set per task."""
    torch.manual_seed(tuned)
    return [
        {
            number: (normal(*shape) / 5, normal(shape[0]) / 5)
            for number, shape in SHAPES.items()
            if number > 6 - tuned
        }
        for _ in range(TASKS)
    ]


def random_data(tuned: int) -> tuple[Tensor, Tensor]:
    first = 7 - tuned
    features = normal(TASKS, BATCH, SIDE[first] ** 2, SHAPES[first][1]).relu()
    angle = normal(TASKS, BATCH)
    quality = (angle > -0.5).to(DTYPE)
    return features, torch.stack([quality, angle.sin(), angle.cos()], dim=-1)


def as_states(tasks: list[Weights]) -> list[LayerState]:
    return [
        LayerState.start(
            torch.stack([task[number][0].permute(2, 3, 1, 0).flatten(0, 2) for task in tasks]),
            torch.stack([task[number][1] for task in tasks]),
        )
        for number in tasks[0]
    ]


def plain_layer(number: int, weights: Weights, x: Tensor) -> Tensor:
    x = F.conv2d(x, *weights[number], stride=2 if number <= 4 else 1)
    x = F.relu(x) if number < 6 else x
    return F.avg_pool2d(x, 5) if number == 4 else x


def as_map(features: Tensor) -> Tensor:
    side = round(features.shape[1] ** 0.5)
    return features.transpose(1, 2).unflatten(2, (side, side))


def made_up_gradient(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
    """Stands in for an SGM: anything that depends on layer, activation and label."""
    return torch.sin(layer * activation) + labels[..., None, :1] - labels[..., None, 1:2]


def flat_gradients(number: int, weights: Weights, objective: Tensor) -> tuple[Tensor, Tensor]:
    weight, bias = torch.autograd.grad(objective, list(weights[number]))
    return weight.permute(2, 3, 1, 0).flatten(0, 2), bias


@pytest.mark.parametrize("tuned", range(1, 7))
def test_a_local_step_equals_autograd_with_the_gradient_injected(tuned: int) -> None:
    tasks, (features, labels) = random_weights(tuned), random_data(tuned)
    states = as_states(tasks)
    loss = GraspLoss()

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == 6:
            return error(loss.heads, activation, labels[:, :, None])
        return made_up_gradient(layer, activation, labels)

    rates = [torch.tensor(RATES[number], dtype=DTYPE) for number in tasks[0]]
    updated = local_step(GRASPNET, states, features, labels, rates, gradient_of)
    twice = local_step(GRASPNET, updated, features, labels, rates, gradient_of)
    for task, weights in enumerate(tasks):
        x = as_map(features[task])
        for index, number in enumerate(weights):
            for tensor in weights[number]:
                tensor.requires_grad_()
            x = plain_layer(number, weights, x.detach())
            if number == 6:
                objective = loss(x.flatten(1), labels[task])
            else:
                after = x.flatten(2).transpose(1, 2)
                injected = made_up_gradient(number, after.detach(), labels[task])
                objective = (after * injected).sum() / BATCH
            weight, bias = flat_gradients(number, weights, objective)
            before, once = states[index], updated[index]
            assert_equal(once.weight_momentum[task], weight)
            assert_equal(once.bias_momentum[task], bias)
            assert_equal(once.weight[task], before.weight[task] - RATES[number] * weight)
            assert_equal(once.bias[task], before.bias[task] - RATES[number] * bias)
    # The second step is a first one from there, but for the momentum, which remembers.
    forgetful = [LayerState.start(once.weight, once.bias) for once in updated]
    fresh = local_step(GRASPNET, forgetful, features, labels, rates, gradient_of)
    for rate, once, anew, second in zip(rates, updated, fresh, twice, strict=True):
        momentum = 0.9 * once.weight_momentum + anew.weight_momentum
        assert_equal(second.weight_momentum, momentum)
        assert_equal(second.weight, once.weight - rate * momentum)
        momentum = 0.9 * once.bias_momentum + anew.bias_momentum
        assert_equal(second.bias_momentum, momentum)
        assert_equal(second.bias, once.bias - rate * momentum)


@pytest.mark.parametrize("tuned", range(1, 7))
def test_outputs_equal_plain_convolutions(tuned: int) -> None:
    tasks, (features, _) = random_weights(tuned), random_data(tuned)
    got = outputs(GRASPNET, as_states(tasks), features)
    for task, weights in enumerate(tasks):
        x = as_map(features[task])
        for number in weights:
            x = plain_layer(number, weights, x)
        assert_equal(got[task], x.flatten(1))


@pytest.mark.parametrize("loss", LOSSES, ids=["double", "paper"])
def test_loss_gradient_equals_autograd(loss: GraspLoss) -> None:
    torch.manual_seed(0)
    raw = (3 * normal(50, 3)).requires_grad_()
    labels = torch.rand(50, 3, dtype=DTYPE).round()
    (expected,) = torch.autograd.grad(loss.per_sample(raw, labels).sum(), raw)
    assert_equal(error(loss.heads, raw.detach(), labels), expected)


@pytest.mark.parametrize("tuned", range(1, 7))
@pytest.mark.parametrize("loss", LOSSES, ids=["double", "paper"])
def test_true_gradients_equal_autograd(tuned: int, loss: GraspLoss) -> None:
    tasks, (features, labels) = random_weights(tuned), random_data(tuned)
    got = true_gradients(GRASPNET, as_states(tasks), features, labels, loss.heads)
    assert set(got) == set(tasks[0])
    for task, weights in enumerate(tasks):
        x, activations = as_map(features[task]).requires_grad_(), {}
        for number in weights:
            x = activations[number] = plain_layer(number, weights, x)
        total = loss.per_sample(x.flatten(1), labels[task]).sum()
        expected = torch.autograd.grad(total, list(activations.values()))
        for number, gradient in zip(activations, expected, strict=True):
            rows = gradient.flatten(2).transpose(1, 2)
            assert_equal(got[number][task], rows)


def test_meta_gradients_flow_through_a_step() -> None:
    features, labels = random_data(2)
    states = as_states(random_weights(2))
    scale = torch.ones(2, dtype=DTYPE, requires_grad=True)

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == 6:
            return error(GraspLoss().heads, activation, labels[:, :, None])
        return scale[0] * made_up_gradient(layer, activation, labels)

    rates = [scale[1] * 0.1, torch.tensor(0.1, dtype=DTYPE)]
    updated = local_step(GRASPNET, states, features, labels, rates, gradient_of)
    raw = outputs(GRASPNET, updated, features)
    GraspLoss()(raw.flatten(0, 1), labels.flatten(0, 1)).backward()
    assert scale.grad is not None
    assert (scale.grad != 0).all()
