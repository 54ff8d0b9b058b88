"""The inner loop: run a training step's graph over batches, state in and state out.

State lives in two sets of buffers that swap roles every step (ping-pong): what one step writes
the next one reads, nothing is copied or allocated, and no buffer is read and written in the same
step, which ONNX Runtime does not promise to be safe.
"""

from collections.abc import Callable, Iterator, Mapping
from math import log
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

Array = NDArray[np.float32]
# What the frozen layers leave; where nothing is frozen, the pixels.
Features = NDArray[np.float32] | NDArray[np.uint8]
NEXT = "_next"
BATCH = 32
SHORT_RUN_STEPS, LONG_RUN_STEPS = 75, 500  # 3 and 20 epochs on the device


class StepLoop:
    """A training step bound to its data and its state."""

    def __init__(
        self,
        session: ort.InferenceSession,
        features: Features,  # (N, P, C), input of the first tuned layer
        labels: Array,  # (N, 3)
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
        """Train on the crops `rows`, all rates times `factor`.

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
        """Other crops in the place of those the loop has: `rows` are then among these.

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


def short_run_factor(gain: float, steps: int) -> float:
    """What the rates of a run of this length are multiplied with.

    `gain` for up to 75 steps, nothing from 500 on, and a power of the length between: a short run
    has to take large steps, and is over before these could lead it astray.
    """
    shortness = log(LONG_RUN_STEPS / max(1, steps)) / log(LONG_RUN_STEPS / SHORT_RUN_STEPS)
    return float(gain ** min(1.0, max(0.0, shortness)))


def rate_factor(step: int, steps: int) -> float:
    """Linear decay of all rates, from 1 at step 0 to nothing at step `steps`.

    A constant rate leaves the weights wandering about their optimum; this lets them settle.
    """
    return 1.0 - step / steps


def batches(count: int, rng: np.random.Generator) -> Iterator[NDArray[np.int64]]:
    """Rows of every batch of one epoch over `count` crops, shuffled; the last may be smaller."""
    order = rng.permutation(count)
    for start in range(0, count, BATCH):
        yield order[start : start + BATCH]


def tune(
    loop: StepLoop,
    count: int,
    epochs: int,
    rng: np.random.Generator,
    after_epoch: Callable[[int, float], None],
) -> None:
    """Run `epochs` passes over the first `count` crops; `after_epoch` gets its number and loss."""
    step, steps = 0, epochs * -(-count // BATCH)
    for epoch in range(1, epochs + 1):
        losses = []
        for rows in batches(count, rng):
            losses.append(loop.step(rows, rate_factor(step, steps)))
            step += 1
        after_epoch(epoch, float(np.mean(losses)))
