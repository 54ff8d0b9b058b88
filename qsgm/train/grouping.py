"""Where SGMs pay: the last layers in groups, each with an SGM behind it but the last.

Behind an SGM nothing has to be kept for a way back, so the more of them there are, the less memory
a step takes. But behind a layer that gives maps as large as its input an SGM costs more than the
layer (Neven et al. 2020, Table 3). So: of all groups, those that hold the fewest bytes at once,
among groups whose step takes at most a quarter more multiply-adds than the cheapest ones.

Counted from shapes: a forward pass, the weights' gradients, inside of a group the gradients carried
back, behind it its SGM. In a group are held the windows and outputs of its layers, of one sample
where it goes sample by sample, else of the batch.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import inf

from qsgm.blocks import Blocks
from qsgm.manifest import FLOAT_BYTES
from qsgm.network import Network
from qsgm.schedule import BATCH
from qsgm.train.graphs.layers import MANY_WINDOWS

# Times those of the groups with the fewest multiply-adds.
MOST_MACS = 1.25


@dataclass(frozen=True)
class SgmCost:
    """Of the SGM behind a layer, a sample at a time."""

    macs: int
    numbers: int  # in its inputs and hidden tensors


@dataclass(frozen=True)
class Cost:
    """Of a group in a training step of 32 samples."""

    macs: int
    held_bytes: int


def sgm_cost(network: Network, layer: int, weights: Iterable[tuple[int, ...]]) -> SgmCost:
    """An SGM with convolutions of these shapes (O, I, kh, kw)."""
    positions, macs, numbers = network.positions_after(layer), 0, 0
    for out, into, height, width in weights:
        macs += out * into * height * width * positions
        numbers += into * positions
    return SgmCost(macs, numbers)


def cost_of(network: Network, group: range, sgm: SgmCost | None) -> Cost:
    """A group's cost; without an SGM it is the last one."""
    macs = sum((2 + (k != group[0])) * network.macs(k) for k in group)
    held = sum(network.windows(k) * (network.layer(k).window + network.layer(k).out) for k in group)
    if sgm is None:
        return Cost(BATCH * macs, FLOAT_BYTES * BATCH * held)
    by_sample = any(network.windows(k) > MANY_WINDOWS for k in group)
    samples, last = 1 if by_sample else BATCH, group[-1]
    given = BATCH * network.positions_after(last) * network.layer(last).out
    numbers = samples * (held + sgm.numbers) + (given if by_sample else 0)
    return Cost(BATCH * (macs + sgm.macs), FLOAT_BYTES * numbers)


def cost_of_blocks(network: Network, blocks: Blocks, sgms: Mapping[int, SgmCost]) -> Cost:
    """A whole step's: multiply-adds add up, of what is held the most counts."""
    costs = [
        cost_of(network, group, sgms[group[-1]] if group[-1] in blocks.sgm_layers else None)
        for group in blocks.groups
    ]
    return Cost(sum(cost.macs for cost in costs), max(cost.held_bytes for cost in costs))


def paying_blocks(
    network: Network, layers: range, sgms: Mapping[int, SgmCost], late: int = 1
) -> Blocks:
    """The groups of these layers, the last of the network, that hold the least and pay.

    Args:
        network: whose layers they are.
        layers: two or more.
        sgms: behind every layer but the last.
        late: so many of the last layers were meta-trained, each on its own, and stay so; earlier
            ones may join the first of them.
    """
    costs = {
        (first, last): cost_of(
            network, range(first, last + 1), None if last == layers[-1] else sgms[last]
        )
        for first in layers
        for last in range(first, layers[-1] + 1)
        if last <= max(first, layers[-1] + 1 - late)
        and (first, last) != (layers[0], layers[-1])  # without any SGM
    }
    _, fewest = _cheapest(layers, costs, inf)
    bounds = sorted({cost.held_bytes for cost in costs.values()})
    every = (_cheapest(layers, costs, bound) for bound in bounds)
    return next(found for found, macs in every if macs <= MOST_MACS * fewest)


def usual_blocks(
    network: Network, most_layers: int, sgms: Mapping[int, SgmCost], late: int
) -> dict[int, Blocks]:
    """By how many of the last layers are tuned, up to so many, the groups that pay.

    Arguments are those of :func:`paying_blocks`.
    """
    return {
        tuned: paying_blocks(network, network.last(tuned), sgms, min(late, tuned))
        for tuned in range(2, most_layers + 1)
    }


def _cheapest(
    layers: range, costs: Mapping[tuple[int, int], Cost], bound: float
) -> tuple[Blocks, float]:
    """Groups of the fewest multiply-adds in which none holds more than `bound` bytes."""
    best: dict[int, tuple[float, tuple[int, ...]]] = {layers[-1] + 1: (0, ())}
    for first in layers[::-1]:
        options = [
            (costs[first, last].macs + best[last + 1][0], (first, *best[last + 1][1]))
            for last in range(first, layers[-1] + 1)
            if (first, last) in costs and costs[first, last].held_bytes <= bound
        ]
        best[first] = min(options, default=(inf, ()))
    macs, starts = best[layers[0]]
    ends = [*starts, layers[-1] + 1]
    return Blocks(tuple(range(first, end) for first, end in pairwise(ends))), macs
