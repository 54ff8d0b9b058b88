"""The inner loop: run a training step's graph over batches, state in and state out.

State lives in two sets of buffers that swap roles every step (ping-pong): what one step writes
the next one reads, nothing is copied or allocated, and no buffer is read and written in the same
step, which ONNX Runtime does not promise to be safe.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm.schedule import batches, rate_factor, steps_per_epoch
from qsgm.tune.features import Features
from qsgm.tune.graphs import NEXT

Array = NDArray[np.float32]


class StepLoop:
    """A training step bound to its data and its state."""

    def __init__(
        self,
        session: ort.InferenceSession,
        features: Features,  # (N, P, C), input of the first tuned layer
        labels: Array,  # (N, L)
        weights: Mapping[str, Array],  # weight{k}: (Co, K), bias{k}: (Co,)
        rates: Mapping[int, float],  # per tuned layer
    ) -> None:
        self._session = session
        self._rates = dict(rates)
        # Kept here, since bindings read these arrays' memory.
        self._data: dict[str, NDArray[Any]] = {
            "features": np.ascontiguousarray(features),
            "labels": np.ascontiguousarray(labels, dtype=np.float32),
            **{f"rate{k}": np.array(rate, dtype=np.float32) for k, rate in rates.items()},
        }
        results = [result.name for result in session.get_outputs()]
        shapes = {wanted.name: wanted.shape for wanted in session.get_inputs()}
        names = [name.removesuffix(NEXT) for name in results if name.endswith(NEXT)]
        start = {
            name: weights[name] if name in weights else np.zeros(shapes[name], np.float32)
            for name in names
        }
        self._state = [_buffers(start), _buffers(start)]
        # Written by every step: asking a binding for its outputs takes longer than many a node.
        self._loss = np.zeros((), dtype=np.float32)
        self._bindings = [self._bind(0, 1), self._bind(1, 0)]
        self._now = 0

    def step(
        self,
        rows: NDArray[np.int64],
        factor: float = 1.0,
        options: ort.RunOptions | None = None,
    ) -> float:
        """Train on the samples `rows`, all rates times `factor`.

        Returns the batch's mean loss before the update.
        """
        for layer, rate in self._rates.items():
            self._data[f"rate{layer}"][...] = factor * rate
        binding = self._bindings[self._now]
        binding.bind_cpu_input("rows", rows)
        self._session.run_with_iobinding(binding, options)
        self._now = 1 - self._now
        return float(self._loss)

    def put(self, features: Features, labels: Array) -> None:
        """Other samples in the place of those the loop has: `rows` are then among these.

        Nothing happens where they are the same arrays.
        """
        if features is self._data["features"]:
            return
        self._data |= {"features": features, "labels": labels}
        for binding in self._bindings:
            binding.bind_cpu_input("features", features)
            binding.bind_cpu_input("labels", labels)

    def weights(self) -> dict[str, Array]:
        """A copy of the weights and biases as they are now."""
        current = self._state[self._now]
        return {name: current[name].numpy().copy() for name in current if _is_weight(name)}

    def _bind(self, source: int, target: int) -> ort.IOBinding:
        binding = self._session.io_binding()
        for name, array in self._data.items():
            binding.bind_cpu_input(name, array)
        for name in self._state[source]:
            binding.bind_ortvalue_input(name, self._state[source][name])
            binding.bind_ortvalue_output(name + NEXT, self._state[target][name])
        binding.bind_ortvalue_output("loss", ort.OrtValue.ortvalue_from_numpy(self._loss))
        return binding


def _is_weight(name: str) -> bool:
    """Whether a state is a layer's weight or bias rather than a moment or a count."""
    return name.startswith(("weight", "bias")) and "_" not in name


def _buffers(arrays: Mapping[str, Array]) -> dict[str, ort.OrtValue]:
    # An OrtValue shares the memory of the array it is made from, so every set gets its own copy.
    return {
        name: ort.OrtValue.ortvalue_from_numpy(np.array(a, order="C")) for name, a in arrays.items()
    }


def run_epochs(
    step: Callable[[NDArray[np.int64], float], float],
    count: int,
    epochs: int,
    rng: np.random.Generator,
    after_epoch: Callable[[int, float], None],
) -> None:
    """Run `epochs` passes over the first `count` samples, all rates decaying linearly.

    Args:
        step: takes the rows of a batch and a factor on all rates, returns the loss.
        count: of samples to learn from.
        epochs: passes over them.
        rng: orders the samples.
        after_epoch: gets an epoch's number and mean loss.
    """
    done, steps = 0, epochs * steps_per_epoch(count)
    for epoch in range(1, epochs + 1):
        losses = []
        for rows in batches(count, rng):
            losses.append(step(rows, rate_factor(done, steps)))
            done += 1
        after_epoch(epoch, float(np.mean(losses)))
