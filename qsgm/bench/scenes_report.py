"""What was found in composed scenes, as JSON and as tables."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
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
from qsgm.tables import DASH, TIGHT, legend, number, table
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


def report_json(
    plan: ScenePlan, settings: Settings, bundle: Path, source: str, methods: Sequence[MethodResults]
) -> dict[str, Any]:
    """All answers to all scenes.

    Args:
        plan: of the scenes.
        settings: of the first method.
        bundle: of the first method.
        source: where the subjects come from.
        methods: the first is the one measured, the others are rivals.
    """
    measured = methods[0]
    return {
        "bundle": str(bundle),
        "method": settings.method,
        "precision": settings.precision,
        "layers": settings.layers,
        "epochs": settings.epochs,
        "seed": settings.seed,
        "frames": source,
        "objects": len(plan.taught),
        "pairs_per_condition_and_object": plan.count,
        **summary(measured.results),
        **by_condition(measured, plan, shares),
        "at_false_alarm_rate": at_rate(plan, methods),
        "per_scene": [_scene_json(result) for result in measured.results],
    }


def summary(results: Sequence[Judged]) -> dict[str, float | int | None]:
    """The figures of all conditions together."""
    present = sum(result.truth.present for result in results)
    outcomes = Counter(result.outcome for result in results)
    elsewhere = outcomes["wrong_thing"] + outcomes["background"]
    alarms = outcomes["false_alarm"]
    found = errors(results)
    return {
        "scenes": present,
        "empty_scenes": len(results) - present,
        "median_center_error_px": number(found["median_center_error_px"], 2),
        "median_turn_error_deg": number(found["median_turn_error_deg"], 2),
        "found_share": number(outcomes["right_place"] / max(present, 1), 4),
        "missed": outcomes["missed"],
        "false_detections": elsewhere + alarms,
        "false_detections_elsewhere": elsewhere,
        "false_detections_empty": alarms,
        "free_of_false_detections": number(1 - (elsewhere + alarms) / max(len(results), 1), 4),
    }


def by_condition(
    method: MethodResults, plan: ScenePlan, statistics: Callable[[Tally], Mapping[str, float]]
) -> dict[str, Any]:
    """One method's figures in every condition, and of all."""
    of = {name: figures(method.of(name), plan.seed, statistics) for name in plan.conditions}
    return {"conditions": of, POOLED: figures(method.results, plan.seed, statistics)}


def at_rate(plan: ScenePlan, methods: Sequence[MethodResults]) -> dict[str, Any]:
    """Every method at its threshold for 2 % false alarms, and the differences to the first."""
    levelled = [method.at_false_alarm_rate() for method in methods]
    mine, *theirs = (Tally.of(method.results).right for method in levelled)
    differences = {
        rival.name: paired_difference(mine, right, plan.seed)
        for rival, right in zip(levelled[1:], theirs, strict=True)
    }
    return {
        "rate": FALSE_ALARM_RATE,
        "methods": {
            method.name: {
                "threshold": number(method.threshold, 4),
                "seconds_per_scene": _median_seconds(method.results),
                **by_condition(method, plan, outcome_shares),
            }
            for method in levelled
        },
        "right_place_minus": {
            name: {
                "difference": number(difference, 4),
                "interval_95": [number(low, 4), number(high, 4)],
            }
            for name, (difference, (low, high)) in differences.items()
        },
    }


def render(values: dict[str, Any]) -> RenderableType:
    """Tables for people of what :func:`report_json` gave."""
    levelled = values["at_false_alarm_rate"]
    rivals = [methods_table(levelled)] if len(levelled["methods"]) > 1 else []
    texts = Text(intervals_line(values)), legend(LEGEND)
    return Group(conditions_table(values), *texts, *rivals, *difference_lines(levelled))


def figures(
    results: Sequence[Judged],
    seed: int,
    statistics: Callable[[Tally], Mapping[str, float]],
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
    rows: list[list[object]] = [
        [_plain(name), *(_cell(row[key], *form) for key, _, *form in _COLUMNS)]
        for name, row in (*values["conditions"].items(), (POOLED, values[POOLED]))
    ]
    title = (
        f"objects looked for, {values['objects']} in number: {values['scenes']} scenes with them, "
        f"{values['empty_scenes']} without"
    )
    headings = ["scenes", *(heading for _, heading, _, _ in _COLUMNS)]
    return table(title, headings, [*rows[:-1], [], rows[-1]], padding=TIGHT)


def methods_table(values: dict[str, Any]) -> Table:
    """Right places of every method at the same rate of false alarms."""
    methods = [*values["methods"].values()]
    rows: list[list[object]] = [
        [_plain(name), *(_with_interval(one["conditions"][name], "right_place") for one in methods)]
        for name in methods[0]["conditions"]
    ]
    rows += [[], [POOLED, *(_with_interval(one[POOLED], "right_place") for one in methods)]]
    for label, key, factor, digits in _METHOD_ROWS:
        rows.append([label, *(_cell(one[POOLED][key], factor, digits) for one in methods)])
    rows.append(["ms per scene", *(_cell(one["seconds_per_scene"], 1000, 0) for one in methods)])
    title = (
        f"right place [%], every method at its threshold for {100 * values['rate']:.0f} % "
        f"false alarms"
    )
    return table(title, ["scenes", *values["methods"]], rows, padding=TIGHT)


_METHOD_ROWS = (
    ("found on a wrong thing", "wrong_thing", 100, 1),
    ("found on background", "background", 100, 1),
    ("median centre error [px]", "median_center_error_px", 1, 1),
    ("median turn error [°]", "median_turn_error_deg", 1, 1),
)


def difference_lines(levelled: dict[str, Any]) -> list[Text]:
    """How much more often the first method is right, on the very same scenes, in points of 100."""
    first, *_ = levelled["methods"]
    lines = []
    for name, row in levelled["right_place_minus"].items():
        value, low, high = (100 * one for one in (row["difference"], *row["interval_95"]))
        points = f"{value:+.1f} points right place ({low:+.1f} to {high:+.1f})"
        lines.append(Text(f"{first} minus {name}: {points}"))
    return lines


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


def _plain(name: Condition | str) -> str:
    return name.replace("_", " ")


def _cell(value: float | None, factor: float, digits: int) -> str:
    return DASH if value is None else f"{factor * value:.{digits}f}"


def _with_interval(row: dict[str, Any], key: str) -> str:
    low, high = row[f"{key}_95"]
    return f"{_cell(row[key], 100, 1)} ({_cell(low, 100, 0)}-{_cell(high, 100, 0)})"


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
