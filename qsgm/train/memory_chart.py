"""Memory at a glance (host): a step's peak by the number of tuned layers, and what SGMs save."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator

from qsgm.bench.memory import BP, FLOAT, INT8, STEPS, MemoryReport, outputs_alone, ratio
from qsgm.train.charts import DPI, GREY, SIZE_INCHES, SMALL, TEXT, save_png
from qsgm.train.fidelity_chart import apart

# Of Okabe and Ito, which the colour-blind tell apart.
COLOURS = {INT8: "#0072B2", FLOAT: "#009E73", BP: "#D55E00"}
TITLES = {INT8: "SGM int8", FLOAT: "SGM float", BP: "backprop"}
LABEL_GAP = 0.065  # between two labels, as a share of the axes
UNITS = ((1e6, "MB"), (1e3, "kB"), (1.0, "bytes"))
DECADES = tuple(10.0**power for power in range(2, 10))
OUTPUTS = "outputs"
DOTTED, DASHED = (0, (1, 1.5)), (0, (4, 3))


def write_memory_chart(report: MemoryReport, path: Path) -> None:
    """Write the picture of :func:`memory_chart` as a PNG file, 1800 pixels wide.

    Raises:
        QsgmError: the place cannot be written to.
    """
    save_png(memory_chart(report), path)


def memory_chart(report: MemoryReport) -> Figure:
    """Peaks of the largest and the smallest batch, and backpropagation's over the SGMs'."""
    figure = Figure(figsize=SIZE_INCHES, dpi=DPI)
    left, right = figure.subplots(1, 2)
    figure.subplots_adjust(left=0.07, right=0.88, top=0.92, bottom=0.255, wspace=0.6)
    draw_peaks(left, report)
    draw_ratios(right, report)
    for axes in (left, right):
        axes.set_xticks([*report.steps[max(report.steps)]])
        axes.set_xlabel("tuned layers", fontsize=SMALL, color=GREY)
        axes.tick_params(labelsize=SMALL, color=GREY, labelcolor=GREY, length=3)
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(GREY)
    figure.text(0.04, 0.02, caption(report), fontsize=SMALL, color=GREY, linespacing=1.4)
    return figure


def draw_peaks(axes: Axes, report: MemoryReport) -> None:
    """Live activations, on a logarithmic axis."""
    axes.set_title("Peak of a step's activations", loc="left", fontsize=TEXT, fontweight="bold")
    axes.set_yscale("log")
    labels = {}
    for batch, style in batch_styles(report).items():
        steps = report.steps[batch]
        for name in STEPS:
            peaks = [some[name].peak for some in steps.values()]
            axes.plot([*steps], peaks, color=COLOURS[name], linestyle=style, linewidth=1.8)
            text = f"{TITLES[name]} {in_units(peaks[-1])}"
            labels[batch, name] = text, float(peaks[-1]), COLOURS[name]
    axes.yaxis.set_major_locator(FixedLocator(DECADES))
    axes.yaxis.set_minor_locator(NullLocator())
    axes.yaxis.set_major_formatter(lambda value, _place: in_units(value))
    label_lines(axes, [*labels.values()])


def batch_styles(report: MemoryReport) -> dict[int, Any]:
    """How the smallest and the largest batch's lines are drawn."""
    return {min(report.steps): DOTTED, max(report.steps): "-"}


def draw_ratios(axes: Axes, report: MemoryReport) -> None:
    """Backpropagation's peak over the SGMs'."""
    axes.set_title("Backprop's peak over the SGM's", loc="left", fontsize=TEXT, fontweight="bold")
    steps = report.steps[max(report.steps)]
    lines: dict[str, tuple[list[float], str, Any]] = {
        TITLES[name]: ([ratio(some, name) for some in steps.values()], COLOURS[name], "-")
        for name in (INT8, FLOAT)
    }
    lines[OUTPUTS] = [outputs_alone(tuned) for tuned in steps], GREY, DASHED
    axes.axhline(1, color=GREY, linewidth=0.8)
    for ratios, colour, style in lines.values():
        axes.plot([*steps], ratios, color=colour, linestyle=style, linewidth=1.8)
    axes.set_ylim(bottom=0)
    ends = {name: (some[-1], colour) for name, (some, colour, _) in lines.items()}
    label_lines(axes, [(f"{name} {end:.2f}", end, colour) for name, (end, colour) in ends.items()])


def label_lines(axes: Axes, labels: Sequence[tuple[str, float, str]]) -> None:
    """Texts beside the lines' ends; each with its line's last value and colour."""
    to_axes = axes.transData + axes.transAxes.inverted()
    heights = {i: to_axes.transform((0, end))[1] for i, (_, end, _) in enumerate(labels)}
    for i, height in apart(heights, LABEL_GAP).items():
        axes.annotate(
            labels[i][0],
            (1, height),
            xycoords="axes fraction",
            xytext=(4, 0),
            textcoords="offset points",
            color=labels[i][2],
            fontsize=SMALL,
            verticalalignment="center",
        )


def in_units(count: float) -> str:
    """Bytes to three digits."""
    unit, name = next((some for some in UNITS if count >= some[0]), UNITS[-1])
    return f"{count / unit:.3g} {name}"


def caption(report: MemoryReport) -> str:
    """What is drawn, in two lines."""
    few, many = min(report.steps), max(report.steps)
    return (
        f"Dotted: a step of {few} crop{'s' * (few > 1)}; all others: of {many}. Outputs: all"
        " layers' outputs alone over the largest layer's, as the paper counts.\n"
        "Activations alive at once in the graphs that ONNX Runtime runs; weights, states, inputs"
        " and outputs are not counted."
    )
