"""Charts of what `-o` writes: learning curves, fidelity over a run, memory, calibration.

Each takes a report's JSON values and gives a figure, drawn without pyplot and its global state.
matplotlib (extra `report`) is imported only when something is drawn.
"""

import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qsgm.files import write_bytes_atomic
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.schedule import BATCH, steps_per_epoch
from qsgm.tune.drift import LEAST_COSINE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
DPI = 200
STEPS_PER_EPOCH = steps_per_epoch(TRAIN_CROPS)
TEXT, SMALL = 10.0, 8.5  # points
# Of Okabe and Ito, which the colour-blind tell apart, too.
BLUE, RED, GREEN, PINK, ORANGE, GREY = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#595959",
)  # fmt: skip
DASHED: Any = (0, (4, 3))
METHODS = {"sgm int8": ("SGM int8", BLUE), "sgm float": ("SGM float", GREEN)}
METHODS |= {"bp": ("backprop", RED), "bp best": ("backprop", RED), "untouched": ("untouched", GREY)}
LAYERS = {"1": ORANGE, "2": PINK, "3": GREEN, "4": RED, "5": BLUE}
LABEL_GAP = 0.065  # between two labels, as a share of the axes


def write_chart(figure: "Figure", path: Path) -> None:
    """Write a figure as a PNG file, whole or not at all.

    Raises:
        QsgmError: the place cannot be written to.
    """
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=DPI)  # a bare figure: by Agg
    write_bytes_atomic(path, picture.getvalue())


def new_page(size: tuple[float, float], rows: int, columns: int, **margins: float) -> "Figure":
    """A figure of `size` inches with panels, whose axes are `figure.axes`, row by row."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=DPI)
    figure.subplots(rows, columns)
    figure.subplots_adjust(**margins)
    return figure


def style(axes: "Axes", title: str, xlabel: str = "") -> None:
    """A panel with two thin axes, its title on the left."""
    axes.set_title(title, loc="left", fontsize=TEXT, fontweight="bold")
    axes.set_xlabel(xlabel, fontsize=SMALL, color=GREY)
    axes.tick_params(labelsize=SMALL, color=GREY, labelcolor=GREY, length=3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def caption(figure: "Figure", text: str, at: tuple[float, float] = (0.04, 0.02)) -> None:
    """What one has to know to read a figure."""
    figure.text(*at, text, fontsize=SMALL, color=GREY, linespacing=1.4)


def ticks(axis: Any, places: Sequence[float], form: Callable[[float], str] = "{:g}".format) -> None:
    """Ticks at these places alone."""
    from matplotlib.ticker import FixedLocator, NullLocator

    axis.set_major_locator(FixedLocator(places))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(lambda value, _place: form(value))


def label_ends(
    axes: "Axes", labels: Sequence[tuple[str, float, str]], gap: float = LABEL_GAP
) -> None:
    """Texts at the right border as high as their values, or apart: (text, value, colour) each."""
    to_axes = axes.transData + axes.transAxes.inverted()
    heights = [float(to_axes.transform((0, value))[1]) for _, value, _ in labels]
    for (text, _, colour), height in zip(labels, apart(heights, gap), strict=True):
        axes.annotate(
            text, (1, height), xycoords="axes fraction", xytext=(6, 0), textcoords="offset points",
            color=colour, fontsize=SMALL, verticalalignment="center",
        )  # fmt: skip


def apart(heights: Sequence[float], gap: float) -> list[float]:
    """Heights in the same order but at least `gap` apart, from 0 up and, if there is room, to 1."""
    order, moved = np.argsort(heights, kind="stable"), list(heights)
    lowest, highest = 0.0, max(1.0, gap * (len(heights) - 1))
    for k in order:
        moved[k] = max(moved[k], lowest)
        lowest = moved[k] + gap
    for k in order[::-1]:
        moved[k] = min(moved[k], highest)
        highest = moved[k] - gap
    return moved


def learning_curves(values: Mapping[str, Any]) -> "Figure":
    """Angle and detection error against steps (`bench accuracy`): means and quartiles.

    Lines follow the main run; dots are where runs end, those of the shorter ones included, whose
    rates decay faster.
    """
    margins = {"left": 0.04, "right": 0.85, "top": 0.925, "bottom": 0.275, "wspace": 0.5}
    figure = new_page((9.0, 4.5), 1, 2, **margins)
    left, right = figure.axes
    runs = values["runs"]
    left.set_yscale("log")
    right.set_yscale("symlog", linthresh=0.5, linscale=0.5)  # below half a percent: linear, to 0
    for axes, title, metric, unit in (
        (left, "Angle error [°]", "angle_mae_deg", "°"),
        (right, "Detection error [%]", "detection_accuracy", " %"),
    ):
        style(axes, title, f"training steps of {BATCH} crops; below: epochs")
        draw_curves(axes, runs, metric)
        ticks(axes.yaxis, (0, 0.2, 0.5, 1, 2, 3, 5, 10, 20, 50))
        if axes is right:
            axes.set_ylim(bottom=0)
        ends = {name: curve(runs[-1], name, metric, "mean")[-1] for name in CURVES}
        texts = [(f"{METHODS[n][0]} {v:.2f}{unit}", v, METHODS[n][1]) for n, v in ends.items()]
        label_ends(axes, texts)
    names, recipes = {"sgd": "SGD", "adam": "Adam"}, [run["bp_best"] for run in runs]
    best = ", ".join(f"{names[one['optimizer']]} {one['rate']:g}" for one in recipes)
    kind = "elongated objects" if values["chosen_on"] == "elongated" else "objects"
    caption(
        figure,
        f"Lines: mean over {values[values['chosen_on']]['frames']} {kind}, 200 validation crops "
        f"each; bands: their quartiles.\nDots: ends of runs of "
        f"{', '.join(str(run['epochs']) for run in runs)} epochs, the rates of each decaying to "
        f"nothing there.\nBackprop with the optimizer and rate that did best on these objects, per "
        f"run: {best}.",
    )
    return figure


CURVES = ("sgm int8", "bp best", "untouched")


def curve(run: Mapping[str, Any], name: str, metric: str, line: str) -> Floats:
    """One line of a run's learning curves; detection as percent missed."""
    found = np.array(run["curves"]["methods"][name][metric][line], float)
    return 100 * (1 - found) if metric == "detection_accuracy" else found


def draw_curves(axes: "Axes", runs: Sequence[Mapping[str, Any]], metric: str) -> None:
    """One metric of the runs of every length, the main one last."""
    main = runs[-1]
    steps = main["curves"]["steps"]
    untouched = curve(main, "untouched", metric, "mean")[0]
    axes.axhline(untouched, color=GREY, linewidth=1, linestyle=DASHED)
    for name in CURVES[:2]:
        colour = METHODS[name][1]
        low, high = (curve(main, name, metric, f"{end}_quartile") for end in ("lower", "upper"))
        axes.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
        axes.plot(steps, curve(main, name, metric, "mean"), color=colour, linewidth=1.8)
        ends = [curve(run, name, metric, "mean")[-1] for run in runs]
        axes.plot(
            [run["steps"] for run in runs], ends, "o", color=colour, markeredgecolor="white",
            markersize=7, clip_on=False, zorder=3,
        )  # fmt: skip
    last = {run["steps"]: f"{run['steps']}\n{run['epochs']}" for run in runs}
    named = {step: str(step) for step in (0, 1, 5) if step < min(last)} | last
    axes.set_xscale("symlog", linthresh=1, linscale=0.4)  # by doublings from the first one on
    axes.set_xlim(0, max(*last, 1))
    ticks(axes.xaxis, [*named], lambda step: named[round(step)])


@dataclass(frozen=True)
class Panel:
    """One metric of fidelity against the step."""

    title: str
    key: str
    form: str  # of the mean beside the lines
    set_axis: "Callable[[Axes, Floats], None]"  # given all values that are drawn on such an axis
    scale: float = 1.0  # what is drawn is so many times the metric


# Cosines with a tick: -1, 0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99 and so on; nearer to 1 than the last
# one nothing is told apart.
NINES = 6
COSINES = tuple(1 - k / 10**n for n in range(NINES + 1) for k in (5, 2, 1) if k <= 2 * 10**n)
MOST_TICKS = 9
DOTS = 40  # up to so many probes each shows as a dot; more are a mist around their running mean
LONGEST_NAME = 32


def near_one(axes: "Axes", values: Floats) -> None:
    """An axis for cosines on which every further nine takes as much space as the one before."""
    nearest = 10.0**-NINES
    axes.set_yscale(
        "function",
        functions=(lambda y: -np.log10(np.maximum(1 - y, nearest)), lambda t: 1 - 10.0**-t),
    )
    low = max((tick for tick in COSINES if tick < values.min()), default=min(COSINES))
    high = min((tick for tick in COSINES if tick > values.max()), default=max(COSINES))
    axes.set_ylim(low, high)
    shown = [tick for tick in COSINES if low <= tick <= high]
    if len(shown) > MOST_TICKS:  # 0, 0.9, 0.99
        shown = [1 - 10.0**-n for n in range(NINES + 1)]
    ticks(axes.yaxis, shown, f"{{:.{NINES}g}}".format)


def up_to_one(axes: "Axes", values: Floats) -> None:
    """A linear axis for cosines that ends at 1."""
    linear(axes, min(0.8, np.floor(10 * values.min()) / 10), 1)


def from_zero(axes: "Axes", values: Floats) -> None:
    """A linear axis that starts at 0 and has room for 1."""
    linear(axes, 0, 1.15 * max(1.0, values.max()))


def around(axes: "Axes", values: Floats) -> None:
    """A linear axis around the values, at least 10 high."""
    middle, half = (values.max() + values.min()) / 2, (values.max() - values.min()) / 2
    linear(axes, middle - max(5, 1.1 * half), middle + max(5, 1.1 * half))


def linear(axes: "Axes", low: float, high: float) -> None:
    """A linear axis that counts by 1, 2 or 5."""
    from matplotlib.ticker import MaxNLocator

    axes.set_ylim(low, high)
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))


ROWS = {
    "int8 against float SGM: cosine of": (
        Panel("the batch's gradient", "cos_int8_float", "{:.5f}", near_one),
        Panel("each sample's, mean", "cos_sample_int8_float", "{:.5f}", near_one),
        Panel("the weights' gradient", "cos_update_int8_float", "{:.5f}", near_one),
    ),
    "int8 SGM against true gradient: cosine of": (
        Panel("the batch's gradient", "cos_int8_true", "{:.3f}", up_to_one),
        Panel("each sample's, mean", "cos_sample_int8_true", "{:.3f}", up_to_one),
        Panel("the weights' gradient", "cos_update_int8_true", "{:.3f}", up_to_one),
    ),
    "Size, noise and range": (
        Panel("norm ratio, |int8|/|true|", "norm_ratio_int8_true", "{:.2f}", from_zero),
        Panel("SQNR, int8 to float [dB]", "sqnr_db", "{:.1f}", around),
        Panel("clipped SGM inputs [%]", "clipped_fraction", "{:.2f}", from_zero, 100),
    ),
}


def fidelity_over_run(values: Mapping[str, Any]) -> "Figure":
    """Every metric against the step (`qsgm fidelity`), a line per SGM; beside them their means."""
    from matplotlib.lines import Line2D

    margins = {"left": 0.08, "right": 0.935, "top": 0.845, "bottom": 0.07}
    figure = new_page((9.0, 8.0), 3, 3, wspace=0.42, hspace=0.42, **margins)
    probes, layers = values["fidelity_over_run"], sorted(values["fidelity"])
    for k, (title, panels) in enumerate(ROWS.items()):
        row = figure.axes[3 * k : 3 * k + 3]
        row[0].annotate(
            title, (0, 1), xycoords="axes fraction", xytext=(0, 19), textcoords="offset points",
            fontsize=TEXT, fontweight="bold",
        )  # fmt: skip
        draw_row(row, panels, probes, layers)
    for axes in figure.axes[:-3]:
        axes.tick_params(labelbottom=False)
    for axes in figure.axes[-3:]:
        axes.set_xlabel("training step", fontsize=SMALL, color=GREY)
    figure.text(0.08, 0.966, heading(values), fontsize=TEXT + 1, weight="bold", parse_math=False)
    mist = " Thick: over an epoch." if len(probes) > DOTS else ""
    caption(
        figure,
        f"{BATCH} random crops at steps 0 to {probes[-1]['step']} by {values['every']}; "
        f"{STEPS_PER_EPOCH} steps are an epoch. Numbers: means over the run.{mist}\n"
        f"Dashed: int8 as large as true. Below a mean cosine of {LEAST_COSINE:g} to float an "
        "object counts as unlike the calibration set.",
        (0.08, 0.92),
    )
    figure.legend(
        [Line2D([], [], color=LAYERS[k], linewidth=2.5) for k in layers],
        [f"layer {k}" for k in layers],
        loc="upper right", bbox_to_anchor=(0.985, 0.904), ncols=len(layers), fontsize=SMALL,
        frameon=False, handlelength=1.2, columnspacing=1.2,
    )  # fmt: skip
    return figure


def heading(values: Mapping[str, Any]) -> str:
    """Whose run it was; of the name what fits, and what the font has."""
    known = " ".join(values["object"].split()).encode("latin-1", "replace").decode("latin-1")
    shown = known if len(known) <= LONGEST_NAME else known[: LONGEST_NAME - 1] + "…"
    return (
        f"{shown}: gradients of {values['layers']} layers over {values['epochs']} epochs, "
        f"{values['precision']} SGMs"
    )


def draw_row(
    row: "Sequence[Axes]",
    panels: Sequence[Panel],
    probes: Sequence[Mapping[str, Any]],
    layers: Sequence[str],
) -> None:
    """Panels side by side; those with the same kind of axis share its limits."""
    steps = np.array([probe["step"] for probe in probes])
    drawn = [
        {k: p.scale * np.array([probe[k][p.key] for probe in probes], float) for k in layers}
        for p in panels
    ]
    for axes, panel, lines in zip(row, panels, drawn, strict=True):
        alike = [
            values
            for other, some in zip(panels, drawn, strict=True)
            if (other.set_axis, other.scale) == (panel.set_axis, panel.scale)
            for values in some.values()
        ]
        draw_lines(axes, panel, steps, lines)
        panel.set_axis(axes, np.concatenate(alike))
        if axes is not row[0] and len(alike) > len(lines):  # the first one says it
            axes.tick_params(labelleft=False)
        means = {k: float(line.mean()) for k, line in lines.items()}
        label_ends(axes, [(panel.form.format(m), m, LAYERS[k]) for k, m in means.items()], 0.13)


def draw_lines(
    axes: "Axes", panel: Panel, steps: NDArray[np.int64], lines: Mapping[str, Floats]
) -> None:
    """Lines of one panel, and its axis of steps."""
    from matplotlib.ticker import MaxNLocator

    style(axes, "")
    axes.set_title(panel.title, loc="left", fontsize=SMALL, color=GREY, pad=5)
    if panel.key == "norm_ratio_int8_true":
        axes.axhline(1, color=GREY, linewidth=1, linestyle=DASHED)
    for k, line in lines.items():
        if len(steps) <= DOTS:
            axes.plot(steps, line, "o-", color=LAYERS[k], linewidth=1.4, markersize=2.5)
        else:
            axes.plot(steps, line, color=LAYERS[k], linewidth=0.6, alpha=0.35)
            axes.plot(steps, running_mean(line, steps), color=LAYERS[k], linewidth=1.6)
    axes.set_xlim(0, max(1, int(steps[-1])))
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10], integer=True))
    axes.grid(axis="y", color=GREY, alpha=0.15, linewidth=0.8)


def running_mean(values: Floats, steps: NDArray[np.int64]) -> Floats:
    """At each of these steps (n,), the mean of the values (n,) up to half an epoch away."""
    near = np.abs(steps[:, None] - steps) <= STEPS_PER_EPOCH / 2
    return np.asarray(near @ values / near.sum(axis=1))


def memory(values: Mapping[str, Any]) -> "Figure":
    """Peaks of the largest and the smallest batch (`bench memory`), and backprop's over SGMs'."""
    margins = {"left": 0.07, "right": 0.88, "top": 0.92, "bottom": 0.255, "wspace": 0.6}
    figure = new_page((9.0, 4.5), 1, 2, **margins)
    left, right = figure.axes
    style(left, "Peak of a step's activations", "tuned layers")
    style(right, "Backprop's peak over the SGM's", "tuned layers")
    few, *_, many = values["steps"]
    labels = []
    for batch, dashes in ((few, (0, (1, 1.5))), (many, "-")):
        for name in ("sgm int8", "sgm float", "bp"):
            title, colour = METHODS[name]
            peaks = [some[name]["peak_bytes"] for some in values["steps"][batch].values()]
            layers = range(1, len(peaks) + 1)
            left.plot(layers, peaks, color=colour, linestyle=dashes, linewidth=1.8)
            labels.append((f"{title} {in_units(peaks[-1])}", float(peaks[-1]), colour))
    left.set_yscale("log")
    ticks(left.yaxis, [10.0**power for power in range(2, 10)], in_units)
    label_ends(left, labels)
    ends = []
    for key, title, colour, dashes in (
        ("bp_over_sgm_int8", "SGM int8", BLUE, "-"),
        ("bp_over_sgm_float", "SGM float", GREEN, "-"),
        ("outputs_alone", "outputs", GREY, DASHED),
    ):
        ratios = [some[key] for some in values["steps"][many].values()]
        right.plot(layers, ratios, color=colour, linestyle=dashes, linewidth=1.8)
        ends.append((f"{title} {ratios[-1]:.2f}", ratios[-1], colour))
    right.axhline(1, color=GREY, linewidth=0.8)
    right.set_ylim(bottom=0)
    label_ends(right, ends)
    for axes in figure.axes:
        axes.set_xticks(layers)
    caption(
        figure,
        f"Dotted: a step of {few} crop{'s' * (few != '1')}; all others: of {many}. Outputs: all"
        " layers' outputs alone over the largest layer's, as the paper counts.\n"
        "Activations alive at once in the graphs that ONNX Runtime runs; weights, states, inputs"
        " and outputs are not counted.",
    )
    return figure


def in_units(count: float) -> str:
    """Bytes to three digits."""
    units = ((1e6, "MB"), (1e3, "kB"), (1.0, "bytes"))
    unit, name = next((some for some in units if count >= some[0]), units[-1])
    return f"{count / unit:.3g} {name}"


def calibration(values: Mapping[str, Any]) -> "Figure":
    """A cell per calibration set and variant (`bench calibration`), coloured by angle error."""
    from matplotlib.colors import LinearSegmentedColormap, LogNorm

    sources = values["sources"]
    variants = [*next(iter(sources.values()))]
    floating, height = values["float"]["angle_mae_deg"], 1.6 + 0.46 * len(sources)
    margins = {"left": 0.23, "right": 0.98, "bottom": 0.6 / height, "top": 1 - 1.0 / height}
    figure = new_page((9.0, height), 1, 1, **margins)
    (axes,) = figure.axes
    angles = np.array([[row[v]["angle_mae_deg"] for v in variants] for row in sources.values()])
    ratio = np.maximum(angles / floating, 1.0)
    loss = LinearSegmentedColormap.from_list("loss", ["#FFFFFF", "#F6C19A", RED, "#7A3300"])
    axes.pcolormesh(ratio, cmap=loss, norm=LogNorm(1.0, 10.0), edgecolors="white", linewidth=1.5)
    axes.invert_yaxis()
    for (i, k), angle in np.ndenumerate(angles):
        cosine = [*sources.values()][i][variants[k]]["cos_int8_float"] or 0.0
        axes.text(
            k + 0.5, i + 0.5, f"{angle:.2f}°\n{cosine:.4f}".replace("-", "−"), ha="center",
            va="center", fontsize=SMALL, linespacing=1.25,
            color="white" if ratio[i, k] > 3.0 else "black",
        )  # fmt: skip
    axes.set_yticks(np.arange(len(sources)) + 0.5, [*sources], fontsize=SMALL)
    tops = ["{} bit\n{} bit\n{}".format(*variant.split("/")) for variant in variants]
    axes.set_xticks(np.arange(len(variants)) + 0.5, tops, fontsize=SMALL)
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    title = "Calibrated there, tuned elsewhere: angle error, and cosine of int8 to float gradients"
    figure.text(0.015, 1 - 0.1 / height, title, fontsize=TEXT, fontweight="bold", va="top")
    rows = "activations\nweights\ncalibrator"
    figure.text(0.22, 1 - 0.94 / height, rows, fontsize=SMALL, color=GREY, ha="right")
    caption(
        figure,
        f"Angles: means over {values['angles_of_frames']} of {len(values['frames'])} frames, none "
        f"of them in a calibration set, {values['layers']} layers, {values['epochs']} epochs; "
        f"float SGMs: {floating:.2f}°.\n"
        "White: no worse than float; the darkest: 10 times its angle error or more.",
        (0.015, 0.12 / height),
    )
    return figure
