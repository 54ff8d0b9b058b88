"""Pretraining, fifth stage of tasks of samples: optimizer and rates, by a run's length.

Where rates start is tried out on runs as the device does them: on lessons of their own, at every
length that a user is likely to ask for, with the same decay, by SGD and by Adam. A device meets who
is unlike anybody drawn, of whom the network knows nearly everything: of rates that do about as well
the highest are taken, among those at whose double no run is lost.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from qsgm.manifest import OptimizerName, Recipe
from qsgm.schedule import BATCH
from qsgm.task import Task
from qsgm.train.model.curvature import FLAT
from qsgm.train.pretraining.evaluate import (
    Score,
    best_rates,
    mean_score,
    run_each,
    score,
)
from qsgm.train.pretraining.rates import Rates, Start, Trials
from qsgm.train.pretraining.tasks import TaskSet, start_states

LENGTHS = (1, 3, 20)  # epochs
# What a shape of rates is multiplied with, each twice the one before: the margin is one further.
# Where the first is too much already, halves of it down to the least.
SCALES = (0.125, 0.25, 0.5, 1.0, 2.0, 4.0)
LEAST = 2.0**-10
SGD_LAST, ADAM_LAST = 0.1, 0.016  # of the last layer, at scale 1
# Of a layer's rate, what the one in front of it has.
SHARES = (0.03, 0.1, 0.3, 1.0)
# Times the lowest held-out objective of all scales: about as well.
AS_WELL = 1.05
# Adam keeps twice as much; it has to be worth that.
WORTH = 0.98

Shape: TypeAlias = tuple[OptimizerName, Rates]


@dataclass(frozen=True)
class Chosen:
    """A shape of rates, what runs of each length multiply it with, and what comes of that."""

    shape: Shape
    scales: tuple[float, ...]
    scores: tuple[Score, ...]  # by length

    @property
    def objective(self) -> float:
        """The sum over lengths."""
        return sum(one.objective for one in self.scores)

    def recipe(self, steps: Sequence[int]) -> Recipe:
        """As a bundle has it: rates of the longest run, and gains of runs of so many steps."""
        (name, rates), last = self.shape, self.scales[-1]
        gains = tuple((s, scale / last) for s, scale in zip(steps, self.scales, strict=True))
        return Recipe(name, tuple(last * rate for rate in rates), gains)


def shapes(tuned: int, learnt: Rates) -> Iterator[Shape]:
    """Rates worth a trial for so many layers, at scale 1; `learnt` are the meta-trained ones."""
    if tuned == len(learnt):
        yield "sgd", learnt
    else:
        yield from (("sgd", rates) for rates in _graded(SGD_LAST, tuned))
    yield from (("adam", rates) for rates in _graded(ADAM_LAST, tuned))


def _graded(last: float, tuned: int) -> Iterator[Rates]:
    for share in SHARES if tuned > 1 else (1.0,):
        yield tuple(last * share**k for k in range(tuned))[::-1]


def late_runs(learnt: Rates) -> int:
    """How often :func:`choose_recipes` tells about runs."""
    layers = range(1, len(learnt) + 1)
    return len(LENGTHS) * sum(len([*shapes(tuned, learnt)]) for tuned in layers)


def choose_recipes(trials: Trials) -> tuple[dict[int, tuple[Recipe, ...]], Score]:
    """By the number of layers a recipe for each optimizer, the usual one first.

    Known are the meta-trained rates, of all layers that the trials start with.

    Returns:
        Recipes, and what the longest run of the most layers by SGD comes to.

    Raises:
        QsgmError: runs diverge at all rates.
    """
    most, learnt = len(trials.start), trials.rule.rates
    found = {k: _by_optimizer(trials.of_last(k), learnt) for k in range(1, most + 1)}
    steps = [epochs * -(-trials.tasks.support // BATCH) for epochs in LENGTHS]
    recipes = {
        tuned: tuple(one.recipe(steps) for one in _usual_first(chosen))
        for tuned, chosen in found.items()
    }
    return recipes, found[most]["sgd"].scores[-1]


def _usual_first(chosen: Mapping[OptimizerName, Chosen]) -> list[Chosen]:
    sgd, adam = chosen["sgd"], chosen["adam"]
    return [adam, sgd] if adam.objective < WORTH * sgd.objective else [sgd, adam]


def _by_optimizer(trials: Trials, learnt: Rates) -> dict[OptimizerName, Chosen]:
    """The best shape of each optimizer."""
    rule, best = trials.rule, dict[OptimizerName, Chosen]()
    bounds = lost_beyond(trials.start, trials.tasks, rule.task)
    for shape in shapes(len(trials.start), learnt):
        name, _ = shape
        curvatures = FLAT if name == "adam" else rule.curvatures
        trial = replace(trials, rule=replace(rule, optimizer=name, curvatures=curvatures))
        chosen = _of_shape(trial, shape, bounds)
        if name not in best or chosen.objective < best[name].objective:
            best[name] = chosen
    return best


def lost_beyond(start: Start, tasks: TaskSet, task: Task) -> list[float]:
    """By task, the held-out objective beyond which a run is lost.

    It made things worse by more than what the untouched network is off on the average: one whose
    network was nearly right may lose a little, of which there is enough by chance.
    """
    before = score(start_states(start, len(tasks)), tasks, task)
    typical = mean_score(before).objective
    return [one.objective + typical for one in before]


def _of_shape(trials: Trials, shape: Shape, bounds: Sequence[float]) -> Chosen:
    """The best scale of one shape at each length."""
    scales, scores = list[float](), list[Score]()
    for epochs in LENGTHS:

        def run(scale: float, epochs: int = epochs) -> tuple[Score, bool]:
            """What comes of a scale, and whether no run is lost."""
            trial = replace(trials.rule, rates=tuple(scale * rate for rate in shape[1]))
            each = run_each(trial, trials.start, trials.tasks, epochs, chunk=len(trials.tasks))
            pairs = zip(each, bounds, strict=True)
            return mean_score(each), all(one.objective <= bound for one, bound in pairs)

        tried = sound_scales(run)
        scale = highest(tried)
        scales.append(scale)
        scores.append(tried[scale])
        trials.after_run(tried[scale])
    return Chosen(shape, tuple(scales), tuple(scores))


def highest(tried: Mapping[float, Score]) -> float:
    """Of scales, the lowest first, the highest that does about as well as the best.

    Raises:
        QsgmError: there is none that is finite.
    """
    (best,) = best_rates({(scale,): result for scale, result in tried.items()})
    bound = AS_WELL * tried[best].objective
    return max(scale for scale, result in tried.items() if result.objective <= bound)


def sound_scales(run: Callable[[float], tuple[Score, bool]]) -> dict[float, Score]:
    """Scales at whose double a run is sound, too, the lowest first, and what comes of them.

    `run` gives a scale's score, and whether it is sound. There is always a scale: where none of
    those to be tried is, the first lower one.
    """
    scale, found = SCALES[0], dict[float, Score]()
    result, sound = run(scale)
    while not sound and scale > LEAST:
        scale /= 2
        result, sound = run(scale)
    for double in SCALES[1:] if scale == SCALES[0] else ():
        following, sound = run(double)
        if not sound:
            break
        found[scale] = result
        scale, result = double, following
    return found or {scale / 2: run(scale / 2)[0]}
