"""Charts for reports (host): drawn with matplotlib, without pyplot and its global state."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from qsgm.bench.accuracy import (
    ANGLE,
    BP_BEST,
    DETECTION,
    SGM_INT8,
    UNTOUCHED,
    AccuracyReport,
    Floats,
    Runs,
)
from qsgm.files import write_bytes_atomic
from qsgm.tune.loop import BATCH

SIZE_INCHES, DPI = (9.0, 4.5), 200
# Blue and vermilion of Okabe and Ito, which the colour-blind tell apart, too.
COLOURS = {SGM_INT8: "#0072B2", BP_BEST: "#D55E00"}
GREY = "#595959"
TEXT, SMALL = 10.0, 8.5  # points
LINE_HEIGHT = 0.065  # of a label, as a share of the axes
LEVELS = (0, 0.2, 0.5, 1, 2, 3, 5, 10, 20, 50)  # degrees and percent
ONE_CROP = 0.5  # percent of the validation crops; below, the axis is linear and reaches zero
EARLY_STEPS = (0, 1, 5)  # on the axis beside the ends of the runs
TITLES = {SGM_INT8: "SGM int8", BP_BEST: "backprop", UNTOUCHED: "untouched"}
OPTIMIZERS = {"sgd": "SGD", "adam": "Adam"}
# Errors (frames, steps) by method of the runs of one length.
Errors = dict[str, Floats]


def save_png(figure: Figure, path: Path) -> None:
    """Write a figure as a PNG file, whole or not at all.

    Raises:
        QsgmError: the place cannot be written to.
    """
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=DPI)  # a bare figure: by Agg
    write_bytes_atomic(path, picture.getvalue())


def write_learning_curves(report: AccuracyReport, path: Path) -> None:
    """Write the picture of :func:`learning_curves` as a PNG file, 1800 pixels wide.

    Raises:
        QsgmError: the place cannot be written to.
    """
    save_png(learning_curves(report), path)


def learning_curves(report: AccuracyReport) -> Figure:
    """Angle and detection error against steps: means over the judged frames, and quartiles.

    Lines follow the main run; dots are where runs end, those of the shorter ones included, whose
    rates decay faster.
    """
    figure = Figure(figsize=SIZE_INCHES, dpi=DPI)
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.04, right=0.86, top=0.925, bottom=0.275, wspace=0.5)
    left.set_title("Angle error [°]", loc="left", fontsize=TEXT, fontweight="bold")
    right.set_title("Detection error [%]", loc="left", fontsize=TEXT, fontweight="bold")
    left.set_yscale("log")
    right.set_yscale("symlog", linthresh=ONE_CROP, linscale=0.5)
    places = report.groups[report.judged]
    draw_panel(left, report.runs, [angle_errors(runs, places) for runs in report.runs])
    draw_panel(right, report.runs, [missed(runs, places) for runs in report.runs])
    right.set_ylim(bottom=0)
    label_lines(left, angle_errors(report.runs[-1], places), "°")
    label_lines(right, missed(report.runs[-1], places), " %")
    figure.text(0.04, 0.02, caption(report), fontsize=SMALL, color=GREY, linespacing=1.4)
    return figure


def angle_errors(runs: Runs, places: Sequence[int]) -> Errors:
    """In degrees, of the frames at `places`."""
    return {name: curves[places, :, ANGLE] for name, curves in runs.methods.items()}


def missed(runs: Runs, places: Sequence[int]) -> Errors:
    """Percent of the crops on the wrong side of the threshold, of the frames at `places`."""
    return {name: 100 * (1 - curves[places, :, DETECTION]) for name, curves in runs.methods.items()}


def draw_panel(axes: Axes, runs: Sequence[Runs], errors: Sequence[Errors]) -> None:
    """One metric of the runs of every length, the main one last."""
    steps, main = runs[-1].steps, errors[-1]
    axes.axhline(main[UNTOUCHED].mean(), color=GREY, linewidth=1, linestyle=(0, (4, 3)))
    for name, colour in COLOURS.items():
        low, high = np.quantile(main[name], (0.25, 0.75), axis=0)
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(steps, main[name].mean(axis=0), color=colour, linewidth=1.8)
        axes.plot(
            [some.steps[-1] for some in runs],
            [of_length[name][:, -1].mean() for of_length in errors],
            "o",
            color=colour,
            markeredgecolor="white",
            markersize=7,
            clip_on=False,
            zorder=3,
        )
    draw_steps(axes, runs)
    axes.yaxis.set_major_locator(FixedLocator(LEVELS))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.tick_params(labelsize=SMALL, color=GREY, labelcolor=GREY, length=3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def draw_steps(axes: Axes, runs: Sequence[Runs]) -> None:
    """The axis of steps, by doublings from the first one on; below the runs' ends, their epochs."""
    ends = {some.steps[-1]: f"{some.steps[-1]}\n{some.epochs}" for some in runs}
    ticks = {step: str(step) for step in EARLY_STEPS if step < min(ends)} | ends
    axes.set_xscale("symlog", linthresh=1, linscale=0.4)
    axes.set_xlim(0, max(*ends, 1))
    axes.set_xticks(list(ticks), list(ticks.values()))
    axes.xaxis.set_minor_locator(NullLocator())
    text = f"training steps of {BATCH} crops; below: epochs"
    axes.set_xlabel(text, fontsize=SMALL, color=GREY, labelpad=6)


def label_lines(axes: Axes, errors: Errors, unit: str) -> None:
    """Every line's name and last value beside its end, one above the other."""
    ends = {name: float(errors[name][:, -1].mean()) for name in (*COLOURS, UNTOUCHED)}
    to_axes = axes.transData + axes.transAxes.inverted()
    lowest = -np.inf
    for name in sorted(ends, key=lambda name: ends[name]):
        height = max(to_axes.transform((0, ends[name]))[1], lowest)
        lowest = height + LINE_HEIGHT
        axes.annotate(
            f"{TITLES[name]} {ends[name]:.2f}{unit}",
            (1, height),
            xycoords="axes fraction",
            xytext=(8, 0),
            textcoords="offset points",
            color=COLOURS.get(name, GREY),
            fontsize=SMALL,
            verticalalignment="center",
        )


def caption(report: AccuracyReport) -> str:
    """What is drawn, in three lines."""
    frames = len(report.groups[report.judged])
    kind = "elongated objects" if report.judged == "elongated" else "objects"
    epochs = ", ".join(str(runs.epochs) for runs in report.runs)
    best = ", ".join(f"{OPTIMIZERS[r.best.optimizer]} {r.best.rates[0]:g}" for r in report.runs)
    return (
        f"Lines: mean over {frames} {kind}, 200 validation crops each; bands: their quartiles.\n"
        f"Dots: ends of runs of {epochs} epochs, the rates of each decaying to nothing there.\n"
        f"Backprop with the optimizer and rate that did best on these objects, per run: {best}."
    )
