"""A lesson as the tuned layers see it: features, labels, the untouched network's scores.

What all methods share is done once, so that they can be compared on the very same samples.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from qsgm.bundle import Bundle
from qsgm.progress import Progress, ignore
from qsgm.task import Array, Labelled, Lesson, Rows, Scores
from qsgm.tune.features import (
    SLICE,
    Features,
    FeatureSource,
    feature_source,
)
from qsgm.tune.graphs import open_head, running_graphs
from qsgm.tune.plan import Plan
from qsgm.weights import to_step_layout


@dataclass(frozen=True)
class Prepared:
    """What every run on a lesson starts from."""

    bundle: Bundle
    plan: Plan  # by which it was prepared
    lesson: Lesson
    source: FeatureSource
    labelled: Labelled
    start: dict[str, Array]  # weights and biases, in the step graphs' layout
    untouched: Scores  # of the network before any step, on the held-out samples
    seconds: dict[str, float]  # crops, features, total

    @property
    def taught(self) -> int:
        """How many samples are learnt from; those behind them are held out."""
        return self.lesson.taught

    @property
    def labels(self) -> Array:
        """Labels of all samples, (N, L)."""
        return self.labelled.labels

    @property
    def held_out(self) -> Rows:
        """The samples that take no part in training."""
        return np.arange(self.taught, len(self.labels))

    @property
    def features(self) -> Features:
        """All samples' (N, P, C), input of the first tuned layer; streamed ones are made for it."""
        features, _, _ = self.batch(np.arange(len(self.labels)))
        return features

    def batch(self, rows: Rows) -> tuple[Features, Array, Rows]:
        """Features (M, P, C), labels (M, L), and where among them the samples `rows` are."""
        return self.source.batch(rows, self.labels)


def prepare(lesson: Lesson, bundle: Bundle, plan: Plan, watch: Progress | None = None) -> Prepared:
    """Features, labels and what the untouched network makes of them.

    Args:
        lesson: what is to be learnt.
        bundle: whose network it is.
        plan: layers, frozen layers' precision, streaming and threads matter here.
        watch: told about progress.

    Raises:
        QsgmError: a graph does not fit what it is given.
    """
    began = time.perf_counter()
    seconds = {"crops": 0.0, "features": 0.0}
    source = feature_source(lesson, bundle, plan, seconds, watch or ignore)
    start = in_step_layout(bundle.start_weights(plan.layers))
    outputs = outputs_of(source, np.arange(len(lesson)), start, bundle, plan)
    labelled = lesson.labelled(outputs)
    held_out = np.arange(lesson.taught, len(lesson))
    untouched = labelled.scores(outputs[held_out], held_out)
    # What is streamed later is part of other stages.
    seconds = seconds | {"total": time.perf_counter() - began}
    return Prepared(bundle, plan, lesson, source, labelled, start, untouched, seconds)


def outputs_of(
    source: FeatureSource, rows: Rows, weights: Mapping[str, Array], bundle: Bundle, plan: Plan
) -> Array:
    """Activated outputs (B, L) that the tuned layers give for the samples `rows`."""
    session, outputs = open_head(bundle, plan), []
    for first in range(0, len(rows), SLICE):
        features = source.of(rows[first : first + SLICE])
        with running_graphs(bundle):
            given = session.run(["outputs"], {"features": features, **weights})[0]
            outputs.append(given.reshape(len(features), bundle.network.outputs))
            if not np.isfinite(given).all():
                raise ValueError("it answers with NaN or infinity")
    return np.concatenate(outputs)


def validate(prepared: Prepared, weights: Mapping[str, Array]) -> Scores:
    """Weights, in the step graphs' layout, on the samples that took no part in training."""
    rows = prepared.held_out
    outputs = outputs_of(prepared.source, rows, weights, prepared.bundle, prepared.plan)
    return prepared.labelled.scores(outputs, rows)


def in_step_layout(weights: Mapping[str, Array]) -> dict[str, Array]:
    """Weights (Co, Ci, kh, kw) as step graphs have them; biases (Co,) as they are."""
    return {
        name: to_step_layout(value) if value.ndim > 1 else value for name, value in weights.items()
    }
