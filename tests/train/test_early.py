"""The early SGMs' stage, and the choice of rates for many layers."""

import pytest
import torch
from nets import random_net
from torch.nn import functional as F

from qsgm.grasp.network import GRASPNET
from qsgm.train.grasp.task import DrawnGrasping
from qsgm.train.model.curvature import FLAT
from qsgm.train.model.fold import folded_start
from qsgm.train.model.local import outputs
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining.evaluate import Score, UpdateRule
from qsgm.train.pretraining.map_sgms import MapConfig, MapMatching, behind
from qsgm.train.pretraining.rates import (
    EARLY_RATE_GRID,
    SHORT_GAINS,
    RatesConfig,
    Trials,
    choose_early,
    choose_late,
    choose_short_gain,
    late_candidates,
)
from qsgm.train.pretraining.tasks import TaskSet, draw_tasks, start_states

CONFIG = MapConfig(
    tasks=2, crops_per_task=20, epochs=2, looks=(1, 2), steps=40, tasks_per_step=2, crops_per_step=4
)
TASK = DrawnGrasping()


@pytest.fixture(scope="module")
def net() -> ConvNet:
    return random_net(1)


@pytest.fixture(scope="module")
def pixels(net: ConvNet) -> TaskSet:
    return draw_tasks(net, TASK, 2, 20, 5, lambda: None, last_frozen=0)


@pytest.fixture(scope="module")
def rule() -> UpdateRule:
    torch.manual_seed(0)
    sgms = {layer: Sgm(GRASPNET, layer).eval() for layer in range(1, 6)}
    return UpdateRule(sgms, FLAT, (1e-3, 1e-3, 1e-3), TASK)


def test_features_behind_layers_are_those_of_the_network(net: ConvNet, pixels: TaskSet) -> None:
    seen = behind(GRASPNET, folded_start(net, 6)[:3], pixels)
    whole = outputs(GRASPNET, start_states(folded_start(net, 6), 2), pixels.features.float())
    rest = outputs(GRASPNET, start_states(folded_start(net, 3), 2), seen.features)
    torch.testing.assert_close(rest, whole, atol=1e-4, rtol=1e-4)


def test_early_sgms_learn_what_true_gradients_have_in_common(
    net: ConvNet, pixels: TaskSet, rule: UpdateRule
) -> None:
    training = MapMatching(CONFIG, rule, folded_start(net, 6), pixels, seed=0)
    seen: list[float] = []
    sgms = training.run(lambda cosines: seen.append(cosines[3]))
    assert len(seen) == CONFIG.steps
    assert sum(seen[-10:]) > sum(seen[:10]) + 1.0
    # In the gradients' own size, not in the unit that they were learnt in.
    activations, labels, true = training._batch()
    maps = activations[3].flatten(0, 1).transpose(1, 2).unflatten(2, (13, 13))
    given = sgms[3](maps, labels.flatten(0, 1)).detach()
    assert 0.02 < float(given.norm() / true[3].norm()) < 50
    assert all(not sgm.training for sgm in sgms.values())


def test_layers_are_looked_at_before_during_and_after_runs(
    net: ConvNet, pixels: TaskSet, rule: UpdateRule
) -> None:
    training = MapMatching(CONFIG, rule, folded_start(net, 6), pixels, seed=0)
    (moments,) = training.behind
    weights = [states[0].weight for states in moments]
    assert len(weights) == 3
    torch.testing.assert_close(weights[0][0], folded_start(net, 3)[0][0])
    moved = [F.mse_loss(weight, weights[0]).item() for weight in weights]
    assert 0 == moved[0] < moved[1] < moved[2]


def test_rates_are_chosen_for_every_number_of_layers_and_those_behind_keep_theirs(
    net: ConvNet, pixels: TaskSet, rule: UpdateRule
) -> None:
    scores: list[Score] = []
    config = RatesConfig(epochs=1, early_epochs=1)
    start = folded_start(net, 6)
    seen = behind(GRASPNET, start[:3], pixels)
    late, best = choose_late(Trials(rule, start[3:], seen, scores.append), config)
    assert [len(late[tuned]) for tuned in (1, 2, 3)] == [1, 2, 3]
    assert len(scores) == len([*late_candidates(rule.rates)])
    lowest = min(score.objective for score in scores[-4:])
    assert lowest <= best.objective <= 1.01 * lowest
    short = RatesConfig(short_epochs=1)
    trial = UpdateRule(rule.sgms, FLAT, late[3], TASK)
    assert choose_short_gain(Trials(trial, start[3:], seen, scores.append), short) in SHORT_GAINS
    rule = UpdateRule(rule.sgms, FLAT, late[3], TASK)
    early = choose_early(Trials(rule, start, pixels, scores.append), config)
    assert sorted(early) == [4, 5, 6]
    assert early[6][1:] == early[5]
    assert early[5][1:] == early[4]
    assert early[4][1:] == late[3]
    assert {early[6][0], early[5][0], early[4][0]} <= set(EARLY_RATE_GRID)
