"""How a step's cost grows with batch, layers and width, a job's with its crops; int8 on its own.

Batch, layers and crops are timed on the bundle's own graphs, width on graphs built here, with
random weights (:mod:`qsgm.train.wide`) and otherwise as the exporter builds them. Whatever is
compared takes turns in one process, so that what else the machine does hits all of it; medians are
kept.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
from numpy.typing import NDArray

from qsgm import defaults
from qsgm.bench.frames import BenchFrame
from qsgm.bench.growth import CROPS, FEATURES, GrowthReport, Series
from qsgm.bench.step_jobs import median_seconds, start_of
from qsgm.bundle import Bundle, step_file
from qsgm.grasp.crops import CROPS as USUAL_CROPS
from qsgm.grasp.crops import TRAIN_CROPS, label_crops
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.train.growth_jobs import (
    METHODS,
    TUNED,
    Jobs,
    bundle_jobs,
    sgm_jobs,
    trunk_jobs,
    wide_jobs,
)
from qsgm.tune.loop import BATCH, Features, StepLoop, tune
from qsgm.tune.prepare import Array, Watch, ignore, running_graphs, see
from qsgm.tune.settings import Settings

# The layer whose SGM is timed alone, by the SGM's kernel.
LAYER_BEFORE = {1: 4, 3: 3}


@dataclass(frozen=True)
class Sizes:
    """What grows, and how often it is timed."""

    batches: Sequence[int] = (8, 16, 32, 64, 128)
    layers: Sequence[int] = (1, 2, 3, 4, 5, 6)
    widths: Sequence[int] = (1, 2, 4, 8)
    crops: Sequence[int] = (250, 500, 1000, 2000)
    epochs: int = defaults.EPOCHS  # of the jobs
    repeats: int = 100  # of every step, pass and SGM
    runs: int = 5  # of every stage of a job


def measure_growth(
    frame: BenchFrame, bundle: Bundle, threads: int, sizes: Sizes, watch: Watch
) -> GrowthReport:
    """Time everything.

    Args:
        frame: of which crops are cut.
        bundle: whose graphs and SGMs they are.
        threads: of ONNX Runtime.
        sizes: what is timed, and how often.
        watch: told about every size.

    Raises:
        QsgmError: the frame cannot be used, or a graph cannot be run.
    """

    def series(stage: str, some: Sequence[int], jobs: Callable[[int], Jobs]) -> Series:
        return timed(stage, some, jobs, sizes.repeats, watch)

    def sgms(kernel: int, layer: int) -> Series:
        hidden = [len(conv.bias) for conv in bundle.float_sgm(layer).convs[:-1]]
        some = {width * hidden[0]: [width * count for count in hidden] for width in sizes.widths}
        name = f"{kernel}x{kernel} SGM"
        return series(name, [*some], lambda size: sgm_jobs(layer, some[size], threads))

    layers = [tuned for tuned in sizes.layers if tuned <= bundle.most_layers]
    with running_graphs(bundle):
        return GrowthReport(
            bundle,
            frame.path,
            threads,
            sizes.repeats,
            sizes.epochs,
            series("batch", sizes.batches, lambda size: bundle_jobs(bundle, TUNED, size, threads)),
            series("layers", layers, lambda size: bundle_jobs(bundle, size, BATCH, threads)),
            series("width", sizes.widths, lambda size: wide_jobs(bundle, size, threads)),
            crops_series(frame, bundle, threads, sizes, watch),
            series("trunk", sizes.widths, lambda size: trunk_jobs(size, threads)),
            {
                kernel: sgms(kernel, layer)
                for kernel, layer in LAYER_BEFORE.items()
                if str(layer) in bundle.manifest["sgms"]
            },
        )


def timed(
    stage: str, sizes: Sequence[int], jobs: Callable[[int], Jobs], repeats: int, watch: Watch
) -> Series:
    """Seconds of the jobs that there are for each size."""
    series = {}
    for done, size in enumerate(sizes, start=1):
        series[size] = median_seconds(jobs(size), repeats)
        watch(stage, done, len(sizes))
    return series


def crops_series(
    frame: BenchFrame, bundle: Bundle, threads: int, sizes: Sizes, watch: Watch
) -> Series:
    """Seconds of a job's stages by its number of crops, whose usual share is trained on."""
    image = frame.read()
    runs: dict[int, list[dict[str, float]]] = {count: [] for count in sizes.crops}
    for done in range(1, sizes.runs + 1):
        for count, some in runs.items():
            some.append(stage_seconds(image, bundle, count, sizes.epochs, threads))
        watch("stages", done, sizes.runs)
    return {
        count: {stage: median(run[stage] for run in some) for stage in some[0]}
        for count, some in runs.items()
    }


def stage_seconds(
    image: NDArray[np.uint8],  # (H, W, 3) BGR
    bundle: Bundle,
    count: int,
    epochs: int,
    threads: int,
) -> dict[str, float]:
    """Of one job on so many crops: cutting them, their features, and tuning by each method."""
    height, width = image.shape[:2]
    demonstration = Demonstration(image, (width / 2, height / 2))
    things = bundle.distractors()
    crops = crop_source([demonstration], things, np.random.default_rng(0), count)
    seconds = {CROPS: 0.0, FEATURES: 0.0}
    settings = Settings(layers=TUNED, threads=threads)
    features = see(crops, bundle, settings, seconds, ignore)
    labels, trained = label_crops(crops.plan), count * TRAIN_CROPS // USUAL_CROPS
    for method in METHODS:
        loop = method_loop(method, features, labels, bundle, threads)
        began = time.perf_counter()
        tune(loop, trained, epochs, np.random.default_rng(0), lambda _epoch, _loss: None)
        seconds[method] = time.perf_counter() - began
    return seconds


def method_loop(
    method: str, features: Features, labels: Array, bundle: Bundle, threads: int
) -> StepLoop:
    """Steps of SGD at a rate of 0 on features (N, P, C) and labels (N, 3): nothing diverges."""
    precision, blocks_of = METHODS[method]
    blocks = blocks_of(TUNED)
    session = bundle.session(step_file(precision, "sgd", blocks), threads)
    rates = dict.fromkeys(blocks.layers, 0.0)
    return StepLoop(session, features, labels, start_of(bundle, TUNED), rates)
