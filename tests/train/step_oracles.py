"""Runs of step graphs and probes against plain torch convolutions and autograd.

Sums over thousands of positions come out differently in another order, and the order is up to the
CPU. So every step begins at the graph's own state, and what it makes of that is held to what torch
makes of it in float64: it may be a few times as far off as torch in float32 is, and no farther.
"""

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from string import ascii_lowercase
from types import MappingProxyType

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from losses import GraspLoss, Loss
from torch import Tensor, nn
from torch.nn import functional as F

from qsgm.blocks import Blocks
from qsgm.grasp.network import GRASPNET
from qsgm.network import Pair
from qsgm.sgm.float import FoldedConv, FoldedSgm
from qsgm.sgm.int8 import QuantizedSgm, SgmRanges, integer_forward, quantize_sgm
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_sgm, run_folded_conv, run_folded_sgm
from qsgm.train.model.net import Convolution
from qsgm.train.model.sgm import Sgm
from qsgm.weights import to_step_layout

CROPS, BATCH = 37, 8
EPOCH = 5  # steps
EPSILON = float(np.finfo(np.float32).eps)
# An error may be so many times torch's in float32. With three other seeds, of which two were run
# with two orders of torch's sums, it came to at most 2.0 times.
FEW = 4
# Of Adam, behind its moments: eight results are rounded, to half an epsilon each.
OPERATIONS = 8
# Gates of one step that rounding may turn. Were there many, there would be nothing to compare.
MOST_IN_DOUBT = 50
RATES = {1: 0.001, 2: 0.001, 3: 0.001, 4: 0.002, 5: 0.005, 6: 0.02}
RATE = 0.003  # of layers that GraspNet has not
# Input of the first tuned layer, by how many are tuned; of all six it is the pixels.
POSITIONS = {1: 1, 2: 1, 3: 169, 4: 841, 5: 3844, 6: 16384}
CHANNELS = {1: 16, 2: 16, 3: 16, 4: 8, 5: 8, 6: 3}
HEADS = GraspLoss().heads
OPTIMIZERS = pytest.mark.parametrize("optimizer", [Sgd(), Adam()], ids=["sgd", "adam"])
TORCH_OPTIMIZERS: dict[type, Callable[..., torch.optim.Optimizer]] = {
    Sgd: lambda groups: torch.optim.SGD(groups, momentum=0.9),
    Adam: torch.optim.Adam,
}
TORCH_MOMENTS = {"momentum": "momentum_buffer", "mean": "exp_avg", "square": "exp_avg_sq"}

Arrays = dict[str, np.ndarray]
NOTHING: Mapping[int, Tensor] = MappingProxyType({})


def random_sgms(hidden: Sequence[int] | None = None) -> dict[int, FoldedSgm]:
    torch.manual_seed(4)
    return {layer: fold_sgm(Sgm(GRASPNET, layer, hidden).eval()) for layer in range(1, 6)}


def quiet(sgms: dict[int, FoldedSgm]) -> dict[int, FoldedSgm]:
    """Untrained as they are, kept from running away: the more positions, the larger are sums."""
    for layer, sgm in sgms.items():
        positions = POSITIONS[6 - layer]
        sgm.convs[-1].weight[:] *= 0.03 / positions**0.5
        sgm.convs[-1].bias[:] *= 0.03 / positions**0.5
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
            name, number = wanted.name, wanted.name.lstrip("_" + ascii_lowercase)
            if name in data:
                self.feeds[name] = data[name]
            elif name == f"weight{number}":
                self.feeds[name] = to_step_layout(net.layers[int(number) - 1].weight)
            elif name == f"bias{number}":
                self.feeds[name] = net.layers[int(number) - 1].bias
            elif name == f"rate{number}":
                self.feeds[name] = np.array(rate_of(int(number)), np.float32)
            elif name != "rows":
                self.feeds[name] = np.zeros(wanted.shape, np.float32)

    def step(self, rows: np.ndarray) -> Arrays:
        values = self.session.run(None, {**self.feeds, "rows": rows})
        results = dict(zip(self.results, values, strict=True))
        for name, value in results.items():
            if name.endswith("_next"):
                self.feeds[name.removesuffix("_next")] = value
        return results


@dataclass(frozen=True)
class Start:
    """Where a step begins, and all that it is given."""

    state: Arrays  # a graph's
    done: int  # steps before this one
    data: Arrays
    rows: np.ndarray
    blocks: Blocks
    sgms: Mapping[int, AnySgm]


class Reference:
    """The last layers as torch convolutions, trained by autograd."""

    def __init__(
        self,
        net: FoldedNet,
        layers: range,
        loss: Loss,
        optimizer: Optimizer,
        dtype: torch.dtype = torch.float32,
    ) -> None:
        self.loss, self.network = loss, net.network
        self.moments = optimizer.moments
        self.convs = {}
        for number in layers:
            folded, layer = net.layers[number - 1], net.network.layer(number)
            out_channels, in_channels, *kernel = folded.weight.shape
            conv = Convolution(in_channels, out_channels, kernel, layer.stride, layer.padding)
            conv.weight.data = torch.tensor(folded.weight, dtype=dtype)
            conv.bias.data = torch.tensor(folded.bias, dtype=dtype)
            self.convs[number] = conv
        groups = [
            {"params": [conv.weight, conv.bias], "lr": rate_of(number)}
            for number, conv in self.convs.items()
        ]
        self.optimizer = TORCH_OPTIMIZERS[type(optimizer)](groups)
        self.before_relu: dict[int, Tensor] = {}  # by layer, of the last forward pass
        self.turned: Mapping[int, Tensor] = {}  # gates that are to be on their other side

    def parameters(self) -> Iterator[tuple[str, int, nn.Parameter]]:
        for number, conv in self.convs.items():
            yield "weight", number, conv.weight
            yield "bias", number, conv.bias

    def stepped(self, start: Start, turned: Mapping[int, Tensor] = NOTHING) -> Arrays:
        """The state behind a step, and its loss."""
        self.put(start.state, start.done)
        self.turned = turned
        loss = self.step(start.data, start.rows, start.blocks, start.sgms)
        self.turned = {}
        return {"loss": np.array(loss)} | self.state()

    def put(self, state: Arrays, done: int) -> None:
        """Go on from a graph's state, so many steps after its start: at that, from torch's own."""
        for kind, number, parameter in self.parameters():
            parameter.data = as_parameter(state[f"{kind}{number}"], parameter)
            self.optimizer.state[parameter] = {}
            if done:
                self.optimizer.state[parameter] = {"step": torch.tensor(float(done))} | {
                    TORCH_MOMENTS[m]: as_parameter(state[f"{kind}_{m}{number}"], parameter)
                    for m in self.moments
                }

    def state(self) -> Arrays:
        """As graphs name it and lay it out, behind at least one step."""
        state = {}
        for kind, number, parameter in self.parameters():
            state[f"{kind}{number}"] = as_rows(parameter)
            for m in self.moments:
                moment = self.optimizer.state[parameter][TORCH_MOMENTS[m]]
                state[f"{kind}_{m}{number}"] = as_rows(moment)
        return state

    def layer(self, number: int, x: Tensor) -> Tensor:
        x, layer = self.convs[number](x), self.network.layer(number)
        if layer.relu:
            self.before_relu[number] = x.detach()
            gate = x.detach() > 0
            x = x * (gate ^ self.turned[number] if number in self.turned else gate)
        return F.avg_pool2d(x, layer.pool, layer.pool_stride)

    def step(
        self, data: Arrays, rows: np.ndarray, blocks: Blocks, sgms: Mapping[int, AnySgm]
    ) -> float:
        """Every block sees a detached input, and the SGM's gradient as if from behind."""
        dtype, depth = self.convs[blocks.layers[0]].weight.dtype, self.network.depth
        x, labels = picked(data, rows, self.network.before(blocks.layers[0]), dtype)
        stand_in = torch.zeros(())
        for group in blocks.groups:
            x = x.detach()
            for number in group:
                x = self.layer(number, x)
            if group[-1] < depth:
                gradient = sgm_gradient(sgms[group[-1]], x.detach(), labels)
                stand_in = stand_in + (x * gradient).sum() / len(x)
        return self.finish(self.loss(x.flatten(1), labels), stand_in)

    def finish(self, loss: Tensor, stand_in: Tensor) -> float:
        """Update; return the loss before it."""
        self.optimizer.zero_grad()
        (loss + stand_in).backward()
        self.optimizer.step()
        return loss.item()


def rate_of(number: int) -> float:
    """A layer's rate as graphs are given it, in float32."""
    return float(np.float32(RATES.get(number, RATE)))


def as_rows(parameter: Tensor) -> np.ndarray:
    """A parameter, or something of its shape, as graphs lay it out."""
    parameter = parameter.detach()
    rows = parameter.permute(0, 2, 3, 1).flatten(1) if parameter.dim() == 4 else parameter
    return rows.clone().numpy()


def as_parameter(rows: np.ndarray, like: Tensor) -> Tensor:
    """The inverse, in the shape and the type of a parameter."""
    values = torch.tensor(rows, dtype=like.dtype)
    if like.dim() == 1:
        return values.reshape(like.shape)
    out_channels, in_channels, height, width = like.shape
    maps = values.reshape(out_channels, height, width, in_channels)
    return maps.permute(0, 3, 1, 2).contiguous()


def sgm_gradient(sgm: AnySgm, activation: Tensor, labels: Tensor) -> Tensor:
    if isinstance(sgm, FoldedSgm):
        return run_folded_sgm(in_type(sgm, activation.dtype), activation, labels)
    gradient = integer_forward(sgm, seen_by_sgm(activation, labels).numpy())[0]
    return as_map(gradient, sgm.side)


def in_type(sgm: FoldedSgm, dtype: torch.dtype) -> FoldedSgm:
    """The same SGM with constants in torch's float32 or float64."""
    kind = torch.zeros((), dtype=dtype).numpy().dtype
    convs = (FoldedConv(conv.weight.astype(kind), conv.bias.astype(kind)) for conv in sgm.convs)
    return replace(sgm, convs=tuple(convs))


def seen_by_sgm(activation: Tensor, labels: Tensor) -> Tensor:
    """(B, P, Ci), position by position."""
    filled = labels[:, :, None, None].expand(-1, -1, *activation.shape[2:])
    return torch.cat([activation, filled], dim=1).flatten(2).transpose(1, 2)


def rows_of(maps: Tensor) -> Tensor:
    """(B, C, H, W) to position-major (B, P, C)."""
    return maps.flatten(2).transpose(1, 2)


def as_map(features: np.ndarray, side: Pair, dtype: torch.dtype = torch.float32) -> Tensor:
    """Position-major (N, P, C) to (N, C, H, W); pixels to [-1, 1]."""
    values = torch.tensor(features, dtype=dtype)
    if features.dtype == np.uint8:
        values = values / 127.5 - 1
    return values.reshape(len(features), *side, -1).permute(0, 3, 1, 2)


def picked(
    data: Arrays, rows: np.ndarray, side: Pair, dtype: torch.dtype = torch.float32
) -> tuple[Tensor, Tensor]:
    """Features as a map and labels of a batch."""
    return as_map(data["features"][rows], side, dtype), torch.tensor(
        data["labels"][rows], dtype=dtype
    )


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


def compare_runs(net: FoldedNet, blocks: Blocks, optimizer: Optimizer, steps: int) -> None:
    exported = compare_steps(net, blocks, quiet(random_sgms()), GraspLoss(), optimizer, steps)
    start = {k: to_step_layout(net.layers[k - 1].weight) for k in blocks.layers}
    moved = [float(np.abs(exported.feeds[f"weight{k}"] - start[k]).max()) for k in start]
    assert max(moved) > 5e-3
    assert min(moved) > 1e-6
    assert exported.feeds.get("step", steps) == steps


def compare_steps(
    net: FoldedNet,
    blocks: Blocks,
    sgms: Mapping[int, AnySgm],
    loss: Loss,
    optimizer: Optimizer,
    steps: int,
    data: Arrays | None = None,
    terms: float = 0.0,
) -> Exported:
    """A run of the graph, whose every step torch takes as well, from the same state.

    What a step leaves is compared in two parts. Moments are sums, which rounding moves in
    proportion to the largest of their entries. Weights go by what their moments say, which is a
    formula for each entry on its own: Adam divides one moment by the other, and where both are
    next to nothing the quotients of two right sums need not have a digit in common.

    Rounding counts against `terms` as well: where a parameter has a single entry, that may be next
    to nothing beside the terms that it is a sum of.
    """
    data = random_data(len(blocks.layers)) if data is None else data
    exported = Exported(step_model(net, blocks, sgms, loss.heads, optimizer), net, data)
    exact, rounded = (
        Reference(net, blocks.layers, loss, optimizer, dtype)
        for dtype in (torch.float64, torch.float32)
    )
    errors: dict[str, list[list[float]]] = defaultdict(list)  # graph's, torch's; largest entry
    for done, rows in enumerate(batches(steps)):
        start = Start(dict(exported.feeds), done, data, rows, blocks, sgms)
        results = exported.step(rows)
        graphs = {name.removesuffix("_next"): value for name, value in results.items()}
        truth, torchs = exact.stepped(start), rounded.stepped(start)
        for after in (graphs, truth):
            assert_weights_moved_as_their_moments_say(optimizer, start, after)
        for name, doubt in of_doubtful_gates(exact, rounded, start, truth).items():
            found = [error(after[name], truth[name], doubt) for after in (graphs, torchs)]
            errors[name].append([*found, float(np.abs(truth[name]).max())])
    for name, by_step in errors.items():
        # Over all steps: in one of them torch may by luck be right to the last digit.
        graph, torch_, largest = np.max(by_step, axis=0)
        assert graph <= FEW * (torch_ + EPSILON * max(largest, terms)), name
    return exported


def assert_weights_moved_as_their_moments_say(
    optimizer: Optimizer, start: Start, after: Arrays
) -> None:
    """To the rounding of a handful of operations, each entry on its own."""
    for kind, number in product(("weight", "bias"), start.blocks.layers):
        name = f"{kind}{number}"
        before, found = start.state[name].astype(np.float64), after[name]
        moments = [
            after[f"{kind}_{moment}{number}"].astype(np.float64).reshape(found.shape)
            for moment in optimizer.moments
        ]
        step = rate_of(number) * direction(optimizer, moments, start.done + 1)
        rounding = np.finfo(found.dtype).eps * (np.abs(before) + OPERATIONS * np.abs(step))
        assert (np.abs(found - (before - step)) <= rounding).all(), name


def direction(optimizer: Optimizer, moments: Sequence[np.ndarray], steps: int) -> np.ndarray:
    """What times the rate is taken off, as the papers have it."""
    if isinstance(optimizer, Sgd):
        return moments[0]
    mean, square = moments[0] / (1 - 0.9**steps), moments[1] / (1 - 0.999**steps)
    return mean / (np.sqrt(square) + 1e-8)


def of_doubtful_gates(exact: Reference, rounded: Reference, start: Start, truth: Arrays) -> Arrays:
    """How far loss and moments are from the truth where a gate is on its other side.

    What rounding may carry over zero opens or shuts a gate of ReLU: no error, and no small change.
    """
    doubts = {
        name: np.zeros_like(value) for name, value in truth.items() if name == "loss" or "_" in name
    }
    sums = dict(exact.before_relu)
    gates = [
        (number, tuple(gate))
        for number, values in sums.items()
        for gate in torch.nonzero(
            values.abs()
            <= FEW * (rounded.before_relu[number] - values).abs().amax((0, 2, 3), keepdim=True)
        )
    ]
    assert len(gates) < MOST_IN_DOUBT
    for number, gate in gates:
        turned = torch.zeros_like(sums[number], dtype=torch.bool)
        turned[gate] = True
        other = exact.stepped(start, {number: turned})
        for name in doubts:
            doubts[name] += np.abs(other[name] - truth[name])
    return doubts


def error(got: np.ndarray, truth: np.ndarray, doubt: np.ndarray) -> float:
    """The largest beyond the doubt."""
    return float(np.maximum(np.abs(got.reshape(truth.shape) - truth) - doubt, 0).max())


def seen_by_sgms(
    net: FoldedNet, tuned: int, data: Arrays, sgms: dict[int, FoldedSgm]
) -> dict[int, SgmRanges]:
    reference = Reference(net, GRASPNET.last(tuned), GraspLoss(), Sgd())
    first = GRASPNET.last(tuned)[0]
    x, labels = picked(data, np.arange(len(data["labels"])), GRASPNET.before(first))
    ranges = {}
    for number in GRASPNET.last(tuned)[:-1]:
        x = reference.layer(number, x).detach()
        seen = seen_by_sgm(x, labels)
        hidden = [as_map(seen.numpy(), sgms[number].side)]
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
