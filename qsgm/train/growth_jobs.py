"""What takes turns when growth is measured (host): steps, passes and SGMs, ready to be called."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import ModelProto, TensorProto, numpy_helper

from qsgm import defaults
from qsgm.bench.growth import (
    ALONE,
    BP,
    FLOAT,
    FLOAT_WIDER,
    FORWARD,
    INT8,
    INT8_WIDER,
    S8_8,
    S8_16,
    U8_8,
    U8_16,
)
from qsgm.bench.step_jobs import forward_job, start_of, still_loop
from qsgm.blocks import LAYERS, Blocks, one_block, single_layers, tuned_layers
from qsgm.bundle import Bundle, Precision, head_file, step_file
from qsgm.runtime import open_session
from qsgm.sgm.int8 import LABEL_HIGH, LABEL_LOW, LABELS, ActivationBits
from qsgm.train.graphs.layers import CROP_SIDE, input_side
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.probe import head_model
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.graphs.trunk import int8_trunk_model, trunk_model
from qsgm.train.model.graspnet import CHANNELS, Loss
from qsgm.train.wide import (
    WideNet,
    quantized,
    random_curvature,
    random_net,
    random_sgm,
    sgm_model,
    wide_net,
    wide_sgms,
)
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import SLICE

TUNED = defaults.LAYERS
METHODS: Mapping[str, tuple[Precision, Callable[[int], Blocks]]] = {
    BP: ("float", one_block),
    FLOAT: ("float", single_layers),
    INT8: ("int8", single_layers),
}
Job = Callable[[], object]
Jobs = dict[str, Job]  # by variant


def bundle_jobs(bundle: Bundle, tuned: int, batch: int, threads: int) -> Jobs:
    """A forward pass and a step of each method on so many crops, by the bundle's graphs."""
    start = start_of(bundle, tuned)
    jobs = {FORWARD: forward_job(bundle.session(head_file(tuned), threads), start, batch)}
    for name, (precision, blocks) in METHODS.items():
        session = bundle.session(step_file(precision, "sgd", blocks(tuned)), threads)
        jobs[name] = still_loop(session, start, blocks(tuned), batch)
    return jobs


def wide_jobs(bundle: Bundle, width: int, threads: int) -> Jobs:
    """The same with wider layers, and with SGMs that are as much wider."""
    wide, layers = wide_net(width), tuned_layers(TUNED)
    start = wide.start(layers)
    head = opened(head_model(wide.net, TUNED, bundle.encoding), threads)
    jobs = {FORWARD: forward_job(head, start)}
    for name, model in wide_steps(bundle, wide, width).items():
        blocks = one_block(TUNED) if name == BP else single_layers(TUNED)
        jobs[name] = still_loop(opened(model, threads), start, blocks, BATCH)
    return jobs


def wide_steps(bundle: Bundle, wide: WideNet, width: int) -> dict[str, ModelProto]:
    """Steps of SGD, by variant: with SGMs as the bundle's, and with ones `width` times as wide.

    As in the bundle, curvatures bend the gradients that SGMs give, and no others.
    """
    net, loss, blocks = wide.net, Loss(bundle.encoding), single_layers(TUNED)
    curvatures = {k: random_curvature(net, k) for k in blocks.layers}

    def step(sgms: Mapping[int, AnySgm]) -> ModelProto:
        return step_model(net, blocks, sgms, loss, Sgd(), curvatures)

    steps = {BP: step_model(net, one_block(TUNED), {}, loss, Sgd())}
    for hidden, floating, int8 in ((1, FLOAT, INT8), (width, FLOAT_WIDER, INT8_WIDER)):
        sgms = wide_sgms(bundle, blocks.sgm_layers, width, hidden)
        steps[floating] = step(sgms)
        steps[int8] = step({k: quantized(s, bundle.activation_bits(k)) for k, s in sgms.items()})
    return steps


def trunk_jobs(width: int, threads: int) -> Jobs:
    """The frozen layers on a slice of crops, in float and in int8."""
    wide, frozen = wide_net(width), LAYERS - TUNED
    shape = (SLICE, CROP_SIDE, CROP_SIDE, CHANNELS[0])
    feeds = {"crops": np.random.default_rng(0).integers(0, 256, shape, np.uint8)}
    int8 = int8_trunk_model(wide.net, wide.int8_trunk, frozen)
    sessions = {
        ALONE: opened(trunk_model(wide.net, frozen), threads),
        U8_8: opened(int8, threads),
        S8_8: opened(with_s8_weights(int8), threads),
    }
    return {name: run_job(session, feeds) for name, session in sessions.items()}


def sgm_jobs(layer: int, hidden: Sequence[int], threads: int) -> Jobs:
    """The SGM behind a layer alone on a batch, its hidden convolutions as wide as these."""
    channels, side = CHANNELS[layer], input_side(random_net(1), layer + 1)
    sgm = random_sgm(layer, channels, hidden)
    sessions = {ALONE: opened(sgm_model(sgm, channels, side), threads)}
    kinds: tuple[tuple[ActivationBits, str, str], ...] = ((16, U8_16, S8_16), (8, U8_8, S8_8))
    for bits, u8, s8 in kinds:
        int8 = sgm_model(quantized(sgm, bits), channels, side)
        sessions |= {u8: opened(int8, threads), s8: opened(with_s8_weights(int8), threads)}
    rng = np.random.default_rng(0)
    feeds = {
        "activation": rng.uniform(0, 1, (BATCH * side**2, channels)).astype(np.float32),
        "labels": rng.uniform(LABEL_LOW, LABEL_HIGH, (BATCH, LABELS)).astype(np.float32),
    }
    return {name: run_job(session, feeds) for name, session in sessions.items()}


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
