"""What `qsgm bench accuracy` found out: as JSON and as tables."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.bench.accuracy import (
    ANGLE,
    BP_BEST,
    DETECTION,
    METRICS,
    SGM_INT8,
    AccuracyReport,
    Floats,
    Runs,
)
from qsgm.bundle import Recipe
from qsgm.tune.report import number, plain_table
from qsgm.tune.settings import trunk_precision

LEGEND = """means over frames after so many epochs (ep.); then the longest run's median and
spread (standard deviation); angle: error in degrees, modulo 180°
bp best: of a grid, the optimizer and rate with the lowest angle error on these
very frames, for every run length anew, which favours backpropagation"""
# (metric, its short name, format)
_COLUMNS = ((DETECTION, "detect", "{:.3f}"), (ANGLE, "angle", "{:.2f}"))


def accuracy_report_json(report: AccuracyReport) -> dict[str, Any]:
    """The main run length's figures, then all lengths' with the grid and the learning curves."""
    main, groups = report.runs[-1], report.groups
    return {
        "bundle": str(report.bundle.folder),
        "layers": report.settings.layers,
        "trunk": trunk_precision(report.settings, report.bundle),
        "epochs": report.settings.epochs,
        "seed": report.settings.seed,
        **{
            group: {"frames": len(places), "methods": summary(main, places)}
            for group, places in groups.items()
        },
        "per_frame": [
            {
                "frame": frame.name,
                "elongated": frame.elongated,
                "methods": one_frame(main, i),
                "runs": {str(runs.epochs): one_frame(runs, i) for runs in report.runs},
            }
            for i, frame in enumerate(report.frames)
        ],
        "chosen_on": report.judged,
        "runs": [runs_json(runs, groups, report.judged) for runs in report.runs],
    }


def runs_json(runs: Runs, groups: dict[str, list[int]], judged: str) -> dict[str, Any]:
    """One run length: every group's figures, what `bp best` is, and the learning curves."""
    return {
        "epochs": runs.epochs,
        "steps": runs.steps[-1],
        "bp_best": _recipe_json(runs.best),
        "sgm_int8_over_bp_best": {
            group: {m: number(over_best(runs, places, k), 4) for k, m in enumerate(METRICS)}
            for group, places in groups.items()
        },
        **{group: summary(runs, places) for group, places in groups.items()},
        "grid": [
            _recipe_json(recipe)
            | {group: _means(curves[places, -1]) for group, places in groups.items()}
            for recipe, curves in runs.grid.items()
        ],
        "curves": {
            "frames": judged,
            "steps": list(runs.steps),
            "methods": {
                name: {m: curve_json(values[groups[judged], :, k]) for k, m in enumerate(METRICS)}
                for name, values in runs.methods.items()
            },
        },
    }


def one_frame(runs: Runs, place: int) -> dict[str, Any]:
    """One frame's results by method."""
    return {name: _means(values[[place], -1]) for name, values in runs.methods.items()}


def summary(runs: Runs, places: Sequence[int]) -> dict[str, Any]:
    """Mean, median, spread and both ends of every metric at the end of the runs, by method."""
    return {
        name: {m: statistics(values[places, -1, k].tolist()) for k, m in enumerate(METRICS)}
        for name, values in runs.methods.items()
    }


def statistics(values: Sequence[float]) -> dict[str, float | None]:
    """Mean, median, standard deviation and both ends."""
    return {
        "mean": number(float(np.mean(values)), 4),
        "median": number(float(np.median(values)), 4),
        "spread": number(float(np.std(values)), 4),
        "min": number(min(values), 4),
        "max": number(max(values), 4),
    }


def curve_json(values: Floats) -> dict[str, list[float | None]]:
    """Mean and quartiles over the frames of one metric (frames, steps)."""
    low, high = np.quantile(values, (0.25, 0.75), axis=0)
    lines = {"mean": values.mean(axis=0), "lower_quartile": low, "upper_quartile": high}
    return {name: [number(value, 4) for value in line] for name, line in lines.items()}


def over_best(runs: Runs, places: Sequence[int], metric: int) -> float:
    """Mean of `sgm int8` over that of `bp best`, at the end of the runs."""
    ours, best = (runs.methods[name][places, -1, metric].mean() for name in (SGM_INT8, BP_BEST))
    return float(ours / best) if best else np.nan


def render(report: AccuracyReport, per_frame: bool) -> RenderableType:
    """Tables of every group, of the best backpropagation and, if asked for, of every frame."""
    parts = [summary_table(report.runs, *group) for group in report.groups.items()]
    parts += [best_table(report), Text(LEGEND)]
    return Group(*parts, per_frame_table(report)) if per_frame else Group(*parts)


def summary_table(runs: Sequence[Runs], group: str, places: Sequence[int]) -> RenderableType:
    """One row per method; means of every run length, median and spread of the main one."""
    main = runs[-1]
    table = plain_table(f"{group}: {len(places)} frames")
    table.padding = 0
    table.add_column("\nmethod", no_wrap=True)
    for some in runs:
        table.add_column(f"{some.epochs} ep.\ndetect", justify="right", no_wrap=True)
        table.add_column("\nangle", justify="right", no_wrap=True)
    for _, header, _ in _COLUMNS:
        table.add_column(f"{header}\nmedian", justify="right", no_wrap=True)
        table.add_column("\nspread", justify="right", no_wrap=True)
    for name in main.methods:
        cells = [
            form.format(some.methods[name][places, -1, metric].mean())
            for some in runs
            for metric, _, form in _COLUMNS
        ]
        cells += [
            form.format(statistic(main.methods[name][places, -1, metric]))
            for metric, _, form in _COLUMNS
            for statistic in (np.median, np.std)
        ]
        table.add_row(name, *cells)
    return table


def best_table(report: AccuracyReport) -> RenderableType:
    """One row per run length: what `bp best` is, and how `sgm int8` compares with it."""
    table = plain_table(f"{report.judged}: {SGM_INT8} against {BP_BEST}")
    for header in ("\nrun length", "\nsteps", "bp best:\noptimizer", "\nrate"):
        table.add_column(header, justify="left" if header.endswith("optimizer") else "right")
    table.add_column("sgm int8 / bp best:\ndetection", justify="right")
    table.add_column("\nangle error", justify="right")
    places = report.groups[report.judged]
    for runs in report.runs:
        ratios = [f"{over_best(runs, places, metric):.3f}" for metric in (DETECTION, ANGLE)]
        rate = f"{runs.best.rates[0]:g}"
        table.add_row(_epochs(runs), str(runs.steps[-1]), runs.best.optimizer, rate, *ratios)
    return table


def per_frame_table(report: AccuracyReport) -> RenderableType:
    """One row per frame: detection and angle error of every method, main run length."""
    main = report.runs[-1]
    table = plain_table(f"per frame, {_epochs(main)}: detection, angle error")
    table.padding = 0
    table.add_column("frame", no_wrap=True, max_width=18)
    for name in main.methods:
        table.add_column(name, justify="right", no_wrap=True)
    for i, frame in enumerate(report.frames):
        ends = [values[i, -1] for values in main.methods.values()]
        cells = [f"{end[DETECTION]:.2f} {end[ANGLE]:4.1f}" for end in ends]
        table.add_row(frame.name, *cells)
    return table


def _epochs(runs: Runs) -> str:
    return f"{runs.epochs} epoch{'' if runs.epochs == 1 else 's'}"


def _recipe_json(recipe: Recipe) -> dict[str, Any]:
    return {"optimizer": recipe.optimizer, "rate": recipe.rates[0]}


def _means(values: Floats) -> dict[str, float | None]:
    """Of every metric over frames: (frames, METRICS)."""
    return {m: number(values[:, k].mean(), 4) for k, m in enumerate(METRICS)}
