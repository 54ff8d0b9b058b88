"""The baselines against torch autograd, torch.optim, and the formulas of their papers."""

from collections.abc import Callable, Iterator
from copy import deepcopy

import pytest
import torch
from nets import random_net
from torch import Tensor
from torch.nn import functional as F

from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask
from qsgm.schedule import rate_factor
from qsgm.train.heads import error, mean_loss
from qsgm.train.model.fold import folded_start
from qsgm.train.model.local import LayerState, local_step, true_gradients
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.backpropagation import Backpropagation
from qsgm.train.paper.baselines.direct_feedback import DirectFeedbackAlignment
from qsgm.train.paper.baselines.feedback_alignment import FeedbackAlignment, random_feedback
from qsgm.train.paper.baselines.interface import Baseline, ForwardPass, forward_pass
from qsgm.train.paper.baselines.online_sgms import OnlineSgms, bootstrapped_target, true_target
from qsgm.train.paper.baselines.projections import random_projections
from qsgm.train.paper.baselines.static_sgms import LabelFreeSgm, StaticSgms
from qsgm.train.paper.baselines.target_projection import TargetProjection
from qsgm.train.paper.baselines.tuning import (
    MakeOptimizer,
    Recipe,
    adam,
    constant_rate,
    run_baseline,
    sgd,
    tuned_states,
)
from qsgm.train.pretraining.evaluate import Score, score
from qsgm.train.pretraining.maml import apply_sgm
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states

TASKS, CROPS, SUPPORT = 2, 50, 40
SIDE = {1: 128, 2: 62, 3: 29, 4: 13, 5: 1, 6: 1}  # of the map that a layer sees of a crop
CHANNELS = {1: 3, 2: 8, 3: 8, 4: 16, 5: 16, 6: 16}
TASK = GraspTask("paper", label_smoothing=0.0)
Start = list[tuple[Tensor, Tensor]]


def random_tasks(tuned: int, tasks: int = TASKS) -> TaskSet:
    generator = torch.Generator().manual_seed(tuned)
    first = 7 - tuned
    shape = tasks, CROPS, SIDE[first] ** 2, CHANNELS[first]
    features = torch.randn(shape, generator=generator).relu().half()
    angle = 3 * torch.rand(tasks, CROPS, generator=generator) - 1.5
    quality = (torch.rand(tasks, CROPS, generator=generator) > 0.5).float()
    labels = torch.stack([quality, quality * angle.sin(), quality * angle.cos()], dim=-1)
    return TaskSet(features, labels, SUPPORT)


def figures(scores: list[Score]) -> Tensor:
    """Objective, detection accuracy and angle error [deg] of every task, (T, 3)."""
    names = ("detection_accuracy", "angle_mae_deg")
    return torch.tensor([[one.objective, *(one.scores[n] for n in names)] for one in scores])


def random_start(tuned: int) -> Start:
    return folded_start(random_net(tuned), tuned)


def random_sgms() -> dict[int, Sgm]:
    """Outputs of about the size of true gradients."""
    torch.manual_seed(1)
    sgms = {layer: Sgm(GRASPNET, layer) for layer in (3, 4, 5)}
    for sgm in sgms.values():
        torch.nn.init.normal_(sgm.convs[-1].weight, std=0.01)
        torch.nn.init.normal_(sgm.norms[0].running_mean)
    return sgms


def one_batch(tuned: int, start: Start | None = None) -> tuple[dict[int, Tensor], ForwardPass]:
    """Weights by layer, and a forward pass with them."""
    tasks = random_tasks(tuned)
    states = dict(enumerate(start_states(start or random_start(tuned), TASKS), 7 - tuned))
    weights = {layer: state.weight for layer, state in states.items()}
    return weights, forward_pass(GRASPNET, states, tasks.features.float(), tasks.labels, TASK.heads)


# Made anew for a number of tasks and a start.
BASELINES: dict[str, Callable[[int, Start], Baseline]] = {
    "backpropagation": lambda _tasks, _start: Backpropagation(),
    "feedback alignment": lambda _tasks, start: FeedbackAlignment(
        random_feedback(GRASPNET, start, 1)
    ),
    "direct feedback": lambda _tasks, _start: DirectFeedbackAlignment(
        random_projections(GRASPNET, 1)
    ),
    "target projection": lambda _tasks, _start: TargetProjection(random_projections(GRASPNET, 1)),
    "static SGMs": lambda _tasks, _start: StaticSgms(random_sgms()),
    "online SGMs": lambda tasks, _start: OnlineSgms(random_sgms(), tasks),
    "bootstrapped SGMs": lambda tasks, _start: OnlineSgms(
        random_sgms(), tasks, bootstrapped_target
    ),
}


def plain_layers(start: Start) -> list[torch.nn.Conv2d]:
    """The tuned layers as torch's convolutions."""
    layers = []
    for number, (weight, bias) in enumerate(start, 7 - len(start)):
        side = 5 if number <= 4 else 1
        conv = torch.nn.Conv2d(len(weight) // side**2, len(bias), side, 2 if side == 5 else 1)
        maps = weight.unflatten(0, (side, side, -1)).permute(3, 2, 0, 1)
        conv.load_state_dict({"weight": maps, "bias": bias})
        layers.append(conv)
    return layers


def run_plain(layers: list[torch.nn.Conv2d], features: Tensor) -> Iterator[Tensor]:
    """Every tuned layer's activation (N, C, H, W) of features (N, P, C)."""
    side = round(features.shape[1] ** 0.5)
    x = features.transpose(1, 2).unflatten(2, (side, side))
    for number, conv in enumerate(layers, 7 - len(layers)):
        x = conv(x)
        x = F.relu(x) if number < 6 else x
        x = F.avg_pool2d(x, 5) if number == 4 else x
        yield x


@pytest.mark.parametrize("factor", [constant_rate, rate_factor])
@pytest.mark.parametrize(
    ("make", "torchs", "rate"),
    [
        (sgd, lambda groups: torch.optim.SGD(groups, momentum=0.9), 2e-2),
        (adam, torch.optim.Adam, 1e-3),
    ],
    ids=["sgd", "adam"],
)
@pytest.mark.parametrize("tuned", [1, 2, 3, 4])
def test_backpropagation_equals_autograd_and_torch_optim(
    tuned: int,
    make: MakeOptimizer,
    torchs: MakeOptimizer,
    rate: float,
    factor: Callable[[int, int], float],
) -> None:
    tasks, start = random_tasks(tuned), random_start(tuned)
    rates = tuple(rate * (1 + i) for i in range(tuned))
    recipe = Recipe(make, rates, 3, factor)
    states = tuned_states(tasks, start, Backpropagation(), recipe, TASK, 5)
    for task in range(TASKS):
        layers = plain_layers(start)
        optimizer = torchs([{"params": conv.parameters(), "lr": 0.0} for conv in layers])
        batches = list(shuffled_batches(SUPPORT, 3, 5))
        for step, rows in enumerate(batches):
            for group, own in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = own * (1 - step / len(batches) if factor is rate_factor else 1)
            *_, raw = run_plain(layers, tasks.features[task, rows].float())
            optimizer.zero_grad()
            mean_loss(TASK.heads, raw.flatten(1), tasks.labels[task, rows]).backward()
            optimizer.step()
        for conv, state, (weight, _) in zip(layers, states, start, strict=True):
            learnt = conv.weight.detach().permute(2, 3, 1, 0).flatten(0, 2)
            assert (learnt - weight).abs().max() > 4e-4  # else agreeing would be easy
            torch.testing.assert_close(state.weight[task], learnt, atol=2e-5, rtol=1e-4)
            torch.testing.assert_close(state.bias[task], conv.bias.detach(), atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("tuned", [2, 4, 6])
def test_feedback_through_the_weights_themselves_is_backpropagation(tuned: int) -> None:
    start = random_start(tuned)
    weights, batch = one_batch(tuned, start)
    own = {layer: weight[0] for layer, weight in weights.items()}
    tasks = random_tasks(tuned)
    true = true_gradients(
        GRASPNET,
        start_states(start, TASKS),
        tasks.features.float(),
        tasks.labels,
        TASK.heads,
    )
    got = FeedbackAlignment(own).gradients({}, batch)
    assert set(got) == set(range(7 - tuned, 6))
    for layer, gradient in got.items():
        torch.testing.assert_close(gradient, true[layer], atol=1e-6, rtol=1e-4)


def test_random_feedback_has_the_spread_of_the_weights() -> None:
    start = random_start(3)
    feedback = random_feedback(GRASPNET, start, 2)
    assert list(feedback) == [4, 5, 6]
    for (weight, _), matrix in zip(start, feedback.values(), strict=True):
        assert matrix.shape == weight.shape
        assert float(matrix.std() / weight.std()) == pytest.approx(1, abs=0.25)
    assert torch.equal(feedback[4], random_feedback(GRASPNET, start, 2)[4])
    assert not torch.equal(feedback[4], random_feedback(GRASPNET, start, 3)[4])


def test_direct_feedback_through_the_last_layers_weight_is_backpropagation() -> None:
    """Layer 6 is a 1x1 convolution without a nonlinearity: its transpose is the true feedback."""
    start = random_start(2)
    weights, batch = one_batch(2, start)
    projection = start[1][0].T[:, None]  # (3, 1, 16)
    got = DirectFeedbackAlignment({5: projection}).gradients(weights, batch)
    expected = Backpropagation().gradients(weights, batch)
    torch.testing.assert_close(got[5], expected[5], atol=1e-7, rtol=1e-4)


def test_direct_feedback_projects_every_crops_error() -> None:
    weights, batch = one_batch(4)
    projections = random_projections(GRASPNET, 0)
    got = DirectFeedbackAlignment(projections).gradients(weights, batch)
    assert set(got) == {3, 4, 5}
    error = batch.output_error[1, 7, 0]
    expected = sum(error[i] * projections[3][i] for i in range(3))
    torch.testing.assert_close(got[3][1, 7], expected)


def test_target_projection_looks_at_nothing_but_the_label() -> None:
    start = random_start(3)
    other = [start[0], *[(weight + 1, bias - 1) for weight, bias in start[1:]]]
    system = TargetProjection(random_projections(GRASPNET, 0))
    got = system.gradients(*one_batch(3, start))
    weights, batch = one_batch(3, other)
    assert not torch.equal(batch.output_error, one_batch(3, start)[1].output_error)
    for layer, gradient in system.gradients(weights, batch).items():
        assert torch.equal(gradient, got[layer])
        negative = batch.labels[..., 0] == 0
        assert (gradient[negative] == 0).all()
        assert (gradient[~negative] != 0).all()
    label, projection = batch.labels[0, 3], random_projections(GRASPNET, 0)[4]
    torch.testing.assert_close(got[4][0, 3], torch.tensordot(label, projection, dims=1))


def test_projections_fit_the_activations_of_a_crop() -> None:
    projections = random_projections(GRASPNET, 0)
    x = torch.zeros(1, 3, 128, 128)
    for layer, module in enumerate(ConvNet(GRASPNET).eval().layers[:5], 1):
        x = module(x)
        matrix = projections[layer]
        assert matrix.shape == (3, x[0, 0].numel(), x.shape[1])
        bound = (6 / x.numel()) ** 0.5  # torch's kaiming_uniform_: fan-in of a (3, C, H, W)
        assert float(matrix.abs().max()) == pytest.approx(bound, rel=0.1)
        assert abs(float(matrix.mean())) < bound / 5


@pytest.mark.parametrize("tuned", [2, 3, 4])
def test_static_sgms_tune_as_the_local_steps_do(tuned: int) -> None:
    tasks, start, sgms = random_tasks(tuned), random_start(tuned), random_sgms()
    rates = (3e-3, 1e-3, 2e-3, 1e-3)[:tuned]
    before = {layer: deepcopy(sgm.state_dict()) for layer, sgm in sgms.items()}
    scores = figures(run_baseline(tasks, start, StaticSgms(sgms), Recipe(sgd, rates, 4), TASK, 3))

    @torch.no_grad()
    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == 6:
            return error(TASK.heads, activation, labels[:, :, None])
        return apply_sgm(sgms[layer], activation, labels)

    states, batches = start_states(start, TASKS), list(shuffled_batches(SUPPORT, 4, 3))
    for step, rows in enumerate(batches):
        features, labels = tasks.features[:, rows].float(), tasks.labels[:, rows]
        now = [torch.tensor(rate * (1 - step / len(batches))) for rate in rates]
        states = local_step(GRASPNET, states, features, labels, now, gradient_of)
    assert scores.shape == (TASKS, 3)
    torch.testing.assert_close(scores, figures(score(states, tasks, TASK)), atol=1e-4, rtol=1e-4)
    for layer, sgm in sgms.items():
        for name, value in sgm.state_dict().items():
            assert torch.equal(value, before[layer][name])


def test_a_label_free_sgm_answers_every_label_alike() -> None:
    torch.manual_seed(0)
    sgm, plain = LabelFreeSgm(GRASPNET, 4), Sgm(GRASPNET, 4)
    plain.load_state_dict(sgm.state_dict())
    activation, labels = torch.rand(9, 16, 1, 1), torch.rand(9, 3)
    with torch.no_grad():
        got = sgm(activation, labels)
        torch.testing.assert_close(got, sgm(activation, 1 - labels))
        torch.testing.assert_close(got, plain(activation, torch.zeros(9, 3)))
        assert not torch.allclose(got, plain(activation, labels))


def test_an_online_sgm_takes_torchs_step_on_the_mean_squared_error() -> None:
    weights, batch = one_batch(3)
    sgms = random_sgms()
    online = OnlineSgms(sgms, TASKS, true_target, rate=0.2)
    given = [online.gradients(weights, batch) for _ in range(3)]
    true = Backpropagation().gradients(weights, batch)
    for layer in (4, 5):
        for task in range(TASKS):
            sgm = deepcopy(sgms[layer]).train()
            optimizer = torch.optim.SGD(sgm.parameters(), 0.2, momentum=0.9)
            for step in range(3):
                x = batch.activations[layer][task, :, 0, :, None, None]
                guess = sgm(x, batch.labels[task])[:, :, 0, 0]
                torch.testing.assert_close(given[step][layer][task, :, 0], guess.detach())
                optimizer.zero_grad()
                ((guess - true[layer][task, :, 0]) ** 2).mean().backward()
                optimizer.step()
            for learnt, expected in zip(
                online.sgms[layer][task].parameters(), sgm.parameters(), strict=True
            ):
                torch.testing.assert_close(learnt, expected, atol=1e-6, rtol=1e-4)
        for name, value in random_sgms()[layer].state_dict().items():
            assert torch.equal(value, sgms[layer].state_dict()[name])  # theirs were copies


def test_bootstrapped_targets_are_the_next_layers_synthetic_gradient_carried_back() -> None:
    start = random_start(4)
    weights, batch = one_batch(4, start)
    synthetic = {k: torch.randn(x.shape) for k, x in batch.hidden().items()}
    got = bootstrapped_target(weights, batch, synthetic)
    layers, tasks = plain_layers(start), random_tasks(4)
    for task in range(TASKS):
        inputs = [x.detach() for x in run_plain(layers, tasks.features[task].float())]
        for layer in (3, 4):
            x = inputs[layer - 3].requires_grad_()
            after = F.relu(layers[layer - 2](x))
            after = F.avg_pool2d(after, 5) if layer + 1 == 4 else after
            given = synthetic[layer + 1][task].transpose(1, 2).unflatten(2, after.shape[2:])
            (expected,) = torch.autograd.grad(after, x, given)
            rows = expected.flatten(2).transpose(1, 2)
            torch.testing.assert_close(got[layer][task], rows, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(got[5], true_target(weights, batch, synthetic)[5])


@pytest.mark.parametrize("name", BASELINES)
def test_tasks_tuned_side_by_side_do_not_see_each_other(name: str) -> None:
    tasks, start = random_tasks(3), random_start(3)
    recipe = Recipe(sgd, (1e-3, 1e-3, 1e-3), 2)
    together = figures(run_baseline(tasks, start, BASELINES[name](TASKS, start), recipe, TASK, 0))
    untouched = figures(
        run_baseline(tasks, start, Backpropagation(), Recipe(sgd, (0.0,) * 3, 1), TASK, 0)
    )
    assert (together[:, 0] != untouched[:, 0]).all()
    for task, alone in enumerate(tasks.chunks(1)):
        scores = figures(run_baseline(alone, start, BASELINES[name](1, start), recipe, TASK, 0))
        torch.testing.assert_close(together[task], scores[0], atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("name", BASELINES)
def test_the_last_layer_alone_learns_from_the_loss_in_every_system(name: str) -> None:
    tasks, start, recipe = random_tasks(1), random_start(1), Recipe(adam, (1e-2,), 2)
    got = figures(run_baseline(tasks, start, BASELINES[name](TASKS, start), recipe, TASK, 0))
    expected = figures(run_baseline(tasks, start, Backpropagation(), recipe, TASK, 0))
    torch.testing.assert_close(got, expected)


def test_a_run_that_diverges_says_so_in_its_loss() -> None:
    tasks, start = random_tasks(3), random_start(3)
    scores = figures(
        run_baseline(tasks, start, Backpropagation(), Recipe(sgd, (1e6,) * 3, 3), TASK, 0)
    )
    assert not (scores[:, 0] < 1e3).any()


def test_the_callers_start_is_not_changed() -> None:
    start = random_start(2)
    before = [weight.clone() for weight, _ in start]
    recipe = Recipe(sgd, (0.1, 0.1), 1)
    states = tuned_states(random_tasks(2), start, Backpropagation(), recipe, TASK, 0)
    assert isinstance(states[0], LayerState)
    for (weight, _), old in zip(start, before, strict=True):
        assert torch.equal(weight, old)
