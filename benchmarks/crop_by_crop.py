"""What it costs and saves to run layers with many windows crop by crop inside a step.

    python benchmarks/crop_by_crop.py sgm.pt

A float step of 3 to 6 layers, each on its own, with the limit on a crop's windows above which a
layer goes crop by crop: out of reach, as shipped, and below layer 4's. Milliseconds are medians of
variants that take turns; megabytes are activations alive at once.
"""

import sys
import tempfile
from math import inf
from pathlib import Path

import onnx
from rich.console import Console
from rich.table import Table

from qsgm.bench.timing import median_seconds
from qsgm.blocks import Blocks, single_layers
from qsgm.runtime import open_session
from qsgm.schedule import BATCH
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.graphs import layers
from qsgm.train.graphs.memory import live_peak, traced
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.step import step_model
from qsgm.train.quantization.calibration_runs import Trainee, prepare
from qsgm.tune.noop_step import noop_step
from qsgm.weights import to_step_layout

LIMITS = {"at once": inf, "as shipped": layers.MANY_WINDOWS, "layer 4, too": 20}
TUNED, TURNS = range(3, 7), 30


def step(trainee: Trainee, tuned: int, limit: float) -> onnx.ModelProto:
    """With layers of more windows than the limit crop by crop."""
    layers.MANY_WINDOWS = limit
    checkpoint, blocks = trainee.checkpoint, single_layers(trainee.network.last(tuned))
    curvatures = {k: one.arrays() for k, one in checkpoint.curvatures.items()}
    heads = checkpoint.task.heads
    return step_model(trainee.net, blocks, trainee.sgms, heads, Sgd(), curvatures)


def peak_megabytes(model: onnx.ModelProto, start: dict, blocks: Blocks) -> float:
    """Of activations in a step of 32 crops."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "step.onnx"
        onnx.save(model, path)
        trace = traced(path, lambda s: noop_step(s, start, blocks, BATCH)())
    return live_peak(trace.nodes, trace.bound).bytes / 1e6


def main(path: Path) -> None:
    """Print the table."""
    trainee = prepare(load_checkpoint(path))
    table = Table(
        "tuned layers", *(f"{name}{unit}" for name in LIMITS for unit in (" [ms]", " [MB]"))
    )
    for tuned in TUNED:
        blocks, start = single_layers(trainee.network.last(tuned)), {}
        for number in blocks.layers:
            layer = trainee.net.layers[number - 1]
            start |= {f"weight{number}": to_step_layout(layer.weight), f"bias{number}": layer.bias}
        models = {name: step(trainee, tuned, limit) for name, limit in LIMITS.items()}
        sessions = {name: open_session(one.SerializeToString()) for name, one in models.items()}
        jobs = {name: noop_step(s, start, blocks, BATCH) for name, s in sessions.items()}
        seconds = median_seconds(jobs, TURNS)
        cells = []
        for name, model in models.items():
            cells += [f"{1000 * seconds[name]:.2f}", f"{peak_megabytes(model, start, blocks):.2f}"]
        table.add_row(str(tuned), *cells)
    Console().print(table)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
