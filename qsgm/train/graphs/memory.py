"""How many bytes of activations a training step needs at once, reckoned from its graph (host).

The nodes are those that ONNX Runtime makes of the graph, in the order in which it runs them, with
the shapes they really give: from the optimized model and the profile of one step. A tensor lives
from the node that makes it to the last one that reads it. Views (:data:`VIEWS`) are their input;
where a kernel may write over an input (:data:`IN_PLACE`) that nobody reads any more, it does. Not
counted: constants, the graph's inputs, its bound outputs, and what a kernel needs for itself. Of
a loop's rounds, which are all alike, one stands for all; what it gives for its items lies in the
loop's own results, and its sums go back and forth between two copies.

The same profile says what the runtime asked its allocator for, against which this is checked.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from math import prod
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
from onnx import helper

from qsgm.blocks import Blocks
from qsgm.bundle import Bundle
from qsgm.manifest import Manifest, Precision, step_file
from qsgm.progress import Progress
from qsgm.runtime import session_options
from qsgm.schedule import BATCH
from qsgm.train.graphs.inspection import all_nodes, bodies
from qsgm.tune.graphs import running_graphs
from qsgm.tune.noop_step import noop_step, start_of

# Their result is their first input under another shape.
VIEWS = frozenset({"Reshape", "Squeeze", "Unsqueeze", "Flatten", "Identity"})
# Their result may take the place of their first input, if that is as large and read no more.
IN_PLACE = frozenset({"Relu", "Sigmoid", "Tanh", "Clip", "Cast"})
KERNEL = "_kernel_time"
IN_USE, CHANGE = "mem_bytes_requested_in_use", "mem_requested_in_use_delta"


@dataclass(frozen=True)
class StepMemory:
    """Of one training step, in bytes."""

    peak: int  # most activations alive at once
    node: str  # that runs then
    alive: Mapping[str, int]  # by tensor, largest first
    first_step: int | None  # most that the runtime asked for at once; None: it does not say
    later_steps: int | None  # the same once it has planned one block for all


@dataclass(frozen=True)
class Run:
    """One node as it ran."""

    name: str
    op_type: str
    inputs: tuple[str, ...]
    outputs: Mapping[str, int]  # bytes of each


@dataclass(frozen=True)
class Tensor:
    """Memory, and the nodes between which it is needed, both included."""

    bytes: int
    first: int
    last: int


@dataclass(frozen=True)
class Peak:
    """The moment at which most bytes are alive."""

    bytes: int
    node: str  # that runs then
    alive: Mapping[str, int]  # bytes by tensor, largest first


@dataclass(frozen=True)
class Trace:
    """What a profile says of each of several runs of a graph."""

    nodes: tuple[Run, ...]
    bound: frozenset[str]  # the graph's outputs
    before: int | None  # bytes in use before the first run; None: this runtime does not say
    in_use: tuple[int, ...]  # most bytes in use during each run, those included


def step_memory(
    bundle: Bundle, precision: Precision, blocks: Blocks, batch: int, threads: int = 1
) -> StepMemory:
    """Of a step of SGD on so many crops, see :func:`graph_memory`."""
    return graph_memory(bundle, step_file(precision, "sgd", blocks), blocks, batch, threads)


def graph_memory(
    bundle: Bundle, name: str, blocks: Blocks, batch: int, threads: int = 1
) -> StepMemory:
    """Of one of the bundle's training steps, which is of these blocks, on so many crops.

    Raises:
        QsgmError: the graph is not there, or does not fit what it is given.
    """

    def two_steps(session: ort.InferenceSession) -> None:
        # In the first one memory is asked for piece by piece, from then on in one block.
        with running_graphs(bundle):
            step = noop_step(session, start_of(bundle, blocks.layers), blocks, batch)
            step()
            step()

    trace = traced(bundle.graph_path(name), two_steps, threads)
    peak = live_peak(trace.nodes, trace.bound)
    before = trace.before
    asked = None if before is None else [most - before for most in trace.in_use]
    return StepMemory(
        peak.bytes,
        peak.node,
        peak.alive,
        None if asked is None else asked[0],
        None if asked is None else asked[-1],
    )


def with_peaks(bundle: Bundle, steps: Mapping[str, Blocks], watch: Progress) -> Manifest:
    """A bundle's manifest, saying how many bytes of activations each training step holds at once.

    `steps` are files and their blocks. Raises QsgmError as :func:`graph_memory`.
    """
    files = dict(bundle.manifest.files)
    for done, (name, blocks) in enumerate(steps.items(), start=1):
        peak = graph_memory(bundle, name, blocks, BATCH).peak
        files[name] = replace(files[name], peak_activation_bytes=peak)
        watch("memory", done, len(steps))
    return replace(bundle.manifest, files=files)


def traced(model: Path, use: Callable[[ort.InferenceSession], object], threads: int = 1) -> Trace:
    """Open a model, use it, and read what its profile says; nothing of it stays on the disk."""
    options = session_options(threads)
    with tempfile.TemporaryDirectory() as folder:
        optimized = Path(folder) / "optimized.onnx"
        options.optimized_model_filepath = str(optimized)
        options.enable_profiling = True
        options.profile_file_prefix = str(Path(folder) / "profile")
        session = ort.InferenceSession(str(model), options, ["CPUExecutionProvider"])
        try:
            use(session)
        finally:
            profile = Path(session.end_profiling())
        graph = onnx.load(optimized, load_external_data=False).graph
        events = json.loads(profile.read_text(encoding="utf-8"))
    return read_trace(graph, [e for e in events if e["name"].endswith(KERNEL)])


def read_trace(graph: onnx.GraphProto, events: Sequence[Mapping[str, Any]]) -> Trace:
    """A graph's nodes in the order of their events, and what was in use in each run of them."""
    every = [*all_nodes(graph)]
    nodes = {node.name: node for node in every}
    assert len(nodes) == len(every), "ONNX Runtime gives every node a name of its own"
    names = [event["name"].removesuffix(KERNEL) for event in events]
    # There are no branches: every run takes every node, and loops always the same rounds.
    length = len(events) // names.count(graph.node[-1].name)
    assert names[:length] * (len(events) // length) == names, "a run of the profile is incomplete"
    first = dict(zip(names[:length], events[:length], strict=True))
    ran = [(nodes[name], run_of(nodes[name], event)) for name, event in first.items()]
    runs = with_loops_open(ran, Counter(names[:length]))
    bound = frozenset(output.name for output in graph.output) | given_to_loops(every)
    memory = [event["args"] for event in events]
    if not all(IN_USE in some for some in memory):
        return Trace(tuple(runs), bound, None, ())
    in_use = [int(some[IN_USE]) for some in memory]
    before = in_use[0] - int(memory[0][CHANGE])
    most = (max(in_use[i : i + length]) for i in range(0, len(in_use), length))
    return Trace(tuple(runs), bound, before, tuple(most))


def with_loops_open(
    runs: Sequence[tuple[onnx.NodeProto, Run]], rounds: Mapping[str, int]
) -> list[Run]:
    """A loop makes its results and copies in front of its body, and reads its inputs behind it.

    `rounds` says how often each node ran.
    """
    opened: list[Run] = []
    for node, run in runs:
        body = {inner.name for graph in bodies(node) for inner in all_nodes(graph)}
        if body:
            start = next(i for i, one in enumerate(opened) if one.name in body)
            copies = copies_of_sums(node, run, rounds[opened[start].name])
            opened.insert(start, replace(run, inputs=(), outputs={**run.outputs, **copies}))
            opened.append(replace(run, inputs=(*run.inputs, *copies), outputs={}))
        else:
            opened.append(run)
    return opened


def copies_of_sums(loop: onnx.NodeProto, run: Run, rounds: int) -> dict[str, int]:
    """Bytes of what a loop holds its sums in until the last round, which writes the results."""
    items = next(int(one.i) for one in loop.attribute if one.name == "num_scan_inputs")
    sums = loop.output[: len(loop.input) - items]
    return {f"{name}_{i}": run.outputs[name] for name in sums for i in range(min(2, rounds - 1))}


def given_to_loops(nodes: Sequence[onnx.NodeProto]) -> frozenset[str]:
    """What the bodies of loops give: it lies in the loops' results and copies."""
    return frozenset(
        output.name for node in nodes for body in bodies(node) for output in body.output
    )


def run_of(node: onnx.NodeProto, event: Mapping[str, Any]) -> Run:
    """A node, and the bytes of the outputs that it really gave."""
    names = [name for name in node.output if name]
    shapes = event["args"]["output_type_shape"]  # such as [{"float": [32, 3]}]
    sizes = [size_of(kind, shape) for one in shapes for kind, shape in one.items()]
    inputs = tuple(name for name in node.input if name)
    return Run(node.name, node.op_type, inputs, dict(zip(names, sizes, strict=True)))


def size_of(kind: str, shape: Sequence[int]) -> int:
    """Bytes of a tensor of a type by ONNX Runtime's name for it."""
    code = getattr(onnx.TensorProto, kind.upper())
    return int(prod(shape)) * np.dtype(helper.tensor_dtype_to_np_dtype(code)).itemsize


def live_peak(runs: Sequence[Run], bound: AbstractSet[str]) -> Peak:
    """When most bytes are alive; the first such moment, if there are several.

    Args:
        runs: nodes in the order in which they run.
        bound: values whose memory is given; they count nothing.
    """
    tensors = lifetimes(runs, bound)
    makers = {value: run for run in runs for value in run.outputs}
    change = np.zeros(len(runs) + 1, np.int64)
    for tensor in tensors.values():
        change[tensor.first] += tensor.bytes
        change[tensor.last + 1] -= tensor.bytes
    moment = int(np.argmax(np.cumsum(change[:-1])))
    alive = {
        titled(value, makers[value]): tensor.bytes
        for value, tensor in sorted(tensors.items(), key=lambda item: -item[1].bytes)
        if tensor.first <= moment <= tensor.last
    }
    return Peak(sum(alive.values()), titled(runs[moment].name, runs[moment]), alive)


def titled(name: str, run: Run) -> str:
    """A node's or a value's name with what the node does in it: layer4/7 is layer4/Gather_7."""
    scope, slash, number = name.rpartition("/")
    return f"{scope}/{run.op_type}_{number}" if slash else name


def lifetimes(runs: Sequence[Run], bound: AbstractSet[str]) -> dict[str, Tensor]:
    """Every tensor that needs memory of its own, by the first value in it."""
    last_read = {value: i for i, run in enumerate(runs) for value in run.inputs}
    tensors: dict[str, Tensor] = {}
    held: dict[str, str] = {}  # value: the tensor in whose memory it is
    for i, run in enumerate(runs):
        source = held.get(run.inputs[0]) if run.inputs else None
        for value, size in run.outputs.items():
            if value in bound or (source is None and run.op_type in VIEWS):
                continue  # its memory is given, or that of which it is a view
            if source is not None and shares(run, tensors[source], i, size):
                held[value] = source
            else:
                held[value], tensors[value] = value, Tensor(size, i, i)
            tensor = tensors[held[value]]
            last = max(tensor.last, last_read.get(value, i))
            tensors[held[value]] = replace(tensor, last=last)
    return tensors


def shares(run: Run, source: Tensor, moment: int, size: int) -> bool:
    """Whether a node's result of this size lies in the memory of its first input."""
    over = run.op_type in IN_PLACE and source.last == moment and source.bytes == size
    return over or run.op_type in VIEWS
