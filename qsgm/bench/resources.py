"""What training costs: this bundle's layers and SGMs beside the paper's Table 3, and their time.

Everything but the time is counted, from the shapes of the layers and SGMs that a bundle holds.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.bench.paper_table import (
    PAPER_LEGEND,
    PUBLISHED,
    counted_row,
    paper_sgm_table,
    paper_table,
)
from qsgm.bench.shapes import OUTPUTS_PER_CROP, Shape, layer_shapes
from qsgm.bench.step_jobs import step_seconds
from qsgm.bench.tables import right_table
from qsgm.blocks import LAYERS
from qsgm.bundle import FLOAT_BYTES, Bundle
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import ActivationBits
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import Watch
from qsgm.tune.report import number

# Of an int8 SGM: scale and bias of a row, low end and gain of an input, step and zero point of a
# low plane.
ROW_BYTES, INPUT_BYTES, LOW_PLANE_BYTES = 8, 8, 5
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
    """Of the constants of an SGM in int8, as :func:`qsgm.sgm.int8.constants` lists them."""
    weights = 2 * sum(conv.weight.size for conv in sgm.convs)
    rows = sum(len(conv.bias) for conv in sgm.convs)
    low_plane = LOW_PLANE_BYTES if bits == 16 else 0
    inputs = INPUT_BYTES * int(sgm.convs[0].weight.shape[1])
    return weights + ROW_BYTES * rows + inputs + low_plane


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
