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
from qsgm.train.fold import (
    FoldedNet,
    FoldedSgm,
    fold_net,
    fold_sgm,
    run_folded_conv,
    run_folded_sgm,
)
from qsgm.train.graphs.inspection import integer_operators
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.probe import probe_model
from qsgm.train.graphs.step import AnySgm, backprop_step_model, step_model
from qsgm.train.graspnet import Loss
from qsgm.train.quantize import QuantizedSgm, SgmRanges, integer_forward, quantize_sgm
from qsgm.train.sgm import Sgm
from qsgm.tuning import StepLoop
from qsgm.weights import to_step_layout

CROPS, BATCH = 37, 8
RATES = {4: 0.002, 5: 0.005, 6: 0.02}
DEPTHS = pytest.mark.parametrize("hidden", [None, (64, 64)], ids=["paper", "deep"])
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
    return {layer: fold_sgm(Sgm(layer, hidden).eval()) for layer in (4, 5)}


def random_data(tuned: int) -> Arrays:
    """Features of every crop as the frozen layers leave them, and labels."""
    rng = np.random.default_rng(tuned)
    positions = 169 if tuned == 3 else 1
    angle = rng.uniform(-np.pi, np.pi, CROPS)
    quality = (rng.random(CROPS) < 0.6).astype(float)
    data = {
        "features": np.maximum(rng.normal(size=(CROPS, positions, 16)), 0),
        "labels": np.stack([quality, np.sin(angle), np.cos(angle)], axis=1),
    }
    return {name: value.astype(np.float32) for name, value in data.items()}


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

    def __init__(self, net: FoldedNet, tuned: int, loss: Loss, optimizer: Optimizer) -> None:
        self.loss = loss
        self.convs = {}
        for number in range(7 - tuned, 7):
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

    def backprop_step(self, x: Tensor, labels: Tensor) -> float:
        for number in self.convs:
            x = self.layer(number, x)
        return self.finish(self.loss(x.flatten(1), labels))

    def local_step(self, x: Tensor, labels: Tensor, sgms: Mapping[int, AnySgm]) -> float:
        """Every layer sees a detached input, and the SGM's gradient as if from behind."""
        stand_in = torch.zeros(())
        for number in self.convs:
            x = self.layer(number, x.detach())
            if number < 6:
                gradient = sgm_gradient(sgms[number], x.detach(), labels)
                stand_in = stand_in + (x * gradient).sum() / len(x)
        return self.finish(self.loss(x.flatten(1), labels), stand_in)

    def finish(self, loss: Tensor, stand_in: Tensor | float = 0.0) -> float:
        """Update; return the loss before it."""
        self.optimizer.zero_grad()
        (loss + stand_in).backward()
        self.optimizer.step()
        return loss.item()


def sgm_gradient(sgm: AnySgm, activation: Tensor, labels: Tensor) -> Tensor:
    if isinstance(sgm, FoldedSgm):
        return run_folded_sgm(sgm, activation, labels)
    seen = torch.cat([activation.flatten(1), labels], dim=1)
    return torch.tensor(integer_forward(sgm, seen.numpy())[0])[:, :, None, None]


def as_map(features: np.ndarray) -> Tensor:
    """Position-major (N, P, C) to (N, C, H, W)."""
    count, positions, channels = features.shape
    side = round(positions**0.5)
    return torch.tensor(features).reshape(count, side, side, channels).permute(0, 3, 1, 2)


def picked(data: Arrays, rows: np.ndarray) -> tuple[Tensor, Tensor]:
    """Features as a map and labels of a batch."""
    return as_map(data["features"][rows]), torch.tensor(data["labels"][rows])


def assert_same_weights(exported: Exported, reference: Reference, tolerance: float) -> None:
    for number, conv in reference.convs.items():
        weight = conv.weight.detach().permute(0, 2, 3, 1).flatten(1)
        for name, expected in (("weight", weight), ("bias", conv.bias.detach())):
            got = torch.tensor(exported.feeds[f"{name}{number}"])
            torch.testing.assert_close(got, expected, rtol=tolerance, atol=tolerance)


def batches(steps: int) -> list[np.ndarray]:
    """Epochs over shuffled crops; the last batch of each is shorter."""
    rng, rows = np.random.default_rng(0), []
    while len(rows) < steps:
        order = rng.permutation(CROPS)
        rows += [order[start : start + BATCH] for start in range(0, CROPS, BATCH)]
    return rows[:steps]


@DEPTHS
@pytest.mark.parametrize("loss", LOSSES, ids=["double", "paper"])
@pytest.mark.parametrize("tuned", [1, 2, 3])
def test_a_local_update_equals_autograd_with_the_sgms_gradient_injected(
    net: FoldedNet, tuned: int, loss: Loss, hidden: Sequence[int] | None
) -> None:
    data, sgms, rows = random_data(tuned), random_sgms(hidden), np.arange(BATCH)
    exported = Exported(step_model(net, tuned, sgms, loss, Sgd()), net, data)
    reference = Reference(net, tuned, loss, Sgd())
    for number in reference.convs:  # compare whole gradients, not a thousandth of them
        exported.feeds[f"rate{number}"] = np.array(1, np.float32)
    for group in reference.optimizer.param_groups:
        group["lr"] = 1.0
    expected_loss = reference.local_step(*picked(data, rows), sgms)
    results = exported.step(rows)
    assert_same_weights(exported, reference, 1e-5)
    assert results["loss"] == pytest.approx(expected_loss, abs=1e-6)


@pytest.mark.parametrize("optimizer", [Sgd(), Adam()], ids=["sgd", "adam"])
@pytest.mark.parametrize("tuned", [1, 2, 3])
def test_a_hundred_local_steps_equal_torchs(
    net: FoldedNet, tuned: int, optimizer: Optimizer
) -> None:
    data, sgms = random_data(tuned), random_sgms()
    for sgm in sgms.values():  # untrained as they are, keep them from running away
        sgm.convs[-1].weight[:] *= 0.1
        sgm.convs[-1].bias[:] *= 0.1
    exported = Exported(step_model(net, tuned, sgms, Loss(), optimizer), net, data)
    reference = Reference(net, tuned, Loss(), optimizer)
    start = reference.convs[7 - tuned].weight.detach().clone()
    for rows in batches(100):
        expected_loss = reference.local_step(*picked(data, rows), sgms)
        assert exported.step(rows)["loss"] == pytest.approx(expected_loss, rel=1e-3)
    assert_same_weights(exported, reference, 1e-4)
    assert (reference.convs[7 - tuned].weight - start).abs().max() > 1e-2
    assert exported.feeds.get("step", 100) == 100


@pytest.mark.parametrize("optimizer", [Sgd(), Adam()], ids=["sgd", "adam"])
@pytest.mark.parametrize("tuned", [1, 2, 3])
def test_a_hundred_backprop_steps_equal_torchs(
    net: FoldedNet, tuned: int, optimizer: Optimizer
) -> None:
    data = random_data(tuned)
    exported = Exported(backprop_step_model(net, tuned, Loss(), optimizer), net, data)
    reference = Reference(net, tuned, Loss(), optimizer)
    start = reference.convs[7 - tuned].weight.detach().clone()
    for count, rows in enumerate(batches(100), start=1):
        expected_loss = reference.backprop_step(*picked(data, rows))
        assert exported.step(rows)["loss"] == pytest.approx(expected_loss, rel=1e-3)
        if count == 1:
            assert_same_weights(exported, reference, 1e-5)
    assert_same_weights(exported, reference, 1e-4)
    assert (reference.convs[7 - tuned].weight - start).abs().max() > 1e-2


@pytest.mark.parametrize("loss", LOSSES, ids=["double", "paper"])
def test_a_backprop_step_equals_autograd_for_both_angle_encodings(
    net: FoldedNet, loss: Loss
) -> None:
    data, rows = random_data(3), np.arange(BATCH)
    exported = Exported(backprop_step_model(net, 3, loss, Sgd()), net, data)
    reference = Reference(net, 3, loss, Sgd())
    expected_loss = reference.backprop_step(*picked(data, rows))
    assert exported.step(rows)["loss"] == pytest.approx(expected_loss, abs=1e-6)
    assert_same_weights(exported, reference, 1e-6)


def test_loss_and_update_stay_finite_for_extreme_logits(net: FoldedNet) -> None:
    data = random_data(1)
    data["features"] *= 1e5
    exported = Exported(backprop_step_model(net, 1, Loss(), Sgd()), net, data)
    results = exported.step(np.arange(CROPS))
    assert all(np.isfinite(value).all() for value in results.values())
    assert results["loss"] > 1000


def seen_by_sgms(
    net: FoldedNet, tuned: int, data: Arrays, sgms: dict[int, FoldedSgm]
) -> dict[int, SgmRanges]:
    reference = Reference(net, tuned, Loss(), Sgd())
    x, labels = picked(data, np.arange(CROPS))
    ranges = {}
    for number in range(7 - tuned, 6):
        x = reference.layer(number, x).detach()
        seen = torch.cat([x.flatten(1), labels], dim=1)
        hidden = [seen[:, :, None, None]]
        for conv in sgms[number].convs[:-1]:
            hidden.append(F.relu(run_folded_conv(conv, hidden[-1])))
        highs = tuple(tensor.amax(dim=(0, 2, 3)).numpy() for tensor in hidden[1:])
        ranges[number] = SgmRanges(seen.amin(dim=0).numpy(), seen.amax(dim=0).numpy(), highs)
    return ranges


def quantized(
    net: FoldedNet, tuned: int, data: Arrays, sgms: dict[int, FoldedSgm]
) -> dict[int, QuantizedSgm]:
    ranges = seen_by_sgms(net, tuned, data, sgms)
    return {number: quantize_sgm(sgms[number], ranges[number]) for number in ranges}


@DEPTHS
@pytest.mark.parametrize("tuned", [2, 3])
def test_an_int8_step_equals_autograd_with_the_integer_sgms_gradient(
    net: FoldedNet, tuned: int, hidden: Sequence[int] | None
) -> None:
    data, sgms, rows = random_data(tuned), random_sgms(hidden), np.arange(BATCH)
    int8_sgms = quantized(net, tuned, data, sgms)
    model = step_model(net, tuned, int8_sgms, Loss(), Sgd())
    assert integer_operators(model) == ["QGemm"] * 2 * len(sgms[4].convs) * (tuned - 1)
    exported = Exported(model, net, data)
    reference = Reference(net, tuned, Loss(), Sgd())
    reference.local_step(*picked(data, rows), int8_sgms)
    exported.step(rows)
    assert_same_weights(exported, reference, 1e-5)


@DEPTHS
@pytest.mark.parametrize("tuned", [2, 3])
def test_the_probe_gives_true_float_and_int8_gradients(
    net: FoldedNet, tuned: int, hidden: Sequence[int] | None
) -> None:
    data, sgms, rows = random_data(tuned), random_sgms(hidden), np.arange(20)
    int8_sgms = quantized(net, tuned, data, sgms)
    model = probe_model(net, tuned, sgms, int8_sgms, Loss())
    assert integer_operators(model) == ["QGemm"] * 2 * len(sgms[4].convs) * (tuned - 1)
    got = Exported(model, net, data).step(rows)

    reference = Reference(net, tuned, Loss(), Sgd())
    x, labels = picked(data, rows)
    activations = {}
    for number in reference.convs:
        x = activations[number] = reference.layer(number, x)
    behind = {number: activations[number] for number in range(7 - tuned, 6)}
    total = Loss().per_sample(x.flatten(1), labels).sum()
    truths = torch.autograd.grad(total, list(behind.values()))
    for (number, activation), truth in zip(behind.items(), truths, strict=True):
        seen = activation.detach()
        for name, expected in (
            ("true", truth),
            ("float", sgm_gradient(sgms[number], seen, labels)),
            ("int8", sgm_gradient(int8_sgms[number], seen, labels)),
        ):
            np.testing.assert_allclose(got[f"{name}{number}"], expected.flatten(1), atol=1e-5)
        assert got[f"clipped{number}"] == 0


def test_the_probe_counts_inputs_beyond_their_ranges(net: FoldedNet) -> None:
    data, sgms = random_data(2), random_sgms()
    int8_sgms = quantized(net, 2, data, sgms)
    data["labels"] = np.full((CROPS, 3), 9, np.float32)
    got = Exported(probe_model(net, 2, sgms, int8_sgms, Loss()), net, data).step(np.arange(9))
    assert got["clipped5"] == pytest.approx(3 / 19)


def test_layers_run_one_after_the_other_so_that_their_memory_is_freed(
    net: FoldedNet, tmp_path: Path
) -> None:
    data, sgms = random_data(3), random_sgms()
    model = step_model(net, 3, quantized(net, 3, data, sgms), Loss(), Sgd())
    exported = Exported(model, net, data)
    profiled = session(model, enable_profiling=True, profile_file_prefix=str(tmp_path / "run"))
    profiled.run(None, {**exported.feeds, "rows": np.arange(BATCH)})
    events = json.loads(Path(profiled.end_profiling()).read_text())
    order = [event["name"][:6] for event in events if event.get("cat") == "Node"]
    layers = [name for name in order if name.startswith("layer")]
    assert set(layers) == {"layer4", "layer5", "layer6"}
    assert layers == sorted(layers)


def test_inputs_and_outputs_have_their_names(net: FoldedNet) -> None:
    model = step_model(net, 2, random_sgms(), Loss(), Sgd())
    state = [f"{kind}{layer}" for layer in (5, 6) for kind in ("weight", "bias")]
    state += [name[:-1] + "_momentum" + name[-1] for name in state]
    others = {"features", "labels", "rows", "rate5", "rate6"}
    assert {value.name for value in model.graph.input} == {*state, *others}
    results = {value.name for value in model.graph.output}
    assert results == {"loss", *(f"{name}_next" for name in state)}
    assert [(opset.domain, opset.version) for opset in model.opset_import] == [("", 17)]


@pytest.mark.parametrize("tuned", [0, 4])
def test_another_number_of_layers_is_refused(net: FoldedNet, tuned: int) -> None:
    with pytest.raises(QsgmError, match=f"last {tuned} layers: choose 1, 2 or 3"):
        backprop_step_model(net, tuned, Loss(), Sgd())


def test_there_is_nothing_to_probe_behind_the_last_layer(net: FoldedNet) -> None:
    with pytest.raises(QsgmError, match="SGMs of 1 tuned layers: the last layer has none"):
        probe_model(net, 1, {}, {}, Loss())


@pytest.mark.parametrize("optimizer", [Sgd(), Adam()], ids=["sgd", "adam"])
def test_the_devices_loop_gives_what_plain_runs_of_the_graph_give(
    net: FoldedNet, optimizer: Optimizer
) -> None:
    data = random_data(3)
    model = step_model(net, 3, random_sgms((64, 64)), Loss(), optimizer)
    exported = Exported(model, net, data)
    start = {
        name: value.copy()
        for name, value in exported.feeds.items()
        if name in {f"{kind}{k}" for kind in ("weight", "bias") for k in RATES}
    }
    loop = StepLoop(session(model), data["features"], data["labels"], start, RATES)
    for rows in batches(12):
        assert loop.step(rows) == float(exported.step(rows)["loss"])
    tuned = loop.weights()
    assert set(tuned) == set(start)
    for name, value in tuned.items():
        np.testing.assert_array_equal(value, exported.feeds[name])
        assert not np.array_equal(value, start[name])


def test_a_missing_sgm_is_refused(net: FoldedNet) -> None:
    sgms = random_sgms()
    del sgms[4]
    with pytest.raises(QsgmError, match=r"no SGM for layers \[4\]"):
        step_model(net, 3, sgms, Loss(), Sgd())
