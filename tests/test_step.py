"""Exported training steps and probes against plain torch convolutions and autograd."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from nets import random_net
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm import QsgmError
from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers, tuned_layers
from qsgm.folded import FoldedSgm
from qsgm.quantize import QuantizedSgm, SgmRanges, integer_forward, quantize_sgm
from qsgm.train.curvature import FLAT, Curvature
from qsgm.train.fold import FoldedNet, fold_net, fold_sgm, run_folded_conv, run_folded_sgm
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.inspection import (
    all_nodes,
    integer_operators,
    refuse_float_products,
)
from qsgm.train.graphs.layers import is_positive
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.probe import probe_model
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.graspnet import Loss, normalize
from qsgm.train.sgm import Sgm
from qsgm.tuning import StepLoop
from qsgm.weights import to_step_layout

CROPS, BATCH = 37, 8
RATES = {1: 0.001, 2: 0.001, 3: 0.001, 4: 0.002, 5: 0.005, 6: 0.02}
# Input of the first tuned layer, by how many are tuned; of all six it is the pixels.
POSITIONS = {1: 1, 2: 1, 3: 169, 4: 841, 5: 3844, 6: 16384}
CHANNELS = {1: 16, 2: 16, 3: 16, 4: 8, 5: 8, 6: 3}
LOSSES = [Loss(), Loss("paper", label_smoothing=0.0, angle_weight=3.0)]
TORCH_OPTIMIZERS: dict[type, Callable[..., torch.optim.Optimizer]] = {
    Sgd: lambda groups: torch.optim.SGD(groups, momentum=0.9),
    Adam: torch.optim.Adam,
}

Arrays = dict[str, np.ndarray]


@pytest.fixture(scope="module")
def net() -> FoldedNet:
    return fold_net(random_net(0))


def random_sgms(hidden: Sequence[int] | None = None) -> dict[int, FoldedSgm]:
    torch.manual_seed(4)
    return {layer: fold_sgm(Sgm(layer, hidden).eval()) for layer in range(1, 6)}


def quiet(sgms: dict[int, FoldedSgm]) -> dict[int, FoldedSgm]:
    """Untrained as they are, kept from running away."""
    for sgm in sgms.values():
        sgm.convs[-1].weight[:] *= 0.03
        sgm.convs[-1].bias[:] *= 0.03
    return sgms


def random_data(tuned: int, crops: int = CROPS) -> Arrays:
    """Features of every crop as the frozen layers leave them, and labels."""
    rng = np.random.default_rng(tuned)
    angle = rng.uniform(-np.pi, np.pi, crops)
    quality = (rng.random(crops) < 0.6).astype(float)
    shape = (crops, POSITIONS[tuned], CHANNELS[tuned])
    features = np.maximum(rng.normal(size=shape), 0).astype(np.float32)
    if tuned == 6:
        features = rng.integers(0, 256, shape, np.uint8)
    labels = np.stack([quality, np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)
    return {"features": features, "labels": labels}


def session(model: onnx.ModelProto, **options: object) -> ort.InferenceSession:
    chosen = ort.SessionOptions()
    chosen.intra_op_num_threads = 1
    for name, value in options.items():
        setattr(chosen, name, value)
    return ort.InferenceSession(model.SerializeToString(), chosen, ["CPUExecutionProvider"])


class Exported:
    """Runs a step graph and carries its state."""

    def __init__(self, model: onnx.ModelProto, net: FoldedNet, data: Arrays) -> None:
        self.session = session(model)
        self.results = [result.name for result in self.session.get_outputs()]
        self.feeds: Arrays = {}
        for wanted in self.session.get_inputs():
            name, number = wanted.name, wanted.name[-1]
            if name in data:
                self.feeds[name] = data[name]
            elif name == f"weight{number}":
                self.feeds[name] = to_step_layout(net.layers[int(number) - 1].weight)
            elif name == f"bias{number}":
                self.feeds[name] = net.layers[int(number) - 1].bias
            elif name == f"rate{number}":
                self.feeds[name] = np.array(RATES[int(number)], np.float32)
            elif name != "rows":
                self.feeds[name] = np.zeros(wanted.shape, np.float32)

    def step(self, rows: np.ndarray) -> Arrays:
        values = self.session.run(None, {**self.feeds, "rows": rows})
        results = dict(zip(self.results, values, strict=True))
        for name, value in results.items():
            if name.endswith("_next"):
                self.feeds[name.removesuffix("_next")] = value
        return results


class Reference:
    """The last layers as torch convolutions, trained by autograd."""

    def __init__(self, net: FoldedNet, layers: range, loss: Loss, optimizer: Optimizer) -> None:
        self.loss = loss
        self.convs = {}
        for number in layers:
            folded = net.layers[number - 1]
            out_channels, in_channels, kernel, _ = folded.weight.shape
            conv = nn.Conv2d(in_channels, out_channels, kernel, folded.stride)
            conv.weight.data = torch.tensor(folded.weight)
            conv.bias.data = torch.tensor(folded.bias)
            self.convs[number] = conv
        groups = [{"params": list(c.parameters()), "lr": RATES[n]} for n, c in self.convs.items()]
        self.optimizer = TORCH_OPTIMIZERS[type(optimizer)](groups)

    def layer(self, number: int, x: Tensor) -> Tensor:
        x = self.convs[number](x)
        x = F.relu(x) if number < 6 else x
        return F.avg_pool2d(x, 5) if number == 4 else x

    def step(self, x: Tensor, labels: Tensor, blocks: Blocks, sgms: Mapping[int, AnySgm]) -> float:
        """Every block sees a detached input, and the SGM's gradient as if from behind."""
        stand_in = torch.zeros(())
        for group in blocks.groups:
            x = x.detach()
            for number in group:
                x = self.layer(number, x)
            if group[-1] < 6:
                gradient = sgm_gradient(sgms[group[-1]], x.detach(), labels)
                stand_in = stand_in + (x * gradient).sum() / len(x)
        return self.finish(self.loss(x.flatten(1), labels), stand_in)

    def finish(self, loss: Tensor, stand_in: Tensor) -> float:
        """Update; return the loss before it."""
        self.optimizer.zero_grad()
        (loss + stand_in).backward()
        self.optimizer.step()
        return loss.item()


def sgm_gradient(sgm: AnySgm, activation: Tensor, labels: Tensor) -> Tensor:
    if isinstance(sgm, FoldedSgm):
        return run_folded_sgm(sgm, activation, labels)
    gradient = integer_forward(sgm, seen_by_sgm(activation, labels).numpy())[0]
    return as_map(gradient)


def seen_by_sgm(activation: Tensor, labels: Tensor) -> Tensor:
    """(B, P, Ci), position by position."""
    filled = labels[:, :, None, None].expand(-1, -1, *activation.shape[2:])
    return torch.cat([activation, filled], dim=1).flatten(2).transpose(1, 2)


def rows_of(maps: Tensor) -> Tensor:
    """(B, C, H, W) to position-major (B, P, C)."""
    return maps.flatten(2).transpose(1, 2)


def as_map(features: np.ndarray) -> Tensor:
    """Position-major (N, P, C) to (N, C, H, W); pixels to [-1, 1]."""
    count, positions, channels = features.shape
    side = round(positions**0.5)
    maps = torch.tensor(features).reshape(count, side, side, channels)
    return normalize(maps) if features.dtype == np.uint8 else maps.permute(0, 3, 1, 2)


def picked(data: Arrays, rows: np.ndarray) -> tuple[Tensor, Tensor]:
    """Features as a map and labels of a batch."""
    return as_map(data["features"][rows]), torch.tensor(data["labels"][rows])


def assert_same_weights(exported: Exported, reference: Reference, tolerance: float) -> None:
    for number, conv in reference.convs.items():
        weight = conv.weight.detach().permute(0, 2, 3, 1).flatten(1)
        for name, expected in (("weight", weight), ("bias", conv.bias.detach())):
            got = torch.tensor(exported.feeds[f"{name}{number}"])
            # Sums over thousands of positions cancel: an error counts against the largest entry.
            scale = max(1.0, float(expected.abs().max()))
            torch.testing.assert_close(got, expected, rtol=tolerance, atol=tolerance * scale)


def batches(steps: int) -> list[np.ndarray]:
    """Epochs over shuffled crops; the last batch of each is shorter."""
    rng, rows = np.random.default_rng(0), []
    while len(rows) < steps:
        order = rng.permutation(CROPS)
        rows += [order[start : start + BATCH] for start in range(0, CROPS, BATCH)]
    return rows[:steps]


SINGLE_STEPS = ["6", "5,6", "4,5,6", "4,5-6", "4-5,6", "4-6", "3,4-5,6", "3-6", "2,3,4,5,6"]
SINGLE_STEPS += ["1,2,3,4,5,6", "1-4,5,6", "1-2,3,4-6", "1-6"]


def at_rate_one(exported: Exported, reference: Reference) -> None:
    """Compare whole gradients, not a thousandth of them."""
    for number in reference.convs:
        exported.feeds[f"rate{number}"] = np.array(1, np.float32)
    for group in reference.optimizer.param_groups:
        group["lr"] = 1.0


@pytest.mark.parametrize("loss", LOSSES, ids=["double", "paper"])
@pytest.mark.parametrize("text", SINGLE_STEPS)
def test_an_update_equals_autograd_with_the_sgms_gradient_injected_behind_every_block(
    net: FoldedNet, text: str, loss: Loss
) -> None:
    blocks = parse_blocks(text)
    data, rows = random_data(len(blocks.layers)), np.arange(BATCH)
    for hidden in (None, (12, 10)):
        sgms = random_sgms(hidden)
        exported = Exported(step_model(net, blocks, sgms, loss, Sgd()), net, data)
        reference = Reference(net, blocks.layers, loss, Sgd())
        at_rate_one(exported, reference)
        expected_loss = reference.step(*picked(data, rows), blocks, sgms)
        results = exported.step(rows)
        assert_same_weights(exported, reference, 1e-5)
        assert results["loss"] == pytest.approx(expected_loss, abs=1e-6)


OPTIMIZERS = pytest.mark.parametrize("optimizer", [Sgd(), Adam()], ids=["sgd", "adam"])


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


def compare_runs(net: FoldedNet, blocks: Blocks, optimizer: Optimizer, steps: int) -> None:
    data, sgms = random_data(len(blocks.layers)), quiet(random_sgms())
    exported = Exported(step_model(net, blocks, sgms, Loss(), optimizer), net, data)
    reference = Reference(net, blocks.layers, Loss(), optimizer)
    start = {number: conv.weight.detach().clone() for number, conv in reference.convs.items()}
    for rows in batches(steps):
        expected_loss = reference.step(*picked(data, rows), blocks, sgms)
        assert exported.step(rows)["loss"] == pytest.approx(expected_loss, rel=1e-3)
    assert_same_weights(exported, reference, 1e-4)
    moved = [float((c.weight.detach() - start[k]).abs().max()) for k, c in reference.convs.items()]
    assert max(moved) > 5e-3
    assert min(moved) > 1e-6
    assert exported.feeds.get("step", steps) == steps


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
    exported = Exported(step_model(net, one_block(1), {}, Loss(), Sgd()), net, data)
    results = exported.step(np.arange(CROPS))
    assert all(np.isfinite(value).all() for value in results.values())
    assert results["loss"] > 1000


def seen_by_sgms(
    net: FoldedNet, tuned: int, data: Arrays, sgms: dict[int, FoldedSgm]
) -> dict[int, SgmRanges]:
    reference = Reference(net, tuned_layers(tuned), Loss(), Sgd())
    x, labels = picked(data, np.arange(len(data["labels"])))
    ranges = {}
    for number in tuned_layers(tuned)[:-1]:
        x = reference.layer(number, x).detach()
        seen = seen_by_sgm(x, labels)
        hidden = [as_map(seen.numpy())]
        for conv in sgms[number].convs[:-1]:
            hidden.append(F.relu(run_folded_conv(conv, hidden[-1])))
        highs = tuple(tensor.amax(dim=(0, 2, 3)).numpy() for tensor in hidden[1:])
        low, high = seen.amin(dim=(0, 1)).numpy(), seen.amax(dim=(0, 1)).numpy()
        ranges[number] = SgmRanges(low, high, highs)
    return ranges


def quantized(
    net: FoldedNet, tuned: int, data: Arrays, sgms: dict[int, FoldedSgm]
) -> dict[int, QuantizedSgm]:
    ranges = seen_by_sgms(net, tuned, data, sgms)
    return {number: quantize_sgm(sgms[number], ranges[number]) for number in ranges}


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
    model = step_model(net, blocks, int8_sgms, Loss(), Sgd())
    products = 2 * len(sgms[4].convs) * len(blocks.sgm_layers)
    assert integer_operators(model) == ["QGemm"] * products
    refuse_float_products(text, model)
    exported = Exported(model, net, data)
    reference = Reference(net, blocks.layers, Loss(), Sgd())
    reference.step(*picked(data, rows), blocks, int8_sgms)
    exported.step(rows)
    assert_same_weights(exported, reference, 1e-5)


@pytest.mark.parametrize(
    ("tuned", "hidden"),
    [(2, None), (2, (64, 64)), (3, None), (3, (64, 64)), (4, (12, 10)), (6, None)],
)
def test_the_probe_gives_true_float_and_int8_gradients(
    net: FoldedNet, tuned: int, hidden: Sequence[int] | None
) -> None:
    data, sgms, rows = random_data(tuned, 12), random_sgms(hidden), np.arange(BATCH)
    int8_sgms = quantized(net, tuned, data, sgms)
    model = probe_model(net, tuned, sgms, int8_sgms, Loss())
    assert integer_operators(model) == ["QGemm"] * 2 * len(sgms[4].convs) * (tuned - 1)
    got = Exported(model, net, data).step(rows)

    reference = Reference(net, tuned_layers(tuned), Loss(), Sgd())
    x, labels = picked(data, rows)
    activations = {}
    for number in reference.convs:
        x = activations[number] = reference.layer(number, x)
    behind = {number: activations[number] for number in tuned_layers(tuned)[:-1]}
    total = Loss().per_sample(x.flatten(1), labels).sum()
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
    got = Exported(probe_model(net, tuned, sgms, int8_sgms, Loss()), net, data).step(rows)
    reference = Reference(net, tuned_layers(tuned), Loss(), Sgd())
    x, _ = picked(data, rows)
    for number in tuned_layers(tuned)[:-1]:
        after, conv = reference.layer(number, x), reference.convs[number]
        for name in ("true", "float", "int8"):
            given = as_map(got[f"{name}{number}"])
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
    got = Exported(probe_model(net, 4, sgms, int8_sgms, Loss()), net, data).step(np.arange(9))
    for number in (3, 4, 5):
        assert got[f"clipped{number}"] == pytest.approx(3 / 19)


@pytest.mark.parametrize("text", ["4,5,6", "4-5,6", "3-4,5-6", "2,3-4,5,6"])
def test_blocks_run_one_after_the_other_so_that_their_memory_is_freed(
    net: FoldedNet, tmp_path: Path, text: str
) -> None:
    blocks = parse_blocks(text)
    data, sgms = random_data(len(blocks.layers), BATCH), random_sgms()
    int8_sgms = quantized(net, len(blocks.layers), data, sgms)
    exported = Exported(step_model(net, blocks, int8_sgms, Loss(), Sgd()), net, data)
    profiled = session(
        step_model(net, blocks, int8_sgms, Loss(), Sgd()),
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
    model = step_model(net, parse_blocks(text), random_sgms(), Loss(), Sgd())
    kinds = [node.op_type for node in all_nodes(model.graph)]
    assert kinds.count("ConvTranspose") == carried_back_through


def test_inputs_and_outputs_have_their_names(net: FoldedNet) -> None:
    model = step_model(net, single_layers(2), random_sgms(), Loss(), Sgd())
    state = [f"{kind}{layer}" for layer in (5, 6) for kind in ("weight", "bias")]
    state += [name[:-1] + "_momentum" + name[-1] for name in state]
    others = {"features", "labels", "rows", "rate5", "rate6"}
    assert {value.name for value in model.graph.input} == {*state, *others}
    results = {value.name for value in model.graph.output}
    assert results == {"loss", *(f"{name}_next" for name in state)}
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 17)]


def test_there_is_nothing_to_probe_behind_the_last_layer(net: FoldedNet) -> None:
    with pytest.raises(QsgmError, match="SGMs of 1 tuned layers: the last layer has none"):
        probe_model(net, 1, {}, {}, Loss())


@OPTIMIZERS
@pytest.mark.parametrize("text", ["4,5,6", "1-4,5,6"])
def test_the_devices_loop_gives_what_plain_runs_of_the_graph_give(
    net: FoldedNet, text: str, optimizer: Optimizer
) -> None:
    blocks = parse_blocks(text)
    data = random_data(len(blocks.layers))
    model = step_model(net, blocks, quiet(random_sgms((64, 64))), Loss(), optimizer)
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
    model = step_model(net, single_layers(3), quiet(random_sgms()), Loss(), Sgd())
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


def test_a_missing_sgm_is_refused(net: FoldedNet) -> None:
    sgms = random_sgms()
    del sgms[4]
    with pytest.raises(QsgmError, match=r"no SGM for layers \[4\]: tuning 4,5,6 needs"):
        step_model(net, single_layers(3), sgms, Loss(), Sgd())
    step_model(net, parse_blocks("4-5,6"), sgms, Loss(), Sgd())


@pytest.mark.parametrize("text", ["4,5,6", "5,6", "3-4,5,6"])
def test_gradients_are_bent_in_the_graph_as_they_are_in_torch(net: FoldedNet, text: str) -> None:
    blocks, rows = parse_blocks(text), np.arange(BATCH)
    data, sgms = random_data(len(blocks.layers)), random_sgms()
    torch.manual_seed(0)
    curvatures = {
        k: Curvature(*(torch.randn(m.shape) for m in Curvature.identity(k).matrices))
        for k in blocks.layers
    }
    momenta = []
    for used in (FLAT, curvatures):
        exported = Exported(step_model(net, blocks, sgms, Loss(), Sgd(), used), net, data)
        momenta.append(exported.step(rows))
    for k, curvature in curvatures.items():
        plain, bent = (
            [torch.from_numpy(m[f"{kind}_momentum{k}_next"]) for kind in ("weight", "bias")]
            for m in momenta
        )
        weight, bias = curvature.bend(plain[0].T[None], plain[1][None])
        scale = float(weight.abs().max())
        torch.testing.assert_close(bent[0] / scale, weight[0].T / scale, atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(bent[1], bias[0], atol=1e-4, rtol=1e-4)
