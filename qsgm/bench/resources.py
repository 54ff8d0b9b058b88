"""What training costs: the paper's Table 3 again, this bundle's layers and SGMs, and their time.

Everything but the time is counted, from the shapes of the layers and SGMs that a bundle holds. How
the paper counts follows from its figures:

- parameters: a convolution's weights and biases, and its batchnorm's scales and shifts;
- MACs: parameters times positions, and one for each output of the pool; of one crop, written with
  two decimals of thousands or millions, then taken 64 times;
- activations, in numbers: of layers 1 to 3 and 6 one tensor, of layers 4 and 5 convolution,
  batchnorm and ReLU, and of layer 4 also the pool's output. That is uneven;
- SGMs: parameters times positions. So printed behind layers 3 to 5; the figures behind layers 1 and
  2 are 1.1 and 0.6 % lower, and by no one rule.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import isqrt
from statistics import median
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.blocks import LAYERS, Blocks, one_block, single_layers
from qsgm.bundle import FLOAT_BYTES, Bundle, Precision, head_file, step_file
from qsgm.finetuning import OUTPUTS_PER_CROP, Watch, running_graphs
from qsgm.folded import FoldedSgm
from qsgm.quantize import LABELS, ActivationBits
from qsgm.report import number, plain_table
from qsgm.tuning import BATCH, StepLoop
from qsgm.weights import to_step_layout

PAPER_BATCH = 64
STRIDES = (2, 2, 2, 2, 1, 1)
POOLED = 4  # of a crop, the pool behind it leaves one position
PADDED = 3  # up to this layer the paper's SGMs have 3x3 kernels, behind it 1x1
# How many tensors of a layer the paper counts as activations; the pool's output comes on top.
TENSORS = {1: 1, 2: 1, 3: 1, 4: 3, 5: 3, 6: 1}
# Of an int8 SGM: scales, coarse scales and biases of a row, low end and gain of an input.
ROW_BYTES, INPUT_BYTES = 12, 8
PAPER_LEGEND = (
    "MAC: parameters times positions, and the pool's outputs; of a crop, with two decimals of K or "
    "M; activations: one tensor of layers 1 to 3 and 6, three of 4 and 5, and the pool's output; "
    "x layer: the SGM's MAC over its layer's, as counted"
)
BUNDLE_LEGEND = (
    "k: thousands of multiply-adds, in int8 of a u8 and an s8 number each; w grad: gradient of the "
    "weight; to input: gradient carried back, by backpropagation only; SGM: its constants; SGM "
    "tensors: its inputs and hidden tensors, in int8 their u8 planes"
)
STEP_LEGEND = (
    "MAC: of a forward pass in millions, of whole steps over that; ms: medians; fwd: forward pass "
    "alone; bp: the same layers without SGMs, their gradients carried back"
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


@dataclass(frozen=True)
class Shape:
    """A layer's convolution on a crop."""

    number: int
    weight: tuple[int, ...]  # (Co, Ci, kh, kw)
    side: int  # of its input map

    @property
    def channels(self) -> int:
        return self.weight[0]

    @property
    def products(self) -> int:
        """Multiply-adds at one position: as many as weights."""
        return int(np.prod(self.weight))

    @property
    def positions(self) -> int:
        """Of the map that the convolution makes."""
        return ((self.side - self.weight[2]) // STRIDES[self.number - 1] + 1) ** 2

    @property
    def positions_behind(self) -> int:
        """Of the layer's output, which its SGM sees."""
        return 1 if self.number == POOLED else self.positions


@dataclass(frozen=True)
class Cost:
    """One layer and the SGM behind it, per crop; without SGM its figures are 0."""

    layer: int
    forward: int  # multiply-adds
    weight_gradient: int
    to_input: int  # its gradient carried back to its input
    sgm_float: int
    sgm_int8: int  # each of a u8 and an s8 number
    parameter_bytes: int
    output_bytes: int  # convolution, ReLU and pool, float32
    sgm_bytes_float: int = 0  # of its constants
    sgm_bytes_int8: int = 0
    sgm_tensor_bytes_float: int = 0  # inputs and hidden tensors
    sgm_tensor_bytes_int8: int = 0  # their u8 planes


@dataclass(frozen=True)
class StepCost:
    """A training step of the last layers: multiply-adds, and measured seconds by variant."""

    forward: int
    backprop: int
    sgm_float: int
    sgm_int8: int
    seconds: Mapping[str, float]


@dataclass(frozen=True)
class ResourcesReport:
    """Of one bundle, layer by layer and by the number of layers tuned."""

    bundle: Bundle
    shapes: tuple[Shape, ...]
    costs: tuple[Cost, ...]
    steps: Mapping[int, StepCost]

    def to_json(self) -> dict[str, Any]:
        return {
            "bundle": str(self.bundle.folder),
            "paper": {
                str(shape.number): {
                    "counted": asdict(counted_row(shape)),
                    "printed": asdict(PUBLISHED[shape.number]),
                }
                for shape in self.shapes
            },
            "layers": {str(cost.layer): asdict(cost) for cost in self.costs},
            "steps": {
                str(tuned): {
                    "mac": {
                        "forward": step.forward,
                        "backprop": step.backprop,
                        "sgm_float": step.sgm_float,
                        "sgm_int8": step.sgm_int8,
                    },
                    "ms": {name: number(1000 * s, 4) for name, s in step.seconds.items()},
                }
                for tuned, step in self.steps.items()
            },
        }

    def render(self) -> RenderableType:
        """The paper's table, this bundle's, and whole steps."""
        return Group(
            paper_table(self.shapes),
            paper_sgm_table(self.shapes),
            Text(PAPER_LEGEND, style="dim"),
            mac_table(self.costs),
            bytes_table(self.costs),
            Text(BUNDLE_LEGEND, style="dim"),
            step_table(self.steps),
            Text(STEP_LEGEND, style="dim"),
        )


def measure_resources(bundle: Bundle, repeats: int, threads: int, watch: Watch) -> ResourcesReport:
    """Count a bundle's layers and SGMs, and time steps of any number of them.

    Args:
        bundle: whose layers and SGMs they are.
        repeats: steps of every variant, in turns; medians are kept.
        threads: of ONNX Runtime.
        watch: told about every number of layers.

    Raises:
        QsgmError: a graph of the bundle cannot be run.
    """
    shapes = layer_shapes(bundle)
    costs = tuple(cost_of(bundle, shape) for shape in shapes)
    steps = {}
    for tuned in range(1, bundle.most_layers + 1):
        seconds = step_seconds(bundle, tuned, repeats, threads)
        steps[tuned] = step_cost(costs[-tuned:], seconds)
        watch("layers", tuned, bundle.most_layers)
    return ResourcesReport(bundle, shapes, costs, steps)


def layer_shapes(bundle: Bundle) -> tuple[Shape, ...]:
    """Of all layers that the bundle can tune."""
    shapes = []
    for tuned in range(bundle.most_layers, 0, -1):
        layer = LAYERS + 1 - tuned
        weight = tuple(bundle.manifest["initializers"][f"weight{layer}"]["shape"])
        (features,) = (
            value.shape
            for value in bundle.session(head_file(tuned)).get_inputs()
            if value.name == "features"
        )
        shapes.append(Shape(layer, weight, isqrt(features[1])))
    return tuple(shapes)


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


def cost_of(bundle: Bundle, shape: Shape) -> Cost:
    """One layer of this bundle and the SGM behind it."""
    macs = shape.products * shape.positions
    of_layer = {
        "layer": shape.number,
        "forward": macs,
        "weight_gradient": macs,
        "to_input": macs,
        "parameter_bytes": FLOAT_BYTES * (shape.products + shape.channels),
        "output_bytes": FLOAT_BYTES * OUTPUTS_PER_CROP[shape.number],
    }
    if shape.number == LAYERS:
        return Cost(**of_layer, sgm_float=0, sgm_int8=0)
    sgm, bits = bundle.float_sgm(shape.number), bundle.activation_bits(shape.number)
    products = sum(conv.weight.size for conv in sgm.convs) * shape.positions_behind
    between = sum(conv.weight.shape[1] for conv in sgm.convs) * shape.positions_behind
    return Cost(
        **of_layer,
        sgm_float=products,
        # The first plane by the coarse weights, and all planes by the rest.
        sgm_int8=products * (1 + bits // 8),
        sgm_bytes_float=sum(conv.weight.nbytes + conv.bias.nbytes for conv in sgm.convs),
        sgm_bytes_int8=int8_bytes(sgm, bits),
        sgm_tensor_bytes_float=FLOAT_BYTES * between,
        sgm_tensor_bytes_int8=bits // 8 * between,
    )


def int8_bytes(sgm: FoldedSgm, bits: ActivationBits) -> int:
    """Of the constants of an SGM in int8, as :func:`qsgm.quantize.constants` lists them."""
    weights = sum(conv.weight.size for conv in sgm.convs) * (1 + bits // 8)
    rows = sum(len(conv.bias) for conv in sgm.convs)
    return weights + ROW_BYTES * rows + INPUT_BYTES * int(sgm.convs[0].weight.shape[1])


def step_cost(costs: Sequence[Cost], seconds: Mapping[str, float]) -> StepCost:
    """Of a batch that trains these layers; the first one's input needs no gradient."""
    forward = BATCH * sum(cost.forward for cost in costs)
    updated = forward + BATCH * sum(cost.weight_gradient for cost in costs)
    return StepCost(
        forward,
        updated + BATCH * sum(cost.to_input for cost in costs[1:]),
        updated + BATCH * sum(cost.sgm_float for cost in costs),
        updated + BATCH * sum(cost.sgm_int8 for cost in costs),
        seconds,
    )


def step_seconds(bundle: Bundle, tuned: int, repeats: int, threads: int) -> dict[str, float]:
    """Median of a step's seconds by variant, which take turns."""
    jobs = {
        "forward": forward_pass(bundle, tuned, threads),
        "backprop": step_job(bundle, "float", one_block(tuned), threads),
        "sgm_float": step_job(bundle, "float", single_layers(tuned), threads),
        "sgm_int8": step_job(bundle, "int8", single_layers(tuned), threads),
    }
    times: dict[str, list[float]] = {name: [] for name in jobs}
    with running_graphs(bundle):
        for turn in range(-1, repeats):  # the first turn allocates and does not count
            for name, job in jobs.items():
                began = time.perf_counter()
                job()
                if turn >= 0:
                    times[name].append(time.perf_counter() - began)
    return {name: median(some) for name, some in times.items()}


def forward_pass(bundle: Bundle, tuned: int, threads: int) -> Callable[[], object]:
    """The tuned layers on one batch, without training."""
    session = bundle.session(head_file(tuned), threads)
    feeds = {"features": random_features(session), **start_of(bundle, tuned)}
    return lambda: session.run(["outputs"], feeds)


def step_job(
    bundle: Bundle, precision: Precision, blocks: Blocks, threads: int
) -> Callable[[], object]:
    """A step of SGD on one batch at a rate of 0: the same work, and nothing can diverge."""
    session = bundle.session(step_file(precision, "sgd", blocks), threads)
    return still_loop(session, start_of(bundle, len(blocks.layers)), blocks, BATCH)


def still_loop(
    session: Any, start: Mapping[str, Any], blocks: Blocks, batch: int
) -> Callable[[], float]:
    """A step on so many crops that changes no weight."""
    labels = np.tile(np.array([1, 0, 1], np.float32), (batch, 1))
    rates = dict.fromkeys(blocks.layers, 0.0)
    loop = StepLoop(session, random_features(session, batch), labels, start, rates)
    rows = np.arange(batch)
    return lambda: loop.step(rows)


def random_features(session: Any, crops: int = BATCH) -> Any:
    """What a graph's input `features` takes, of so many crops: pixels or codes, or floats."""
    (features,) = (value for value in session.get_inputs() if value.name == "features")
    shape, rng = (crops, *features.shape[1:]), np.random.default_rng(0)
    if "uint8" in features.type:
        return rng.integers(0, 256, shape, np.uint8)
    return rng.uniform(0, 1, shape).astype(np.float32)


def start_of(bundle: Bundle, tuned: int) -> dict[str, Any]:
    """The starting weights in the step graphs' layout."""
    return {
        name: to_step_layout(value) if value.ndim > 1 else value
        for name, value in bundle.start_weights(tuned).items()
    }


def right_table(title: str, *headings: str) -> Table:
    """Columns of numbers."""
    table = plain_table(title)
    table.padding = (0, 1, 0, 0)
    for heading in headings:
        table.add_column(Text(heading), justify="right")
    return table


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


def mac_table(costs: Sequence[Cost]) -> Table:
    """Multiply-adds of this bundle's layers and SGMs."""
    table = right_table(
        "this bundle: multiply-adds [k], per crop",
        *("\nlayer", "\nforward", "\nw grad", "\nto input", "SGM\nfloat", "SGM\nint8"),
        "float SGM\nx forward",
    )
    for cost in costs:
        cells = (cost.forward, cost.weight_gradient, cost.to_input, cost.sgm_float, cost.sgm_int8)
        table.add_row(
            str(cost.layer),
            *(f"{cell / 1000:,.2f}" if cell else "-" for cell in cells),
            f"{cost.sgm_float / cost.forward:.4f}" if cost.sgm_float else "-",
        )
    return table


def bytes_table(costs: Sequence[Cost]) -> Table:
    """Bytes of this bundle's layers and SGMs."""
    table = right_table(
        "this bundle: bytes; activations per crop",
        *("\nlayer", "\nparam", "\nactivations", "SGM\nfloat", "SGM\nint8"),
        *("SGM tensors\nfloat", "\nint8"),
    )
    for cost in costs:
        cells = (
            cost.parameter_bytes,
            cost.output_bytes,
            cost.sgm_bytes_float,
            cost.sgm_bytes_int8,
            cost.sgm_tensor_bytes_float,
            cost.sgm_tensor_bytes_int8,
        )
        table.add_row(str(cost.layer), *(f"{cell:,}" if cell else "-" for cell in cells))
    return table


def step_table(steps: Mapping[int, StepCost]) -> Table:
    """Whole steps by the number of layers tuned."""
    table = right_table(
        f"a step of {BATCH} crops",
        *("tuned\nlayers", "MAC [M]\nfwd", "x fwd\nbp", "SGM\nfloat", "SGM\nint8"),
        *("[ms]\nfwd", "\nbp", "SGM\nfloat", "SGM\nint8", "int8\nx bp"),
    )
    for tuned, step in steps.items():
        macs = (step.backprop, step.sgm_float, step.sgm_int8)
        seconds = step.seconds
        table.add_row(
            str(tuned),
            f"{step.forward / 1e6:,.2f}",
            *(f"{mac / step.forward:.2f}" for mac in macs),
            *(f"{1000 * value:.2f}" for value in seconds.values()),
            f"{seconds['sgm_int8'] / seconds['backprop']:.2f}",
        )
    return table
