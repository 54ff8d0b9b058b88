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


def choose_late(
    rule: UpdateRule, start: Start, tasks: TaskSet, config: RatesConfig, after_run: AfterRun
) -> tuple[dict[int, Rates], Score]:
    """The best rates for few layers, by their number, and the score of the most.

    Args:
        rule: how layers learn; its rates are the meta-trained ones.
        start: of as many layers as there are meta-trained rates.
        tasks: as the first of these layers sees them.
        config: sizes.
        after_run: told about every run.
    """
    scores: dict[int, dict[Rates, Score]] = {}
    for rates in late_candidates(rule.rates):
        tuned = len(rates)
        skipped = len(start) - tuned
        network = rule.task.network
        seen = behind(network, start[:skipped], tasks, network.depth + 1 - len(start))
        # A layer alone has its gradient from the loss, and is trained as by backpropagation.
        trial = replace(rule, rates=rates, curvatures=rule.curvatures if tuned > 1 else FLAT)
        score = run_sgms(trial, start[skipped:], seen, config.epochs)
        scores.setdefault(tuned, {})[rates] = score
        after_run(score)
    best = {tuned: best_rates(of_tuned) for tuned, of_tuned in scores.items()}
    return best, scores[len(start)][best[len(start)]]


def choose_short_gain(
    rule: UpdateRule, start: Start, tasks: TaskSet, config: RatesConfig, after_run: AfterRun
) -> float:
    """What the rates of a whole run are best multiplied with in a short one."""
    scores: dict[Rates, Score] = {}
    for gain in SHORT_GAINS:
        trial = replace(rule, rates=tuple(gain * rate for rate in rule.rates))
        scores[(gain,)] = run_sgms(trial, start, tasks, config.short_epochs)
        after_run(scores[(gain,)])
    return best_rates(scores)[0]


def choose_grouped(
    rule: UpdateRule,
    start: Start,
    pixels: TaskSet,
    config: RatesConfig,
    every: Sequence[Blocks],
    after_run: AfterRun,
) -> dict[str, Rates]:
    """The best rates for layers in groups: one for all in front of the meta-trained ones.

    Args:
        rule: how layers learn; its rates are those of the meta-trained layers.
        start: of all layers.
        pixels: tasks as layer 1 sees them.
        config: sizes.
        every: groups of more layers than were meta-trained.
        after_run: told about every run.
    """
    return {
        str(blocks): _with_early(
            replace(rule, blocks=blocks), len(blocks.layers), start, pixels, config, after_run
        )
        for blocks in every
    }


def choose_early(
    rule: UpdateRule, start: Start, pixels: TaskSet, config: RatesConfig, after_run: AfterRun
) -> dict[int, Rates]:
    """The best rates for many layers, one more at a time: those behind keep theirs.

    Args:
        rule: how layers learn; its rates are those of fewer layers than `start` has.
        start: of all layers.
        pixels: tasks as layer 1 sees them.
        config: sizes.
        after_run: told about every run.
    """
    chosen = {}
    for tuned in range(len(rule.rates) + 1, len(start) + 1):
        chosen[tuned] = _with_early(rule, tuned, start, pixels, config, after_run)
        rule = replace(rule, rates=chosen[tuned])
    return chosen


def _with_early(
    rule: UpdateRule,
    tuned: int,
    start: Start,
    pixels: TaskSet,
    config: RatesConfig,
    after_run: AfterRun,
) -> Rates:
    """The rule's rates, and in front of them the best one of a few, up to so many layers."""
    skipped, scores = len(start) - tuned, dict[Rates, Score]()
    seen = behind(rule.task.network, start[:skipped], pixels)
    for rate in EARLY_RATE_GRID:
        rates = (rate,) * (tuned - len(rule.rates)) + rule.rates
        trial = replace(rule, rates=rates)
        scores[rates] = run_sgms(trial, start[skipped:], seen, config.early_epochs, chunk=1)
        after_run(scores[rates])
    return best_rates(scores)
