"""The exported probe against autograd, float SGMs and integer arithmetic."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch
from losses import GraspLoss
from nets import random_net
from step_oracles import (
    BATCH,
    HEADS,
    Exported,
    Reference,
    as_map,
    picked,
    quantized,
    random_data,
    random_sgms,
    rows_of,
    sgm_gradient,
)

from qsgm import QsgmError
from qsgm.grasp.network import GRASPNET
from qsgm.train.graphs.inspection import (
    integer_operators,
)
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.probe import probe_model
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


@pytest.mark.parametrize(
    ("tuned", "hidden"),
    [(2, None), (2, (64, 64)), (3, None), (3, (64, 64)), (4, (12, 10)), (6, None)],
)
def test_the_probe_gives_true_float_and_int8_gradients(
    net: FoldedNet, tuned: int, hidden: Sequence[int] | None
) -> None:
    data, sgms, rows = random_data(tuned, 12), random_sgms(hidden), np.arange(BATCH)
    int8_sgms = quantized(net, tuned, data, sgms)
    model = probe_model(net, tuned, sgms, int8_sgms, HEADS)
    assert integer_operators(model) == ["QGemm"] * 2 * len(sgms[4].convs) * (tuned - 1)
    got = Exported(model, net, data).step(rows)

    reference = Reference(net, GRASPNET.last(tuned), GraspLoss(), Sgd())
    x, labels = picked(data, rows, GRASPNET.before(GRASPNET.last(tuned)[0]))
    activations = {}
    for number in reference.convs:
        x = activations[number] = reference.layer(number, x)
    behind = {number: activations[number] for number in GRASPNET.last(tuned)[:-1]}
    total = GraspLoss().per_sample(x.flatten(1), labels).sum()
    truths = torch.autograd.grad(total, list(behind.values()))
    for (number, activation), truth in zip(behind.items(), truths, strict=True):
        seen = activation.detach()
        for name, expected in (
            ("true", truth),
            ("float", sgm_gradient(sgms[number], seen, labels)),
        ):
            np.testing.assert_allclose(got[f"{name}{number}"], rows_of(expected), atol=1e-5)
        integers = rows_of(sgm_gradient(int8_sgms[number], seen, labels)).numpy()
        # Activations differ in their last bits between the two; a few then round the other way.
        atol = 3e-4 * np.abs(integers).max()
        np.testing.assert_allclose(got[f"int8{number}"], integers, atol=atol)
        assert got[f"clipped{number}"] == 0


@pytest.mark.parametrize("tuned", [2, 3, 4, 6])
def test_the_probes_updates_are_autograds_with_each_gradient_behind_the_layer(
    net: FoldedNet, tuned: int
) -> None:
    data, sgms, rows = random_data(tuned, 12), random_sgms(), np.arange(BATCH)
    int8_sgms = quantized(net, tuned, data, sgms)
    got = Exported(probe_model(net, tuned, sgms, int8_sgms, HEADS), net, data).step(rows)
    reference = Reference(net, GRASPNET.last(tuned), GraspLoss(), Sgd())
    x, _ = picked(data, rows, GRASPNET.before(GRASPNET.last(tuned)[0]))
    for number in GRASPNET.last(tuned)[:-1]:
        after, conv = reference.layer(number, x), reference.convs[number]
        for name in ("true", "float", "int8"):
            given = as_map(got[f"{name}{number}"], GRASPNET.after(number))
            weight, bias = torch.autograd.grad(
                (after * given).sum(), [conv.weight, conv.bias], retain_graph=True
            )
            expected = torch.cat([weight.permute(0, 2, 3, 1).flatten(1), bias[:, None]], dim=1)
            found = got[f"update_{name}{number}"]
            assert found.shape == expected.shape
            scale = float(expected.abs().max())
            np.testing.assert_allclose(found / scale, expected / scale, atol=1e-5)
            assert scale > 0
        x = after.detach()


def test_the_probe_counts_inputs_beyond_their_ranges(net: FoldedNet) -> None:
    data, sgms = random_data(4, 12), random_sgms()
    int8_sgms = quantized(net, 4, data, sgms)
    data["labels"] = np.full((12, 3), 9, np.float32)
    got = Exported(probe_model(net, 4, sgms, int8_sgms, HEADS), net, data).step(np.arange(9))
    for number in (3, 4, 5):
        assert got[f"clipped{number}"] == pytest.approx(3 / 19)


def test_there_is_nothing_to_probe_behind_the_last_layer(net: FoldedNet) -> None:
    with pytest.raises(QsgmError, match="SGMs of 1 tuned layers: the last layer has none"):
        probe_model(net, 1, {}, {}, HEADS)
