"""Graphs of a bundle in other runtimes than ONNX Runtime, which is what they are compared with.

Whichever is installed: `pip install openvino tract`. onnx's reference evaluator always is.
"""

import importlib.util
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from types import ModuleType

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from numpy.typing import NDArray

from qsgm.blocks import Blocks, one_block, parse_blocks
from qsgm.bundle import Bundle, load_bundle
from qsgm.manifest import head_file, probe_file, step_file, trunk_file
from qsgm.schedule import BATCH
from qsgm.train.graphs.inspection import all_nodes
from qsgm.train.graphs.memory import step_memory
from qsgm.train.slim import slim_bundle
from qsgm.tune.noop_step import start_of

Arrays = dict[str, NDArray]
Slims = Callable[[str], Bundle]

SAMPLES, ROWS = 6, np.array([4, 1, 3, 0])
# Of the largest number of an output, or of how far a step moves it. Roundings come to 1e-5, a gate
# that they turn to a bit more; gates that are wrong, to a half.
TOLERANCE = 1e-2


SCRIPT = Path(__file__).parents[2] / "benchmarks" / "runtimes.py"


def script() -> ModuleType:
    """`benchmarks/runtimes.py`, which knows how each is asked."""
    spec = importlib.util.spec_from_file_location("runtimes", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


OPEN = script().RUNTIMES


def run_in(runtime: str, path: Path, outputs: Sequence[str], inputs: Arrays) -> Arrays:
    pytest.importorskip(runtime)
    return OPEN[runtime](path, outputs, inputs)(inputs)


@pytest.fixture(scope="module")
def slims(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Slims:
    """Slim bundles without loops, by the blocks they tune."""
    made: dict[str, Bundle] = {}

    def slim(text: str) -> Bundle:
        if text not in made:
            folder = tmp_path_factory.mktemp("slim") / "bundle"
            slim_bundle(bundle, parse_blocks(text), folder, without_scan=True)
            made[text] = load_bundle(folder)
        return made[text]

    return slim


def inputs_of(path: Path, bundle: Bundle, layers: range) -> tuple[Arrays, list[str]]:
    """Random ones for a graph, with the bundle's own weights; and the names of its outputs."""
    session, rng = ort.InferenceSession(path, providers=["CPUExecutionProvider"]), rng_of(path)
    there = rng.random((SAMPLES, 1)) < 0.6
    angles = rng.uniform(-np.pi, np.pi, (SAMPLES, 1))
    labels = np.hstack([there, there * np.sin(angles), there * np.cos(angles)])
    known = {"labels": labels.astype(np.float32), "rows": ROWS} | start_of(bundle, layers)
    inputs: Arrays = {}
    for value in session.get_inputs():
        sides = [side if isinstance(side, int) else 150 for side in value.shape]
        if value.name in ("features", "samples"):
            sides[0] = SAMPLES
        if "uint8" in value.type:
            known[value.name] = rng.integers(0, 256, sides, np.uint8)
        elif value.name == "features":
            known[value.name] = rng.uniform(0, 1, sides).astype(np.float32)
        fill = 1e-3 if value.name.startswith("rate") else 0.0
        inputs[value.name] = known.get(value.name, np.full(sides, fill, np.float32))
    return inputs, [value.name for value in session.get_outputs()]


def rng_of(path: Path) -> np.random.Generator:
    return np.random.default_rng(list(path.name.encode()))


def compare(runtime: str, path: Path, bundle: Bundle, layers: range) -> None:
    inputs, outputs = inputs_of(path, bundle, layers)
    expected = run_in("onnxruntime", path, outputs, inputs)
    assert_equal(run_in(runtime, path, outputs, inputs), expected, inputs)


def assert_equal(found: Arrays, expected: Arrays, inputs: Arrays) -> None:
    for name in expected:
        wanted, got = (one[name].astype(np.float64) for one in (expected, found))
        moved = np.abs(wanted - inputs.get(name.removesuffix("_next"), 0)).max()
        assert moved > 0 or name.startswith(("clipped", "underflow")), name
        error = np.abs(got.reshape(wanted.shape) - wanted).max()
        assert error <= TOLERANCE * moved, name


def steps_of(blocks: Blocks) -> list[str]:
    steps = [step_file(precision, "sgd", blocks) for precision in ("float", "int8")]
    return [*steps, step_file("float", "adam", one_block(blocks.layers))]


@pytest.mark.parametrize(
    ("runtime", "text"),
    # The reference evaluator takes its time over maps.
    [
        *product(["onnx", "openvino", "tract"], ["4,5,6", "3,4,5,6"]),
        *product(["openvino", "tract"], ["1-4,5,6"]),
    ],
)
def test_a_step_moves_weights_as_in_onnx_runtime(slims: Slims, runtime: str, text: str) -> None:
    bundle, blocks = slims(text), parse_blocks(text)
    for name in steps_of(blocks):
        compare(runtime, bundle.folder / name, bundle, blocks.layers)


@pytest.mark.parametrize("runtime", ["onnx", "openvino", "tract"])
def test_all_other_graphs_answer_as_in_onnx_runtime(bundle: Bundle, runtime: str) -> None:
    layers = range(4, 7)
    names = [trunk_file("float", layers), trunk_file("int8", layers), head_file(3), probe_file(3)]
    for name in (*names, "network.onnx"):
        compare(runtime, bundle.folder / name, bundle, layers)


def test_loops_run_in_the_reference_evaluator(bundle: Bundle) -> None:
    blocks = parse_blocks("3,4,5,6")
    for name in steps_of(blocks)[:2]:
        compare("onnx", bundle.folder / name, bundle, blocks.layers)


@pytest.mark.parametrize("text", ["3,4,5,6", "1-4,5,6"])
def test_without_loops_a_step_is_the_same_but_for_rounding(
    bundle: Bundle, slims: Slims, text: str
) -> None:
    blocks, slim = parse_blocks(text), slims(text)
    for name in steps_of(blocks)[:2]:
        kinds = [
            {node.op_type for node in all_nodes(onnx.load(one.folder / name).graph)}
            for one in (bundle, slim)
        ]
        assert ["Scan" in some for some in kinds] == [True, False]

        inputs, outputs = inputs_of(slim.folder / name, slim, blocks.layers)
        at_once, one_by_one = (
            run_in("onnxruntime", one.folder / name, outputs, inputs) for one in (slim, bundle)
        )
        assert_equal(at_once, one_by_one, inputs)


def test_a_whole_run_ends_alike_in_all_of_them(slims: Slims, frame_path: Path) -> None:
    folder = slims("4,5,6").folder
    command = [sys.executable, SCRIPT, folder, frame_path, "--epochs", 1, "--json", folder / "x"]
    subprocess.run([*map(str, command)], check=True, capture_output=True)
    rows = json.loads((folder / "x").read_text())
    installed = [name for name in OPEN if importlib.util.find_spec(name) is not None]
    assert [row["runtime"] for row in rows] == 2 * installed
    assert all(row["apart"] < 1e-3 for row in rows)


def test_without_loops_a_step_says_that_it_takes_more_memory(
    bundle: Bundle, slims: Slims, tmp_path: Path
) -> None:
    blocks = parse_blocks("3,4,5,6")
    slim_bundle(bundle, blocks, tmp_path / "looping")
    name = step_file("int8", "sgd", blocks)
    more, less = (
        step_memory(one, "int8", blocks, BATCH).peak
        for one in (slims(str(blocks)), load_bundle(tmp_path / "looping"))
    )
    assert slims(str(blocks)).manifest.files[name].peak_activation_bytes == more > 2 * less


def test_no_gate_begins_at_what_openvino_takes_for_its_default(bundle: Bundle) -> None:
    names = [name for name in bundle.manifest.files if name.startswith(("step", "probe"))]
    nodes = [n for name in names for n in all_nodes(onnx.load(bundle.folder / name).graph)]
    gates = [node for node in nodes if node.op_type == "HardSigmoid"]
    betas = [one.f for node in gates for one in node.attribute if one.name == "beta"]
    assert len(betas) == len(gates) > len(names)
    assert all(betas)
