"""The input of the first tuned layer: the frozen layers' features, kept or made for every batch."""

import time
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from qsgm.bundle import Bundle
from qsgm.progress import Progress
from qsgm.task import Array, Inputs, Lesson, Rows
from qsgm.tune.graphs import open_trunk, running_graphs
from qsgm.tune.plan import Plan

# What the frozen layers leave; where nothing is frozen, the inputs.
Features = Inputs
# Samples that are in memory at once. With more the frozen layers in float take much of it, and are
# no quicker. Batches and both sets of samples are whole numbers of slices: whatever a graph makes
# of a slice's size, a sample's features are the same in all of them.
SLICE = 8


class FeatureSource(Protocol):
    """Where the input of the first tuned layer comes from."""

    def of(self, rows: Rows) -> Features:
        """Features (B, P, C) of the samples `rows`."""

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        """Features (M, P, C), labels (M, L), and where among them the samples `rows` are.

        `labels` (N, L) are all samples'.
        """


@dataclass(frozen=True)
class KeptFeatures:
    """Made once, for all samples."""

    features: Features  # (N, P, C)

    def of(self, rows: Rows) -> Features:
        return self.features[rows]

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        return self.features, labels, rows


class StreamedFeatures:
    """Made again whenever they are asked for: kept is no more than the lesson."""

    def __init__(
        self,
        lesson: Lesson,
        bundle: Bundle,
        plan: Plan,
        seconds: MutableMapping[str, float],  # crops, features: their time is added there
    ) -> None:
        self._lesson, self._bundle, self._seconds = lesson, bundle, seconds
        self._session = open_trunk(bundle, plan)
        (output,) = (value for value in self._session.get_outputs() if value.name == "features")
        first = plan.layers[0]
        self._shape = bundle.network.positions_before(first), bundle.network.channels_before(first)
        self._dtype = np.dtype(np.uint8 if "uint8" in output.type else np.float32)

    def of(self, rows: Rows, watch: Progress | None = None) -> Features:
        """Features (B, P, C) of the samples `rows`, cut slice by slice: they never all exist."""
        features = np.empty((len(rows), *self._shape), self._dtype)
        for first in range(0, len(rows), SLICE):
            some = slice(first, min(first + SLICE, len(rows)))
            with _adding_to(self._seconds, "crops"):
                inputs = self._lesson.cut(rows[some])
            with _adding_to(self._seconds, "features"), running_graphs(self._bundle):
                given = self._session.run(["features"], {"samples": inputs})[0]
                features[some] = given.reshape(len(inputs), *self._shape)
            if watch is not None:
                watch("crops", some.stop, len(rows))
        return features

    def batch(self, rows: Rows, labels: Array) -> tuple[Features, Array, Rows]:
        return self.of(rows), labels[rows], np.arange(len(rows))


def feature_source(
    lesson: Lesson,
    bundle: Bundle,
    plan: Plan,
    seconds: MutableMapping[str, float],
    watch: Progress,
) -> FeatureSource:
    """Features of a lesson's samples, kept or streamed as the settings say."""
    streamed = StreamedFeatures(lesson, bundle, plan, seconds)
    if plan.settings.stream:
        return streamed
    return KeptFeatures(streamed.of(np.arange(len(lesson)), watch))


@contextmanager
def _adding_to(seconds: MutableMapping[str, float], stage: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[stage] += time.perf_counter() - began
