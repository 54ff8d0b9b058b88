"""What was taught and found, as tables for people and as JSON for programs.

The keys of the JSON objects are stable: more may be added, none goes or changes its meaning.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.grasp.angles import round_degrees, rounded_angle, rounded_turn
from qsgm.grasp.heatmap import Detection
from qsgm.grasp.taught import FinetuneResult
from qsgm.grasp.verdict import Verdict
from qsgm.tables import number, plain_table
from qsgm.tune.report import fidelity_report, run_title, seconds_line


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
        "angle_deg": rounded_angle(detection.angle_deg, 2),
        "full_angle_deg": full_angle_json(detection.full_angle_deg),
        "full_angle_confidence": None if confidence is None else number(confidence, 4),
        "refined_by": detection.refined_by,
    }


def place_json(place: Detection) -> dict[str, Any]:
    """A place where the object may be."""
    return {
        "center_px": [number(value, 2) for value in place.center_px],
        "quality": number(place.quality, 4),
        "angle_deg": rounded_angle(place.angle_deg, 2),
        "full_angle_deg": full_angle_json(place.full_angle_deg),
    }


def full_angle_json(angle_deg: float | None) -> float | None:
    """A turn over the full circle, if it is known."""
    return None if angle_deg is None else rounded_turn(math.radians(angle_deg))


def finetune_report(result: FinetuneResult, name: str) -> RenderableType:
    """Before and after, fidelity, seconds, and whatever there is to say."""
    return Group(
        before_after_table(result, name),
        fidelity_report(result),
        *verdict_lines(result.verdict),
        seconds_line(result.seconds),
    )


def verdict_lines(verdict: Verdict) -> list[Text]:
    """What to expect of the object, why, and what to do."""
    style = "bold green" if verdict.good else "bold yellow"
    return [
        Text(f"verdict: {verdict.headline}", style=style),
        *(Text(f"  {reason}", style="yellow") for reason in verdict.reasons),
        *(Text(f"  {note}") for note in verdict.notes),
    ]


def before_after_table(result: FinetuneResult, name: str) -> Table:
    """What tuning changed on the validation crops."""
    table = plain_table(run_title(result, name))
    table.add_column("200 validation crops")
    table.add_column("detection", justify="right")
    table.add_column("angle error", justify="right")
    table.add_column("others told apart", justify="right")
    for label, scores in (("untouched", result.untouched), ("tuned", result.scores)):
        told = scores["told_apart"]
        apart = "-" if told is None else f"{told:.3f}"
        detection, error = f"{scores['detection_accuracy']:.3f}", f"{scores['angle_mae_deg']:.1f}°"
        table.add_row(label, detection, error, apart)
    return table


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
        both = "no" if one.full_angle_deg is not None else "yes"
        table.add_row(f"{one.quality:.2f}", *place_texts(one), both)
    return table


def place_texts(place: Detection) -> tuple[str, str, str]:
    """Centre, move and turn in few words."""
    (x, y), (right, down) = place.center_px, (value + 0.0 for value in place.displacement_px)
    return f"{x:.1f}, {y:.1f} px", f"{right:+.1f}, {down:+.1f} px", turn_text(place)


def turn_text(detection: Detection) -> str:
    """Over the full circle where that is known."""
    if detection.full_angle_deg is None:
        return f"{round_degrees(detection.angle_deg, 1):+.1f}°"
    full = round(detection.full_angle_deg, 1) + 0.0
    return f"{180.0 if full <= -180.0 else full:+.1f}°"
