"""Growth at a glance (host): a step's time by batch, layers and width, a job's by its crops."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, NullLocator, StrMethodFormatter

from qsgm import defaults
from qsgm.bench.growth import (
    BP,
    CROPS,
    FEATURES,
    FLOAT,
    FLOAT_WIDER,
    FORWARD,
    INT8,
    INT8_WIDER,
    GrowthReport,
    Series,
)
from qsgm.train.charts import DPI, GREY, SMALL, TEXT, save_png
from qsgm.tune.loop import BATCH

SIZE_INCHES = (7.2, 6.6)
# Of Okabe and Ito, which the colour-blind tell apart.
COLOURS = {FORWARD: GREY, BP: "#D55E00", FLOAT: "#009E73", INT8: "#0072B2"}
COLOURS |= {FLOAT_WIDER: COLOURS[FLOAT], INT8_WIDER: COLOURS[INT8]}
COLOURS |= {CROPS: "#CC79A7", FEATURES: "#E69F00"}
NAMES = {FORWARD: "forward pass", BP: "backprop", FLOAT: "SGM float", INT8: "SGM int8"}
NAMES |= {CROPS: "cutting crops", FEATURES: "frozen layers"}
DASHED: Any = (0, (3, 2))
STYLES = {FLOAT_WIDER: DASHED, INT8_WIDER: DASHED}
MOST_TICKS = 6


def write_growth_chart(report: GrowthReport, path: Path) -> None:
    """Write the picture of :func:`growth_chart` as a PNG file, 1440 pixels wide.

    Raises:
        QsgmError: the place cannot be written to.
    """
    save_png(growth_chart(report), path)


def growth_chart(report: GrowthReport) -> Figure:
    """Four panels, all axes logarithmic but the one of layers."""
    figure = Figure(figsize=SIZE_INCHES, dpi=DPI)
    figure.subplots(2, 2)
    figure.subplots_adjust(left=0.075, right=0.985, top=0.895, bottom=0.16, wspace=0.2, hspace=0.5)
    panels = (
        ("Step by batch [ms]", report.batch, "crops", "log"),
        ("Step by tuned layers [ms]", report.layers, "layers", "linear"),
        ("Step by width [ms]", report.width, "times the channels of every layer", "log"),
        ("Stages of a job by crops [ms]", report.crops, "crops", "log"),
    )
    for axes, (title, series, sizes, scale) in zip(figure.axes, panels, strict=True):
        axes.set_title(title, loc="left", fontsize=TEXT, fontweight="bold")
        draw_times(axes, series)
        draw_sizes(axes, series, sizes, scale)
    draw_legend(figure)
    figure.text(0.03, 0.02, caption(report), fontsize=SMALL, color=GREY, linespacing=1.4)
    return figure


def draw_times(axes: Axes, series: Series) -> None:
    """A line for everything that was timed."""
    for name in next(iter(series.values())):
        axes.plot(
            [*series],
            [1000 * some[name] for some in series.values()],
            color=COLOURS[name],
            linestyle=STYLES.get(name, "-"),
            linewidth=1.6,
            marker="" if name in STYLES else "o",
            markersize=3.5,
        )
    times = [1000 * seconds for some in series.values() for seconds in some.values()]
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(FixedLocator(time_ticks(min(times), max(times))))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.grid(axis="y", color=GREY, alpha=0.15, linewidth=0.6)


def time_ticks(low: float, high: float) -> list[float]:
    """Of an axis from `low` to `high`: by 1, 2 and 5, or where that is too much, by tens."""
    by_ten = [10.0**power for power in range(-4, 6)]
    every = sorted(scale * decade for decade in by_ten for scale in (1, 2, 5))
    inside = [tick for tick in every if low <= 1.2 * tick and tick <= 1.2 * high]
    return inside if len(inside) <= MOST_TICKS else [tick for tick in inside if tick in by_ten]


def draw_sizes(axes: Axes, series: Series, sizes: str, scale: str) -> None:
    """The axis of what grows, and no other frame."""
    axes.set_xscale(scale)
    axes.set_xticks([*series], [*map(str, series)])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel(sizes, fontsize=SMALL, color=GREY)
    axes.tick_params(labelsize=SMALL, color=GREY, labelcolor=GREY, length=3)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(GREY)


def draw_legend(figure: Figure) -> None:
    """One for all panels, above them."""
    lines = [Line2D([], [], color=COLOURS[name], linewidth=1.8) for name in NAMES]
    figure.legend(
        lines,
        [*NAMES.values()],
        loc="upper center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=len(NAMES),
        fontsize=SMALL,
        frameon=False,
        handlelength=1.3,
        columnspacing=1.2,
        handletextpad=0.5,
    )


def caption(report: GrowthReport) -> str:
    """What is drawn, in three lines."""
    threads = f"{report.threads} thread{'s' * (report.threads > 1)}"
    return (
        f"A step: of SGD, the last {defaults.LAYERS} layers on {BATCH} crops unless said otherwise;"
        f" ONNX Runtime, {threads}, medians.\n"
        "Dashed: SGMs whose hidden channels grow with the layers; else they are the bundle's.\n"
        f"A job: {report.epochs} epochs over four fifths of the crops; tuning in the colour of its"
        " method."
    )
