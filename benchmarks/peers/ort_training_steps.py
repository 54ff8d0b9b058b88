"""A training step of onnxruntime-training: artifacts are generated, then trained on.

    python ort_training_steps.py data.npz THREADS SECONDS

prints one JSON object. The data are those of step_data.py. Nothing of qsgm is imported. The only
SGD it has knows no momentum, so that its step does less than the others'.
"""

import importlib
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import numpy_helper, parser
from steps import Step, tell, timed_steps

TRAINING = ("onnxruntime.training.artifacts", "onnxruntime.training.api")

# The softplus of a logit is minus the logarithm of the sigmoid of its opposite, whose operators
# have gradients.
LOSS = """
    logit, turned = Split <axis = 1> (raw, sizes)
    label, direction = Split <axis = 1> (labels, sizes)
    kept = Mul (label, one_less_smoothing)
    target = Add (kept, half_smoothing)
    opposite = Neg (logit)
    unlikely = Sigmoid (opposite)
    logarithm = Log (unlikely)
    drawn = Mul (target, logit)
    likelihood = Add (logarithm, drawn)
    unlikelihood = Neg (likelihood)
    quality = ReduceMean <keepdims = 0> (unlikelihood)
    miss = Sub (direction, activated)
    square = Mul (miss, miss)
    counted = Mul (square, label)
    mean_miss = ReduceMean <keepdims = 0> (counted)
    angle = Mul (mean_miss, twice_angle_weight)
    loss = Add (quality, angle)
"""
ACTIVATIONS = {
    "double": "activated = Tanh (turned)",
    "paper": """
    first, second = Split <axis = 1> (turned)
    sine = Tanh (first)
    cosine = Sigmoid (second)
    activated = Concat <axis = 1> (sine, cosine)""",
}


def loss_model(data: Mapping[str, Any]) -> onnx.ModelProto:
    """Features and labels of one batch to the loss, with the weights as initializers."""
    batch, shape = data["rows"].shape[1], ",".join(map(str, data["features"].shape[1:]))
    model = parser.parse_model(f"""
<ir_version: 8, opset_import: ["": 14]>
step (float[{batch},{shape}] features, float[{batch},3] labels) => (float loss) {{
    {layer_nodes(data)}
    {LOSS.replace("miss =", ACTIVATIONS[str(data["encoding"])] + chr(10) + "    miss =", 1)}
}}""")
    for node in model.graph.node:
        node.name = node.output[0]  # generating artifacts takes equal names for one node
    smoothing, angle_weight = float(data["smoothing"]), float(data["angle_weight"])
    values = {
        "sizes": np.array([1, 2]),
        "one_less_smoothing": np.array(1 - smoothing, np.float32),
        "half_smoothing": np.array(smoothing / 2, np.float32),
        "twice_angle_weight": np.array(2 * angle_weight, np.float32),
        **{name: data[name] for name in weight_names(data)},
    }
    model.graph.initializer.extend(
        numpy_helper.from_array(value, name) for name, value in values.items()
    )
    return model


def weight_names(data: Mapping[str, Any]) -> list[str]:
    """What is trained."""
    return [f"{kind}{number}" for number in data["layers"] for kind in ("weight", "bias")]


def layer_nodes(data: Mapping[str, Any]) -> str:
    """The tuned layers, from `features` to `raw` (B, 3)."""
    lines, x, last = [], "features", data["layers"][-1]
    for k, stride, side in zip(*(data[n] for n in ("layers", "strides", "pools")), strict=True):
        steps = f"strides = [{stride},{stride}]"
        lines.append(f"conv{k} = Conv <{steps}> ({x}, weight{k}, bias{k})")
        x = f"conv{k}"
        if k != last:
            lines.append(f"relu{k} = Relu ({x})")
            x = f"relu{k}"
        if side > 1:
            lines.append(f"pool{k} = AveragePool <kernel_shape = [{side},{side}]> ({x})")
            x = f"pool{k}"
    return "\n    ".join([*lines, f"raw = Flatten ({x})"])


def training_step(data: Mapping[str, Any], threads: int, home: Path) -> Step:
    """Forward, backward and SGD, with artifacts in the folder `home`."""
    from onnxruntime.training import artifacts
    from onnxruntime.training.api import CheckpointState, Module, Optimizer

    artifacts.generate_artifacts(
        loss_model(data),
        requires_grad=weight_names(data),
        optimizer=artifacts.OptimType.SGD,
        artifact_directory=str(home),
    )
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 3
    state = CheckpointState.load_checkpoint(str(home / "checkpoint"))
    module = Module(str(home / "training_model.onnx"), state, session_options=options)
    optimizer = Optimizer(str(home / "optimizer_model.onnx"), module)
    optimizer.set_learning_rate(float(data["rate"]))
    module.train()

    def step(x: Any, labels: Any) -> float:
        loss = float(module(x, labels))
        optimizer.step()
        module.lazy_reset_grad()
        return loss

    return step


def main() -> None:
    """Run once and print what came of it."""
    path, threads, seconds = sys.argv[1:]
    for module in TRAINING:
        importlib.import_module(module)
    imported_at, began = time.time(), time.perf_counter()
    data = dict(np.load(path))
    with tempfile.TemporaryDirectory() as home:
        step = training_step(data, int(threads), Path(home))
        built = time.perf_counter() - began
        arrays = (data[name] for name in ("features", "labels", "rows"))
        tell(ort.__version__, imported_at, built, *timed_steps(step, *arrays, float(seconds)))


if __name__ == "__main__":
    main()
