"""Memory accounted for: what a step's activations need at once, and what a whole process holds.

Steps are reckoned from their graphs (:mod:`qsgm.train.liveness`) beside what ONNX Runtime says that
it asked its allocator for; processes are `qsgm finetune` and the same job in torch, each measured
from inside (:mod:`qsgm.bench.resident`).
"""

import importlib.util
import json
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.bench.shapes import output_bytes
from qsgm.bench.speed import TORCH, VARIANTS, run_once
from qsgm.bench.tables import right_table
from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.bundle import MANIFEST, Bundle, Precision, probe_file
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import Watch
from qsgm.tune.report import number, plain_table
from qsgm.tune.settings import Settings, trunk_precision

INT8, FLOAT, BP = VARIANTS
# variant: its precision and, from the number of tuned layers, its blocks
STEPS: Mapping[str, tuple[Precision, Callable[[int], Blocks]]] = {
    INT8: ("int8", single_layers),
    FLOAT: ("float", single_layers),
    BP: ("float", one_block),
}
BATCHES = (1, 8, BATCH)
# Of a peak; what is smaller is not named.
SMALLEST_SHARE = 0.04
LARGE = 1_000_000  # bytes; below, whatever the runtime needs besides is most of the difference
PEAK_LEGEND = (
    "activations alive at once, without weights, states, inputs and outputs; outputs alone: all "
    "layers' outputs over the largest layer's, which is how the paper counts"
)
ALIVE_LEGEND = (
    "Gather: windows cut for a product, of a layer or of an SGM; Scan: what a layer that goes crop "
    "by crop gives for all crops; batch: the crops themselves"
)
PROCESS_LEGEND = (
    "most that a whole process held, libraries and all crops' features included; "
    "probes: whether it looked at its gradients' fidelity, as it does by default"
)


@dataclass(frozen=True)
class StepMemory:
    """Of one training step, in bytes."""

    peak: int  # most activations alive at once
    node: str  # that runs then
    alive: Mapping[str, int]  # by tensor, largest first
    first_step: int | None  # most that the runtime asked for at once; None: it does not say
    later_steps: int | None  # the same once it has planned one block for all


# (bundle, precision, blocks, batch, threads)
StepMemoryOf = Callable[[Bundle, Precision, Blocks, int, int], StepMemory]
Steps = Mapping[str, StepMemory]  # by variant
Results = dict[int, dict[str, int]]  # bytes, by number of tuned layers and variant


@dataclass(frozen=True)
class MemoryReport:
    """Steps by batch and number of tuned layers, processes by number of tuned layers."""

    bundle: Bundle
    settings: Settings
    frame: Path
    steps: Mapping[int, Mapping[int, Steps]]
    processes: Results
    unprobed: Results  # the same without probes

    def to_json(self) -> dict[str, Any]:
        return {
            "bundle": str(self.bundle.folder),
            "frame": str(self.frame),
            "trunk": trunk_precision(self.settings, self.bundle),
            "epochs": self.settings.epochs,
            "threads": self.settings.threads,
            "steps": {
                str(batch): {str(tuned): steps_json(tuned, some) for tuned, some in by.items()}
                for batch, by in self.steps.items()
            },
            "processes": {str(tuned): dict(some) for tuned, some in self.processes.items()},
            "processes_without_probes": {
                str(tuned): dict(some) for tuned, some in self.unprobed.items()
            },
        }

    def render(self) -> RenderableType:
        """Peaks, what is alive at them, and processes."""
        largest, *smaller = sorted(self.steps, reverse=True)
        parts: list[RenderableType] = [peak_table(largest, self.steps[largest])]
        parts += [Text(PEAK_LEGEND, style="dim"), Text(agreement(self.steps))]
        parts.append(smaller_table({batch: self.steps[batch] for batch in sorted(smaller)}))
        parts += [alive_table(largest, self.steps[largest]), Text(ALIVE_LEGEND, style="dim")]
        if self.processes:
            table = process_table(self.processes, self.unprobed, self.settings.epochs)
            parts += [table, Text(PROCESS_LEGEND, style="dim")]
        return Group(*parts)


def measure_memory(
    frame: Path,
    bundle: Bundle,
    settings: Settings,
    lengths: Sequence[int],
    step_memory: StepMemoryOf,
    watch: Watch,
) -> MemoryReport:
    """Steps of all layers in all batches, and whole processes.

    Args:
        frame: what the processes tune to.
        bundle: whose steps they are.
        settings: of the processes; method, precision and layers do not matter.
        lengths: numbers of tuned layers of the processes.
        step_memory: :func:`qsgm.train.liveness.step_memory`.
        watch: told about every step and process.

    Raises:
        QsgmError: a graph does not fit what it is given, or a process fails.
    """
    steps = measure_steps(bundle, step_memory, settings.threads, watch)
    processes: dict[int, dict[str, int]] = {layers: {} for layers in lengths}
    unprobed: dict[int, dict[str, int]] = {layers: {} for layers in lengths}
    with tempfile.TemporaryDirectory() as folder:
        jobs = process_jobs(bundle, without_probes(bundle, Path(folder)), processes, unprobed)
        for done, (layers, name, used, results) in enumerate(jobs, start=1):
            chosen = replace(settings, layers=layers)
            results[layers][name] = resident_bytes(name, frame, used, chosen)
            watch("processes", done, len(jobs))
    return MemoryReport(bundle, settings, frame, steps, processes, unprobed)


def measure_steps(
    bundle: Bundle, step_memory: StepMemoryOf, threads: int, watch: Watch
) -> dict[int, dict[int, Steps]]:
    """Every variant's step, by batch and number of tuned layers."""
    tuned = range(1, bundle.most_layers + 1)
    steps: dict[int, dict[int, Steps]] = {batch: {} for batch in BATCHES}
    for done, (batch, layers) in enumerate(product(BATCHES, tuned), start=1):
        steps[batch][layers] = {
            name: step_memory(bundle, precision, blocks(layers), batch, threads)
            for name, (precision, blocks) in STEPS.items()
        }
        watch("steps", done, len(BATCHES) * len(tuned))
    return steps


def process_jobs(
    bundle: Bundle, unprobed_bundle: Bundle, processes: Results, unprobed: Results
) -> list[tuple[int, str, Bundle, Results]]:
    """Number of layers, variant, bundle, and where the result goes; torch where it is installed."""
    with_torch = all(importlib.util.find_spec(name) for name in ("torch", "onnx"))
    variants = [*VARIANTS, TORCH] if with_torch else [*VARIANTS]
    jobs = [(layers, name, bundle, processes) for layers in processes for name in variants]
    return jobs + [
        (layers, name, unprobed_bundle, unprobed) for layers in unprobed for name in VARIANTS
    ]


def without_probes(bundle: Bundle, folder: Path) -> Bundle:
    """A copy of a bundle in a new folder, with which `qsgm finetune` looks at no gradients."""
    probes = {probe_file(layers) for layers in range(1, bundle.most_layers + 1)}
    files = {name: value for name, value in bundle.manifest["files"].items() if name not in probes}
    for name in files:
        shutil.copyfile(bundle.folder / name, folder / name)
    manifest = bundle.manifest | {"files": files}
    (folder / MANIFEST).write_text(json.dumps(manifest), encoding="utf-8")
    return Bundle(folder, manifest)


def resident_bytes(name: str, frame: Path, bundle: Bundle, settings: Settings) -> int:
    """Most that one variant held in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bytes"
        launcher = ("-m", "qsgm.bench.resident", str(file))
        run_once(name, frame, bundle, settings, launcher)
        return int(file.read_text(encoding="ascii"))


def steps_json(tuned: int, steps: Steps) -> dict[str, Any]:
    """Every variant's peak, what is alive then, and the ratios between the peaks."""
    return {
        name: {
            "peak_bytes": step.peak,
            "at": step.node,
            "alive_at_peak": named(step),
            "runtime_first_step_bytes": step.first_step,
            "runtime_later_steps_bytes": step.later_steps,
        }
        for name, step in steps.items()
    } | {
        "bp_over_sgm_int8": number(ratio(steps, INT8), 4),
        "bp_over_sgm_float": number(ratio(steps, FLOAT), 4),
        "outputs_alone": number(outputs_alone(tuned), 4),
    }


def ratio(steps: Steps, name: str) -> float:
    """Backpropagation's peak over this variant's."""
    return steps[BP].peak / steps[name].peak


def outputs_alone(tuned: int) -> float:
    """All layers' outputs over the largest layer's."""
    outputs = output_bytes(single_layers(tuned))
    return outputs["backprop"] / outputs["sgm"]


def named(step: StepMemory) -> dict[str, int]:
    """The larger tensors alive at a step's peak."""
    return {name: size for name, size in step.alive.items() if size >= SMALLEST_SHARE * step.peak}


def agreement(steps: Mapping[int, Mapping[int, Steps]]) -> str:
    """How far the runtime's own figures are from the reckoned ones."""
    every = [step for by in steps.values() for some in by.values() for step in some.values()]
    told = [step for step in every if step.first_step is not None and step.later_steps is not None]
    if not told:
        return "this ONNX Runtime does not say what it asked for: nothing to compare with"
    large = [step for step in told if step.peak > LARGE]
    if not large:
        first = max(abs((step.first_step or 0) - step.peak) for step in told)
        return f"what ONNX Runtime asks for in a first step differs by {first} bytes at most"
    off = max(abs((step.first_step or 0) / step.peak - 1) for step in large)
    later = [(step.later_steps or 0) / step.peak for step in large]
    return (
        f"above {LARGE / 1e6:g} MB, what ONNX Runtime asks for in a first step differs by "
        f"{off:.2%} at most; its plan for later steps takes {min(later):.2f} to {max(later):.2f} "
        "times as much"
    )


def peak_table(batch: int, steps: Mapping[int, Steps]) -> Table:
    """Peaks of one batch and what they are to each other."""
    table = right_table(
        f"a step of {batch} crops: peak of live activations [kB]",
        *("tuned\nlayers", "SGM\nint8", "SGM\nfloat", "\nbackprop"),
        *("bp over\nint8", "bp over\nfloat", "outputs\nalone"),
    )
    for tuned, some in steps.items():
        ratios = ratio(some, INT8), ratio(some, FLOAT), outputs_alone(tuned)
        table.add_row(
            str(tuned),
            *(f"{some[name].peak / 1000:,.1f}" for name in STEPS),
            *(f"{value:.2f}" for value in ratios),
        )
    return table


def smaller_table(steps: Mapping[int, Mapping[int, Steps]]) -> Table:
    """Peaks of several batches, side by side."""
    headings = [
        heading
        for batch in steps
        for heading in (f"{batch} crop{'s' * (batch > 1)}\nint8", "\nfloat", "\nbp", "bp/\nint8")
    ]
    table = right_table("smaller batches [kB]", "tuned\nlayers", *headings)
    for tuned in next(iter(steps.values()), {}):
        cells = []
        for by in steps.values():
            cells += [f"{by[tuned][name].peak / 1000:,.1f}" for name in STEPS]
            cells.append(f"{ratio(by[tuned], INT8):.2f}")
        table.add_row(str(tuned), *cells)
    return table


def alive_table(batch: int, steps: Mapping[int, Steps]) -> Table:
    """What makes the peaks of the most layers."""
    tuned = max(steps)
    table = plain_table(f"alive at the peak: {tuned} layers, {batch} crops")
    table.padding = (0, 1, 0, 0)
    for heading in ("", "while", "tensor"):
        table.add_column(heading)
    for heading in ("MB", "share"):
        table.add_column(heading, justify="right")
    for name, step in steps[tuned].items():
        for i, (tensor, size) in enumerate(named(step).items()):
            head = (name, step.node) if i == 0 else ("", "")
            cells = (f"{size / 1e6:.2f}", f"{size / step.peak:.0%}")
            table.add_row(*map(Text, (*head, tensor)), *cells)
    return table


def process_table(processes: Results, unprobed: Results, epochs: int) -> Table:
    """Whole processes."""
    names = [*next(iter(processes.values()))]
    headings = ("tuned\nlayers", "\nprobes", *(f"\n{name}" for name in names))
    title = f"whole processes, {epochs} epoch{'s' * (epochs > 1)}: resident memory [MB]"
    table = right_table(title, *headings)
    for probes, results in (("yes", processes), ("no", unprobed)):
        for tuned, some in results.items():
            cells = (f"{some[name] / 1e6:.0f}" if name in some else "-" for name in names)
            table.add_row(str(tuned), probes, *cells)
    return table
