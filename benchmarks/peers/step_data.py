"""The job of every peer: some batches of a real demonstration, and the losses of the first steps.

    python step_data.py frame.png BUNDLE LAYERS STEPS out.npz

Peers compute in float on maps (N, C, H, W), so codes become what they stand for. The losses are
those of this project's own backpropagation: a peer whose losses are others does another job.
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper
from steps import CHECKED_STEPS

from qsgm.blocks import one_block
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp.task import task_of
from qsgm.grasp.teach import prepare_object
from qsgm.images import read_demonstration
from qsgm.manifest import step_file
from qsgm.schedule import BATCH, MOMENTUM, batches
from qsgm.tune.loop import StepLoop
from qsgm.tune.plan import resolve
from qsgm.tune.prepare import Prepared
from qsgm.tune.settings import Settings

CROPS = 4 * BATCH  # few enough to stay in a cache: copying them is not what is compared
RATE = 0.01
ANGLE_WEIGHT = 1.0  # of the loss's squared part

Array = NDArray[np.float32]


def step_data(frame: NDArray[np.uint8], bundle: Bundle, layers: int, steps: int) -> dict[str, Any]:
    """Everything a peer gets, as arrays by name.

    `features` (N, C, H, W), `labels` (N, 3); `rows` (steps, 32), a batch each; `weight{k}` (Co, Ci,
    kh, kw) and `bias{k}` (Co,) with `strides` and `pools` (side of the average, 1: none) per layer;
    `rate`, `momentum`; the loss's `encoding`, `smoothing` and `angle_weight`; and the losses of the
    first steps, `losses` with momentum and `plain_losses` without.
    """
    plan = resolve(Settings(method="bp", layers=layers, trunk="float"), bundle)
    prepared, task = prepare_object(frame, bundle, plan), task_of(bundle)
    rows, chosen = batch_rows(steps), [bundle.network.layer(number) for number in plan.layers]
    return {
        "features": maps(prepared),
        "labels": prepared.labels[:CROPS],
        "rows": rows,
        **bundle.start_weights(plan.layers),
        "layers": np.array(plan.layers),
        "strides": np.array([layer.stride[0] for layer in chosen]),
        "pools": np.array([layer.pool[0] for layer in chosen]),
        "rate": np.float32(RATE),
        "momentum": np.float32(MOMENTUM),
        "encoding": np.array(task.encoding),
        "smoothing": np.float32(task.label_smoothing),
        "angle_weight": np.float32(ANGLE_WEIGHT),
        "losses": momentum_losses(prepared, rows[:CHECKED_STEPS]),
        "plain_losses": plain_losses(prepared, rows[:CHECKED_STEPS]),
    }


def batch_rows(steps: int) -> NDArray[np.int64]:
    """Rows of so many batches (steps, 32), epoch after epoch."""
    rng = np.random.default_rng(0)
    epochs = -(-steps * BATCH // CROPS)
    some = [rows for _ in range(epochs) for rows in batches(CROPS, rng)]
    return np.stack(some[:steps])


def maps(prepared: Prepared) -> Array:
    """The tuned layers' input (N, C, H, W) as they see it."""
    features = prepared.features[:CROPS].astype(np.float32)
    layers, network = prepared.plan.layers, prepared.bundle.network
    if layers[0] == 1:
        features = features / np.float32(127.5) - np.float32(1)
    elif prepared.features.dtype == np.uint8:
        features *= code_steps(prepared)
    square = features.reshape(len(features), *network.before(layers[0]), -1)
    return np.ascontiguousarray(square.transpose(0, 3, 1, 2))


def code_steps(prepared: Prepared) -> Array:
    """What one step of every channel's u8 code stands for, (C,)."""
    graph = onnx.load(prepared.bundle.folder / prepared.plan.trunk_file).graph
    (rounding,) = (node for node in graph.node if node.op_type == "QuantizeLinear")
    (steps,) = (value for value in graph.initializer if value.name == rounding.input[1])
    return numpy_helper.to_array(steps)


def momentum_losses(prepared: Prepared, rows: NDArray[np.int64]) -> Array:
    """Loss of every batch (S, 32) before its step of SGD with momentum."""
    loop = own_loop(prepared, prepared.start)
    return np.array([loop.step(batch) for batch in rows], np.float32)


def plain_losses(prepared: Prepared, rows: NDArray[np.int64]) -> Array:
    """The same without momentum: every step starts from none."""
    weights, losses = prepared.start, []
    for batch in rows:
        loop = own_loop(prepared, weights)
        losses.append(loop.step(batch))
        weights = loop.weights()
    return np.array(losses, np.float32)


def own_loop(prepared: Prepared, weights: dict[str, Array]) -> StepLoop:
    """This project's backpropagation."""
    blocks = one_block(prepared.plan.layers)
    session = prepared.bundle.session(step_file("float", "sgd", blocks))
    rates = dict.fromkeys(blocks.layers, RATE)
    return StepLoop(session, prepared.features, prepared.labels, weights, rates)


def main() -> None:
    """Write one job."""
    frame, folder, layers, steps, output = sys.argv[1:]
    demonstration = read_demonstration(Path(frame))
    np.savez(output, **step_data(demonstration, load_bundle(Path(folder)), int(layers), int(steps)))


if __name__ == "__main__":
    main()
