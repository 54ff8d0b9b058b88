"""A training step that changes nothing: what is timed, and whose memory is measured."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from qsgm.blocks import Blocks
from qsgm.bundle import Bundle
from qsgm.schedule import BATCH
from qsgm.tune.loop import StepLoop
from qsgm.tune.prepare import in_step_layout


def noop_step(
    session: Any, start: Mapping[str, Any], blocks: Blocks, batch: int = BATCH
) -> Callable[[], float]:
    """A step on one batch at a rate of 0: the same work, and nothing can diverge."""
    inputs = {value.name: value for value in session.get_inputs()}
    labels = np.zeros((batch, inputs["labels"].shape[1]), np.float32)
    rates = dict.fromkeys(blocks.layers, 0.0)
    loop = StepLoop(session, random_features(session, batch), labels, start, rates)
    rows = np.arange(batch)
    return lambda: loop.step(rows)


def random_features(session: Any, samples: int = BATCH) -> Any:
    """What a graph's input `features` takes, of so many samples: pixels or codes, or floats."""
    (features,) = (value for value in session.get_inputs() if value.name == "features")
    shape, rng = (samples, *features.shape[1:]), np.random.default_rng(0)
    if "uint8" in features.type:
        return rng.integers(0, 256, shape, np.uint8)
    return rng.uniform(0, 1, shape).astype(np.float32)


def start_of(bundle: Bundle, layers: range) -> dict[str, Any]:
    """The starting weights of the last layers in the layout of step graphs."""
    return in_step_layout(bundle.start_weights(layers))
