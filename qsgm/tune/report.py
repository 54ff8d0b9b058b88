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

from qsgm.fidelity import LayerFidelity
from qsgm.grasp.angles import round_degrees
from qsgm.grasp.finding import full_degrees
from qsgm.grasp.heatmap import Detection, Place

if TYPE_CHECKING:
    from qsgm.grasp.verdict import Verdict
    from qsgm.tune.prepare import Accuracy
    from qsgm.tune.run import FinetuneResult

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


def full_angle(turn_rad: float) -> float:
    """A turn in degrees, rounded, in (-180, 180]."""
    rounded = round(full_degrees(turn_rad), 2) + 0.0
    return 180.0 if rounded <= -180.0 else rounded


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
        **shown_json(result),
        "verdict": result.verdict.to_json(),
        "warnings": [*result.warnings, *result.verdict.reasons],
    }


def shown_json(result: "FinetuneResult") -> dict[str, Any]:
    """What was shown of the object."""
    shown, others = result.prepared.shown, result.prepared.others_sha256
    turns = [None if turn is None else full_angle(turn) for turn in shown.turns_rad]
    return {
        "scale": number(shown.scale, 5),
        "span_px": None if shown.span_px is None else number(shown.span_px, 1),
        "demonstrations": [{"turn_deg": turn} for turn in turns],
        "others": len(others),
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
    wanted = {key: everything[key] for key in ("object", *keys, "trunk")}
    return wanted | {
        "warnings": list(result.warnings),
        "every": result.settings.probe_every,
        "fidelity_over_run": fidelity_over_run_json(result),
    }


def predict_json(
    detection: Detection,
    heatmap_shape: Sequence[int],
    name: str,
    output: Path | None,
    instances: Sequence[Detection] | None = None,
) -> dict[str, Any]:
    """The stable keys of `qsgm predict`, then the others; `objects` where all were asked for."""
    objects = {} if instances is None else {"objects": [object_json(one) for one in instances]}
    return {
        "object": name,
        **object_json(detection),
        "heatmap_shape": [int(side) for side in heatmap_shape],
        "found": detection.found,
        "scale": number(detection.scale, 5),
        "candidates": [place_json(place) for place in detection.candidates],
        **objects,
        "output": None if output is None else str(output),
    }


def object_json(detection: Detection) -> dict[str, Any]:
    """One object of a scene."""
    confidence = detection.full_angle_confidence
    return {
        "quality": number(detection.quality, 4),
        "center_px": [number(value, 2) for value in detection.center_px],
        "displacement_px": [number(value, 2) for value in detection.displacement_px],
        "angle_deg": angle(detection.angle_deg, 2),
        "full_angle_deg": full_angle_json(detection.full_angle_deg),
        "full_angle_confidence": None if confidence is None else number(confidence, 4),
        "refined_by": detection.refined_by,
    }


def place_json(place: Place) -> dict[str, Any]:
    """A place where the object may be."""
    return {
        "center_px": [number(value, 2) for value in place.center_px],
        "quality": number(place.quality, 4),
        "angle_deg": angle(place.angle_deg, 2),
        "full_angle_deg": full_angle_json(place.full_angle_deg),
    }


def full_angle_json(angle_deg: float | None) -> float | None:
    """A turn over the full circle, if it is known."""
    return None if angle_deg is None else full_angle(math.radians(angle_deg))


def accuracy_json(accuracy: "Accuracy") -> dict[str, float | None]:
    """Detection and angle, with other things on the crops and without, and what was told apart."""
    values = {
        "detection_accuracy": (accuracy.detection_accuracy, 4),
        "angle_mae_deg": (accuracy.angle_mae_deg, 3),
        "detection_accuracy_plain": (accuracy.detection_accuracy_plain, 4),
        "angle_mae_deg_plain": (accuracy.angle_mae_deg_plain, 3),
        "told_apart": (accuracy.told_apart, 4),
    }
    return {
        key: None if value is None else number(value, digits)
        for key, (value, digits) in values.items()
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
        before_after_table(result, name),
        fidelity_report(result),
        *verdict_lines(result.verdict),
        seconds_line(result.seconds),
    )


def verdict_lines(verdict: "Verdict") -> list[Text]:
    """What to expect of the object, why, and what to do."""
    style = "bold green" if verdict.good else "bold yellow"
    return [
        Text(f"verdict: {verdict.headline}", style=style),
        *(Text(f"  {reason}", style="yellow") for reason in verdict.reasons),
        *(Text(f"  {note}") for note in verdict.notes),
    ]


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
    table.add_column("others told apart", justify="right")
    for label, accuracy in (("untouched", result.zero_shot), ("tuned", result.accuracy)):
        told = "-" if accuracy.told_apart is None else f"{accuracy.told_apart:.3f}"
        detection, error = accuracy.detection_accuracy, accuracy.angle_mae_deg
        table.add_row(label, f"{detection:.3f}", f"{error:.1f}°", told)
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
    modulo = "" if detection.full_angle_deg is not None else ", or the opposite"
    table.add_row("turn", f"{turn_text(detection)} counter-clockwise{modulo}")
    return table


def instances_table(instances: Sequence[Detection], name: str) -> RenderableType:
    """Every instance that was found, a row each."""
    if not instances:
        return Text(f"{name}: not found", style="bold red")
    table = plain_table(f"{name}: {len(instances)} found")
    for header in ("quality", "centre", "move right, down", "turn", "or the opposite"):
        table.add_column(header, justify="right")
    for one in instances:
        (x, y), (right, down) = one.center_px, (value + 0.0 for value in one.displacement_px)
        move = f"{right:+.1f}, {down:+.1f} px"
        both = "no" if one.full_angle_deg is not None else "yes"
        table.add_row(f"{one.quality:.2f}", f"{x:.1f}, {y:.1f} px", move, turn_text(one), both)
    return table


def turn_text(detection: Detection) -> str:
    """Over the full circle where that is known."""
    if detection.full_angle_deg is None:
        return f"{round_degrees(detection.angle_deg, 1):+.1f}°"
    full = round(detection.full_angle_deg, 1) + 0.0
    return f"{180.0 if full <= -180.0 else full:+.1f}°"


def plain_table(title: str | None) -> Table:
    """A table without vertical lines, its title on the left."""
    shown = None if title is None else Text(title)  # a name may look like markup: [x]
    return Table(title=shown, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD)
