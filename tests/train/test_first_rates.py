"""Where meta-training starts is chosen by runs on tasks, the same way every time."""

from dataclasses import replace
from math import inf, log

import pytest
import torch
from nets import toy_start, toy_tasks
from toy_task import ToyTask

from qsgm import QsgmError
from qsgm.train.model.curvature import FLAT
from qsgm.train.model.sgm import Sgm
from qsgm.train.pretraining import first_rates
from qsgm.train.pretraining.evaluate import Score, UpdateRule, run_sgms
from qsgm.train.pretraining.first_rates import ALONE_GRID, candidates, choose_first, rate_alone
from qsgm.train.pretraining.matching import MatchingConfig
from qsgm.train.pretraining.rates import Rates, RatesConfig, Start, Trials
from qsgm.train.pretraining.tasks import TaskSet

TASK = ToyTask()
MATCHING = MatchingConfig(epochs=4)
LENGTHS = RatesConfig(epochs=6, short_epochs=2)


@pytest.fixture(scope="module")
def start() -> Start:
    return toy_start()


@pytest.fixture(scope="module")
def tasks() -> TaskSet:
    return toy_tasks(3)


def rule() -> UpdateRule:
    torch.manual_seed(1)
    return UpdateRule({3: Sgm(TASK.network, 3).eval()}, FLAT, (), TASK)


def test_layers_in_front_learn_slower_and_lower_rates_come_first() -> None:
    for late in (1, 2, 3):
        found = [*candidates(late)]
        assert all(len(rates) == late for rates in found)
        assert all([*rates] == sorted(rates) for rates in found)
        assert [rates[-1] for rates in found] == sorted(rates[-1] for rates in found)


def test_the_larger_the_features_the_lower_the_rate_of_a_layer_alone(
    start: Start, tasks: TaskSet
) -> None:
    rates = [
        rate_alone(replace(tasks, features=factor * tasks.features), start, TASK, MATCHING, 0)
        for factor in (30, 1000)
    ]
    assert rates[0] > rates[1]
    assert {*rates} <= {*ALONE_GRID}
    with pytest.raises(QsgmError, match="trial runs"):
        rate_alone(replace(tasks, features=inf * tasks.features), start, TASK, MATCHING, 0)


def test_whole_runs_and_short_ones_count_alike(
    start: Start, tasks: TaskSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    best = {LENGTHS.epochs: 1e-2, LENGTHS.short_epochs: 0.09}  # of the last layer

    def run(trial: UpdateRule, _start: Start, _tasks: TaskSet, epochs: int) -> Score:
        off = (log(trial.rates[1] / best[epochs])) ** 2 + (log(trial.rates[0] / 1.5e-3)) ** 2
        return Score(off, {})

    told: list[Score] = []
    monkeypatch.setattr(first_rates, "run_sgms", run)
    found = choose_first(Trials(rule(), start, tasks, told.append), LENGTHS)
    assert found == pytest.approx((1.5e-3, 3e-2))
    assert len(told) == len([*candidates(2)])


def test_the_rates_chosen_are_those_that_do_best(start: Start, tasks: TaskSet) -> None:
    trials = Trials(rule(), start, tasks, lambda _: None)
    found = choose_first(trials, LENGTHS)
    assert found == choose_first(trials, LENGTHS)

    def worth(rates: Rates) -> float:
        runs = (LENGTHS.epochs, LENGTHS.short_epochs)
        trial = replace(rule(), rates=rates)
        return sum(run_sgms(trial, start, tasks, n).objective for n in runs)

    every = [value for rates in candidates(2) if (value := worth(rates)) == value]
    assert worth(found) <= 1.01 * min(every)
