"""Exported training steps with int8 SGMs against integer arithmetic and autograd."""

from collections.abc import Sequence

import numpy as np
import pytest
from losses import GraspLoss
from nets import random_net
from step_oracles import (
    BATCH,
    HEADS,
    Exported,
    Reference,
    assert_same_weights,
    quantized,
    random_data,
    random_sgms,
)

from qsgm.blocks import parse_blocks
from qsgm.train.graphs.inspection import (
    integer_operators,
    refuse_float_products,
)
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.step import step_model
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


@pytest.mark.parametrize(
    ("text", "hidden"),
    [
        *((text, hidden) for text in ("5,6", "4,5,6", "4,5-6") for hidden in (None, (64, 64))),
        ("3,4-5,6", None),
        ("1,2,3,4,5,6", None),
        ("1-3,4,5,6", (12, 10)),
    ],
)
def test_an_int8_step_equals_autograd_with_the_integer_sgms_gradient(
    net: FoldedNet, text: str, hidden: Sequence[int] | None
) -> None:
    blocks = parse_blocks(text)
    data, sgms, rows = random_data(len(blocks.layers), 12), random_sgms(hidden), np.arange(BATCH)
    int8_sgms = quantized(net, len(blocks.layers), data, sgms)
    model = step_model(net, blocks, int8_sgms, HEADS, Sgd())
    products = 2 * len(sgms[4].convs) * len(blocks.sgm_layers)
    assert integer_operators(model) == ["QGemm"] * products
    refuse_float_products(text, model)
    exported = Exported(model, net, data)
    reference = Reference(net, blocks.layers, GraspLoss(), Sgd())
    reference.step(data, rows, blocks, int8_sgms)
    exported.step(rows)
    assert_same_weights(exported, reference, 1e-5)
