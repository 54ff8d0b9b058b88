"""Training steps and forward passes, timed in turns: the bundle's own graphs on random features."""

import time
from collections.abc import Callable, Mapping
from statistics import median
from typing import Any

from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.bundle import Bundle
from qsgm.manifest import PRECISIONS, Precision, head_file, step_file
from qsgm.schedule import BATCH
from qsgm.tune.graphs import running_graphs
from qsgm.tune.noop_step import noop_step, random_features, start_of

Job = Callable[[], object]


def step_seconds(bundle: Bundle, tuned: int, repeats: int, threads: int) -> dict[str, float]:
    """Median seconds of a step by variant, and of a forward pass, which take turns."""
    with running_graphs(bundle):
        return median_seconds(step_jobs(bundle, tuned, threads), repeats)


def median_seconds(
    jobs: Mapping[str, Job], repeats: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Of each job, by a clock; they take turns."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(-1, repeats):  # the first turn allocates and does not count
        for name, job in jobs.items():
            began = clock()
            job()
            if turn >= 0:
                times[name].append(clock() - began)
    return {name: median(some) for name, some in times.items()}


def check_steps(bundle: Bundle, tuned: int) -> None:
    """Raise QsgmError unless the bundle has what :func:`step_seconds` opens."""
    layers = bundle.network.last(tuned)
    for precision in PRECISIONS:
        bundle.graph_path(step_file(precision, "sgd", single_layers(layers)))
    for name in (head_file(tuned), step_file("float", "sgd", one_block(layers))):
        bundle.graph_path(name)


def step_jobs(bundle: Bundle, tuned: int, threads: int, batch: int = BATCH) -> dict[str, Job]:
    """A forward pass of the last layers, and a step of SGD by every method."""
    head, layers = bundle.session(head_file(tuned), threads), bundle.network.last(tuned)
    return {
        "forward": forward_job(head, start_of(bundle, layers), batch),
        "backprop": step_job(bundle, "float", one_block(layers), threads, batch),
        "sgm_float": step_job(bundle, "float", single_layers(layers), threads, batch),
        "sgm_int8": step_job(bundle, "int8", single_layers(layers), threads, batch),
    }


def forward_job(session: Any, start: Mapping[str, Any], batch: int = BATCH) -> Job:
    """The tuned layers, by a session of their head, without training."""
    feeds = {"features": random_features(session, batch), **start}
    return lambda: session.run(["outputs"], feeds)


def step_job(
    bundle: Bundle, precision: Precision, blocks: Blocks, threads: int, batch: int = BATCH
) -> Job:
    """A step of SGD that changes no weight."""
    session = bundle.session(step_file(precision, "sgd", blocks), threads)
    return noop_step(session, start_of(bundle, blocks.layers), blocks, batch)
