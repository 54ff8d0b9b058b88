"""What training costs: this bundle's layers and SGMs beside the paper's Table 3, and their time.

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

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Group, RenderableType
from rich.table import Table

from qsgm.bench.timing import step_seconds
from qsgm.bundle import Bundle
from qsgm.grasp.network import GRASPNET
from qsgm.manifest import FLOAT_BYTES
from qsgm.network import ONE, Network
from qsgm.progress import Progress
from qsgm.schedule import BATCH
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import ActivationBits
from qsgm.tables import CLOSE, legend, number, table

# Bytes of an int8 SGM: scale and bias of a row, low end and gain of an input, step and zero point
# of a low plane.
ROW_BYTES, INPUT_BYTES, LOW_PLANE_BYTES = 8, 8, 5
PAPER_BATCH = 64
PADDED = 3  # up to this layer the paper's SGMs have 3x3 kernels, behind it 1x1
# How many tensors of a layer the paper counts as activations; the pool's output comes on top.
TENSORS = {1: 1, 2: 1, 3: 1, 4: 3, 5: 3, 6: 1}
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
Cost = dict[str, int]  # of a layer and the SGM behind it, per crop; without SGM its figures are 0
Values = Mapping[str, Any]


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


def measure_resources(
    bundle: Bundle, repeats: int, threads: int, watch: Progress
) -> dict[str, Any]:
    """Count a bundle's layers and SGMs, and time steps of any number of them.

    The paper's table stands beside those of its own network.

    Args:
        bundle: whose layers and SGMs they are.
        repeats: steps of every variant, in turns; medians are kept.
        threads: of ONNX Runtime.
        watch: told about every number of layers.

    Raises:
        QsgmError: a graph of the bundle cannot be run.
    """
    network = bundle.network
    layers = network.last(bundle.manifest.most_layers)
    costs = [cost_of(bundle, number) for number in layers]
    steps = {}
    for tuned in range(1, bundle.manifest.most_layers + 1):
        seconds = step_seconds(bundle, tuned, repeats, threads)
        steps[str(tuned)] = {
            "mac": step_macs(costs[-tuned:]),
            "ms": {name: number(1000 * value, 4) for name, value in seconds.items()},
        }
        watch("layers", tuned, bundle.manifest.most_layers)
    return {
        "bundle": str(bundle.folder),
        "paper": {
            str(number): {
                "counted": asdict(counted_row(network, number)),
                "printed": asdict(PUBLISHED[number]),
            }
            for number in layers
            if network == GRASPNET
        },
        "layers": {str(cost["layer"]): cost for cost in costs},
        "steps": steps,
    }


def output_bytes(network: Network, tuned: int, batch: int = BATCH) -> list[int]:
    """Bytes of every tuned layer's outputs, as the paper's Table 3 counts those of layers 4 and 5.

    Counted in float32: a layer's convolution, ReLU and pool; its batchnorm is folded here.
    Backpropagation keeps those of all layers, with SGMs the largest layer's are alive.
    """
    return [FLOAT_BYTES * batch * outputs_of(network, k) for k in network.last(tuned)]


def outputs_of(network: Network, number: int) -> int:
    """Numbers that a layer leaves per crop: of its convolution, its ReLU and its pool."""
    layer = network.layer(number)
    positions = (1 + layer.relu) * network.windows(number)
    return layer.out * (positions + pooled_positions(network, number))


def pooled_positions(network: Network, number: int) -> int:
    """Positions that a layer's pool gives; without one, none."""
    return network.positions_after(number) if network.layer(number).pool != ONE else 0


def counted_row(network: Network, number: int) -> Row:
    """A layer as the paper counts it, MACs of a crop rounded as printed."""
    layer, positions = network.layer(number), network.windows(number)
    channels, normed = layer.out, number < network.depth  # the last one has no batchnorm
    pooled = channels * pooled_positions(network, number)
    parameters = layer.weights + 2 * channels * normed
    mac = PAPER_BATCH * as_printed(parameters * positions + pooled)
    activations = PAPER_BATCH * (TENSORS[number] * channels * positions + pooled)
    if not normed:
        return Row(mac, parameters, activations)
    taps = 9 if number <= PADDED else 1
    sgm = (taps * (channels + 3) * channels + 3 * channels) + (taps * channels + 1) * channels
    sgm_mac = PAPER_BATCH * as_printed(sgm * network.positions_after(number))
    return Row(mac, parameters, activations, sgm_mac, sgm)


def as_printed(count: int) -> int:
    """With two decimals of thousands or millions, smaller ones as they are."""
    unit = 1_000_000 if count >= 1_000_000 else 1000 if count >= 1000 else 1
    return round(round(count / unit, 2) * unit)


def cost_of(bundle: Bundle, number: int) -> Cost:
    """Multiply-adds and bytes of one layer of this bundle and of the SGM behind it."""
    network = bundle.network
    macs, positions = network.macs(number), network.positions_after(number)
    cost = {
        "layer": number,
        "forward": macs,
        "weight_gradient": macs,
        "to_input": macs,
        "sgm_float": 0,
        "sgm_int8": 0,
        "parameter_bytes": FLOAT_BYTES * network.layer(number).weights,
        "output_bytes": FLOAT_BYTES * outputs_of(network, number),
        "sgm_bytes_float": 0,
        "sgm_bytes_int8": 0,
        "sgm_tensor_bytes_float": 0,
        "sgm_tensor_bytes_int8": 0,
    }
    if number == network.depth:
        return cost
    sgm, bits = bundle.float_sgm(number), bundle.activation_bits(number)
    products = sum(conv.weight.size for conv in sgm.convs) * positions
    between = sum(conv.weight.shape[1] for conv in sgm.convs) * positions
    return cost | {
        "sgm_float": products,
        # The first plane by the coarse weights, and all planes by the rest.
        "sgm_int8": products * (1 + bits // 8),
        "sgm_bytes_float": sum(conv.weight.nbytes + conv.bias.nbytes for conv in sgm.convs),
        "sgm_bytes_int8": int8_bytes(sgm, bits),
        "sgm_tensor_bytes_float": FLOAT_BYTES * between,
        "sgm_tensor_bytes_int8": bits // 8 * between,
    }


def int8_bytes(sgm: FoldedSgm, bits: ActivationBits) -> int:
    """Bytes of an SGM's constants in int8, as :func:`qsgm.sgm.int8.constants` lists them."""
    weights = 2 * sum(int(conv.weight.size) for conv in sgm.convs)
    rows = sum(len(conv.bias) for conv in sgm.convs)
    low_plane = LOW_PLANE_BYTES if bits == 16 else 0
    inputs = INPUT_BYTES * int(sgm.convs[0].weight.shape[1])
    return weights + ROW_BYTES * rows + inputs + low_plane


def step_macs(costs: Sequence[Cost]) -> dict[str, int]:
    """Multiply-adds of a batch that trains these layers; the first's input needs no gradient."""

    def total(key: str, first: int = 0) -> int:
        return BATCH * sum(cost[key] for cost in costs[first:])

    updated = total("forward") + total("weight_gradient")
    return {
        "forward": total("forward"),
        "backprop": updated + total("to_input", 1),
        "sgm_float": updated + total("sgm_float"),
        "sgm_int8": updated + total("sgm_int8"),
    }


def render(values: Values) -> RenderableType:
    """The paper's table, this bundle's, and whole steps."""
    layers = values["layers"].values()
    paper = values["paper"]
    printed = (paper_table(paper), paper_sgm_table(paper), legend(PAPER_LEGEND)) if paper else ()
    return Group(
        *printed,
        mac_table(layers),
        bytes_table(layers),
        legend(BUNDLE_LEGEND),
        step_table(values["steps"]),
        legend(STEP_LEGEND),
    )


def paper_table(paper: Values) -> Table:
    """The layers' half of Table 3, counted beside what is printed."""
    names = {"mac": "MAC", "parameters": "param", "activations": "activations"}
    headings = [(h, "{:,}") for name in names.values() for h in (f"{name}\ncounted", "\nprinted")]
    return table(
        f"Table 3 of Neven et al. (2020) counted again, {PAPER_BATCH} crops: layers",
        ["\nlayer", *headings],
        [
            [layer, *(row[kind][key] for key in names for kind in ("counted", "printed"))]
            for layer, row in paper.items()
        ],
        left=(),
        padding=CLOSE,
    )


def paper_sgm_table(paper: Values) -> Table:
    """The SGMs' half of Table 3, and how they compare with their layers."""
    both = [(layer, row["counted"], row["printed"]) for layer, row in paper.items()][:-1]
    return table(
        "and its SGMs, one hidden layer",
        [
            "\nlayer",
            *(("MAC\ncounted", "{:,}"), ("\nprinted", "{:,}"), ("\nx layer", "{:.4f}")),
            *(("param\ncounted", "{:,}"), ("\nprinted", "{:,}")),
        ],
        [
            [
                layer,
                *(counted["sgm_mac"], printed["sgm_mac"], counted["sgm_mac"] / counted["mac"]),
                *(counted["sgm_parameters"], printed["sgm_parameters"]),
            ]
            for layer, counted, printed in both
        ],
        left=(),
        padding=CLOSE,
    )


def mac_table(costs: Sequence[Cost]) -> Table:
    """Multiply-adds of this bundle's layers and SGMs."""
    keys = {"forward": "\nforward", "weight_gradient": "\nw grad", "to_input": "\nto input"}
    keys |= {"sgm_float": "SGM\nfloat", "sgm_int8": "SGM\nint8"}
    return table(
        "this bundle: multiply-adds [k], per crop",
        [
            "\nlayer",
            *((heading, "{:,.2f}") for heading in keys.values()),
            ("float SGM\nx forward", "{:.4f}"),
        ],
        [
            [
                cost["layer"],
                *(cost[key] / 1000 or None for key in keys),
                cost["sgm_float"] / cost["forward"] or None,
            ]
            for cost in costs
        ],
        left=(),
        padding=CLOSE,
    )


def bytes_table(costs: Sequence[Cost]) -> Table:
    """Bytes of this bundle's layers and SGMs."""
    keys = {"parameter_bytes": "\nparam", "output_bytes": "\nactivations"}
    keys |= {"sgm_bytes_float": "SGM\nfloat", "sgm_bytes_int8": "SGM\nint8"}
    keys |= {"sgm_tensor_bytes_float": "SGM tensors\nfloat", "sgm_tensor_bytes_int8": "\nint8"}
    return table(
        "this bundle: bytes; activations per crop",
        ["\nlayer", *((heading, "{:,}") for heading in keys.values())],
        [[cost["layer"], *(cost[key] or None for key in keys)] for cost in costs],
        left=(),
        padding=CLOSE,
    )


def step_table(steps: Values) -> Table:
    """Whole steps by the number of layers tuned."""
    rows = []
    for tuned, step in steps.items():
        (forward, *macs), ms = step["mac"].values(), step["ms"]
        ratio = ms["sgm_int8"] / ms["backprop"]
        rows.append([tuned, forward / 1e6, *(mac / forward for mac in macs), *ms.values(), ratio])
    headings = ("x fwd\nbp", "SGM\nfloat", "SGM\nint8", "[ms]\nfwd", "\nbp", "SGM\nfloat")
    return table(
        f"a step of {BATCH} crops",
        [
            *("tuned\nlayers", ("MAC [M]\nfwd", "{:,.2f}")),
            *((heading, "{:.2f}") for heading in (*headings, "SGM\nint8", "int8\nx bp")),
        ],
        rows,
        left=(),
        padding=CLOSE,
    )
