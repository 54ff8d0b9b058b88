"""SGMs learn along the runs that they drive themselves."""

from copy import deepcopy
from dataclasses import replace
from functools import partial

import pytest
import torch
from nets import toy_start, toy_tasks
from torch import Tensor
from torch.nn import functional as F
from toy_task import ToyTask

from qsgm.schedule import MOMENTUM, rate_factor
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.maml import apply_sgm
from qsgm.train.pretraining.matching import Examples, MatchingConfig
from qsgm.train.pretraining.own_runs import (
    OwnRunsConfig,
    learn_along_own_runs,
    looks_along,
)
from qsgm.train.pretraining.rates import Start
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches

TASK = ToyTask()
FIT = MatchingConfig(fit_steps=80, fit_batch=128)
CONFIG = OwnRunsConfig(rounds=3, epochs=4, look_every=2, fit=FIT)
RATES = (0.1, 0.1)


@pytest.fixture(scope="module")
def start() -> Start:
    return toy_start()


@pytest.fixture(scope="module")
def tasks() -> TaskSet:
    return toy_tasks(4)


def sgm() -> Sgm:
    torch.manual_seed(1)
    return Sgm(TASK.network, 3, (16,)).eval()


def gradient_by_autograd(weights: list[Tensor], x: Tensor, labels: Tensor) -> tuple[Tensor, Tensor]:
    """Activation of layer 3, and each sample's gradient there; weights get theirs of the mean."""
    hidden = torch.relu(x.flatten(1) @ weights[0] + weights[1])
    hidden.retain_grad()
    raw = hidden @ weights[2] + weights[3]
    F.cross_entropy(raw, labels, label_smoothing=0.05).backward()
    assert hidden.grad is not None
    return hidden.detach(), len(x) * hidden.grad


def test_without_sgms_looks_are_those_of_backpropagation(start: Start, tasks: TaskSet) -> None:
    """One task, by autograd and torch's SGD."""
    one = next(tasks.chunks(1))
    looks = [found for _, found in looks_along({}, start, one, RATES, TASK, CONFIG, 5)]
    weights = [tensor.clone().requires_grad_() for layer in start for tensor in layer]
    groups = [{"params": weights[:2], "lr": 0.0}, {"params": weights[2:], "lr": 0.0}]
    optimizer = torch.optim.SGD(groups, momentum=MOMENTUM)
    batches, wanted = [*shuffled_batches(64, CONFIG.epochs, 5)], []
    for step, rows in enumerate(batches):
        optimizer.zero_grad()
        seen = gradient_by_autograd(weights, one.features[0, rows].float(), one.labels[0, rows])
        wanted += [seen] if step % 2 == 0 else []
        for group, rate in zip(optimizer.param_groups, RATES, strict=True):
            group["lr"] = rate * rate_factor(step, len(batches))
        optimizer.step()
    assert len(looks) == len(wanted) == 4
    for look, (activation, gradient) in zip(looks, wanted, strict=True):
        torch.testing.assert_close(look.activations[:, 0], activation, atol=1e-5, rtol=1e-3)
        torch.testing.assert_close(look.gradients[:, 0], gradient, atol=1e-5, rtol=1e-3)


def mismatch(one: Sgm, looks: list[Examples]) -> float:
    """Mean over looks of the squared error, beside the true gradients' own square."""
    parts = []
    for look in looks:
        guess = apply_sgm(one, look.activations[None], look.labels[None])[0].detach()
        parts.append(
            float((guess - look.gradients).square().mean() / look.gradients.square().mean())
        )
    return sum(parts) / len(parts)


def test_sgms_come_to_answer_along_their_own_runs(start: Start, tasks: TaskSet) -> None:
    by_backpropagation, by_themselves = {3: sgm()}, {3: sgm()}
    for sgms, rounds in ((by_backpropagation, 1), (by_themselves, 3)):
        fit = replace(FIT, fit_steps=240 // rounds)
        sizes = replace(CONFIG, rounds=rounds, fit=fit)
        steps: list[None] = []
        learn_along_own_runs(sgms, start, tasks, RATES, TASK, sizes, 0, partial(steps.append, None))
        assert len(steps) == 240
        assert not sgms[3].training
    errors = []
    for sgms in ({3: sgm()}, by_backpropagation, by_themselves):
        along = looks_along(sgms, start, tasks, RATES, TASK, CONFIG, 9)
        errors.append(mismatch(sgms[3], [look for _, look in along]))
    assert errors[2] < errors[1] < errors[0]


def test_what_is_lost_teaches_nothing(start: Start, tasks: TaskSet) -> None:
    looks = looks_along({3: sgm()}, start, tasks, (1e6, 1e6), TASK, CONFIG, 0)
    first, *later = (look for _, look in looks)
    assert len(first.labels) == 4 * 32
    assert all(len(look.labels) == 0 for look in later)
    sgms = {3: sgm()}
    learn_along_own_runs(sgms, start, tasks, (1e6, 1e6), TASK, CONFIG, 0, lambda: None)
    assert all(torch.isfinite(value).all() for value in sgms[3].state_dict().values())


def test_without_rounds_nothing_changes(start: Start, tasks: TaskSet) -> None:
    sgms, before = {3: sgm()}, deepcopy(sgm().state_dict())
    none = replace(CONFIG, rounds=0)
    learn_along_own_runs(sgms, start, tasks, RATES, TASK, none, 0, lambda: None)
    assert all(torch.equal(value, before[k]) for k, value in sgms[3].state_dict().items())
