"""What was found in composed scenes, as JSON and as tables."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.bench.composing import Condition
from qsgm.bench.judging import (
    FALSE_ALARM_RATE,
    ON_OBJECT_PX,
    Judged,
    Tally,
    errors,
    intervals,
    outcome_shares,
    paired_difference,
    shares,
)
from qsgm.bench.scenes import MethodResults, ScenePlan
from qsgm.tune.report import number, plain_table
from qsgm.tune.settings import Settings

POOLED = "pooled"
LEGEND = (
    f"right: found within {ON_OBJECT_PX:.0f} px of the true centre; thing: found on another thing; "
    "backgr: found elsewhere; alarm: found though absent; all in % of the scenes with or without "
    "the object. ROC: area, EER: equal error rate [%], of the quality. centre [px] and turn [°, "
    "modulo 180, elongated objects]: median errors of right places; way: right way round [%]; "
    "fallback: of refining them"
)
# (key, heading, factor, digits)
_COLUMNS = (
    ("right_place", "right", 100, 1),
    ("wrong_thing", "thing", 100, 1),
    ("background", "backgr", 100, 1),
    ("missed", "missed", 100, 1),
    ("false_alarm", "alarm", 100, 1),
    ("roc_area", "ROC", 1, 3),
    ("equal_error_rate", "EER", 100, 1),
    ("median_center_error_px", "centre", 1, 1),
    ("median_turn_error_deg", "turn", 1, 1),
    ("full_turn_right", "way", 100, 0),
)


@dataclass(frozen=True)
class ScenesReport:
    """All answers to all scenes; the first method is the one measured, the others are rivals."""

    plan: ScenePlan
    settings: Settings
    bundle: Path
    source: str  # where the subjects come from
    methods: tuple[MethodResults, ...]

    @property
    def measured(self) -> MethodResults:
        return self.methods[0]

    def summary(self) -> dict[str, float | int | None]:
        """The figures of all conditions together."""
        results = self.measured.results
        present = [result for result in results if result.truth.present]
        empty = [result for result in results if not result.truth.present]
        outcomes = [result.outcome for result in results]
        elsewhere = outcomes.count("wrong_thing") + outcomes.count("background")
        alarms = outcomes.count("false_alarm")
        found = errors(results)
        return {
            "scenes": len(present),
            "empty_scenes": len(empty),
            "median_center_error_px": number(found["median_center_error_px"], 2),
            "median_turn_error_deg": number(found["median_turn_error_deg"], 2),
            "found_share": number(outcomes.count("right_place") / max(len(present), 1), 4),
            "missed": outcomes.count("missed"),
            "false_detections": elsewhere + alarms,
            "false_detections_elsewhere": elsewhere,
            "false_detections_empty": alarms,
            "free_of_false_detections": number(1 - (elsewhere + alarms) / max(len(results), 1), 4),
        }

    def to_json(self) -> dict[str, Any]:
        plan, settings = self.plan, self.settings
        return {
            "bundle": str(self.bundle),
            "method": settings.method,
            "precision": settings.precision,
            "layers": settings.layers,
            "epochs": settings.epochs,
            "seed": settings.seed,
            "frames": self.source,
            "objects": len(plan.taught),
            "pairs_per_condition_and_object": plan.count,
            **self.summary(),
            "conditions": {
                name: figures(self.measured.of(name), plan.seed) for name in plan.conditions
            },
            POOLED: figures(self.measured.results, plan.seed),
            "at_false_alarm_rate": self.at_rate(),
            "per_scene": [_scene_json(result) for result in self.measured.results],
        }

    def at_rate(self) -> dict[str, Any]:
        """Every method at its threshold for 2 % false alarms, and the differences to the first."""
        levelled = [method.at_false_alarm_rate() for method in self.methods]
        mine = Tally.of(levelled[0].results).right
        values: dict[str, Any] = {"rate": FALSE_ALARM_RATE, "methods": {}}
        for method in levelled:
            values["methods"][method.name] = {
                "threshold": number(method.threshold, 4),
                "seconds_per_scene": _median_seconds(method.results),
                "conditions": {
                    name: figures(method.of(name), self.plan.seed, outcome_shares)
                    for name in self.plan.conditions
                },
                POOLED: figures(method.results, self.plan.seed, outcome_shares),
            }
        values["right_place_minus"] = {
            rival.name: _difference_json(mine, Tally.of(rival.results).right, self.plan.seed)
            for rival in levelled[1:]
        }
        return values

    def render(self, values: dict[str, Any]) -> RenderableType:
        """Tables for people of what :meth:`to_json` gave."""
        parts: list[RenderableType] = [
            conditions_table(values),
            Text(intervals_line(values)),
            Text(LEGEND, style="dim"),
        ]
        if len(self.methods) > 1:
            parts += [methods_table(values["at_false_alarm_rate"]), *difference_lines(values)]
        return Group(*parts)


def figures(
    results: Sequence[Judged],
    seed: int,
    statistics: Callable[[Tally], Mapping[str, float]] = shares,
) -> dict[str, Any]:
    """Shares with their 95 % intervals, and errors."""
    tally = Tally.of(results)
    values, ranges = statistics(tally), intervals(tally, seed, statistics)
    found: dict[str, Any] = {"scenes": len(tally.found)}
    for name in values:
        low, high = ranges[name]
        found[name] = number(values[name], 4)
        found[f"{name}_95"] = [number(low, 4), number(high, 4)]
    digits = {"full_turn_right": 4, "fallback": 4}
    return found | {
        name: number(value, digits.get(name, 2)) for name, value in errors(results).items()
    }


def conditions_table(values: dict[str, Any]) -> Table:
    """A row per condition and one of all."""
    table = plain_table(
        f"objects looked for, {values['objects']} in number: {values['scenes']} scenes with them, "
        f"{values['empty_scenes']} without"
    )
    table.padding = 0  # the lines between columns are blanks, and 80 columns have to do
    table.add_column("scenes")
    for _, heading, _, _ in _COLUMNS:
        table.add_column(heading, justify="right")
    for name, row in _rows(values):
        if name == POOLED:
            table.add_section()
        table.add_row(name, *(_cell(row[key], *form) for key, _, *form in _COLUMNS))
    return table


def methods_table(values: dict[str, Any]) -> Table:
    """Right places of every method at the same rate of false alarms."""
    methods: dict[str, Any] = values["methods"]
    table = plain_table(
        f"right place [%], every method at its threshold for {100 * values['rate']:.0f} % "
        f"false alarms"
    )
    table.padding = 0
    table.add_column("scenes")
    for name in methods:
        table.add_column(Text(name), justify="right")
    names = [*next(iter(methods.values()))["conditions"], POOLED]
    for name in names:
        rows = [m[POOLED] if name == POOLED else m["conditions"][name] for m in methods.values()]
        if name == POOLED:
            table.add_section()
        table.add_row(_plain(name), *(_with_interval(row, "right_place") for row in rows))
    for label, key, factor, digits in _METHOD_ROWS:
        cells = [_cell(m[POOLED][key], factor, digits) for m in methods.values()]
        table.add_row(Text(label), *cells)
    times = [_cell(m["seconds_per_scene"], 1000, 0) for m in methods.values()]
    table.add_row("ms per scene", *times)
    return table


_METHOD_ROWS = (
    ("found on a wrong thing", "wrong_thing", 100, 1),
    ("found on background", "background", 100, 1),
    ("median centre error [px]", "median_center_error_px", 1, 1),
    ("median turn error [°]", "median_turn_error_deg", 1, 1),
)


def difference_lines(values: dict[str, Any]) -> list[Text]:
    """How much more often the first method is right, on the very same scenes."""
    first, *_ = values["at_false_alarm_rate"]["methods"]
    return [
        Text(f"{first} minus {name}: {difference_text(difference)}")
        for name, difference in values["at_false_alarm_rate"]["right_place_minus"].items()
    ]


def difference_text(difference: dict[str, Any]) -> str:
    """A difference in right places with its interval, in points of a hundred."""
    low, high = difference["interval_95"]
    value = 100 * difference["difference"]
    return f"{value:+.1f} points right place ({100 * low:+.1f} to {100 * high:+.1f})"


def intervals_line(values: dict[str, Any]) -> str:
    """The pooled figures' 95 % intervals, and how often a right place was not refined."""
    row = values[POOLED]
    shown = (("right", "right_place", 100, 1), ("alarm", "false_alarm", 100, 1))
    texts = [
        f"{label} {_cell(row[f'{key}_95'][0], factor, digits)} to "
        f"{_cell(row[f'{key}_95'][1], factor, digits)}"
        for label, key, factor, digits in (*shown, ("ROC", "roc_area", 1, 3))
    ]
    fallback = _cell(row["fallback"], 100, 1)
    return f"pooled, 95 % intervals: {', '.join(texts)}; fallback ran in {fallback} %"


def _rows(values: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    rows = [(_plain(name), row) for name, row in values["conditions"].items()]
    return [*rows, (POOLED, values[POOLED])]


def _plain(name: Condition | str) -> str:
    return name.replace("_", " ")


def _cell(value: float | None, factor: float, digits: int) -> str:
    return "-" if value is None else f"{factor * value:.{digits}f}"


def _with_interval(row: dict[str, Any], key: str) -> str:
    low, high = row[f"{key}_95"]
    return f"{_cell(row[key], 100, 1)} ({_cell(low, 100, 0)}-{_cell(high, 100, 0)})"


def _difference_json(
    mine: np.ndarray[Any, np.dtype[np.bool_]],
    theirs: np.ndarray[Any, np.dtype[np.bool_]],
    seed: int,
) -> dict[str, Any]:
    difference, (low, high) = paired_difference(mine, theirs, seed)
    return {"difference": number(difference, 4), "interval_95": [number(low, 4), number(high, 4)]}


def _median_seconds(results: Sequence[Judged]) -> float | None:
    seconds = [r.answer.seconds for r in results if r.answer.seconds is not None]
    return number(float(np.median(seconds)), 5) if seconds else None


def _scene_json(result: Judged) -> dict[str, Any]:
    truth, answer = result.truth, result.answer
    present = truth.present
    full = answer.full_turn_deg
    return {
        "frame": truth.frame,
        "condition": truth.condition,
        "number": truth.number,
        "elongated": truth.elongated,
        "unique": truth.unique,
        "present": present,
        "absent_thing": truth.absent_thing,
        "true_center_px": _point_json(truth.center_px),
        "true_turn_deg": number(truth.turn_deg, 2),
        "true_scale": number(truth.scale, 3),
        "found": answer.found,
        "quality": number(answer.quality, 4),
        "center_px": _point_json(answer.center_px),
        "angle_deg": number(answer.turn_deg, 2),
        "full_angle_deg": None if full is None else number(full, 2),
        "refined": answer.refined,
        "center_error_px": number(result.center_error_px, 2),
        "turn_error_deg": number(result.turn_error_deg, 2) if present else None,
        "on": result.spot,
        "on_object": result.outcome == "right_place",
        "outcome": result.outcome,
    }


def _point_json(point: tuple[float, float] | None) -> list[float | None] | None:
    if point is None or not all(map(math.isfinite, point)):
        return None
    return [number(value, 2) for value in point]
