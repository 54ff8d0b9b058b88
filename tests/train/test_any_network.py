"""Local updates, step graphs and trunks of any small network against torch and integer arithmetic.

Two to four layers and twelve, on rectangles and rows: padding, strides and pools of their own per
direction, layers with and without ReLU, any heads.
"""

import numpy as np
import onnxruntime as ort
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from losses import HeadsLoss
from networks import SHALLOW, SHAPES, Case, Shape, blocks_of, cases, plain_layer, plain_maps
from step_oracles import CROPS, Exported, compare_steps
from test_fold import shake_norms
from test_trunk import integer_trunk
from torch import Tensor

from qsgm.blocks import single_layers
from qsgm.fidelity import cosine
from qsgm.runtime import session_options
from qsgm.sgm.float import FoldedSgm, float_trace
from qsgm.sgm.int8 import QuantizedSgm, SgmRanges, integer_forward, quantize_sgm
from qsgm.task import label_span
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.probe import head_model, probe_model
from qsgm.train.graphs.step import step_model
from qsgm.train.graphs.trunk import int8_trunk_model, network_model, trunk_model
from qsgm.train.heads import error
from qsgm.train.model.arrays import FLAT_ARRAYS
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.fold import fold_net, folded_start, run_folded, run_folded_sgm
from qsgm.train.model.local import (
    LayerState,
    group_gradients,
    local_step,
    outputs,
    true_gradients,
)
from qsgm.train.model.net import ConvNet, as_seen
from qsgm.train.quantization.trunk import feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_samples
from qsgm.weights import to_step_layout

EVERY_SHAPE = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
EXAMPLES = 20  # of every shape
TASKS, BATCH = 2, 3
ROUNDING = 1e-12  # of the largest entry, in float64
Weights = dict[int, tuple[Tensor, Tensor]]


def assert_equal(got: Tensor, expected: Tensor) -> None:
    """But for float64's rounding; sums cancel, so it counts against the largest entry."""
    assert got.dtype == expected.dtype == torch.float64
    assert got.shape == expected.shape
    assert float((got - expected).abs().max()) <= ROUNDING * max(1.0, float(expected.abs().max()))


def weights_of(case: Case, tuned: int) -> list[Weights]:
    """One set per task, in float64."""
    rng = np.random.default_rng([case.seed, 1])
    return [
        {
            k: tuple(
                torch.from_numpy(a + 0.1 * rng.normal(size=a.shape)).requires_grad_()
                for a in (case.net.layers[k - 1].weight, case.net.layers[k - 1].bias)
            )
            for k in case.network.last(tuned)
        }
        for _ in range(TASKS)
    ]


def states_of(tasks: list[Weights]) -> list[LayerState]:
    return [
        LayerState.start(
            torch.stack([rows_of(task[k][0].detach()) for task in tasks]),
            torch.stack([task[k][1].detach() for task in tasks]),
        )
        for k in tasks[0]
    ]


def rows_of(weight: Tensor) -> Tensor:
    """(Co, Ci, kh, kw) to (kh * kw * Ci, Co)."""
    return weight.permute(2, 3, 1, 0).flatten(0, 2)


def data_of(case: Case, tuned: int) -> tuple[Tensor, Tensor]:
    """Features (T, B, P, C) and labels (T, B, L) in float64."""
    first = case.network.last(tuned)[0]
    features = torch.from_numpy(case.features(first, TASKS * BATCH)).double()
    labels = torch.from_numpy(case.labels(TASKS * BATCH)).double()
    return features.unflatten(0, (TASKS, BATCH)), labels.unflatten(0, (TASKS, BATCH))


def made_up(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
    """Stands in for an SGM: anything that depends on layer, activation and label."""
    return torch.sin(layer + activation) + labels[..., None, :1]


@EVERY_SHAPE
@settings(max_examples=EXAMPLES)
@given(st.data())
def test_a_local_step_and_true_gradients_are_autograds(shape: Shape, data: st.DataObject) -> None:
    case = data.draw(cases(**shape))
    network, tuned = case.network, data.draw(st.integers(1, case.network.depth))
    tasks, (features, labels) = weights_of(case, tuned), data_of(case, tuned)
    states, loss = states_of(tasks), HeadsLoss(case.heads)

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == network.depth:
            return error(case.heads, activation, labels[:, :, None])
        return made_up(layer, activation, labels)

    rates = [torch.tensor(0.1 * k, dtype=torch.float64) for k in tasks[0]]
    updated = local_step(network, states, features, labels, rates, gradient_of)
    raw = outputs(network, states, features)
    true = true_gradients(network, states, features, labels, case.heads)
    assert set(true) == set(tasks[0])
    for task, weights in enumerate(tasks):
        first = network.last(tuned)[0]
        x = features[task].transpose(1, 2).unflatten(2, network.before(first))
        whole, activations = x.requires_grad_(), {}
        for index, (k, (weight, bias)) in enumerate(weights.items()):
            whole = activations[k] = plain_layer(network.layer(k), weight, bias, whole)
            x = plain_layer(network.layer(k), weight, bias, x.detach())
            if k == network.depth:
                objective = loss(x.flatten(1), labels[task])
            else:
                after = x.flatten(2).transpose(1, 2)
                objective = (after * made_up(k, after.detach(), labels[task])).sum() / BATCH
            d_weight, d_bias = torch.autograd.grad(objective, [weight, bias])
            assert_equal(updated[index].weight_momentum[task], rows_of(d_weight))
            assert_equal(updated[index].bias_momentum[task], d_bias)
            moved = rows_of(weight.detach()) - rates[index] * rows_of(d_weight)
            assert_equal(updated[index].weight[task], moved)
        assert_equal(raw[task], whole.detach().flatten(1))
        total = loss.per_sample(whole.flatten(1), labels[task]).sum()
        found = torch.autograd.grad(total, list(activations.values()))
        for k, gradient in zip(activations, found, strict=True):
            assert_equal(true[k][task], gradient.flatten(2).transpose(1, 2))


@settings(max_examples=40)
@given(cases(), st.data())
def test_gradients_inside_of_groups_are_autograds(case: Case, data: st.DataObject) -> None:
    network, blocks = case.network, blocks_of(data.draw, case.network)
    tasks, (features, labels) = (f(case, len(blocks.layers)) for f in (weights_of, data_of))
    found = group_gradients(network, blocks.groups, states_of(tasks), features, labels, made_up)
    for task, weights in enumerate(tasks):
        side = network.before(blocks.layers[0])
        x = features[task].transpose(1, 2).unflatten(2, side)
        for group in blocks.groups:
            x, behind = x.detach().requires_grad_(), {}
            for k in group:
                x = behind[k] = plain_layer(network.layer(k), *weights[k], x)
            after = x.flatten(2).transpose(1, 2)
            objective = (after * made_up(group[-1], after.detach(), labels[task])).sum()
            for k, gradient in zip(
                group, torch.autograd.grad(objective, [*behind.values()]), strict=True
            ):
                assert_equal(found[k][task], gradient.flatten(2).transpose(1, 2))


@EVERY_SHAPE
@settings(max_examples=EXAMPLES)
@given(st.sampled_from([Sgd(), Adam()]), st.data())
def test_a_step_graph_steps_as_torch(
    shape: Shape, optimizer: Optimizer, data: st.DataObject
) -> None:
    case = data.draw(cases(**shape))
    blocks = blocks_of(data.draw, case.network)
    arrays = {
        "features": case.features(blocks.layers[0], CROPS),
        "labels": case.labels(CROPS),
    }
    loss = HeadsLoss(case.heads)
    # What a sample adds to a sum is at most twice its head's weight, times inputs of about one;
    # each layer of a deep network hands on the rounding of those in front of it.
    handed_on = len(blocks.layers) if case.network.depth > SHALLOW else 1
    terms = 2 * handed_on * sum(head.weight for head in case.heads)
    compare_steps(case.net, blocks, case.sgms(), loss, optimizer, 5, arrays, terms=terms)


def quantized(case: Case, sgm: FoldedSgm, seen: np.ndarray) -> QuantizedSgm:
    """Calibrated on what it is given."""
    low, high = label_span(case.heads)
    channels = len(sgm.convs[-1].bias)
    _, hidden = float_trace(sgm, seen)
    ranges = SgmRanges(
        np.concatenate([seen.min(axis=(0, 1))[:channels], low]),
        np.concatenate([seen.max(axis=(0, 1))[:channels], high]),
        tuple(tensor.max(axis=(0, 1)) for tensor in hidden),
    )
    return quantize_sgm(sgm, ranges)


@EVERY_SHAPE
@settings(max_examples=EXAMPLES)
@given(st.data())
def test_a_probe_tells_what_sgms_give_in_float_and_bit_for_bit_in_integers(
    shape: Shape, data: st.DataObject
) -> None:
    case = data.draw(cases(**shape))
    network = case.network
    tuned = data.draw(st.integers(2, network.depth))
    first = network.last(tuned)[0]
    arrays = {"features": case.features(first, BATCH), "labels": case.labels(BATCH)}
    sgms, rows = case.sgms(), np.arange(BATCH)
    numbers = single_layers(network.last(tuned)).sgm_layers
    x = torch.from_numpy(arrays["features"]).double()
    if arrays["features"].dtype == np.uint8:
        x = x / 127.5 - 1
    maps = x.transpose(1, 2).unflatten(2, network.before(first)).requires_grad_()
    behind = {}
    for k in network.last(tuned):
        arrays_k = case.net.layers[k - 1]
        weight, bias = (torch.from_numpy(a).double() for a in (arrays_k.weight, arrays_k.bias))
        maps = behind[k] = plain_layer(network.layer(k), weight, bias, maps)
    total = HeadsLoss(case.heads).per_sample(maps.flatten(1), torch.from_numpy(arrays["labels"]))
    truths = torch.autograd.grad(total.sum(), [behind[k] for k in numbers])
    seen = {}
    for k in numbers:
        rows_k = behind[k].detach().flatten(2).transpose(1, 2).float().numpy()
        filled = np.repeat(arrays["labels"][:, None], rows_k.shape[1], axis=1)
        seen[k] = np.concatenate([rows_k, filled], axis=2)
    int8 = {k: quantized(case, sgms[k], seen[k]) for k in numbers}
    model = probe_model(case.net, tuned, sgms, int8, case.heads)
    got = Exported(model, case.net, arrays).step(rows)
    for k, truth in zip(numbers, truths, strict=True):
        after, labels = got[f"activation{k}"], torch.from_numpy(arrays["labels"])
        close(after, behind[k].detach().flatten(2).transpose(1, 2).numpy())
        close(got[f"true{k}"], truth.flatten(2).transpose(1, 2).numpy())
        maps_k = torch.from_numpy(after).transpose(1, 2).unflatten(2, network.after(k))
        floating = run_folded_sgm(sgms[k], maps_k, labels).flatten(2).transpose(1, 2)
        close(got[f"float{k}"], floating.numpy())
        # What the SGM sees is what the graph itself gave, to the last bit.
        filled = np.repeat(arrays["labels"][:, None], after.shape[1], axis=1)
        integers, _ = integer_forward(int8[k], np.concatenate([after, filled], axis=2))
        np.testing.assert_array_equal(got[f"int8{k}"], integers)


def close(got: np.ndarray, expected: np.ndarray) -> None:
    """But for float32's rounding, which counts against the largest entry."""
    assert got.shape == expected.shape
    largest = max(1.0, float(np.abs(expected).max()))
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-5 * largest)


def run(model: object, **feeds: np.ndarray) -> np.ndarray:
    session = ort.InferenceSession(
        model.SerializeToString(),  # type: ignore[attr-defined]
        session_options(),
        ["CPUExecutionProvider"],
    )
    return session.run(None, feeds)[0]


@EVERY_SHAPE
@settings(max_examples=EXAMPLES)
@given(st.data())
def test_trunk_head_and_network_are_the_folded_network_in_torch(
    shape: Shape, data: st.DataObject
) -> None:
    case = data.draw(cases(**shape))
    network, samples = case.network, case.samples(4)
    last = data.draw(st.integers(0, network.depth - 1))
    got = run(trunk_model(case.net, last), samples=samples)
    if last == 0:
        np.testing.assert_array_equal(got, samples.reshape(got.shape))
    else:
        close(got, plain_maps(case, samples, last).flatten(2).transpose(1, 2).numpy())
    raw = plain_maps(case, samples, network.depth).flatten(1)
    expected = HeadsLoss(case.heads).activate(raw).numpy()
    weights = {}
    for k in network.last(network.depth - last):
        weights[f"weight{k}"] = to_step_layout(case.net.layers[k - 1].weight)
        weights[f"bias{k}"] = case.net.layers[k - 1].bias
    head = head_model(case.net, network.depth - last, case.heads)
    close(run(head, features=got, **weights), expected)
    whole = network_model(case.net, case.heads)
    close(run(whole, frame=samples[0])[:, 0, 0], expected[0])
    close(run_folded(case.net, torch.from_numpy(samples)).flatten(1).numpy(), raw.numpy())


@EVERY_SHAPE
@settings(max_examples=EXAMPLES)
@given(st.data())
def test_the_int8_trunk_is_integer_arithmetic_and_near_the_float_one(
    shape: Shape, data: st.DataObject
) -> None:
    case = data.draw(cases(("pixels",), relu=True, padded_first=False, **shape))
    network, samples = case.network, case.samples(6)
    ranges = dict(observe_samples(case.net, samples))
    net = type(case.net)(network, case.net.layers, feature_steps(ranges))
    layers = quantize_trunk(net, ranges)
    assert [*layers] == [*range(1, network.depth)]
    last = data.draw(st.integers(1, network.depth - 1))
    got = run(int8_trunk_model(net, layers, last), samples=samples)
    expected = integer_trunk(layers, samples, last, network)
    local = [
        k
        for k in range(1, last + 1)
        if layers[k].pool_gain is not None and not network.pools_all(k)
    ]
    if local:  # the mean of a window is rounded before its gain is put on
        assert np.abs(got.astype(int) - expected).max() <= len(local)
    else:
        np.testing.assert_array_equal(got, expected)
    exact = plain_maps(case, samples, last).flatten(2).transpose(1, 2).numpy()
    if np.abs(exact).max() > 0.1:
        assert cosine((got * net.feature_steps[last]).astype(np.float32), exact) > 0.98


@settings(max_examples=40)
@given(cases(), st.data())
def test_curvature_bends_the_same_in_the_graph_and_in_torch(
    case: Case, data: st.DataObject
) -> None:
    blocks, sgms = blocks_of(data.draw, case.network), case.sgms()
    arrays = {"features": case.features(blocks.layers[0], BATCH), "labels": case.labels(BATCH)}
    torch.manual_seed(case.seed % 2**31)
    plain_ones = {k: Curvature.identity(case.network.layer(k)) for k in blocks.layers}
    curvatures = {
        k: Curvature(*(torch.randn(m.shape) for m in one.matrices)) for k, one in plain_ones.items()
    }
    momenta = []
    for used in (FLAT_ARRAYS, {k: one.arrays() for k, one in curvatures.items()}):
        model = step_model(case.net, blocks, sgms, case.heads, Sgd(), used)
        momenta.append(Exported(model, case.net, arrays).step(np.arange(BATCH)))
    for k, curvature in curvatures.items():
        plain, bent = (
            [torch.from_numpy(m[f"{kind}_momentum{k}_next"]) for kind in ("weight", "bias")]
            for m in momenta
        )
        weight, bias = curvature.precondition(plain[0].T[None], plain[1][None])
        close(bent[0].numpy(), weight[0].T.numpy())
        close(bent[1].numpy(), bias[0].numpy())


@EVERY_SHAPE
@settings(max_examples=EXAMPLES)
@given(st.data())
def test_a_network_with_any_batchnorms_is_itself_folded(shape: Shape, data: st.DataObject) -> None:
    case = data.draw(cases(**shape))
    torch.manual_seed(case.seed % 2**31)
    net = ConvNet(case.network)
    shake_norms(net, case.seed)
    net, folded, samples = net.double(), fold_net(net), torch.from_numpy(case.samples(3))
    with torch.no_grad():
        expected = net(as_seen(case.network, samples).double()).flatten(1)
    close(run_folded(folded, samples).flatten(1).numpy(), expected.numpy())
    start = folded_start(net.float(), case.network.depth)
    for (weight, bias), arrays in zip(start, folded.layers, strict=True):
        close(weight.numpy(), rows_of(torch.from_numpy(arrays.weight)).numpy())
        close(bias.numpy(), arrays.bias)


@given(cases(("pixels",), padded_first=False))
def test_layers_run_in_integers_up_to_the_first_without_a_relu(case: Case) -> None:
    ranges = dict(observe_samples(case.net, case.samples(3)))
    frozen = case.network.layers[:-1]
    whole = next((k for k, layer in enumerate(frozen) if not layer.relu), len(frozen))
    assert [*quantize_trunk(case.net, ranges)] == [*range(1, whole + 1)]
