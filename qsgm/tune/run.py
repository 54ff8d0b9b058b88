"""One run: feed-forward training of the tuned layers, watched while it goes on.

plan = resolve(settings, bundle)
prepared = prepare(lesson, bundle, plan)
result = tune(prepared, plan)
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from qsgm.errors import QsgmError
from qsgm.progress import Progress, ignore
from qsgm.runtime import run_options
from qsgm.schedule import steps_per_epoch
from qsgm.task import Array, Rows
from qsgm.tune.drift import drift_warnings
from qsgm.tune.graphs import open_step, running_graphs
from qsgm.tune.loop import StepLoop, run_epochs
from qsgm.tune.plan import Plan
from qsgm.tune.prepare import Prepared, validate
from qsgm.tune.probe import Prober
from qsgm.tune.recalibrate import recalibrate
from qsgm.tune.result import Result
from qsgm.weights import to_conv_layout


class Observer(Protocol):
    """Looks at the weights of a run every now and then."""

    def wants(self, step: int) -> bool:
        """Whether it looks after so many steps (0: before the first)."""
        ...

    def look(self, step: int, weights: Mapping[str, Array]) -> None:
        """Be shown the weights, in the step graphs' layout."""
        ...


class Keeper:
    """An observer that keeps the weights after some steps."""

    def __init__(self, steps: Sequence[int]) -> None:
        self.kept: dict[int, dict[str, Array]] = {}
        self._steps = frozenset(steps)

    def wants(self, step: int) -> bool:
        return step in self._steps

    def look(self, step: int, weights: Mapping[str, Array]) -> None:
        self.kept[step] = dict(weights)


def tune(prepared: Prepared, plan: Plan, watch: Progress | None = None) -> Result:
    """A run with all that a user expects of one: recalibration if asked for, probes, warnings.

    Args:
        prepared: as :func:`qsgm.tune.prepare.prepare` returned it.
        plan: of the run.
        watch: told about every epoch.

    Raises:
        QsgmError: training diverged, or there is nothing to recalibrate.
    """
    began = time.perf_counter()
    extra = {}
    if plan.settings.recalibrate:
        plan = recalibrate(prepared, plan)
        extra["recalibration"] = time.perf_counter() - began
    prober = Prober(prepared, plan)
    result = train(prepared, plan, (prober,), watch)
    seconds = prepared.seconds | extra | {"tuning": result.seconds["tuning"] - prober.looking}
    seconds["probes"] = prober.seconds
    seconds["total"] = prepared.seconds["total"] + time.perf_counter() - began
    result = replace(result, probes=tuple(prober.probes), seconds=seconds)
    if plan.precision == "float":
        return result
    advice = "compare with --float" if plan.settings.recalibrate else "tune it with --recalibrate"
    return replace(result, warnings=drift_warnings(result.fidelity, advice))


def train(
    prepared: Prepared,
    plan: Plan,
    observers: Sequence[Observer] = (),
    watch: Progress | None = None,
) -> Result:
    """The training alone; what was prepared stays as it is.

    Args:
        prepared: as :func:`qsgm.tune.prepare.prepare` returned it.
        plan: may differ from the one it was prepared by in all but layers, trunk and streaming.
        observers: shown the weights.
        watch: told about every epoch.

    Raises:
        QsgmError: training diverged.
    """
    if plan.layers != prepared.plan.layers:
        raise ValueError(f"prepared for layers {prepared.plan.layers}, not for {plan.layers}")
    began = time.perf_counter()
    run = _Run(prepared, plan, observers)
    started = time.perf_counter()
    losses = run.epochs(watch or ignore)
    tuning = time.perf_counter() - started
    weights = run.loop.weights()
    scores = validate(prepared, weights)
    total = prepared.seconds["total"] + time.perf_counter() - began
    return Result(
        prepared,
        plan,
        _in_conv_layout(weights, prepared.bundle.start_weights(plan.layers)),
        scores,
        tuple(losses),
        prepared.seconds | {"tuning": tuning, "total": total},
    )


class _Run:
    """A training step's loop that stops at the first step that leaves the realm of numbers."""

    def __init__(self, prepared: Prepared, plan: Plan, observers: Sequence[Observer]) -> None:
        self._prepared, self._plan, self._observers = prepared, plan, observers
        bundle = prepared.bundle
        session = open_step(bundle, plan)
        # A probe takes as much as a step: neither keeps its memory while the other runs.
        self._before_look = run_options(give_memory_back=plan.takes_much_memory)
        steps = plan.epochs * steps_per_epoch(prepared.taught)
        rates = dict(zip(plan.layers, plan.recipe.rates_over(steps), strict=True))
        features, labels, _ = prepared.batch(np.arange(0))
        with running_graphs(bundle):
            self.loop = StepLoop(session, features, labels, prepared.start, rates)
        self._steps = 0

    def epochs(self, watch: Progress) -> list[float]:
        """Train to the end; the mean loss of every epoch."""
        plan, losses = self._plan, list[float]()

        def after_epoch(epoch: int, loss: float) -> None:
            losses.append(loss)
            self._finite_weights()
            watch("tuning", epoch, plan.epochs)

        self._look()
        # Methods with the same seed see the same batches in the same order.
        rng = np.random.default_rng([plan.settings.seed, 1])
        run_epochs(self._step, self._prepared.taught, plan.epochs, rng, after_epoch)
        return losses

    def _step(self, rows: Rows, factor: float) -> float:
        features, labels, among = self._prepared.batch(rows)
        soon = any(one.wants(self._steps + 1) for one in self._observers)
        with running_graphs(self._prepared.bundle):
            self.loop.put(features, labels)
            loss = self.loop.step(among, factor, self._before_look if soon else None)
        self._steps += 1
        self._refuse_unless_finite(bool(np.isfinite(loss)), "the loss")
        self._look()
        return loss

    def _look(self) -> None:
        looking = [one for one in self._observers if one.wants(self._steps)]
        if looking:
            weights = self._finite_weights()
            for one in looking:
                one.look(self._steps, weights)

    def _finite_weights(self) -> dict[str, Array]:
        weights = self.loop.weights()
        self._refuse_unless_finite(all(np.isfinite(w).all() for w in weights.values()), "a weight")
        return weights

    def _refuse_unless_finite(self, finite: bool, what: str) -> None:
        if not finite:
            raise QsgmError(
                f"tuning diverged: {what} is not finite at step {self._steps}; nothing was "
                "written. Try another --method or --optimizer, or a better demonstration"
            )


def _in_conv_layout(weights: Mapping[str, Array], like: Mapping[str, Array]) -> dict[str, Array]:
    return {
        name: to_conv_layout(weights[name], value.shape[2:]) if value.ndim > 1 else weights[name]
        for name, value in like.items()
    }
