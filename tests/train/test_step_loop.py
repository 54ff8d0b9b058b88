"""The device's loop around an exported step against plain runs of it."""

import numpy as np
import pytest
from nets import random_net
from step_oracles import (
    HEADS,
    OPTIMIZERS,
    RATES,
    Exported,
    batches,
    quiet,
    random_data,
    random_sgms,
    session,
)

from qsgm.blocks import parse_blocks, single_layers
from qsgm.grasp.network import GRASPNET
from qsgm.train.graphs.optimizers import Optimizer, Sgd
from qsgm.train.graphs.step import step_model
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net
from qsgm.tune.loop import StepLoop


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


@OPTIMIZERS
@pytest.mark.parametrize("text", ["4,5,6", "1-4,5,6"])
def test_the_devices_loop_gives_what_plain_runs_of_the_graph_give(
    net: FoldedNet, text: str, optimizer: Optimizer
) -> None:
    blocks = parse_blocks(text)
    data = random_data(len(blocks.layers))
    model = step_model(net, blocks, quiet(random_sgms((64, 64))), HEADS, optimizer)
    exported = Exported(model, net, data)
    start = {
        name: value.copy()
        for name, value in exported.feeds.items()
        if name in {f"{kind}{k}" for kind in ("weight", "bias") for k in RATES}
    }
    rates = {number: RATES[number] for number in blocks.layers}
    loop = StepLoop(session(model), data["features"], data["labels"], start, rates)
    for rows in batches(12 if len(rates) == 3 else 3):
        assert loop.step(rows) == float(exported.step(rows)["loss"])
    tuned = loop.weights()
    assert set(tuned) == set(start)
    for name, value in tuned.items():
        np.testing.assert_array_equal(value, exported.feeds[name])
        assert not np.array_equal(value, start[name])


def test_the_loop_takes_other_crops_in_the_place_of_those_it_has(net: FoldedNet) -> None:
    data = random_data(3)
    model = step_model(net, single_layers(GRASPNET.last(3)), quiet(random_sgms()), HEADS, Sgd())
    start = {
        name: value.copy()
        for name, value in Exported(model, net, data).feeds.items()
        if name in {f"{kind}{k}" for kind in ("weight", "bias") for k in (4, 5, 6)}
    }
    rates = {number: RATES[number] for number in (4, 5, 6)}
    features, labels = data["features"], data["labels"]
    whole = StepLoop(session(model), features, labels, start, rates)
    one_by_one = StepLoop(session(model), features[:0], labels[:0], start, rates)
    for rows in batches(6):
        one_by_one.put(features[rows], labels[rows])
        assert one_by_one.step(np.arange(len(rows))) == whole.step(rows)
    for name, value in whole.weights().items():
        np.testing.assert_array_equal(one_by_one.weights()[name], value)


def test_the_loop_takes_back_the_crops_that_it_had_before_others(net: FoldedNet) -> None:
    data = random_data(3)
    others = {name: values[::-1].copy() for name, values in data.items()}
    model = step_model(net, single_layers(GRASPNET.last(3)), quiet(random_sgms()), HEADS, Sgd())
    feeds = Exported(model, net, data).feeds
    start = {name: feeds[name].copy() for k in (4, 5, 6) for name in (f"weight{k}", f"bias{k}")}
    rates = {number: RATES[number] for number in (4, 5, 6)}
    loop, same = (
        StepLoop(session(model), data["features"], data["labels"], start, rates) for _ in range(2)
    )
    (rows, *_) = batches(1)
    loop.put(others["features"], others["labels"])
    loop.put(data["features"], data["labels"])
    assert loop.step(rows) == same.step(rows)
