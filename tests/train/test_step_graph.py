"""Exported training steps against plain torch convolutions and autograd; see :mod:`steps`."""

import json
from pathlib import Path

import numpy as np
import pytest
from losses import GraspLoss
from nets import random_net
from step_oracles import (
    BATCH,
    CROPS,
    EPOCH,
    HEADS,
    Exported,
    compare_steps,
    quantized,
    quiet,
    random_data,
    random_sgms,
    session,
)

from qsgm import QsgmError
from qsgm.blocks import one_block, parse_blocks, single_layers
from qsgm.grasp.network import GRASPNET
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.inspection import (
    all_nodes,
)
from qsgm.train.graphs.layers import is_positive
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.step import step_model
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net

LOSSES = [GraspLoss(), GraspLoss("paper", label_smoothing=0.0, angle_weight=3.0)]
SINGLE_STEPS = ["6", "5,6", "4,5,6", "4,5-6", "4-5,6", "4-6", "3,4-5,6", "3-6", "2,3,4,5,6"]
SINGLE_STEPS += ["1,2,3,4,5,6", "1-4,5,6", "1-2,3,4-6", "1-6"]


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


@pytest.mark.parametrize("loss", LOSSES, ids=["double", "paper"])
@pytest.mark.parametrize("text", SINGLE_STEPS)
def test_an_update_equals_autograd_with_the_sgms_gradient_injected_behind_every_block(
    net: FoldedNet, text: str, loss: GraspLoss
) -> None:
    for hidden in (None, (12, 10)):
        compare_steps(net, parse_blocks(text), quiet(random_sgms(hidden)), loss, Sgd(), EPOCH)


def test_a_gate_is_one_above_zero_and_else_zero_however_small_or_large_a_number_is() -> None:
    graph = Graph("gate")
    op, x = graph.within("gate"), graph.input("x", np.float32, ("numbers",))
    graph.output("gates", is_positive(op, x), np.float32, ("numbers",))
    limits = np.finfo(np.float32)
    sizes = np.float32([limits.tiny, 1e-30, 1, 1e30, limits.max, np.inf])
    numbers = np.concatenate([[0, -0.0], sizes, -sizes], dtype=np.float32)
    gates = session(graph.model()).run(None, {"x": numbers})[0]
    np.testing.assert_array_equal(gates, numbers > 0)


def test_loss_and_update_stay_finite_for_extreme_logits(net: FoldedNet) -> None:
    data = random_data(1)
    data["features"] *= 1e5
    exported = Exported(step_model(net, one_block(GRASPNET.last(1)), {}, HEADS, Sgd()), net, data)
    results = exported.step(np.arange(CROPS))
    assert all(np.isfinite(value).all() for value in results.values())
    assert results["loss"] > 1000


@pytest.mark.parametrize("text", ["4,5,6", "4-5,6", "3-4,5-6", "2,3-4,5,6"])
def test_blocks_run_one_after_the_other_so_that_their_memory_is_freed(
    net: FoldedNet, tmp_path: Path, text: str
) -> None:
    blocks = parse_blocks(text)
    data, sgms = random_data(len(blocks.layers), BATCH), random_sgms()
    int8_sgms = quantized(net, len(blocks.layers), data, sgms)
    exported = Exported(step_model(net, blocks, int8_sgms, HEADS, Sgd()), net, data)
    profiled = session(
        step_model(net, blocks, int8_sgms, HEADS, Sgd()),
        enable_profiling=True,
        profile_file_prefix=str(tmp_path / "run"),
    )
    profiled.run(None, {**exported.feeds, "rows": np.arange(BATCH)})
    events = json.loads(Path(profiled.end_profiling()).read_text())
    # Reshape does nothing: it may come as late as somebody reads what it makes.
    order = [
        event["name"]
        for event in events
        if event.get("cat") == "Node" and event["args"]["op_name"] != "Reshape"
    ]
    numbers = [int(name[5]) for name in order if name.startswith("layer")]
    assert set(numbers) == set(blocks.layers)
    ran = [next(i for i, group in enumerate(blocks.groups) if n in group) for n in numbers]
    assert ran == sorted(ran)


@pytest.mark.parametrize(
    ("text", "carried_back_through"),
    [("1,2,3,4,5,6", 0), ("1-4,5,6", 3), ("3,4-5,6", 0), ("3-4,5-6", 1), ("1-6", 3)],
)
def test_gradients_are_carried_back_inside_blocks_only(
    net: FoldedNet, text: str, carried_back_through: int
) -> None:
    """5x5 layers through which a gradient is carried back: those of a block but its first."""
    model = step_model(net, parse_blocks(text), random_sgms(), HEADS, Sgd())
    kinds = [node.op_type for node in all_nodes(model.graph)]
    assert kinds.count("ConvTranspose") == carried_back_through


def test_inputs_and_outputs_have_their_names(net: FoldedNet) -> None:
    model = step_model(net, single_layers(GRASPNET.last(2)), random_sgms(), HEADS, Sgd())
    state = [f"{kind}{layer}" for layer in (5, 6) for kind in ("weight", "bias")]
    state += [name[:-1] + "_momentum" + name[-1] for name in state]
    others = {"features", "labels", "rows", "rate5", "rate6"}
    assert {value.name for value in model.graph.input} == {*state, *others}
    results = {value.name for value in model.graph.output}
    assert results == {"loss", *(f"{name}_next" for name in state)}
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 19)]


def test_a_missing_sgm_is_refused(net: FoldedNet) -> None:
    sgms = random_sgms()
    del sgms[4]
    with pytest.raises(QsgmError, match=r"no SGM for layers \[4\]: tuning 4,5,6 needs"):
        step_model(net, single_layers(GRASPNET.last(3)), sgms, HEADS, Sgd())
    step_model(net, parse_blocks("4-5,6"), sgms, HEADS, Sgd())
