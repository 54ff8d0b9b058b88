"""Pretraining, fifth stage: where the device's decaying rates start, for any number of layers.

Each choice is the best of a few on whole runs on drawn objects of their own.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product

from torch import Tensor

from qsgm.blocks import Blocks
from qsgm.network import Network
from qsgm.train.model.curvature import FLAT
from qsgm.train.pretraining.evaluate import Score, UpdateRule, best_rates, run_sgms
from qsgm.train.pretraining.map_sgms import behind
from qsgm.train.pretraining.tasks import TaskSet

RATE_GRID = (1e-2, 3e-2, 1e-1, 3e-1)
# Meta-training looks ahead a few steps at a time; whole runs may want a smaller scale. At 1.4 and 2
# a run of 500 steps blew up on one of 48 drawn objects that these were not chosen on.
META_RATE_FACTORS = (0.5, 0.7, 1.0)
SHORT_GAINS = (1.0, 1.4, 2.0, 2.8)
# Of the layer in front of those whose rates are known.
EARLY_RATE_GRID = (1e-4, 1e-3, 1e-2)
# Of layers in one block with the first meta-trained one, whose true gradients are worth more.
BLOCK_RATE = 3e-3

Rates = tuple[float, ...]
Start = Sequence[tuple[Tensor, Tensor]]
AfterRun = Callable[[Score], None]


@dataclass(frozen=True)
class RatesConfig:
    """Sizes of the fifth stage."""

    tasks: int = 48
    crops_per_task: int = 400
    epochs: int = 40  # as many steps as 20 epochs on the 800 crops of the device
    short_epochs: int = 8  # of the same tasks: 80 steps
    early_tasks: int = 6
    early_crops_per_task: int = 160
    early_epochs: int = 15


@dataclass(frozen=True)
class Trials:
    """Fine-tuning runs by which rates of the last layers are chosen."""

    rule: UpdateRule  # how layers learn; its rates are those that are known beforehand
    start: Start  # of as many layers
    tasks: TaskSet  # as the first of these layers sees them
    after_run: AfterRun  # told about every run

    def of_last(self, tuned: int) -> "Trials":
        """The same of fewer layers."""
        network, skipped = self.rule.task.network, len(self.start) - tuned
        first = network.depth + 1 - len(self.start)
        tasks = behind(network, self.start[:skipped], self.tasks, first)
        # A layer alone has its gradient from the loss, and is trained as by backpropagation.
        rule = replace(self.rule, curvatures=self.rule.curvatures if tuned > 1 else FLAT)
        return Trials(rule, self.start[skipped:], tasks, self.after_run)

    def run(self, rates: Rates, epochs: int, chunk: int = 8) -> Score:
        """What comes of a run with these rates, so many tasks at once."""
        score = run_sgms(replace(self.rule, rates=rates), self.start, self.tasks, epochs, chunk)
        self.after_run(score)
        return score


def block_rates(network: Network, meta_rates: Rates) -> dict[str, Rates]:
    """Rates by blocks: earlier layers as one block with the first meta-trained one.

    The meta-trained layers keep theirs.
    """
    first, *rest = network.last(len(meta_rates))
    singles = "".join(f",{number}" for number in rest)
    return {
        f"{start}-{first}{singles}": (BLOCK_RATE,) * (first - start) + meta_rates
        for start in range(first - 1, 0, -1)
    }


def late_candidates(meta_rates: Rates) -> Iterator[Rates]:
    """Rates worth a trial for one layer up to as many as were meta-trained."""
    for tuned in range(1, len(meta_rates)):
        yield from product(RATE_GRID, repeat=tuned)
    yield from (tuple(factor * rate for rate in meta_rates) for factor in META_RATE_FACTORS)


def choose_late(trials: Trials, config: RatesConfig) -> tuple[dict[int, Rates], Score]:
    """The best rates for few layers, by their number, and the score of the most.

    Known are the meta-trained ones, of all layers that the trials start with.
    """
    most, scores = len(trials.start), dict[int, dict[Rates, Score]]()
    for rates in late_candidates(trials.rule.rates):
        score = trials.of_last(len(rates)).run(rates, config.epochs)
        scores.setdefault(len(rates), {})[rates] = score
    best = {tuned: best_rates(of_tuned) for tuned, of_tuned in scores.items()}
    return best, scores[most][best[most]]


def choose_short_gain(trials: Trials, config: RatesConfig) -> float:
    """What the rates of a whole run are best multiplied with in a short one."""
    scores: dict[Rates, Score] = {}
    for gain in SHORT_GAINS:
        rates = tuple(gain * rate for rate in trials.rule.rates)
        scores[(gain,)] = trials.run(rates, config.short_epochs)
    return best_rates(scores)[0]


def choose_grouped(
    trials: Trials, config: RatesConfig, every: Sequence[Blocks]
) -> dict[str, Rates]:
    """The best rates for layers in groups: one for all in front of those that are known.

    Args:
        trials: of all layers.
        config: sizes.
        every: groups of more layers than are known.
    """
    return {
        str(one): _with_early(trials, replace(trials.rule, blocks=one), len(one.layers), config)
        for one in every
    }


def choose_early(trials: Trials, config: RatesConfig) -> dict[int, Rates]:
    """The best rates for many layers, one more at a time: those behind keep theirs.

    Known are those of fewer layers than the trials start with, which are all.
    """
    rule, chosen = trials.rule, dict[int, Rates]()
    for tuned in range(len(rule.rates) + 1, len(trials.start) + 1):
        chosen[tuned] = _with_early(trials, rule, tuned, config)
        rule = replace(rule, rates=chosen[tuned])
    return chosen


def _with_early(trials: Trials, rule: UpdateRule, tuned: int, config: RatesConfig) -> Rates:
    """The rule's rates, and in front of them the best one of a few, up to so many layers."""
    scores, trial = dict[Rates, Score](), replace(trials, rule=rule).of_last(tuned)
    for rate in EARLY_RATE_GRID:
        rates = (rate,) * (tuned - len(rule.rates)) + rule.rates
        scores[rates] = trial.run(rates, config.early_epochs, chunk=1)
    return best_rates(scores)
