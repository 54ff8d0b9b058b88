"""Live activations: peaks known by hand, and what ONNX Runtime itself asks for."""

from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given
from hypothesis import strategies as st

from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.network import GRASPNET
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.memory import Run, live_peak, size_of, step_memory, traced

# The runtime also allocates the loss, and may keep a small tensor for one that comes later.
SLACK_BYTES, SLACK = 256, 0.01


def run(op_type: str, inputs: str, **outputs: int) -> Run:
    """A node called by its first output."""
    return Run(next(iter(outputs)), op_type, tuple(inputs.split()), outputs)


def test_in_a_chain_two_neighbours_are_alive_at_once() -> None:
    runs = [run("Gemm", "x", a=10), run("Gemm", "a", b=30), run("Gemm", "b", c=20)]
    peak = live_peak(runs, frozenset({"c"}))
    assert (peak.bytes, peak.node) == (40, "b")
    assert dict(peak.alive) == {"b": 30, "a": 10}


def test_what_is_read_late_stays() -> None:
    runs = [run("Gemm", "x", a=10), run("Gemm", "a", b=1), run("Gemm", "b", c=2)]
    runs += [run("Gemm", "c a", d=4)]
    peak = live_peak(runs, frozenset())
    assert (peak.bytes, peak.node) == (16, "d")


def test_a_view_needs_no_memory_and_keeps_what_it_views() -> None:
    runs = [run("Gemm", "x", a=10), run("Reshape", "a shape", v=10), run("Gemm", "x", b=5)]
    runs += [run("Gemm", "v b", c=1)]
    peak = live_peak(runs, frozenset())
    assert dict(peak.alive) == {"a": 10, "b": 5, "c": 1}


def test_a_view_of_an_input_or_of_a_bound_output_needs_no_memory() -> None:
    runs = [run("Reshape", "x shape", v=10), run("Gemm", "v", out=10)]
    runs += [run("Reshape", "out shape", w=10), run("Gemm", "w", a=3)]
    assert live_peak(runs, frozenset({"out"})).bytes == 3


@pytest.mark.parametrize(
    ("op_type", "size", "read_again", "peak"),
    [
        ("Relu", 10, False, 10),
        ("Relu", 10, True, 20),  # the input is needed once more
        ("Cast", 40, False, 50),  # does not fit into it
        ("Add", 10, False, 20),  # its kernel does not write over an input
    ],
)
def test_a_result_takes_its_inputs_place_only_where_the_kernel_may_and_nobody_reads_it(
    op_type: str, size: int, read_again: bool, peak: int
) -> None:
    runs = [run("Gemm", "x", a=10), run(op_type, "a", b=size)]
    runs += [run("Gemm", "a b" if read_again else "b", out=1)]
    assert live_peak(runs, frozenset({"out"})).bytes == peak


def test_an_output_that_nobody_reads_lives_while_its_node_runs() -> None:
    runs = [run("Split", "x", a=10, b=7), run("Gemm", "a", c=2)]
    peak = live_peak(runs, frozenset())
    assert (peak.bytes, peak.node) == (17, "a")
    assert live_peak([*runs, run("Gemm", "x", d=13)], frozenset()).node == "a"


@given(
    st.lists(
        st.tuples(st.integers(1, 1000), st.lists(st.integers(0, 30), max_size=3)),
        min_size=1,
        max_size=30,
    )
)
def test_a_peak_is_that_of_an_allocator_that_frees_after_the_last_reader(
    nodes: list[tuple[int, list[int]]],
) -> None:
    runs = [
        Run(f"v{i}", "Gemm", tuple(f"v{k}" for k in reads if k < i), {f"v{i}": size})
        for i, (size, reads) in enumerate(nodes)
    ]
    readers = {f"v{i}": sum(f"v{i}" in run.inputs for run in runs) for i in range(len(runs))}
    in_use, most = 0, 0
    for node in runs:
        in_use += node.outputs[node.name]
        most = max(most, in_use)
        for value in {*node.inputs}:
            readers[value] -= 1
        done = [value for value in {*node.inputs, node.name} if readers.get(value) == 0]
        for value in done:
            in_use -= runs[int(value[1:])].outputs[value]
            del readers[value]
    assert live_peak(runs, frozenset()).bytes == most


def test_a_small_graph_needs_what_one_can_work_out_and_the_runtime_says_the_same(
    tmp_path: Path,
) -> None:
    graph = Graph("small")
    x = graph.input("x", np.float32, ("n", 64))
    op = graph.within("some")
    wide = op.MatMul(x, op.constant(np.ones((64, 256))))  # (n, 256)
    folded = op.Reshape(wide, op.shape(-1, 128))  # (2 n, 128)
    narrow = op.ReduceMean(folded, op.shape(1), keepdims=1)  # (2 n, 1)
    graph.output("y", op.Sub(folded, narrow), np.float32, ("m", 128))
    path = tmp_path / "small.onnx"
    onnx.save(graph.model(), path)
    n = 100
    given_output = ort.OrtValue.ortvalue_from_numpy(np.zeros((2 * n, 128), np.float32))

    def use(session: ort.InferenceSession) -> None:
        binding = session.io_binding()
        binding.bind_cpu_input("x", np.ones((n, 64), np.float32))
        binding.bind_ortvalue_output("y", given_output)
        session.run_with_iobinding(binding)

    trace = traced(path, use)
    peak = live_peak(trace.nodes, trace.bound)
    assert peak.bytes == 4 * (n * 256 + 2 * n)
    assert [*peak.alive.values()] == [4 * n * 256, 4 * 2 * n]
    if trace.before is not None:
        assert trace.in_use[0] - trace.before == peak.bytes


@pytest.mark.parametrize(
    ("kind", "shape", "size"),
    [("float", [32, 3], 384), ("uint8", [5], 5), ("int64", [], 8), ("bool", [2, 2], 4)],
)
def test_sizes_are_those_of_the_runtimes_types(kind: str, shape: list[int], size: int) -> None:
    assert size_of(kind, shape) == size


@pytest.mark.parametrize(("tuned", "batch"), [(3, 1), (5, 1), (5, 2), (3, 8), (4, 8), (5, 8)])
def test_a_steps_peak_is_what_the_runtime_asks_for_in_its_first_step(
    bundle: Bundle, tuned: int, batch: int
) -> None:
    for precision, blocks in (
        ("int8", single_layers(GRASPNET.last(tuned))),
        ("float", single_layers(GRASPNET.last(tuned))),
        ("float", one_block(GRASPNET.last(tuned))),
    ):
        step = step_memory(bundle, precision, blocks, batch)
        if step.first_step is None:
            pytest.skip("this ONNX Runtime does not say what it asks for")
        assert abs(step.first_step - step.peak) <= SLACK_BYTES + SLACK * step.peak
        assert step.later_steps is not None
        assert step.later_steps >= step.peak


def layers_at(alive: dict[str, int]) -> set[str]:
    """Layers whose larger tensors are alive."""
    largest = max(alive.values())
    return {name.partition("/")[0] for name, size in alive.items() if size > largest / 50}


def test_with_sgms_one_layer_is_alive_at_the_peak_and_with_backpropagation_several(
    bundle: Bundle,
) -> None:
    sgm = step_memory(bundle, "int8", single_layers(GRASPNET.last(6)), 4)
    bp = step_memory(bundle, "float", one_block(GRASPNET.last(6)), 4)
    assert layers_at(dict(sgm.alive)) == {"layer1", "batch"}  # and the crops it reads
    assert layers_at(dict(bp.alive)) >= {"layer1", "layer2", "layer3"}


def test_the_sgms_peak_of_all_six_layers_is_a_quarter_of_backpropagations_at_most(
    bundle: Bundle,
) -> None:
    most = step_memory(bundle, "float", one_block(GRASPNET.last(6)), 32).peak / 4
    for precision, text in (("int8", "1,2,3,4,5,6"), ("float", "1,2,3,4,5,6"), ("int8", "1-4,5,6")):
        assert step_memory(bundle, precision, parse_blocks(text), 32).peak < most


def test_a_peak_grows_with_the_batch_but_where_layers_go_crop_by_crop(bundle: Bundle) -> None:
    def growth(blocks: Blocks) -> float:
        few, many = (step_memory(bundle, "float", blocks, batch).peak for batch in (4, 8))
        return many / few

    assert growth(one_block(GRASPNET.last(5))) == pytest.approx(2, rel=0.02)
    assert growth(single_layers(GRASPNET.last(5))) < 1.5
