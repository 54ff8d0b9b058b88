"""The paper's Table 3, counted again beside its printed figures.

How the paper counts follows from its figures:

- parameters: a convolution's weights and biases, and its batchnorm's scales and shifts;
- MACs: parameters times positions, and one for each output of the pool; of one crop, written with
  two decimals of thousands or millions, then taken 64 times;
- activations, in numbers: of layers 1 to 3 and 6 one tensor, of layers 4 and 5 convolution,
  batchnorm and ReLU, and of layer 4 also the pool's output. That is uneven;
- SGMs: parameters times positions. So printed behind layers 3 to 5; the figures behind layers 1 and
  2 are 1.1 and 0.6 % lower, and by no one rule.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from rich.table import Table

from qsgm.bench.shapes import POOLED, Shape
from qsgm.bench.tables import right_table
from qsgm.blocks import LAYERS
from qsgm.sgm.int8 import LABELS

PAPER_BATCH = 64
PADDED = 3  # up to this layer the paper's SGMs have 3x3 kernels, behind it 1x1
# How many tensors of a layer the paper counts as activations; the pool's output comes on top.
TENSORS = {1: 1, 2: 1, 3: 1, 4: 3, 5: 3, 6: 1}
PAPER_LEGEND = (
    "MAC: parameters times positions, and the pool's outputs; of a crop, with two decimals of K or "
    "M; activations: one tensor of layers 1 to 3 and 6, three of 4 and 5, and the pool's output; "
    "x layer: the SGM's MAC over its layer's, as counted"
)


@dataclass(frozen=True)
class Row:
    """A line of the paper's Table 3, of 64 crops; without SGM its figures are 0."""

    mac: int
    parameters: int
    activations: int
    sgm_mac: int = 0
    sgm_parameters: int = 0


PUBLISHED = {
    1: Row(153_600_000, 624, 1_968_128, 340_480_000, 1400),
    2: Row(87_680_000, 1620, 430_592, 74_880_000, 1400),
    3: Row(35_130_240, 3250, 173_056, 55_206_400, 5100),
    4: Row(10_318_080, 6450, 77_824, 39_936, 624),
    5: Row(19_456, 304, 3072, 39_936, 624),
    6: Row(3264, 51, 192),
}


def counted_row(shape: Shape) -> Row:
    """A layer as the paper counts it, MACs of a crop rounded as printed."""
    channels, layer = shape.channels, shape.number
    normed = layer < LAYERS  # the last one has no batchnorm
    pooled = channels if layer == POOLED else 0
    parameters = shape.products + channels + 2 * channels * normed
    activations = TENSORS[layer] * channels * shape.positions + pooled
    row = Row(
        PAPER_BATCH * as_printed(parameters * shape.positions + pooled),
        parameters,
        PAPER_BATCH * activations,
    )
    if not normed:
        return row
    taps = 9 if layer <= PADDED else 1
    sgm = (taps * (channels + LABELS) * channels + 3 * channels) + (taps * channels + 1) * channels
    sgm_mac = PAPER_BATCH * as_printed(sgm * shape.positions_behind)
    return Row(row.mac, parameters, row.activations, sgm_mac, sgm)


def as_printed(count: int) -> int:
    """With two decimals of thousands or millions, smaller ones as they are."""
    unit = 1_000_000 if count >= 1_000_000 else 1000 if count >= 1000 else 1
    return round(round(count / unit, 2) * unit)


def paper_table(shapes: Sequence[Shape]) -> Table:
    """The layers' half of Table 3."""
    table = right_table(
        f"Table 3 of Neven et al. (2020) counted again, {PAPER_BATCH} crops: layers",
        "\nlayer",
        "MAC\ncounted",
        "\nprinted",
        "param\ncounted",
        "\nprinted",
        "activations\ncounted",
        "\nprinted",
    )
    for shape in shapes:
        row, printed = counted_row(shape), PUBLISHED[shape.number]
        pairs = (
            (row.mac, printed.mac),
            (row.parameters, printed.parameters),
            (row.activations, printed.activations),
        )
        table.add_row(str(shape.number), *(f"{cell:,}" for pair in pairs for cell in pair))
    return table


def paper_sgm_table(shapes: Sequence[Shape]) -> Table:
    """The SGMs' half of Table 3, and how they compare with their layers."""
    table = right_table(
        "and its SGMs, one hidden layer",
        "\nlayer",
        "MAC\ncounted",
        "\nprinted",
        "\nx layer",
        "param\ncounted",
        "\nprinted",
    )
    for shape in shapes[:-1]:
        row, printed = counted_row(shape), PUBLISHED[shape.number]
        table.add_row(
            str(shape.number),
            f"{row.sgm_mac:,}",
            f"{printed.sgm_mac:,}",
            f"{row.sgm_mac / row.mac:.4f}",
            f"{row.sgm_parameters:,}",
            f"{printed.sgm_parameters:,}",
        )
    return table
