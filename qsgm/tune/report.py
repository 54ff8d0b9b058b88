"""A run as tables for people and as JSON for programs.

The keys of the JSON objects are stable: more may be added, none goes or changes its meaning.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.blocks import single_layers
from qsgm.fidelity import LayerFidelity
from qsgm.tables import number, plain_table
from qsgm.task import Scores
from qsgm.tune.result import Result

FIDELITY_LEGEND = (
    "means over the run; cos: cosine of int8, float and true gradients; norm ratio: |int8|/|true|; "
    "signs agree: int8 with float; clipped: share of the SGM's inputs outside its ranges"
)
# (key, header, format)
_FIDELITY_COLUMNS = (
    ("cos_int8_float", "cos\nint8,float", "{:.5f}"),
    ("cos_int8_true", "cos\nint8,true", "{:.3f}"),
    ("cos_float_true", "cos\nfloat,true", "{:.3f}"),
    ("norm_ratio_int8_true", "norm\nratio", "{:.2f}"),
    ("sign_agreement_int8_float", "signs\nagree", "{:.3f}"),
    ("sqnr_db", "SQNR\n[dB]", "{:.1f}"),
    ("clipped_fraction", "\nclipped", "{:.4f}"),
)
DETAIL_LEGEND = (
    "angle: between int8 and float; weighted error: of int8, its components weighted by |float|; "
    "sample: each sample's own cosine; update: cosine of what the layer's weights get"
)
_DETAIL_COLUMNS = (
    ("direction_deviation_deg", "angle\n[°]", "{:.2f}"),
    ("weighted_error", "weighted\nerror", "{:.4f}"),
    ("cos_sample_int8_float", "sample\nint8,float", "{:.4f}"),
    ("cos_sample_int8_true", "sample\nint8,true", "{:.3f}"),
    ("cos_update_int8_float", "update\nint8,float", "{:.4f}"),
    ("cos_update_int8_true", "update\nint8,true", "{:.3f}"),
    ("cos_update_float_true", "update\nfloat,true", "{:.3f}"),
)


def result_json(result: Result, name: str, output: Path) -> dict[str, Any]:
    """The stable keys of `qsgm finetune`, then the others."""
    settings, plan = result.plan.settings, result.plan
    return {
        "object": name,
        "method": settings.method,
        "precision": plan.precision,
        "layers": settings.layers,
        "epochs": settings.epochs,
        "seed": settings.seed,
        "bundle": str(result.prepared.bundle.folder),
        "output": str(output),
        **scores_json(result.scores),
        "zero_shot": scores_json(result.untouched),
        "fidelity": {str(k): fidelity_json(v) for k, v in result.fidelity.items()},
        "seconds": seconds_json(result.seconds),
        "peak_activation_bytes": result.peak_activation_bytes,
        "blocks": str(result.blocks),
        "recalibrated": settings.recalibrate,
        "stream": result.prepared.plan.settings.stream,
        "trunk": result.prepared.plan.trunk,
        "optimizer": plan.recipe.optimizer,
        "rates": list(plan.recipe.rates_over(result.steps)),
        "warnings": list(result.warnings),
    }


def course_json(result: Result) -> dict[str, Any]:
    """How a run went: loss by epoch, fidelity by probe."""
    return {
        "loss": [number(loss, 5) for loss in result.losses],
        "fidelity_over_run": fidelity_over_run_json(result),
    }


def fidelity_command_json(result: Result, name: str) -> dict[str, Any]:
    """What `qsgm fidelity` prints: the part of :func:`result_json` that concerns gradients."""
    keys = ("method", "precision", "layers", "epochs", "seed", "bundle", "fidelity")
    everything = result_json(result, name, Path())
    wanted = {key: everything[key] for key in ("object", *keys, "trunk")}
    return wanted | {
        "warnings": list(result.warnings),
        "every": result.plan.settings.probe_every,
        "fidelity_over_run": fidelity_over_run_json(result),
    }


def scores_json(scores: Scores) -> dict[str, float | None]:
    """What held-out samples say, by name."""
    return {name: None if value is None else number(value, 4) for name, value in scores.items()}


def fidelity_json(layer: LayerFidelity, digits: int = 5) -> dict[str, float | None]:
    """One SGM layer's metrics."""
    return {name: number(value, digits) for name, value in asdict(layer).items()}


def fidelity_over_run_json(result: Result) -> list[dict[str, Any]]:
    """Every probe: its step (0: before the first one), epoch, and its layers' metrics."""
    return [
        {"step": probe.step, "epoch": number(probe.epoch, 5)}
        | {str(k): fidelity_json(v, 7) for k, v in probe.layers.items()}
        for probe in result.probes
    ]


def seconds_json(seconds: Mapping[str, float]) -> dict[str, float | None]:
    """Seconds per stage, the total last."""
    stages = [stage for stage in seconds if stage != "total"]
    return {stage: number(seconds[stage], 4) for stage in (*stages, "total")}


def fidelity_report(result: Result) -> RenderableType:
    """The fidelity table with its legend, and warnings."""
    parts: list[RenderableType] = []
    if result.probes:
        parts += [fidelity_table(result.fidelity), Text(FIDELITY_LEGEND, style="dim")]
    return Group(*parts, *warning_lines(result))


def fidelity_command_report(result: Result) -> RenderableType:
    """What `qsgm fidelity` shows: both tables with their legends, when it looked, and warnings."""
    last, every = result.probes[-1].step, result.plan.settings.probe_every
    return Group(
        fidelity_table(result.fidelity),
        Text(FIDELITY_LEGEND, style="dim"),
        detail_table(result.fidelity),
        Text(DETAIL_LEGEND, style="dim"),
        Text(f"probes: {len(result.probes)}, at steps 0 to {last} by {every}"),
        *warning_lines(result),
    )


def warning_lines(result: Result) -> list[Text]:
    """One line for every warning."""
    return [Text(f"note: {warning}", style="yellow") for warning in result.warnings]


def run_title(result: Result, name: str) -> str:
    """What was tuned, and how."""
    settings = result.plan.settings
    how = settings.method if settings.method == "bp" else f"sgm {settings.precision}"
    which = f"last {settings.layers} layers"
    if settings.method == "sgm" and result.blocks != single_layers(result.blocks.layers):
        which = f"blocks {result.blocks}"
    return f"{name}: {which}, {how}, {settings.epochs} epochs"


def fidelity_table(fidelity: Mapping[int, LayerFidelity]) -> Table:
    """One row per SGM layer; :data:`FIDELITY_LEGEND` goes below."""
    table = plain_table("how faithful the gradients were")
    _add_layers(table, fidelity, _FIDELITY_COLUMNS)
    return table


def detail_table(fidelity: Mapping[int, LayerFidelity]) -> Table:
    """The other metrics, a row per SGM layer; :data:`DETAIL_LEGEND` goes below."""
    table = plain_table("sample by sample, and what the weights get")
    table.padding = 0  # the lines between columns are blanks, and 80 columns have to do
    _add_layers(table, fidelity, _DETAIL_COLUMNS)
    return table


def _add_layers(
    table: Table, fidelity: Mapping[int, LayerFidelity], columns: Sequence[tuple[str, str, str]]
) -> None:
    """Columns (key, header, format), and a row per SGM layer."""
    table.add_column("\nlayer", justify="right")
    for _, header, _ in columns:
        table.add_column(Text(header), justify="right")
    for layer, values in sorted(fidelity.items()):
        cells = [form.format(getattr(values, key)) for key, _, form in columns]
        table.add_row(str(layer), *cells)


def seconds_line(seconds: Mapping[str, float]) -> Text:
    """Seconds per stage on one line."""
    stages = [f"{stage} {seconds[stage]:.2f}" for stage in seconds if stage != "total"]
    return Text(f"seconds: {', '.join(stages)}; total {seconds['total']:.2f}")
