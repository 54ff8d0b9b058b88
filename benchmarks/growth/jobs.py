"""What takes turns when growth is measured: steps, passes and SGMs, ready to be called."""

import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import ModelProto, TensorProto, numpy_helper
from wide import (
    WideNet,
    hidden_channels,
    quantized,
    random_curvature,
    random_sgm,
    sgm_model,
    wide_net,
)

from qsgm import defaults
from qsgm.bench.timing import Job, forward_job, median_seconds
from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.crops import CROPS as USUAL_CROPS
from qsgm.grasp.crops import TRAIN_CROPS, label_crops
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.source import crop_source
from qsgm.grasp.task import distractors_of
from qsgm.grasp.teach import as_demonstrations
from qsgm.manifest import Precision, step_file
from qsgm.progress import ignore
from qsgm.runtime import open_session
from qsgm.schedule import BATCH
from qsgm.sgm.int8 import ActivationBits
from qsgm.task import label_span
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.probe import head_model
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.graphs.trunk import int8_trunk_model, trunk_model
from qsgm.tune.features import SLICE, feature_source
from qsgm.tune.loop import StepLoop, run_epochs
from qsgm.tune.noop_step import noop_step, start_of
from qsgm.tune.plan import resolve
from qsgm.tune.settings import Settings

TUNED = defaults.LAYERS
RUNS = 5  # of every stage of a job
METHODS: Mapping[str, tuple[Precision, Callable[[range], Blocks]]] = {
    "backprop": ("float", one_block),
    "sgm_float": ("float", single_layers),
    "sgm_int8": ("int8", single_layers),
}
Jobs = dict[str, Job]  # by variant
# Milliseconds by size, then by variant.
Series = dict[int, dict[str, float]]


def series(sizes: Sequence[int], repeats: int, jobs: Callable[..., Jobs]) -> Series:
    """Milliseconds of the jobs that there are for each size."""
    found = {}
    for size in sizes:
        seconds = median_seconds(jobs(size), repeats)
        found[size] = {name: 1000 * one for name, one in seconds.items()}
    return found


def crops_series(
    image: Any, bundle: Bundle, counts: Sequence[int], epochs: int, threads: int
) -> Series:
    """Milliseconds of a job's stages by its number of crops, whose usual share is trained on."""
    runs: dict[int, list[dict[str, float]]] = {count: [] for count in counts}
    for _ in range(RUNS):
        for count, some in runs.items():
            some.append(stage_seconds(image, bundle, count, epochs, threads))
    return {
        count: {stage: 1000 * median(run[stage] for run in some) for stage in some[0]}
        for count, some in runs.items()
    }


def stage_seconds(
    image: Any, bundle: Bundle, count: int, epochs: int, threads: int
) -> dict[str, float]:
    """One job on so many crops: cutting them, their features, and tuning by each method."""
    plan = resolve(Settings(layers=TUNED, threads=threads), bundle)
    rng, things = np.random.default_rng(0), distractors_of(bundle)
    crops = crop_source(as_demonstrations(image), things, rng, count)
    seconds = {"crops": 0.0, "features": 0.0}
    lesson = GraspLesson(crops, taught=count * TRAIN_CROPS // USUAL_CROPS)
    features = feature_source(lesson, bundle, plan, seconds, ignore).of(np.arange(count))
    labels = label_crops(crops.plan)
    for method, (precision, blocks_of) in METHODS.items():
        blocks = blocks_of(plan.layers)
        session = bundle.session(step_file(precision, "sgd", blocks), threads)
        rates = dict.fromkeys(blocks.layers, 0.0)  # nothing diverges
        loop = StepLoop(session, features, labels, start_of(bundle, plan.layers), rates)
        began = time.perf_counter()
        rng = np.random.default_rng(0)
        run_epochs(loop.step, lesson.taught, epochs, rng, lambda _epoch, _loss: None)
        seconds[method] = time.perf_counter() - began
    return seconds


def wide_jobs(bundle: Bundle, threads: int, width: int) -> Jobs:
    """A pass and steps with wider layers, and with SGMs that are as much wider."""
    wide, layers = wide_net(bundle.network, width), bundle.network.last(TUNED)
    start = wide.start(layers)
    head = opened(head_model(wide.net, TUNED, bundle.manifest.heads), threads)
    jobs = {"forward": forward_job(head, start)}
    for name, model in wide_steps(bundle, wide, width).items():
        blocks = one_block(layers) if name == "backprop" else single_layers(layers)
        jobs[name] = noop_step(opened(model, threads), start, blocks)
    return jobs


def wide_steps(bundle: Bundle, wide: WideNet, width: int) -> dict[str, ModelProto]:
    """Steps of SGD, by variant: with SGMs as the bundle's, and with ones `width` times as wide.

    As in the bundle, curvatures bend the gradients that SGMs give, and no others.
    """
    net, heads, layers = wide.net, bundle.manifest.heads, bundle.network.last(TUNED)
    blocks = single_layers(layers)
    curvatures = {k: random_curvature(net.network, k) for k in layers}

    def step(sgms: Mapping[int, AnySgm]) -> ModelProto:
        return step_model(net, blocks, sgms, heads, Sgd(), curvatures)

    steps = {"backprop": step_model(net, one_block(layers), {}, heads, Sgd())}
    for hidden, kind in ((1, ""), (width, "_wider")):
        sgms = {
            k: random_sgm(net.network, k, hidden_channels(bundle, k, hidden))
            for k in blocks.sgm_layers
        }
        int8 = {k: quantized(s, bundle.activation_bits(k), heads) for k, s in sgms.items()}
        steps |= {f"sgm_float{kind}": step(sgms), f"sgm_int8{kind}": step(int8)}
    return steps


def trunk_jobs(bundle: Bundle, threads: int, width: int) -> Jobs:
    """The frozen layers on a slice of crops, in float and in int8."""
    network = bundle.network
    wide, frozen = wide_net(network, width), network.depth - TUNED
    crops = np.random.default_rng(0).integers(0, 256, (SLICE, *network.input_shape), np.uint8)
    int8 = int8_trunk_model(wide.net, wide.int8_trunk, frozen)
    models = {
        "float": trunk_model(wide.net, frozen),
        "int8_8_u8": int8,
        "int8_8_s8": with_s8_weights(int8),
    }
    feeds = {int8.graph.input[0].name: crops}
    return {name: run_job(opened(model, threads), feeds) for name, model in models.items()}


def sgm_jobs(bundle: Bundle, layer: int, threads: int, width: int) -> Jobs:
    """The SGM behind a layer alone on a batch, its hidden convolutions so many times as wide."""
    network, heads = bundle.network, bundle.manifest.heads
    sgm = random_sgm(network, layer, hidden_channels(bundle, layer, width))
    models = {"float": sgm_model(sgm, network)}
    kinds: tuple[ActivationBits, ...] = (16, 8)
    for bits in kinds:
        int8 = sgm_model(quantized(sgm, bits, heads), network)
        models |= {f"int8_{bits}_u8": int8, f"int8_{bits}_s8": with_s8_weights(int8)}
    rng, rows = np.random.default_rng(0), BATCH * network.positions_after(layer)
    feeds = {
        "activation": rng.uniform(0, 1, (rows, network.layer(layer).out)).astype(np.float32),
        "labels": rng.uniform(*label_span(heads), (BATCH, network.outputs)).astype(np.float32),
    }
    return {name: run_job(opened(model, threads), feeds) for name, model in models.items()}


def run_job(session: ort.InferenceSession, feeds: Mapping[str, Any]) -> Job:
    """A graph on the same inputs again and again."""
    return lambda: session.run(None, feeds)


def opened(model: ModelProto, threads: int) -> ort.InferenceSession:
    """A session of a graph that was built here."""
    return open_session(model.SerializeToString(), threads)


def with_s8_weights(model: ModelProto) -> ModelProto:
    """The same graph, its u8 weights and their zero point both lower by the zero point.

    It multiplies u8 by s8: exactly where the CPU has VNNI, elsewhere sums saturate.
    """
    signed = constants_folded(model)
    constants = {tensor.name: tensor for tensor in signed.graph.initializer}
    for node in signed.graph.node:
        weight = constants.get(node.input[0]) if node.op_type == "DequantizeLinear" else None
        if weight is None or weight.data_type != TensorProto.UINT8:
            continue
        zero = numpy_helper.to_array(constants[node.input[2]]).astype(np.int16)
        codes = numpy_helper.to_array(weight).astype(np.int16)
        lower = (codes - zero.reshape(-1, *[1] * (codes.ndim - 1))).astype(np.int8)
        # New ones: others may read the same weight, or have the same zero point.
        for i, array in ((0, lower), (2, np.zeros_like(zero, np.int8))):
            name = f"{node.output[0]}/{i}"
            signed.graph.initializer.append(numpy_helper.from_array(array, name))
            node.input[i] = name
    return signed


def constants_folded(model: ModelProto) -> ModelProto:
    """The same graph, what it computes of constants alone computed."""
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_ENABLE_BASIC
    options.log_severity_level = 3
    with tempfile.TemporaryDirectory() as folder:
        options.optimized_model_filepath = str(Path(folder) / "folded.onnx")
        ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
        return onnx.load(options.optimized_model_filepath)
