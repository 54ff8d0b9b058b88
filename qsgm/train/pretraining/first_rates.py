"""Where meta-training's rates start, for a network that nobody has chosen them for.

Rates are tried on tasks that are learnt from anyway, always in the same order: the same tasks give
the same rates. First the one at which backpropagation of the first late layer, the others at rest,
does best: along such runs SGMs regress true gradients. Then, with these SGMs, the rates of all late
layers, on whole runs and on short ones, as the device has both.
"""

from collections.abc import Iterator
from dataclasses import replace

import torch

from qsgm.task import Task
from qsgm.train.pretraining.evaluate import (
    Score,
    best_rates,
    mean_score,
    run_sgms,
    score,
)
from qsgm.train.pretraining.matching import MatchingConfig, backprop_step
from qsgm.train.pretraining.rates import RATE_GRID, Rates, RatesConfig, Start, Trials
from qsgm.train.pretraining.tasks import TaskSet, shuffled_batches, start_states

ALONE_GRID = (1e-3, 3e-3, 1e-2, 3e-2)
# Of a layer's rate, what the one in front of it has: the SGM behind that has to know what the
# layers behind it do, and they are to change little while it learns.
SHARES = (0.02, 0.05, 0.15, 0.5)
TASKS = 8  # tried on


def candidates(late: int) -> Iterator[Rates]:
    """Rates of so many layers, the lower ones first."""
    for last in RATE_GRID:
        for share in SHARES if late > 1 else (1.0,):
            yield tuple(last * share**k for k in range(late))[::-1]


@torch.no_grad()
def rate_alone(
    tasks: TaskSet, start: Start, task: Task, config: MatchingConfig, seed: int
) -> float:
    """The rate at which the first late layer learns best on true gradients, the others at rest.

    Raises:
        QsgmError: it diverges at every one.
    """
    some, scores = next(tasks.chunks(TASKS)), dict[Rates, Score]()
    for rate in ALONE_GRID:
        states = start_states(start, len(some))
        for rows in shuffled_batches(some.support, config.epochs, seed):
            features, labels = some.features[:, rows].float(), some.labels[:, rows]
            rates = (rate, *[0.0] * (len(start) - 1))
            states, _, _ = backprop_step(states, features, labels, rates, task)
        scores[(rate,)] = mean_score(score(states, some, task))
    return best_rates(scores)[0]


def choose_first(trials: Trials, config: RatesConfig) -> Rates:
    """The rates of all late layers with which SGMs that regressed gradients do best.

    None are known: the rule's do not matter.

    Raises:
        QsgmError: runs diverge at all of them.
    """
    some, scores = next(trials.tasks.chunks(TASKS)), dict[Rates, Score]()
    for rates in candidates(len(trials.start)):
        trial = replace(trials.rule, rates=rates)
        lengths = (config.epochs, config.short_epochs)
        scores[rates] = mean_score([run_sgms(trial, trials.start, some, n) for n in lengths])
        trials.after_run(scores[rates])
    return best_rates(scores)
