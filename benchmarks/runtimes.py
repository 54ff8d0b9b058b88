"""A whole run of tuning in other runtimes than ONNX Runtime, on the same features and batches.

    qsgm slim --without-scan -o robot
    python benchmarks/runtimes.py robot object.png

Runs `robot`'s steps with SGMs in float and in int8 in ONNX Runtime, onnx's reference evaluator, and
OpenVINO and tract where they are installed (`pip install openvino tract`), state in and out by way
of numpy, one thread each. Told are CPU time per step, how far weights come apart, and what the
tuned network makes of the held-out crops.
"""

import argparse
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx.reference import ReferenceEvaluator
from rich.console import Console
from rich.table import Table

from qsgm.bundle import load_bundle
from qsgm.grasp.teach import prepare_object
from qsgm.images import read_demonstration
from qsgm.manifest import PRECISIONS
from qsgm.schedule import batches, rate_factor, steps_per_epoch
from qsgm.tune.plan import Plan, resolve
from qsgm.tune.prepare import Prepared, validate
from qsgm.tune.settings import Settings

# isort: split
import onnxruntime as ort  # behind qsgm, which keeps it from reporting home

Arrays = dict[str, NDArray]
Run = Callable[[Arrays], Arrays]
# (file, outputs' names, inputs of the shapes that are to come) -> a graph that is ready to run
Open = Callable[[Path, Sequence[str], Arrays], Run]
TRACT_TYPES = {"float32": "f32", "uint8": "u8", "int64": "i64"}


def open_onnx_runtime(path: Path, outputs: Sequence[str], _inputs: Arrays) -> Run:
    """Stock ONNX Runtime, one thread."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(path, options, ["CPUExecutionProvider"])
    return lambda inputs: dict(zip(outputs, session.run(outputs, inputs), strict=True))


def open_reference(path: Path, outputs: Sequence[str], _inputs: Arrays) -> Run:
    """onnx's own evaluator, in numpy."""
    model = ReferenceEvaluator(onnx.load(path))

    def run(inputs: Arrays) -> Arrays:
        with np.errstate(over="ignore"):  # a gate is so steep that it overflows, and is clipped
            return dict(zip(outputs, model.run(list(outputs), inputs), strict=True))

    return run


def open_openvino(path: Path, outputs: Sequence[str], _inputs: Arrays) -> Run:
    """OpenVINO on the CPU, in float32: by itself it takes bfloat16 where a CPU has it."""
    import openvino

    exact = {"INFERENCE_PRECISION_HINT": "f32", "INFERENCE_NUM_THREADS": 1}
    core = openvino.Core()
    model = core.compile_model(core.read_model(path), "CPU", exact)

    def run(inputs: Arrays) -> Arrays:
        found = model(inputs)
        return {name: np.array(found[name]) for name in outputs}

    return run


def open_tract(path: Path, outputs: Sequence[str], inputs: Arrays) -> Run:
    """The tract library, which wants every shape ahead."""
    import tract

    model = tract.onnx().load(path)
    names = [model.input_name(i) for i in range(model.input_count())]
    for i, name in enumerate(names):
        kind = TRACT_TYPES[str(inputs[name].dtype)]
        model.set_input_fact(i, ",".join([*map(str, inputs[name].shape), kind]))
    runnable = model.into_model().into_runnable()

    def run(inputs: Arrays) -> Arrays:
        found = runnable.run([np.array(inputs[name], order="C") for name in names])
        return {name: one.to_numpy() for name, one in zip(outputs, found, strict=True)}

    return run


RUNTIMES: dict[str, Open] = {
    "onnxruntime": open_onnx_runtime,
    "onnx": open_reference,
    "openvino": open_openvino,
    "tract": open_tract,
}


def tuned(open_graph: Open, prepared: Prepared, plan: Plan) -> tuple[Arrays, float]:
    """The weights behind a run, and CPU seconds per step."""
    path = prepared.bundle.folder / plan.step_file
    values = ort.InferenceSession(path, providers=["CPUExecutionProvider"])
    outputs = [value.name for value in values.get_outputs()]
    inputs: Arrays = {
        value.name: np.zeros([1 if isinstance(n, str) else n for n in value.shape], np.float32)
        for value in values.get_inputs()
    }
    inputs |= prepared.start | {"features": prepared.features, "labels": prepared.labels}
    rng = np.random.default_rng([plan.settings.seed, 1])
    order = [rows for _ in range(plan.epochs) for rows in batches(prepared.taught, rng)]
    steps = plan.epochs * steps_per_epoch(prepared.taught)
    rates = dict(zip(plan.layers, plan.recipe.rates_over(steps), strict=True))
    run = open_graph(path, outputs, inputs | {"rows": order[0]})
    began = time.process_time()
    for done, rows in enumerate(order):
        factor = rate_factor(done, steps)
        inputs |= {f"rate{k}": np.array(factor * rate, np.float32) for k, rate in rates.items()}
        found = run(inputs | {"rows": rows})
        inputs |= {name.removesuffix("_next"): found[name] for name in outputs if name != "loss"}
    seconds = (time.process_time() - began) / steps
    return {name: np.array(inputs[name]) for name in prepared.start}, seconds


def main() -> None:
    """Print the table."""
    arguments = argparse.ArgumentParser(description="Tuning in other runtimes.")
    arguments.add_argument("bundle", type=Path)
    arguments.add_argument("frame", type=Path)
    arguments.add_argument("--epochs", type=int, default=20)
    arguments.add_argument("--json", type=Path)
    given = arguments.parse_args()
    bundle = load_bundle(given.bundle)
    settings = Settings(layers=bundle.manifest.most_layers, epochs=given.epochs)
    settings = replace(settings, blocks=bundle.manifest.blocks[0])
    prepared = prepare_object(read_demonstration(given.frame), bundle, resolve(settings, bundle))
    table = Table("SGMs", "runtime", "ms", "weights apart", "detection", "angle")
    rows = []
    for precision in PRECISIONS:
        plan, weights = resolve(replace(settings, precision=precision), bundle), dict[str, Arrays]()
        for name, open_graph in RUNTIMES.items():
            if find_spec(name) is None:
                print(f"{name} is not installed: left out")
                continue
            weights[name], seconds = tuned(open_graph, prepared, plan)
            first = weights["onnxruntime"]
            apart = max(float(np.abs(weights[name][k] - first[k]).max()) for k in first)
            scores = validate(prepared, weights[name])
            detection, angle = scores["detection_accuracy"], scores["angle_mae_deg"]
            table.add_row(
                precision, name, f"{1e3 * seconds:.2f}", f"{apart:.1e}", f"{detection:.3f}",
                f"{angle:.3f}°",
            )  # fmt: skip
            rows.append(
                {"precision": precision, "runtime": name, "ms": 1e3 * seconds, "apart": apart}
                | {"detection_accuracy": detection, "angle_mae_deg": angle}
            )
    Console().print(table)
    if given.json:
        given.json.write_text(json.dumps(rows))


if __name__ == "__main__":
    main()
