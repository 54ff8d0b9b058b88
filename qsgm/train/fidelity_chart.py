"""A chart of a run's fidelity, probe by probe (host): small multiples, one colour per SGM layer."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from qsgm.train.charts import DPI, GREY, SMALL, TEXT, save_png
from qsgm.tune.drift import LEAST_COSINE
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import STEPS_PER_EPOCH
from qsgm.tune.run import FinetuneResult

Floats = NDArray[np.float64]
SIZE_INCHES = (9.0, 8.0)
# Of Okabe and Ito, which the colour-blind tell apart, too.
COLOURS = {1: "#E69F00", 2: "#CC79A7", 3: "#009E73", 4: "#D55E00", 5: "#0072B2"}
LABEL_GAP = 0.13  # between two labels, as a share of the axes
LONGEST_NAME = 32
DOTS = 40  # up to so many probes each shows as a dot; more are a mist around their running mean
ROUND = [1, 2, 5, 10]  # what linear axes count by, times a power of ten
# Cosines with a tick: -1, 0, 0.5, 0.8, 0.9, 0.95, 0.98, 0.99 and so on; nearer to 1 than the last
# one nothing is told apart.
NINES = 6
TICKS = tuple(1 - k / 10**n for n in range(NINES + 1) for k in (5, 2, 1) if k <= 2 * 10**n)
MOST_TICKS = 9


@dataclass(frozen=True)
class Panel:
    """One metric against the step."""

    title: str
    key: str  # of LayerFidelity
    form: str  # of the mean beside the lines
    set_axis: Callable[[Axes, Floats], None]  # given all values that are drawn on such an axis
    scale: float = 1.0  # what is drawn is so many times the metric
    level: float | None = None  # worth a grey line


@dataclass(frozen=True)
class Row:
    """Panels side by side; those with the same kind of axis share its limits."""

    title: str
    panels: tuple[Panel, ...]


def near_one(axes: Axes, values: Floats) -> None:
    """An axis for cosines on which every further nine takes as much space as the one before."""
    nearest = 10.0**-NINES
    axes.set_yscale(
        "function",
        functions=(lambda y: -np.log10(np.maximum(1 - y, nearest)), lambda t: 1 - 10.0**-t),
    )
    below = [tick for tick in TICKS if tick < values.min()] or [min(TICKS)]
    above = [tick for tick in TICKS if tick > values.max()] or [max(TICKS)]
    ticks = [tick for tick in TICKS if below[-1] <= tick <= above[0]]
    if len(ticks) > MOST_TICKS:  # 0, 0.9, 0.99
        ticks = [1 - 10.0**-n for n in range(NINES + 1)]
    axes.set_ylim(below[-1], above[0])
    axes.yaxis.set_major_locator(FixedLocator(ticks))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(lambda tick, _: f"{tick:.{NINES}g}")


def up_to_one(axes: Axes, values: Floats) -> None:
    """A linear axis for cosines that ends at 1."""
    axes.set_ylim(min(0.8, np.floor(10 * values.min()) / 10), 1)
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=ROUND))


def from_zero(axes: Axes, values: Floats) -> None:
    """A linear axis that starts at 0 and has room for 1."""
    axes.set_ylim(0, 1.15 * max(1.0, values.max()))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=ROUND))


def around(axes: Axes, values: Floats) -> None:
    """A linear axis around the values, at least 10 high."""
    middle, half = (values.max() + values.min()) / 2, (values.max() - values.min()) / 2
    axes.set_ylim(middle - max(5, 1.1 * half), middle + max(5, 1.1 * half))
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=ROUND))


ROWS = (
    Row(
        "int8 against float SGM: cosine of",
        (
            Panel("the batch's gradient", "cos_int8_float", "{:.5f}", near_one),
            Panel("each sample's, mean", "cos_sample_int8_float", "{:.5f}", near_one),
            Panel("the weights' gradient", "cos_update_int8_float", "{:.5f}", near_one),
        ),
    ),
    Row(
        "int8 SGM against true gradient: cosine of",
        (
            Panel("the batch's gradient", "cos_int8_true", "{:.3f}", up_to_one),
            Panel("each sample's, mean", "cos_sample_int8_true", "{:.3f}", up_to_one),
            Panel("the weights' gradient", "cos_update_int8_true", "{:.3f}", up_to_one),
        ),
    ),
    Row(
        "Size, noise and range",
        (
            Panel("norm ratio, |int8|/|true|", "norm_ratio_int8_true", "{:.2f}", from_zero, 1, 1),
            Panel("SQNR, int8 to float [dB]", "sqnr_db", "{:.1f}", around),
            Panel(
                "clipped SGM inputs [%]",
                "clipped_fraction",
                "{:.2f}",
                from_zero,
                100,
            ),
        ),
    ),
)


def write_fidelity_chart(result: FinetuneResult, name: str, path: Path) -> None:
    """Write the picture of :func:`fidelity_chart` as a PNG file, 1800 pixels wide.

    Raises:
        QsgmError: the place cannot be written to.
    """
    save_png(fidelity_chart(result, name), path)


def fidelity_chart(result: FinetuneResult, name: str) -> Figure:
    """Every metric against the step, a line per SGM layer; beside the lines their means.

    Args:
        result: of a run with at least one probe.
        name: what the object is called.
    """
    figure = Figure(figsize=SIZE_INCHES, dpi=DPI)
    grid = figure.subplots(len(ROWS), 3, sharex=True)
    figure.subplots_adjust(left=0.08, right=0.935, top=0.845, bottom=0.07, wspace=0.42, hspace=0.42)
    layers = sorted(result.fidelity)
    for row, drawn in zip(ROWS, grid, strict=True):
        title_row(drawn[0], row.title)
        draw_row(row, drawn, result)
    for axes in grid[-1]:
        axes.set_xlabel("training step", fontsize=SMALL, color=GREY, labelpad=4)
    heading = title(result, name)
    figure.text(0.08, 0.966, heading, fontsize=TEXT + 1, fontweight="bold", parse_math=False)
    figure.text(0.08, 0.955, caption(result), fontsize=SMALL, color=GREY, va="top", linespacing=1.4)
    figure.legend(
        [Line2D([], [], color=COLOURS[k], linewidth=2.5) for k in layers],
        [f"layer {k}" for k in layers],
        loc="upper right",
        bbox_to_anchor=(0.985, 0.904),
        ncols=len(layers),
        fontsize=SMALL,
        frameon=False,
        handlelength=1.2,
        columnspacing=1.2,
    )
    return figure


def curves(result: FinetuneResult, panel: Panel) -> dict[int, Floats]:
    """By layer, the panel's metric at every probe, (n,)."""
    return {
        k: panel.scale * np.array([getattr(probe.layers[k], panel.key) for probe in result.probes])
        for k in sorted(result.fidelity)
    }


def draw_row(row: Row, drawn: NDArray[np.object_], result: FinetuneResult) -> None:
    """One panel after the other."""
    lines = [curves(result, panel) for panel in row.panels]
    steps = np.array([probe.step for probe in result.probes])
    for axes, panel, own in zip(drawn, row.panels, lines, strict=True):
        alike = [
            values
            for other, by_layer in zip(row.panels, lines, strict=True)
            if other.set_axis is panel.set_axis and other.scale == panel.scale
            for values in by_layer.values()
        ]
        draw_panel(axes, panel, steps, own)
        panel.set_axis(axes, np.concatenate(alike))
        if axes is not drawn[0] and len(alike) > len(own):  # the first one says it
            axes.tick_params(labelleft=False)
        label_means(axes, panel, own)


def draw_panel(
    axes: Axes, panel: Panel, steps: NDArray[np.int64], lines: Mapping[int, Floats]
) -> None:
    """Lines, grey level, step axis."""
    if panel.level is not None:
        axes.axhline(panel.level, color=GREY, linewidth=1, linestyle=(0, (4, 3)))
    for k, values in lines.items():
        colour = COLOURS[k]
        if len(steps) <= DOTS:
            axes.plot(steps, values, "o-", color=colour, linewidth=1.4, markersize=2.5)
        else:
            axes.plot(steps, values, color=colour, linewidth=0.6, alpha=0.35)
            axes.plot(steps, running_mean(values, steps), color=colour, linewidth=1.6)
    axes.set_title(panel.title, loc="left", fontsize=SMALL, color=GREY, pad=5)
    axes.set_xlim(0, max(1, int(steps[-1])))
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=ROUND, integer=True))
    axes.tick_params(labelsize=SMALL, color=GREY, labelcolor=GREY, length=3)
    axes.grid(axis="y", color=GREY, alpha=0.15, linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def running_mean(values: Floats, steps: NDArray[np.int64]) -> Floats:
    """At each of these steps (n,), the mean of the values (n,) up to half an epoch away."""
    near = np.abs(steps[:, None] - steps) <= STEPS_PER_EPOCH / 2
    return np.asarray(near @ values / near.sum(axis=1))


def label_means(axes: Axes, panel: Panel, lines: Mapping[int, Floats]) -> None:
    """Every line's mean over the run at the right border, as high as it can be."""
    to_axes = axes.transData + axes.transAxes.inverted()
    means = {k: float(values.mean()) for k, values in lines.items()}
    heights = {k: float(to_axes.transform((0, mean))[1]) for k, mean in means.items()}
    for k, height in apart(heights, LABEL_GAP).items():
        axes.annotate(
            panel.form.format(means[k]),
            (1, height),
            xycoords="axes fraction",
            xytext=(5, 0),
            textcoords="offset points",
            color=COLOURS[k],
            fontsize=SMALL,
            verticalalignment="center",
        )


def apart(heights: Mapping[int, float], gap: float) -> dict[int, float]:
    """Heights in the same order but at least `gap` apart, from 0 up and, if there is room, to 1."""
    moved, lowest = {}, 0.0
    for k in sorted(heights, key=lambda k: heights[k]):
        moved[k] = max(heights[k], lowest)
        lowest = moved[k] + gap
    highest = max(1.0, gap * (len(heights) - 1))
    for k in reversed(list(moved)):
        moved[k] = min(moved[k], highest)
        highest = moved[k] - gap
    return moved


def title_row(axes: Axes, text: str) -> None:
    """What the row's panels have in common, above the first one."""
    axes.annotate(
        text,
        (0, 1),
        xycoords="axes fraction",
        xytext=(0, 19),
        textcoords="offset points",
        fontsize=TEXT,
        fontweight="bold",
    )


def title(result: FinetuneResult, name: str) -> str:
    """Whose run it was; of the name what fits, and what the font has."""
    settings = result.settings
    known = " ".join(name.split()).encode("latin-1", "replace").decode("latin-1")
    shown = known if len(known) <= LONGEST_NAME else known[: LONGEST_NAME - 1] + "…"
    return (
        f"{shown}: gradients of {settings.layers} layers over {settings.epochs} epochs, "
        f"{settings.precision} SGMs"
    )


def caption(result: FinetuneResult) -> str:
    """How it was measured, and what is drawn, in two lines."""
    last, every = result.probes[-1].step, result.settings.probe_every
    mist = " Thick: over an epoch." if len(result.probes) > DOTS else ""
    return (
        f"{BATCH} random crops at steps 0 to {last} by {every}; {STEPS_PER_EPOCH} steps are an "
        f"epoch. Numbers: means over the run.{mist}\n"
        f"Dashed: int8 as large as true. Below a mean cosine of {LEAST_COSINE:g} to float an "
        "object counts as unlike the calibration set."
    )
