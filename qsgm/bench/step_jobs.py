"""Steps and forward passes to be timed: the bundle's own graphs on random features."""

import time
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

import numpy as np

from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.bundle import PRECISIONS, Bundle, Precision, head_file, step_file
from qsgm.tune.loop import BATCH, StepLoop
from qsgm.tune.prepare import running_graphs
from qsgm.weights import to_step_layout


def step_seconds(bundle: Bundle, tuned: int, repeats: int, threads: int) -> dict[str, float]:
    """Median of a step's seconds by variant, which take turns."""
    jobs = {
        "forward": forward_job(bundle.session(head_file(tuned), threads), start_of(bundle, tuned)),
        "backprop": step_job(bundle, "float", one_block(tuned), threads),
        "sgm_float": step_job(bundle, "float", single_layers(tuned), threads),
        "sgm_int8": step_job(bundle, "int8", single_layers(tuned), threads),
    }
    with running_graphs(bundle):
        return median_seconds(jobs, repeats)


def median_seconds(jobs: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Of each job; they take turns."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(-1, repeats):  # the first turn allocates and does not count
        for name, job in jobs.items():
            began = time.perf_counter()
            job()
            if turn >= 0:
                times[name].append(time.perf_counter() - began)
    return {name: median(some) for name, some in times.items()}


def check_steps(bundle: Bundle, tuned: int) -> None:
    """Raise QsgmError unless the bundle has what :func:`step_seconds` opens."""
    for precision in PRECISIONS:
        bundle.graph_path(step_file(precision, "sgd", single_layers(tuned)))
    for name in (head_file(tuned), step_file("float", "sgd", one_block(tuned))):
        bundle.graph_path(name)


def forward_job(session: Any, start: Mapping[str, Any], batch: int = BATCH) -> Callable[[], object]:
    """The tuned layers, by a session of their head, on so many crops, without training."""
    feeds = {"features": random_features(session, batch), **start}
    return lambda: session.run(["outputs"], feeds)


def step_job(
    bundle: Bundle, precision: Precision, blocks: Blocks, threads: int
) -> Callable[[], object]:
    """A step of SGD on one batch at a rate of 0: the same work, and nothing can diverge."""
    session = bundle.session(step_file(precision, "sgd", blocks), threads)
    return still_loop(session, start_of(bundle, len(blocks.layers)), blocks, BATCH)


def still_loop(
    session: Any, start: Mapping[str, Any], blocks: Blocks, batch: int
) -> Callable[[], float]:
    """A step on so many crops that changes no weight."""
    labels = np.tile(np.array([1, 0, 1], np.float32), (batch, 1))
    rates = dict.fromkeys(blocks.layers, 0.0)
    loop = StepLoop(session, random_features(session, batch), labels, start, rates)
    rows = np.arange(batch)
    return lambda: loop.step(rows)


def random_features(session: Any, crops: int = BATCH) -> Any:
    """What a graph's input `features` takes, of so many crops: pixels or codes, or floats."""
    (features,) = (value for value in session.get_inputs() if value.name == "features")
    shape, rng = (crops, *features.shape[1:]), np.random.default_rng(0)
    if "uint8" in features.type:
        return rng.integers(0, 256, shape, np.uint8)
    return rng.uniform(0, 1, shape).astype(np.float32)


def start_of(bundle: Bundle, tuned: int) -> dict[str, Any]:
    """The starting weights in the step graphs' layout."""
    return {
        name: to_step_layout(value) if value.ndim > 1 else value
        for name, value in bundle.start_weights(tuned).items()
    }
