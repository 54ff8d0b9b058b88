"""Looks at the SGMs of a run: their gradients' fidelity, and what they see.

The probe graph gives both. What it shows of the samples is also what int8 SGMs are calibrated on
anew.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm.fidelity import PROBED, LayerFidelity, compare_probe
from qsgm.runtime import run_options
from qsgm.schedule import BATCH, steps_per_epoch
from qsgm.task import Array, Rows
from qsgm.tune.graphs import open_probe, running_graphs
from qsgm.tune.plan import Plan
from qsgm.tune.prepare import Prepared

# Samples that a probe looks at together, where activations take much memory.
PROBE_SLICE = 8


@dataclass(frozen=True)
class Probe:
    """What the gradients were worth after so many steps (0: before the first one)."""

    step: int
    epoch: float  # passes over the samples that the steps make
    layers: dict[int, LayerFidelity]  # by SGM layer


def activations_of(
    session: ort.InferenceSession,  # of the probe graph
    prepared: Prepared,
    plan: Plan,
    weights: Mapping[str, Array],
    rows: Rows,
) -> dict[int, Array]:
    """What the layers in front of SGMs give on the samples `rows` with these weights, (B, P, C)."""
    layers = plan.sgm_blocks.sgm_layers
    feeds = feeds_of(prepared, weights, rows)
    names = [f"activation{layer}" for layer in layers]
    with running_graphs(prepared.bundle):
        values = session.run(names, feeds, run_options(whole_graph=False))
        shapes = [(len(rows), -1, prepared.bundle.network.layer(k).out) for k in layers]
        found = [one.reshape(shape) for one, shape in zip(values, shapes, strict=True)]
    return dict(zip(layers, found, strict=True))


def feeds_of(
    prepared: Prepared, weights: Mapping[str, Array], rows: Rows
) -> dict[str, NDArray[Any]]:
    """What the probe graph takes to look at the samples `rows`."""
    features, labels, among = prepared.batch(rows)
    return {"features": features, "labels": labels, "rows": among, **weights}


def whole_batch(parts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Outputs of the probe graph for a batch, from those for equal parts of it.

    Gradients of samples lie one after the other, those of updates are sums over samples, and what
    has no axis is a share, of which this is the mean.
    """

    def joined(name: str) -> Array:
        found = [part[name] for part in parts]
        if name.startswith("update"):
            return np.asarray(np.sum(found, axis=0))
        return np.concatenate(found) if found[0].ndim else np.asarray(np.mean(found, axis=0))

    return dict(parts[0]) if len(parts) == 1 else {name: joined(name) for name in parts[0]}


class Prober:
    """An observer of a run that compares gradients on one random training batch at a time."""

    def __init__(self, prepared: Prepared, plan: Plan) -> None:
        if plan.settings.probe_every < 1:
            raise ValueError(
                f"`probe_every` must be 1 step or more, got {plan.settings.probe_every}"
            )
        began = time.perf_counter()
        self.probes: list[Probe] = []
        self._layers = plan.sgm_blocks.sgm_layers
        self._names = [f"{kind}{k}" for k in self._layers for kind in PROBED]
        self._every = plan.settings.probe_every
        self._rng = np.random.default_rng([plan.settings.seed, 2])
        self._session = None
        self._batch = min(BATCH, prepared.taught)
        self._at_once = PROBE_SLICE if plan.takes_much_memory else self._batch
        self._options = run_options(whole_graph=False, give_memory_back=plan.takes_much_memory)
        self._prepared, self._bundle = prepared, prepared.bundle
        if self._layers and prepared.bundle.has(plan.probe_file):
            self._session = open_probe(prepared.bundle, plan)
        self.seconds = time.perf_counter() - began
        self.looking = 0.0  # seconds of that while the run went on

    def wants(self, step: int) -> bool:
        return self._session is not None and step % self._every == 0

    def look(self, step: int, weights: Mapping[str, Array]) -> None:
        began = time.perf_counter()
        taught = self._prepared.taught
        rows = self._rng.choice(taught, self._batch, replace=False)
        pieces = np.split(rows, range(self._at_once, len(rows), self._at_once))
        parts = [self._outputs(some, weights) for some in pieces]
        with running_graphs(self._bundle):
            found = compare_probe(whole_batch(parts), self._layers)
        self.probes.append(Probe(step, step / steps_per_epoch(taught), found))
        took = time.perf_counter() - began
        self.seconds, self.looking = self.seconds + took, self.looking + took

    def _outputs(self, rows: Rows, weights: Mapping[str, Array]) -> dict[str, Array]:
        """What the probe graph gives for some samples, by name."""
        assert self._session is not None, "nobody wants to probe"
        feeds = feeds_of(self._prepared, weights, rows)
        with running_graphs(self._bundle):
            values = self._session.run(self._names, feeds, self._options)
        return dict(zip(self._names, values, strict=True))
