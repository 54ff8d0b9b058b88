"""Optimizer and rates by a run's length: what runs of these lengths say, with a margin."""

from dataclasses import replace

import pytest
import torch
from nets import toy_start, toy_tasks
from toy_task import ToyTask

from qsgm.train.model.curvature import FLAT
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.static_sgms import StaticSgms
from qsgm.train.paper.baselines.tuning import Recipe as OracleRecipe
from qsgm.train.paper.baselines.tuning import adam, tuned_states
from qsgm.train.pretraining import recipes as module
from qsgm.train.pretraining.evaluate import Score, UpdateRule, fine_tune, run_each, score
from qsgm.train.pretraining.map_sgms import behind
from qsgm.train.pretraining.rates import Start, Trials
from qsgm.train.pretraining.recipes import choose_recipes, late_runs
from qsgm.train.pretraining.tasks import TaskSet, start_states

TASK = ToyTask()
LEARNT = (0.01, 0.05)


@pytest.fixture(scope="module")
def start() -> Start:
    return toy_start()


@pytest.fixture(scope="module")
def tasks() -> TaskSet:
    return toy_tasks(3)


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LENGTHS", (1, 4))


def rule() -> UpdateRule:
    torch.manual_seed(1)
    return UpdateRule({3: Sgm(TASK.network, 3).eval()}, FLAT, LEARNT, TASK)


def test_runs_by_adam_are_those_of_torchs(start: Start, tasks: TaskSet) -> None:
    trial = replace(rule(), optimizer="adam")
    *_, states = fine_tune(trial, start, tasks, 3)
    oracle = OracleRecipe(adam, LEARNT, 3)
    wanted = tuned_states(tasks, start, StaticSgms(trial.sgms), oracle, TASK, 0)
    for state, other in zip(states, wanted, strict=True):
        torch.testing.assert_close(state.weight, other.weight)
        torch.testing.assert_close(state.bias, other.bias)
    assert not torch.equal(states[0].weight[0], states[0].weight[1])
    torch.testing.assert_close(start_states(start, 1)[0].weight[0], start[0][0])  # left alone


def test_every_number_of_layers_has_both_optimizers_and_a_gain_for_every_length(
    start: Start, tasks: TaskSet
) -> None:
    told: list[Score] = []
    found, _ = choose_recipes(Trials(rule(), start, tasks, told.append))
    assert len(told) == late_runs(LEARNT)
    assert [*found] == [1, 2]
    for tuned, recipes in found.items():
        assert {one.optimizer for one in recipes} == {"sgd", "adam"}
        for one in recipes:
            assert len(one.rates) == tuned
            assert [steps for steps, _ in one.gains] == [2, 8]  # 64 samples an epoch
            assert one.rates_over(8) == pytest.approx(one.rates)
    sgd = next(one for one in found[2] if one.optimizer == "sgd")
    assert sgd.rates[1] / sgd.rates[0] == pytest.approx(LEARNT[1] / LEARNT[0])


@pytest.mark.parametrize("factor", [1, 30])
def test_at_twice_the_rates_no_run_is_lost(start: Start, tasks: TaskSet, factor: int) -> None:
    louder = replace(tasks, features=factor * tasks.features)
    found, _ = choose_recipes(Trials(rule(), start, louder, lambda _: None))
    for tuned, recipes in found.items():
        seen = behind(TASK.network, start[: 2 - tuned], louder, 3)
        before = [one.objective for one in score(start_states(start[2 - tuned :], 3), seen, TASK)]
        bounds = [was + sum(before) / 3 for was in before]
        for one in recipes:
            for epochs, (steps, _) in zip((1, 4), one.gains, strict=True):
                double = tuple(2 * rate for rate in one.rates_over(steps))
                trial = replace(rule(), rates=double, optimizer=one.optimizer)
                after = run_each(trial, start[2 - tuned :], seen, epochs)
                assert all(a.objective <= bound for a, bound in zip(after, bounds, strict=True))


def test_the_louder_the_features_the_lower_the_rates(start: Start, tasks: TaskSet) -> None:
    rates = []
    for factor in (1, 300):
        louder = replace(tasks, features=factor * tasks.features)
        found, _ = choose_recipes(Trials(rule(), start, louder, lambda _: None))
        rates.append(next(one for one in found[2] if one.optimizer == "sgd").rates[0])
    assert rates[0] > rates[1]
