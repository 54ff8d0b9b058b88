"""The calibration study at a glance (host): sets against variants, coloured by angle error."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure

from qsgm.bench.calibration import ANGLE, CalibrationReport, Floats, Variant
from qsgm.train.charts import DPI, GREY, SMALL, TEXT, save_png

WIDTH_INCHES, ROW_INCHES, HEADER_INCHES, FOOTER_INCHES = 9.0, 0.46, 1.0, 0.6
# White: as good as float; the darkest orange: this many times its angle error.
WORST_RATIO = 10.0
COLOURS = LinearSegmentedColormap.from_list("loss", ["#FFFFFF", "#F6C19A", "#D55E00", "#7A3300"])
DARK_CELL = 3.0  # from this ratio on the text is white


def write_calibration_chart(report: CalibrationReport, path: Path) -> None:
    """Write the picture of :func:`calibration_chart` as a PNG file, 1800 pixels wide.

    Raises:
        QsgmError: the place cannot be written to.
    """
    save_png(calibration_chart(report), path)


def calibration_chart(report: CalibrationReport) -> Figure:
    """A cell per calibration set and variant: angle error, and the cosine of int8 to float."""
    height = HEADER_INCHES + ROW_INCHES * len(report.sources) + FOOTER_INCHES
    figure = Figure(figsize=(WIDTH_INCHES, height), dpi=DPI)
    axes = figure.add_axes(
        (0.23, FOOTER_INCHES / height, 0.75, 1 - (HEADER_INCHES + FOOTER_INCHES) / height)
    )
    angles, floating = angle_errors(report)
    ratio = np.maximum(angles / floating, 1.0)
    axes.pcolormesh(
        ratio, cmap=COLOURS, norm=LogNorm(1.0, WORST_RATIO), edgecolors="white", linewidth=1.5
    )
    axes.invert_yaxis()
    label_axes(axes, report)
    for i, k in np.ndindex(*ratio.shape):
        cosine = report.summary(i, k)["cos_int8_float"] or 0.0
        axes.text(
            k + 0.5,
            i + 0.5,
            f"{angles[i, k]:.2f}°\n{cosine:.4f}".replace("-", "−"),
            ha="center",
            va="center",
            fontsize=SMALL,
            linespacing=1.25,
            color="white" if ratio[i, k] > DARK_CELL else "black",
        )
    figure.text(
        0.015,
        1 - 0.1 / height,
        "Calibrated there, tuned elsewhere: angle error, and cosine of int8 to float gradients",
        fontsize=TEXT,
        fontweight="bold",
        va="top",
    )
    figure.text(
        0.22,
        1 - (HEADER_INCHES - 0.06) / height,
        "activations\nweights\ncalibrator",
        fontsize=SMALL,
        color=GREY,
        ha="right",
    )
    figure.text(0.015, 0.12 / height, caption(report, floating), fontsize=SMALL, color=GREY)
    return figure


def angle_errors(report: CalibrationReport) -> tuple[Floats, float]:
    """Mean angle error (sources, variants) and the float SGMs' [degrees]."""
    frames = report.elongated
    angles = report.results[:, :, frames, ANGLE].mean(axis=2)
    return angles, float(report.floating[frames, ANGLE].mean())


def label_axes(axes: Axes, report: CalibrationReport) -> None:
    """Sets on the left, variants on top."""
    axes.set_yticks(np.arange(len(report.sources)) + 0.5, report.sources, fontsize=SMALL)
    axes.set_xticks(
        np.arange(len(report.variants)) + 0.5, [heading(v) for v in report.variants], fontsize=SMALL
    )
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    for spine in axes.spines.values():
        spine.set_visible(False)


def heading(variant: Variant) -> str:
    """A variant on three lines."""
    return f"{variant.activation_bits} bit\n{variant.weight_bits} bit\n{variant.calibrator}"


def caption(report: CalibrationReport, floating: float) -> str:
    """What one has to know to read it."""
    return (
        f"Means over {int(report.elongated.sum())} of {len(report.frames)} frames, none of them in"
        f" a calibration set, {report.settings.layers} layers, {report.settings.epochs} epochs;"
        f" float SGMs: {floating:.2f}°.\n"
        f"White: no worse than float; the darkest: {WORST_RATIO:g} times its angle error or more."
    )
