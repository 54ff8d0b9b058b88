"""Looks at the SGMs of a run: their gradients' fidelity, and what they see.

The probe graph gives both. What it shows of the object's crops is also what int8 SGMs are
calibrated on anew.
"""

import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm.blocks import tuned_layers
from qsgm.bundle import COMMAND, probe_file
from qsgm.errors import QsgmError
from qsgm.fidelity import PROBED, LayerFidelity, compare_probe
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.runtime import run_options
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import STEPS_PER_EPOCH, Array, Prepared, running_graphs
from qsgm.tune.recalibrate import recalibrated
from qsgm.tune.settings import Settings, run_blocks, sgm_blocks, takes_much_memory

# Constants of int8 SGMs: by layer, by initializer name.
Exchanged = Mapping[int, Mapping[str, NDArray[Any]]]
NOTHING_EXCHANGED: Exchanged = MappingProxyType({})
# Crops whose activations an int8 SGM is calibrated on anew, and how many at a time; of maps, whose
# crops have thousands of positions, the first slice has to do.
RECALIBRATION_CROPS, RECALIBRATION_SLICE = 400, 16
# Crops that a probe looks at together, where activations take much memory.
PROBE_SLICE = 8


@dataclass(frozen=True)
class Probe:
    """What the gradients were worth after so many steps (0: before the first one)."""

    step: int
    layers: dict[int, LayerFidelity]  # by SGM layer

    @property
    def epoch(self) -> float:
        """Passes over the crops that the steps make."""
        return self.step / STEPS_PER_EPOCH


def recalibrate(prepared: Prepared, settings: Settings) -> Exchanged:
    """Constants of this run's int8 SGMs for this object; see :mod:`qsgm.tune.recalibrate`.

    Raises:
        QsgmError: the run has no int8 SGM, or the bundle no probe to see activations with.
    """
    if not (settings.precision == "int8" and run_blocks(settings).sgm_layers):
        raise QsgmError(
            "there is nothing to recalibrate: the run has no int8 SGM; leave --recalibrate out, or "
            "tune two layers or more with --method sgm and --int8"
        )
    return recalibrated(prepared.bundle, activations_before(prepared, settings))


def activations_before(prepared: Prepared, settings: Settings) -> dict[int, Array]:
    """What the layers in front of SGMs give on some training crops before any step, (N, P, C).

    Of maps a few crops do, each has thousands of positions; in memory are a few crops at a time.
    """
    session = open_probe(prepared, settings)
    found: dict[int, list[Array]] = {}
    for first in range(0, RECALIBRATION_CROPS, RECALIBRATION_SLICE):
        rows = np.arange(first, first + RECALIBRATION_SLICE)
        some = activations_of(session, prepared, settings, prepared.start, rows)
        for layer, activation in some.items():
            if first == 0 or activation.shape[1] == 1:
                found.setdefault(layer, []).append(activation)
    return {layer: np.concatenate(slices) for layer, slices in found.items()}


def open_probe(
    prepared: Prepared, settings: Settings, exchanged: Exchanged = NOTHING_EXCHANGED
) -> ort.InferenceSession:
    """A session of the probe graph. Raises QsgmError where the bundle has none."""
    bundle, name = prepared.bundle, probe_file(settings.layers)
    if name not in bundle.manifest["files"]:
        raise QsgmError(
            f"the bundle {bundle.folder} has no {name}, by which SGMs are looked at; export it "
            f"again with `{COMMAND}`"
        )
    constants = constants_of(exchanged, tuned_layers(settings.layers))
    return bundle.session(name, settings.threads, constants)


def activations_of(
    session: ort.InferenceSession,  # of the probe graph
    prepared: Prepared,
    settings: Settings,
    weights: Mapping[str, Array],
    rows: NDArray[np.int64],
) -> dict[int, Array]:
    """What the layers in front of SGMs give on the crops `rows` with these weights, (B, P, C)."""
    layers = sgm_blocks(settings).sgm_layers
    feeds = feeds_of(prepared, weights, rows)
    names = [f"activation{layer}" for layer in layers]
    with running_graphs(prepared.bundle):
        values = session.run(names, feeds, run_options(whole_graph=False))
    return dict(zip(layers, values, strict=True))


def feeds_of(
    prepared: Prepared, weights: Mapping[str, Array], rows: NDArray[np.int64]
) -> dict[str, NDArray[Any]]:
    """What the probe graph takes to look at the crops `rows`."""
    features, labels, among = prepared.batch(rows)
    return {"features": features, "labels": labels, "rows": among, **weights}


def constants_of(exchanged: Exchanged, layers: Collection[int]) -> dict[str, NDArray[Any]]:
    """Those of the SGMs behind `layers`, by initializer name."""
    return {name: array for layer in layers for name, array in exchanged.get(layer, {}).items()}


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
    """Compares gradients on one random training batch at a time and keeps what it finds."""

    def __init__(
        self, prepared: Prepared, settings: Settings, wanted: bool, exchanged: Exchanged
    ) -> None:
        if settings.probe_every < 1:
            raise ValueError(f"`probe_every` must be 1 step or more, got {settings.probe_every}")
        began = time.perf_counter()
        self.probes: list[Probe] = []
        self._layers = sgm_blocks(settings).sgm_layers
        self._names = [f"{kind}{k}" for k in self._layers for kind in PROBED]
        self._every = settings.probe_every
        self._rng = np.random.default_rng([settings.seed, 2])
        self._session = None
        much = takes_much_memory(settings)
        self._at_once = PROBE_SLICE if much else BATCH
        self._options = run_options(whole_graph=False, give_memory_back=much)
        self._prepared, self._bundle = prepared, prepared.bundle
        name = probe_file(settings.layers)
        if wanted and self._layers and name in prepared.bundle.manifest["files"]:
            self._session = open_probe(prepared, settings, exchanged)
            self._refuse_unless_complete(name, self._session)
        self.seconds = time.perf_counter() - began

    def wants(self, step: int) -> bool:
        return self._session is not None and step % self._every == 0

    def __call__(self, step: int, weights: Mapping[str, Array]) -> None:
        began = time.perf_counter()
        rows = self._rng.choice(TRAIN_CROPS, BATCH, replace=False)
        pieces = np.split(rows, len(rows) // self._at_once)
        parts = [self._outputs(some, weights) for some in pieces]
        self.probes.append(Probe(step, compare_probe(whole_batch(parts), self._layers)))
        self.seconds += time.perf_counter() - began

    def _outputs(self, rows: NDArray[np.int64], weights: Mapping[str, Array]) -> dict[str, Array]:
        """What the probe graph gives for some crops, by name."""
        assert self._session is not None, "nobody wants to probe"
        feeds = feeds_of(self._prepared, weights, rows)
        with running_graphs(self._bundle):
            values = self._session.run(self._names, feeds, self._options)
        return dict(zip(self._names, values, strict=True))

    def _refuse_unless_complete(self, name: str, session: ort.InferenceSession) -> None:
        there = {output.name for output in session.get_outputs()}
        missing = [wanted for wanted in self._names if wanted not in there]
        if missing:
            raise QsgmError(
                f"{name} of the bundle {self._bundle.folder} has no output {missing[0]}: another "
                f"version of qsgm wrote it; export it again with `{COMMAND}`"
            )
