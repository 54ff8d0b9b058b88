"""Curvature in an exported step against torch."""

import numpy as np
import pytest
import torch
from nets import random_net
from step_oracles import BATCH, HEADS, Exported, random_data, random_sgms

from qsgm.blocks import parse_blocks
from qsgm.grasp.network import GRASPNET
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.step import step_model
from qsgm.train.model.arrays import FLAT_ARRAYS, FoldedNet
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.fold import fold_net


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


@pytest.mark.parametrize("text", ["4,5,6", "5,6", "3-4,5,6"])
def test_gradients_are_bent_in_the_graph_as_they_are_in_torch(net: FoldedNet, text: str) -> None:
    blocks, rows = parse_blocks(text), np.arange(BATCH)
    data, sgms = random_data(len(blocks.layers)), random_sgms()
    torch.manual_seed(0)
    curvatures = {
        k: Curvature(
            *(torch.randn(m.shape) for m in Curvature.identity(GRASPNET.layer(k)).matrices)
        )
        for k in blocks.layers
    }
    momenta = []
    for used in (FLAT_ARRAYS, {k: one.arrays() for k, one in curvatures.items()}):
        exported = Exported(step_model(net, blocks, sgms, HEADS, Sgd(), used), net, data)
        momenta.append(exported.step(rows))
    for k, curvature in curvatures.items():
        plain, bent = (
            [torch.from_numpy(m[f"{kind}_momentum{k}_next"]) for kind in ("weight", "bias")]
            for m in momenta
        )
        weight, bias = curvature.precondition(plain[0].T[None], plain[1][None])
        scale = float(weight.abs().max())
        torch.testing.assert_close(bent[0] / scale, weight[0].T / scale, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(bent[1], bias[0], atol=1e-4, rtol=1e-4)
