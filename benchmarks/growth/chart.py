"""Growth at a glance: a step's time by batch, layers and width, a job's by its crops."""

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from qsgm import defaults
from qsgm.bench.charts import (
    BLUE,
    GREEN,
    GREY,
    ORANGE,
    PINK,
    RED,
    SMALL,
    caption,
    new_page,
    style,
    ticks,
    write_chart,
)
from qsgm.schedule import BATCH

NAMES = {"forward": "forward pass", "backprop": "backprop", "sgm_float": "SGM float"}
NAMES |= {"sgm_int8": "SGM int8", "crops": "cutting crops", "features": "frozen layers"}
COLOURS = dict(zip(NAMES, (GREY, RED, GREEN, BLUE, PINK, ORANGE), strict=True))
PANELS = (
    ("Step by batch [ms]", "batch", "crops", "log"),
    ("Step by tuned layers [ms]", "layers", "layers", "linear"),
    ("Step by width [ms]", "width", "times the channels of every layer", "log"),
    ("Stages of a job by crops [ms]", "crops", "crops", "log"),
)
MOST_TICKS = 6


def draw(values: dict[str, Any], path: Path) -> None:
    """Write four panels, all axes logarithmic but the one of layers, as a PNG file."""
    margins = {"left": 0.075, "right": 0.985, "top": 0.895, "bottom": 0.16}
    figure = new_page((7.2, 6.6), 2, 2, wspace=0.2, hspace=0.5, **margins)
    for axes, (title, name, sizes, scale) in zip(figure.axes, PANELS, strict=True):
        style(axes, title, sizes)
        draw_times(axes, values["ms"][name], scale)
    lines = [Line2D([], [], color=COLOURS[name], linewidth=1.8) for name in NAMES]
    figure.legend(
        lines, [*NAMES.values()], loc="upper center", ncols=len(NAMES), fontsize=SMALL,
        frameon=False, handlelength=1.3, columnspacing=1.2, handletextpad=0.5,
    )  # fmt: skip
    threads = f"{values['threads']} thread{'s' * (values['threads'] > 1)}"
    caption(
        figure,
        f"A step: of SGD, the last {defaults.LAYERS} layers on {BATCH} crops unless said otherwise;"
        f" ONNX Runtime, {threads}, medians.\n"
        "Dashed: SGMs whose hidden channels grow with the layers; else they are the bundle's.\n"
        f"A job: {values['epochs']} epochs over four fifths of the crops; tuning in the colour of"
        " its method.",
        (0.03, 0.02),
    )
    write_chart(figure, path)


def draw_times(axes: Axes, series: dict[int, dict[str, float]], scale: str) -> None:
    """A line for everything that was timed."""
    for name in next(iter(series.values())):
        wider = name.endswith("_wider")
        axes.plot(
            [*series],
            [ms[name] for ms in series.values()],
            color=COLOURS[name.removesuffix("_wider")],
            linestyle=(0, (3, 2)) if wider else "-",
            linewidth=1.6,
            marker="" if wider else "o",
            markersize=3.5,
        )
    times = [one for ms in series.values() for one in ms.values()]
    axes.set_yscale("log")
    ticks(axes.yaxis, time_ticks(min(times), max(times)))
    axes.grid(axis="y", color=GREY, alpha=0.15, linewidth=0.6)
    axes.set_xscale(scale)
    axes.set_xticks([*series], [*map(str, series)])
    axes.xaxis.set_minor_locator(NullLocator())


def time_ticks(low: float, high: float) -> list[float]:
    """Ticks from `low` to `high`: by 1, 2 and 5, or where that is too much, by tens."""
    by_ten = [10.0**power for power in range(-4, 6)]
    every = sorted(scale * decade for decade in by_ten for scale in (1, 2, 5))
    inside = [tick for tick in every if low <= 1.2 * tick and tick <= 1.2 * high]
    return inside if len(inside) <= MOST_TICKS else [tick for tick in inside if tick in by_ten]
