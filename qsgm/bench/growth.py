"""How the cost of training grows, and where int8 wins: what was measured, as tables and as JSON.

It is timed on the host (:mod:`qsgm.train.growth`), which builds the wider graphs.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm import defaults
from qsgm.bench.speed import VARIANTS
from qsgm.bench.tables import right_table
from qsgm.bundle import Bundle
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import SLICE
from qsgm.tune.report import number

INT8, FLOAT, BP = VARIANTS
FORWARD = "forward"
# SGMs whose hidden convolutions are wider by as much as the layers.
FLOAT_WIDER, INT8_WIDER = "sgm float, wider", "sgm int8, wider"
# Stages of a job, beside tuning by each method.
CROPS, FEATURES = "crops", "features"
# What is timed on its own: float, and int8 by its activations' bits and its weights' type.
ALONE = "float"
U8_16, U8_8, S8_16, S8_8 = "int8 16 u8", "int8 8 u8", "int8 16 s8", "int8 8 s8"
# Of float's time; with less saved, int8 does not count as quicker.
LEAST_SAVED = 0.05

STEP_HEADINGS = {FORWARD: "\nfwd", BP: "\nbp", FLOAT: "SGM\nfloat", INT8: "SGM\nint8"}
WIDTH_HEADINGS = STEP_HEADINGS | {FLOAT_WIDER: "wider\nfloat", INT8_WIDER: "wider\nint8"}
STAGE_HEADINGS = {CROPS: "\ncrops", FEATURES: "\nfeatures", BP: "tuning\nbp"}
STAGE_HEADINGS |= {FLOAT: "SGM\nfloat", INT8: "SGM\nint8"}
ALONE_HEADINGS = {ALONE: "\nfloat", U8_16: "16 u8\nint8", U8_8: "8 u8\nint8"}
ALONE_HEADINGS |= {S8_16: "16 s8\nint8", S8_8: "8 s8\nint8"}

STEP_LEGEND = (
    "fwd: forward pass of the same layers; bp: backpropagation; last line: the last over the first"
)
WIDTH_LEGEND = (
    "width: so many times the channels of every layer but the last; SGM: hidden channels as in the "
    "bundle; wider: so many times those, which keeps the SGM's share of the work"
)
STAGE_LEGEND = "medians of a few jobs; four fifths of the crops are trained on; no probes"
ALONE_LEGEND = (
    "16, 8: bits of an activation, in two u8 planes or one (an SGM's weights have two); u8: weights"
    " as this package runs them, with sums exact on every CPU; s8: as exact on CPUs with VNNI; /:"
    " over float"
)

# seconds by size, then by variant
Series = Mapping[int, Mapping[str, float]]


@dataclass(frozen=True)
class GrowthReport:
    """Medians, in seconds; see :func:`qsgm.train.growth.measure_growth`."""

    bundle: Bundle
    frame: Path
    threads: int
    repeats: int
    epochs: int
    batch: Series  # a step, by crops in its batch
    layers: Series  # a step, by tuned layers
    width: Series  # a step, by what all channels are multiplied with
    crops: Series  # stages of a job, by its crops
    trunk: Series  # frozen layers on a slice of crops, by width
    sgms: Mapping[int, Series]  # by kernel: an SGM alone on a batch, by hidden channels

    def to_json(self) -> dict[str, Any]:
        return {
            "bundle": str(self.bundle.folder),
            "frame": str(self.frame),
            "optimizer": "sgd",
            "threads": self.threads,
            "repeats": self.repeats,
            "epochs": self.epochs,
            "step_ms": {
                "batch": in_ms(self.batch),
                "layers": in_ms(self.layers),
                "width": in_ms(self.width),
            },
            "crops_ms": in_ms(self.crops),
            "trunk_ms": in_ms(self.trunk),
            "sgm_ms": {f"{k}x{k}": in_ms(series) for k, series in self.sgms.items()},
            "where_int8_wins": self.where_int8_wins,
        }

    def render(self) -> RenderableType:
        """A table for everything that grows, and the one line."""
        last = f"last {defaults.LAYERS} layers"
        steps = f"ms a step of {BATCH} crops"
        return Group(
            growth_table(f"ms a step, {last}", "batch\n[crops]", self.batch, STEP_HEADINGS),
            size_table(steps, "tuned\nlayers", self.layers, STEP_HEADINGS),
            Text(f"medians of {self.repeats} turns; {STEP_LEGEND}", style="dim"),
            growth_table(f"{steps}, {last}", "\nwidth", self.width, WIDTH_HEADINGS),
            Text(WIDTH_LEGEND, style="dim"),
            growth_table(
                f"ms of the stages, {self.epochs} epochs", "\ncrops", self.crops, STAGE_HEADINGS
            ),
            Text(STAGE_LEGEND, style="dim"),
            alone_table(f"frozen layers: ms for {SLICE} crops", "\nwidth", self.trunk),
            *(
                alone_table(f"{k}x{k} SGM: ms for {BATCH} crops", "hidden\nchannels", series)
                for k, series in self.sgms.items()
            ),
            Text(ALONE_LEGEND, style="dim"),
            Text(self.where_int8_wins),
        )

    @property
    def where_int8_wins(self) -> str:
        """One line, from these times."""
        by_width, by_hidden = "width x{}", "{} hidden channels"
        alone = [("frozen layers", self.trunk, by_width)]
        alone += [(f"{k}x{k} SGMs", series, by_hidden) for k, series in self.sgms.items()]
        places = {
            "steps": wins(self.width, FLOAT, INT8, by_width),
            "steps with wider SGMs": wins(self.width, FLOAT_WIDER, INT8_WIDER, by_width),
        } | {
            f"{name} in {variant.removeprefix('int8 ')}": wins(series, ALONE, variant, form)
            for name, series, form in alone
            for variant in variants_of(series)
        }
        parts = [f"{name} {place}" for name, place in places.items() if place]
        if lost := [name for name, place in places.items() if not place]:
            parts.append(f"nowhere: {', '.join(lost)}")
        return f"int8 saves {LEAST_SAVED:.0%} of float's time or more: {'; '.join(parts)}"


def in_ms(series: Series) -> dict[str, dict[str, float | None]]:
    """Of seconds, as JSON has them."""
    return {
        str(size): {name: number(1000 * seconds, 4) for name, seconds in some.items()}
        for size, some in series.items()
    }


def wins(series: Series, floating: str, int8: str, form: str) -> str:
    """At which sizes, each put into `form`, int8 saves enough of float's time; none: nothing."""
    sizes = sorted(series)
    most = 1 - LEAST_SAVED
    won = [size for size in sizes if series[size][int8] <= most * series[size][floating]]
    if not won:
        return ""
    if won == sizes:
        return "everywhere"
    if won == sizes[-len(won) :]:
        return f"from {form.format(won[0])} on"
    if won == sizes[: len(won)]:
        return f"up to {form.format(won[-1])}"
    return f"at {form.format(' and '.join(map(str, won)))}"


def size_table(title: str, heading: str, series: Series, headings: Mapping[str, str]) -> Table:
    """A line for every size."""
    table = right_table(title, heading, *headings.values())
    for size, some in series.items():
        table.add_row(str(size), *(milliseconds(some[name]) for name in headings))
    return table


def growth_table(title: str, heading: str, series: Series, headings: Mapping[str, str]) -> Table:
    """The same, and what the largest is to the smallest."""
    table = size_table(title, heading, series, headings)
    first, last = min(series), max(series)
    cells = (f"x{series[last][name] / series[first][name]:.1f}" for name in headings)
    table.add_row(f"x{last / first:g}", *cells, style="dim")
    return table


def alone_table(title: str, heading: str, series: Series) -> Table:
    """Float and int8, and what int8 takes of float's time."""
    variants = variants_of(series)
    shown = [ALONE, *variants]
    ratios = [ALONE_HEADINGS[name].replace("int8", "/") for name in variants]
    table = right_table(title, heading, *(ALONE_HEADINGS[name] for name in shown), *ratios)
    for size, some in series.items():
        cells = [milliseconds(some[name]) for name in shown]
        cells += [f"{some[name] / some[ALONE]:.2f}" for name in variants]
        table.add_row(str(size), *cells)
    return table


def variants_of(series: Series) -> list[str]:
    """What was timed in int8."""
    return [name for name in next(iter(series.values())) if name != ALONE]


def milliseconds(seconds: float) -> str:
    """Of seconds; to three digits, but none behind a microsecond's."""
    value = 1000 * seconds
    return f"{value:.{max(0, 3 - len(str(int(value))))}f}" if value >= 1 else f"{value:.3f}"
