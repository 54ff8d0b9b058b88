"""Groups of layers are those of all groups that hold the least at a price that is paid."""

from collections.abc import Iterator
from itertools import pairwise, product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from networks import networks

from qsgm.blocks import Blocks, one_block, parse_blocks
from qsgm.grasp.network import GRASPNET
from qsgm.network import Network, conv
from qsgm.train.grouping import (
    MOST_MACS,
    Cost,
    SgmCost,
    cost_of_blocks,
    paying_blocks,
    sgm_cost,
)

MAPS = Network(
    (12, 12, 8),
    (*[conv(8, 8, 3, padding=1)] * 5, conv(8, 16, 3, stride=2), conv(16, 4, 5, relu=False)),
)


def every_grouping(layers: range) -> Iterator[Blocks]:
    """With an SGM or more."""
    for cuts in product([False, True], repeat=len(layers) - 1):
        ends = [layers[0], *(k for k, cut in zip(layers[1:], cuts, strict=True) if cut)]
        if len(ends) > 1:
            ends.append(layers[-1] + 1)
            yield Blocks(tuple(range(first, end) for first, end in pairwise(ends)))


def sgms_of(network: Network, hidden: int) -> dict[int, SgmCost]:
    found = {}
    for k in range(1, network.depth):
        channels, kernel = network.layer(k).out, network.sgm_kernel(k)
        shapes = ((hidden, channels + network.outputs, *kernel), (channels, hidden, *kernel))
        found[k] = sgm_cost(network, k, shapes)
    return found


@settings(max_examples=60)
@given(networks(3, depth=6, rows=False), st.integers(1, 40), st.integers(2, 6), st.integers(1, 3))
def test_the_groups_are_the_best_of_all_that_there_are(
    network: Network, hidden: int, tuned: int, late: int
) -> None:
    layers, sgms = network.last(tuned), sgms_of(network, hidden)
    found = paying_blocks(network, layers, sgms, late)
    alone = {range(k, k + 1) for k in layers[1:][-(late - 1) :] if late > 1}
    every = {
        blocks: cost_of_blocks(network, blocks, sgms)
        for blocks in every_grouping(layers)
        if alone <= {*blocks.groups}
    }
    affordable = MOST_MACS * min(cost.macs for cost in every.values())
    paid = [cost for cost in every.values() if cost.macs <= affordable]
    least = min(cost.held_bytes for cost in paid)
    assert every[found].macs <= affordable
    assert every[found].held_bytes == least
    assert every[found].macs == min(one.macs for one in paid if one.held_bytes == least)


def test_behind_maps_an_sgm_costs_more_than_its_layer_and_layers_share_one() -> None:
    sgms = sgms_of(MAPS, 8)
    assert sgms[1].macs > MAPS.macs(1)
    found = paying_blocks(MAPS, MAPS.last(7), sgms)
    assert 1 < len(found.groups) < 7
    single = cost_of_blocks(MAPS, parse_blocks("1,2,3,4,5,6,7"), sgms)
    whole = cost_of_blocks(MAPS, one_block(MAPS.last(7)), sgms)
    assert single.macs > MOST_MACS * whole.macs
    assert cost_of_blocks(MAPS, found, sgms).macs < single.macs
    assert cost_of_blocks(MAPS, found, sgms).held_bytes < whole.held_bytes


def test_dense_layers_stand_alone() -> None:
    dense = Network((1, 1, 64), (*[conv(64, 64)] * 7, conv(64, 4, relu=False)), "numbers")
    sgms = sgms_of(dense, 8)
    # The last two hold no more together, and an SGM less is cheaper.
    assert str(paying_blocks(dense, dense.last(8), sgms)) == "1,2,3,4,5,6,7-8"
    assert str(paying_blocks(dense, dense.last(8), sgms, late=2)) == "1,2,3,4,5,6,7,8"


def test_a_layer_is_counted_by_hand() -> None:
    sgms = sgms_of(GRASPNET, 64)
    assert sgms[5] == SgmCost((16 + 3) * 64 + 64 * 16, 16 + 3 + 64)
    whole = cost_of_blocks(GRASPNET, parse_blocks("5-6"), sgms)
    assert whole == Cost(32 * (2 * 256 + 3 * 48), 4 * 32 * (16 + 16 + 16 + 3))
    alone = cost_of_blocks(GRASPNET, parse_blocks("5,6"), sgms)
    macs = 2 * 256 + sgms[5].macs + 2 * 48
    assert alone == Cost(32 * macs, 4 * 32 * max(16 + 16 + 19 + 64, 16 + 3))


@pytest.mark.parametrize("tuned", range(2, 7))
def test_blocks_cover_the_layers_in_order(tuned: int) -> None:
    found = paying_blocks(GRASPNET, GRASPNET.last(tuned), sgms_of(GRASPNET, 64))
    assert found.layers == GRASPNET.last(tuned)
    assert found.sgm_layers
