"""SGD and Adam in exported training steps against torch's, step by step; see :mod:`steps`."""

import pytest
from nets import random_net
from step_oracles import OPTIMIZERS, compare_runs

from qsgm.blocks import parse_blocks
from qsgm.train.graphs.optimizers import Optimizer
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


@OPTIMIZERS
@pytest.mark.parametrize("text", ["6", "5,6", "4,5,6", "4,5-6", "5-6", "4-6"])
def test_a_hundred_steps_equal_torchs(net: FoldedNet, text: str, optimizer: Optimizer) -> None:
    compare_runs(net, parse_blocks(text), optimizer, steps=100)


@OPTIMIZERS
@pytest.mark.parametrize("text", ["1,2,3,4,5,6", "1-6", "2-4,5,6", "3,4,5-6"])
def test_a_few_steps_of_many_layers_equal_torchs(
    net: FoldedNet, text: str, optimizer: Optimizer
) -> None:
    compare_runs(net, parse_blocks(text), optimizer, steps=6)
