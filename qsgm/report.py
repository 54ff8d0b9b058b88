"""What was measured, as tables for people and as JSON for programs.

The keys of the JSON objects are stable: more may be added, none goes or changes its meaning.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.angles import round_degrees
from qsgm.fidelity import LayerFidelity
from qsgm.predict import Detection

if TYPE_CHECKING:
    from qsgm.finetuning import FinetuneResult
    from qsgm.preparing import Accuracy

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


def to_json(values: Mapping[str, Any]) -> str:
    """One JSON object on one line; a number that is not finite is a programming error."""
    return json.dumps(values, allow_nan=False)


def number(value: float, digits: int) -> float | None:
    """A rounded number; None, JSON's null, for one that is not finite."""
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    return round(float(value), digits) + 0.0 if math.isfinite(value) else None


def angle(value_deg: float, digits: int) -> float | None:
    """A rounded angle in (-90, 90], None unless it is finite."""
    return round_degrees(value_deg, digits) if math.isfinite(value_deg) else None


def finetune_json(result: "FinetuneResult", name: str, output: Path) -> dict[str, Any]:
    """The stable keys of `qsgm finetune`, then the others."""
    settings = result.settings
    return {
        "object": name,
        "method": settings.method,
        "precision": settings.precision,
        "layers": settings.layers,
        "epochs": settings.epochs,
        "seed": settings.seed,
        "bundle": str(result.prepared.bundle.folder),
        "output": str(output),
        **accuracy_json(result.accuracy),
        "zero_shot": accuracy_json(result.zero_shot),
        "fidelity": {str(k): fidelity_json(v) for k, v in result.fidelity.items()},
        "seconds": seconds_json(result.seconds),
        "peak_activation_bytes": result.peak_activation_bytes,
        "blocks": str(result.blocks),
        "recalibrated": settings.recalibrate,
        "stream": result.prepared.settings.stream,
        "trunk": result.trunk,
        "optimizer": result.recipe.optimizer,
        "rates": list(result.recipe.rates_over(result.steps)),
        "orientation_deg": angle(math.degrees(result.prepared.offset_rad), 2),
        "orientation_strength": number(result.prepared.offset_strength, 3),
        "warnings": list(result.warnings),
    }


def run_json(result: "FinetuneResult", name: str, output: Path) -> dict[str, Any]:
    """What is kept with the tuned object: :func:`finetune_json` and how the run went."""
    return finetune_json(result, name, output) | {
        "loss": [number(loss, 5) for loss in result.losses],
        "fidelity_over_run": fidelity_over_run_json(result),
    }


def fidelity_command_json(result: "FinetuneResult", name: str) -> dict[str, Any]:
    """What `qsgm fidelity` prints: the part of :func:`finetune_json` that concerns gradients."""
    keys = ("method", "precision", "layers", "epochs", "seed", "bundle", "fidelity")
    everything = finetune_json(result, name, Path())
    wanted = {key: everything[key] for key in ("object", *keys, "trunk", "warnings")}
    return wanted | {
        "every": result.settings.probe_every,
        "fidelity_over_run": fidelity_over_run_json(result),
    }


def predict_json(
    detection: Detection, heatmap_shape: Sequence[int], name: str, output: Path | None
) -> dict[str, Any]:
    """The stable keys of `qsgm predict`, then the others."""
    return {
        "object": name,
        "quality": number(detection.quality, 4),
        "center_px": [number(value, 2) for value in detection.center_px],
        "displacement_px": [number(value, 2) for value in detection.displacement_px],
        "angle_deg": angle(detection.angle_deg, 2),
        "heatmap_shape": [int(side) for side in heatmap_shape],
        "found": detection.found,
        "output": None if output is None else str(output),
    }


def accuracy_json(accuracy: "Accuracy") -> dict[str, float | None]:
    """Detection and angle."""
    return {
        "detection_accuracy": number(accuracy.detection_accuracy, 4),
        "angle_mae_deg": number(accuracy.angle_mae_deg, 3),
    }


def fidelity_json(layer: LayerFidelity) -> dict[str, float | None]:
    """One SGM layer's metrics."""
    return {name: number(value, 5) for name, value in asdict(layer).items()}


def fidelity_over_run_json(result: "FinetuneResult") -> list[dict[str, Any]]:
    """Every probe: its step (0: before the first one), epoch, and its layers' metrics."""
    return [
        {"step": probe.step, "epoch": number(probe.epoch, 5)}
        | {str(k): fidelity_json(v) for k, v in probe.layers.items()}
        for probe in result.probes
    ]


def seconds_json(seconds: Mapping[str, float]) -> dict[str, float | None]:
    """Seconds per stage, the total last."""
    stages = [stage for stage in seconds if stage != "total"]
    return {stage: number(seconds[stage], 4) for stage in (*stages, "total")}


def finetune_report(result: "FinetuneResult", name: str) -> RenderableType:
    """Before and after, fidelity, seconds, and whatever there is to say."""
    return Group(
        before_after_table(result, name), fidelity_report(result), seconds_line(result.seconds)
    )


def fidelity_report(result: "FinetuneResult") -> RenderableType:
    """The fidelity table with its legend, and warnings."""
    parts: list[RenderableType] = []
    if result.probes:
        parts += [fidelity_table(result.fidelity), Text(FIDELITY_LEGEND, style="dim")]
    return Group(*parts, *warning_lines(result))


def fidelity_command_report(result: "FinetuneResult") -> RenderableType:
    """What `qsgm fidelity` shows: both tables with their legends, when it looked, and warnings."""
    last, every = result.probes[-1].step, result.settings.probe_every
    return Group(
        fidelity_table(result.fidelity),
        Text(FIDELITY_LEGEND, style="dim"),
        detail_table(result.fidelity),
        Text(DETAIL_LEGEND, style="dim"),
        Text(f"probes: {len(result.probes)}, at steps 0 to {last} by {every}"),
        *warning_lines(result),
    )


def warning_lines(result: "FinetuneResult") -> list[Text]:
    """One line for every warning."""
    return [Text(f"note: {warning}", style="yellow") for warning in result.warnings]


def before_after_table(result: "FinetuneResult", name: str) -> Table:
    """What tuning changed on the validation crops."""
    settings = result.settings
    how = settings.method if settings.method == "bp" else f"sgm {settings.precision}"
    which = f"blocks {settings.blocks}" if settings.blocks else f"last {settings.layers} layers"
    title = f"{name}: {which}, {how}, {settings.epochs} epochs"
    table = plain_table(title)
    table.add_column("200 validation crops")
    table.add_column("detection", justify="right")
    table.add_column("angle error", justify="right")
    for label, accuracy in (("untouched", result.zero_shot), ("tuned", result.accuracy)):
        table.add_row(label, f"{accuracy.detection_accuracy:.3f}", f"{accuracy.angle_mae_deg:.1f}°")
    return table


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


def detection_table(detection: Detection, name: str) -> RenderableType:
    """What was found, or that nothing was."""
    table = plain_table(None)
    table.show_header = False
    table.add_column(style="bold")
    table.add_column()
    x, y = detection.center_px
    if not detection.found:
        table.add_row(Text(name), Text("not found", style="bold red"))
        table.add_row("quality", f"{detection.quality:.2f} (found from 0.50)")
        table.add_row("best guess", f"{x:.0f}, {y:.0f} px")
        return table
    right, down = (value + 0.0 for value in detection.displacement_px)
    table.add_row(Text(name), Text("found", style="bold green"))
    table.add_row("quality", f"{detection.quality:.2f}")
    table.add_row("centre", f"{x:.1f}, {y:.1f} px")
    table.add_row("move", f"{right:+.1f} px right, {down:+.1f} px down")
    table.add_row("turn", f"{round_degrees(detection.angle_deg, 1):+.1f}° counter-clockwise")
    return table


def plain_table(title: str | None) -> Table:
    """A table without vertical lines, its title on the left."""
    shown = None if title is None else Text(title)  # a name may look like markup: [x]
    return Table(title=shown, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
