"""Memory accounted for: what a step's activations need at once, and what a whole process holds.

Steps are reckoned from their graphs (:mod:`qsgm.train.graphs.memory`) beside what ONNX Runtime says
that it asked its allocator for; processes are `qsgm finetune` and the same job in torch, each
measured from inside (:mod:`qsgm.bench.resident`).
"""

import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.bench.resources import output_bytes
from qsgm.bench.speed import VARIANTS, run_once, variants_here
from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.bundle import Bundle, load_bundle
from qsgm.manifest import MANIFEST, Precision, probe_file
from qsgm.progress import Progress
from qsgm.schedule import BATCH
from qsgm.tables import CLOSE, legend, number, table
from qsgm.tune.settings import Settings

INT8, FLOAT, BP = VARIANTS
# variant: its precision and, from the number of tuned layers, its blocks
STEPS: Mapping[str, tuple[Precision, Callable[[range], Blocks]]] = {
    INT8: ("int8", single_layers),
    FLOAT: ("float", single_layers),
    BP: ("float", one_block),
}
BATCHES = (1, 8, BATCH)
SMALLEST_SHARE = 0.04  # of a peak; what is smaller is not named
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

# A :class:`qsgm.train.graphs.memory.StepMemory` of (bundle, precision, blocks, batch, threads).
StepMemoryOf = Callable[[Bundle, Precision, Blocks, int, int], Any]
Values = Mapping[str, Any]


def measure_memory(
    frame: Path,
    bundle: Bundle,
    settings: Settings,
    lengths: Sequence[int],
    step_memory: StepMemoryOf,
    watch: Progress,
) -> dict[str, Any]:
    """Steps of all layers by batch and number of layers, and whole processes.

    Args:
        frame: what the processes tune to.
        bundle: whose steps they are.
        settings: of the processes; method, precision and layers do not matter.
        lengths: numbers of tuned layers of the processes.
        step_memory: :func:`qsgm.train.graphs.memory.step_memory`.
        watch: told about every step and process.

    Raises:
        QsgmError: a graph does not fit what it is given, or a process fails.
    """
    last, threads = bundle.network.last, settings.threads
    tuned = range(1, bundle.manifest.most_layers + 1)
    steps: dict[str, dict[str, Any]] = {str(batch): {} for batch in BATCHES}
    for done, (batch, layers) in enumerate(product(BATCHES, tuned), start=1):
        some = {
            name: step_json(step_memory(bundle, precision, blocks(last(layers)), batch, threads))
            for name, (precision, blocks) in STEPS.items()
        }
        steps[str(batch)][str(layers)] = some | step_ratios(
            some, output_bytes(bundle.network, layers)
        )
        watch("steps", done, len(BATCHES) * len(tuned))
    with tempfile.TemporaryDirectory() as folder:
        unprobed = without_probes(bundle, Path(folder))
        processes = {
            key: measure_processes(frame, used, settings, lengths, variants, watch)
            for key, used, variants in (
                ("processes", bundle, variants_here()),
                ("processes_without_probes", unprobed, VARIANTS),
            )
        }
    return {
        "bundle": str(bundle.folder),
        "frame": str(frame),
        "trunk": settings.trunk or bundle.manifest.trunk,
        "epochs": settings.epochs,
        "threads": threads,
        "steps": steps,
        **processes,
    }


def step_json(step: Any) -> dict[str, Any]:
    """A step's peak, and the larger tensors that are alive then."""
    return {
        "peak_bytes": step.peak,
        "at": step.node,
        "alive_at_peak": {
            name: size for name, size in step.alive.items() if size >= SMALLEST_SHARE * step.peak
        },
        "runtime_first_step_bytes": step.first_step,
        "runtime_later_steps_bytes": step.later_steps,
    }


def step_ratios(steps: Values, outputs: Sequence[int]) -> dict[str, float | None]:
    """Backpropagation's peak over the SGMs', and all layers' outputs over the largest layer's."""
    peaks = {name: step["peak_bytes"] for name, step in steps.items()}
    return {
        "bp_over_sgm_int8": number(peaks[BP] / peaks[INT8], 4),
        "bp_over_sgm_float": number(peaks[BP] / peaks[FLOAT], 4),
        "outputs_alone": number(sum(outputs) / max(outputs), 4),
    }


def measure_processes(
    frame: Path,
    bundle: Bundle,
    settings: Settings,
    lengths: Sequence[int],
    variants: Iterable[str],
    watch: Progress,
) -> dict[str, dict[str, int]]:
    """Bytes of whole processes by number of tuned layers and variant."""
    found: dict[str, dict[str, int]] = {}
    for done, layers in enumerate(lengths):
        watch("processes", done, len(lengths))
        chosen = replace(settings, layers=layers)
        found[str(layers)] = {
            name: resident_bytes(name, frame, bundle, chosen) for name in variants
        }
    return found


def without_probes(bundle: Bundle, folder: Path) -> Bundle:
    """A copy of a bundle in a new folder, with which `qsgm finetune` looks at no gradients."""
    probes = {probe_file(layers) for layers in range(1, bundle.manifest.most_layers + 1)}
    files = {name: one for name, one in bundle.manifest.files.items() if name not in probes}
    for name in files:
        shutil.copyfile(bundle.folder / name, folder / name)
    manifest = replace(bundle.manifest, files=files)
    (folder / MANIFEST).write_text(manifest.text(), encoding="utf-8")
    return load_bundle(folder)


def resident_bytes(name: str, frame: Path, bundle: Bundle, settings: Settings) -> int:
    """Most that one variant held in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bytes"
        launcher = ("-m", "qsgm.bench.resident", str(file))
        run_once(name, frame, bundle, settings, launcher)
        return int(file.read_text(encoding="ascii"))


def render(values: Values) -> RenderableType:
    """Peaks, what is alive at them, and processes."""
    *smaller, largest = values["steps"]
    tuned = [*values["steps"][largest]][-1]
    parts: list[RenderableType] = [
        peak_table(largest, values["steps"][largest]),
        legend(PEAK_LEGEND),
        Text(agreement(values["steps"])),
        smaller_table({batch: values["steps"][batch] for batch in smaller}),
        table(
            f"alive at the peak: {tuned} layers, {largest} crops",
            ("", "while", "tensor", ("MB", "{:.2f}"), ("share", "{:.0%}")),
            alive_rows(values["steps"][largest][tuned]),
            left=(0, 1, 2),
            padding=CLOSE,
        ),
        legend(ALIVE_LEGEND),
    ]
    if values["processes"]:
        parts += [process_table(values), legend(PROCESS_LEGEND)]
    return Group(*parts)


def agreement(steps: Values) -> str:
    """How far the runtime's own figures are from the reckoned ones."""
    every = [some[name] for by in steps.values() for some in by.values() for name in STEPS]
    told = [
        (s["peak_bytes"], s["runtime_first_step_bytes"], s["runtime_later_steps_bytes"])
        for s in every
        if None not in (s["runtime_first_step_bytes"], s["runtime_later_steps_bytes"])
    ]
    large = [step for step in told if step[0] > LARGE]
    if not told:
        return "this ONNX Runtime does not say what it asked for: nothing to compare with"
    if not large:
        most = max(abs(first - peak) for peak, first, _ in told)
        return f"what ONNX Runtime asks for in a first step differs by {most} bytes at most"
    off = max(abs(first / peak - 1) for peak, first, _ in large)
    later = [later / peak for peak, _, later in large]
    return (
        f"above {LARGE / 1e6:g} MB, what ONNX Runtime asks for in a first step differs by "
        f"{off:.2%} at most; its plan for later steps takes {min(later):.2f} to {max(later):.2f} "
        "times as much"
    )


def peak_table(batch: str, steps: Values) -> Table:
    """Peaks of one batch and what they are to each other."""
    keys = {"bp_over_sgm_int8": "bp over\nint8", "bp_over_sgm_float": "bp over\nfloat"}
    keys |= {"outputs_alone": "outputs\nalone"}
    peaks = [(heading, "{:,.1f}") for heading in ("SGM\nint8", "SGM\nfloat", "\nbackprop")]
    return table(
        f"a step of {batch} crops: peak of live activations [kB]",
        ["tuned\nlayers", *peaks, *((heading, "{:.2f}") for heading in keys.values())],
        [[tuned, *kilobytes(some), *(some[key] for key in keys)] for tuned, some in steps.items()],
        left=(),
        padding=CLOSE,
    )


def kilobytes(steps: Values) -> list[float]:
    """Every variant's peak."""
    return [steps[name]["peak_bytes"] / 1000 for name in STEPS]


def smaller_table(steps: Values) -> Table:
    """Peaks of several batches, side by side."""
    columns: list[str | tuple[str, str]] = ["tuned\nlayers"]
    for batch in steps:
        first = f"{batch} crop{'s' * (batch != '1')}\nint8"
        columns += [(name, "{:,.1f}") for name in (first, "\nfloat", "\nbp")]
        columns.append(("bp/\nint8", "{:.2f}"))
    rows = [
        [tuned, *(c for by in steps.values() for c in [*kilobytes(by[tuned]), by[tuned][RATIO]])]
        for tuned in next(iter(steps.values()), {})
    ]
    return table("smaller batches [kB]", columns, rows, left=(), padding=CLOSE)


RATIO = "bp_over_sgm_int8"


def alive_rows(steps: Values) -> Iterator[list[object]]:
    """What makes the peaks: variant, node, tensor, MB and share."""
    for name in STEPS:
        head = [name, steps[name]["at"]]
        for tensor, size in steps[name]["alive_at_peak"].items():
            yield [*head, tensor, size / 1e6, size / steps[name]["peak_bytes"]]
            head = ["", ""]


def process_table(values: Values) -> Table:
    """Whole processes."""
    probed, unprobed = values["processes"], values["processes_without_probes"]
    names, epochs = [*next(iter(probed.values()))], values["epochs"]
    return table(
        f"whole processes, {epochs} epoch{'s' * (epochs > 1)}: resident memory [MB]",
        ["tuned\nlayers", "\nprobes", *(f"\n{name}" for name in names)],
        [
            [tuned, told, *(f"{some[n] / 1e6:.0f}" if n in some else None for n in names)]
            for told, results in (("yes", probed), ("no", unprobed))
            for tuned, some in results.items()
        ],
        left=(),
        padding=CLOSE,
    )
