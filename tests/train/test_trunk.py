"""The frozen layers in int8 and features in u8, against integer arithmetic in numpy and torch."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from nets import random_net

from qsgm import QsgmError
from qsgm.blocks import one_block, single_layers
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import GraspTask
from qsgm.network import Layer, Network, conv
from qsgm.runtime import session_options
from qsgm.sgm.float import FloatArray, FoldedConv
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.inspection import (
    integer_operators,
    optimized_nodes,
    refuse_float_products,
)
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.probe import head_model
from qsgm.train.graphs.step import step_model
from qsgm.train.graphs.trunk import int8_layer, int8_trunk_model, trunk_model
from qsgm.train.grasp.calibration_set import CalibrationLessons, CalibrationSet
from qsgm.train.grasp.draw_calibration import draw_calibration_set
from qsgm.train.grasp.task import shipped_things
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net, fold_sgm
from qsgm.train.model.net import as_seen
from qsgm.train.model.sgm import Sgm
from qsgm.train.quantization import trunk_ranges
from qsgm.train.quantization.trunk import (
    HEADROOM,
    LayerRange,
    QuantizedLayer,
    feature_steps,
    quantize_trunk,
    u8_steps,
)
from qsgm.train.quantization.trunk_ranges import join, observe_samples, observe_trunk
from qsgm.weights import to_step_layout

ALL, NONE = ort.GraphOptimizationLevel.ORT_ENABLE_ALL, ort.GraphOptimizationLevel.ORT_DISABLE_ALL
FROZEN = pytest.mark.parametrize("last_frozen", range(1, 6))
Codes = np.ndarray[Any, np.dtype[np.uint8]]
HEADS = GraspTask().heads


def calibration_crops(shown: Demonstration, rng: np.random.Generator, count: int) -> Codes:
    """Crops (N, 128, 128, 3) of one frame, as the device cuts them."""
    return crop_source([shown], shipped_things(), rng, count).cut(np.arange(count))


@pytest.fixture(scope="module")
def crops(frame: Codes) -> Codes:
    shown = Demonstration(frame, (320, 240))
    return calibration_crops(shown, np.random.default_rng(0), 200)[:40]


@pytest.fixture(scope="module")
def drawn_net(crops: Codes) -> FoldedNet:
    """Random but for its batchnorms' statistics: else biases drown what varies between crops."""
    net = random_net(0).train()
    with torch.no_grad():
        for _ in range(20):
            net(as_seen(GRASPNET, torch.from_numpy(crops)))
    return fold_net(net.eval())


@pytest.fixture(scope="module")
def ranges(drawn_net: FoldedNet, crops: Codes) -> dict[int, LayerRange]:
    seen = dict(observe_samples(drawn_net, crops))
    # In front of the pool and behind it a step is to stand for different things.
    return seen | {4: replace(seen[4], convolved=3 * seen[4].convolved)}


@pytest.fixture(scope="module")
def net(drawn_net: FoldedNet, ranges: dict[int, LayerRange]) -> FoldedNet:
    return replace(drawn_net, feature_steps=feature_steps(ranges))


@pytest.fixture(scope="module")
def layers(net: FoldedNet, ranges: dict[int, LayerRange]) -> dict[int, QuantizedLayer]:
    return quantize_trunk(net, ranges)


def run(
    model: onnx.ModelProto, level: ort.GraphOptimizationLevel = ALL, **feeds: np.ndarray
) -> list[np.ndarray]:
    options = session_options()
    options.graph_optimization_level = level
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    return session.run(None, feeds)


def to_u8(x: np.ndarray) -> Codes:
    return np.clip(np.rint(x), 0, 255).astype(np.uint8)


def integer_layer(one: Layer, layer: QuantizedLayer, x: Codes) -> Codes:
    """u8 maps (N, Ci, H, W) to u8 maps: sums in integers, two roundings in float32."""
    (up, left), (down, right) = one.padding, one.stride
    x = np.pad(x, ((0, 0), (0, 0), (up, up), (left, left)))
    windows = np.lib.stride_tricks.sliding_window_view(x, one.kernel, axis=(2, 3))
    windows = windows[:, :, ::down, ::right].astype(np.float64)  # holds these integers exactly
    sums = np.einsum("nihwyx,oiyx->nohw", windows, layer.weight.astype(np.float64), optimize=True)
    sums += layer.bias[:, None, None]
    assert np.abs(sums).max() < 2**31
    codes = to_u8(sums.astype(np.float32) * layer.scale[:, None, None])
    if layer.pool_gain is None:
        return codes
    (down, right), pooled = one.pool_stride, np.lib.stride_tricks.sliding_window_view
    windows = pooled(codes, one.pool, axis=(2, 3))[:, :, ::down, ::right]
    total = windows.sum(axis=(4, 5), dtype=np.int64).astype(np.float32)
    return to_u8(total * layer.pool_gain[:, None, None])


def integer_trunk(
    layers: dict[int, QuantizedLayer],
    crops: Codes,
    last_frozen: int,
    network: Network = GRASPNET,
) -> Codes:
    """Samples (N, H, W, C) to features (N, P, C)."""
    x = crops.transpose(0, 3, 1, 2)
    for number in range(1, last_frozen + 1):
        x = integer_layer(network.layer(number), layers[number], x)
    return x.reshape(*x.shape[:2], -1).transpose(0, 2, 1)


def float_features(net: FoldedNet, crops: Codes, last_frozen: int) -> FloatArray:
    return run(trunk_model(replace(net, feature_steps={}), last_frozen), samples=crops)[0]


def sqnr_db(exact: np.ndarray, rounded: np.ndarray) -> float:
    return float(10 * np.log10(np.sum(exact**2.0) / np.sum((rounded - exact) ** 2.0)))


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    shape=st.tuples(st.integers(1, 20), st.integers(1, 20)),
    kernel=st.sampled_from([1, 3, 5]),
    stride=st.integers(1, 2),
    side=st.integers(5, 13),
    pool=st.booleans(),
    bias=st.sampled_from([1.0, 1e3, 1e9]),
)
def test_onnx_runtime_computes_an_int8_layer_bit_for_bit(
    seed: int,
    shape: tuple[int, int],
    kernel: int,
    stride: int,
    side: int,
    pool: bool,
    bias: float,
) -> None:
    rng = np.random.default_rng(seed)
    out = (side - kernel) // stride + 1
    size = (*shape, kernel, kernel)
    weight = rng.normal(size=size) * np.exp(rng.normal(size=(shape[0], 1, 1, 1)))
    folded = FoldedConv(
        weight.astype(np.float32), (bias * rng.normal(size=shape[0])).astype(np.float32)
    )
    side_after = 1 if pool else out
    geometry = conv(shape[1], shape[0], kernel, stride=stride, pool=out if pool else 1)
    behind = conv(shape[0], 1, side_after, relu=False)
    high = np.exp(rng.normal(size=(2, shape[0]))).astype(np.float32) * kernel**2
    one = FoldedNet(Network((side, side, shape[1]), (geometry, behind)), (folded,))
    layer = quantize_trunk(one, {1: LayerRange(high[0], high[1] if pool else high[0])})[1]
    graph = Graph("layer")
    maps = graph.input("x", np.uint8, ("n", shape[1], side, side))
    codes = int8_layer(graph.within("layer1"), one, 1, layer, maps)
    graph.output("codes", codes, np.uint8, ("n", shape[0], side_after, side_after))
    x = rng.integers(0, 256, (3, shape[1], side, side), dtype=np.uint8)
    np.testing.assert_array_equal(run(graph.model(), x=x)[0], integer_layer(geometry, layer, x))


@FROZEN
def test_onnx_runtime_computes_the_int8_trunk_bit_for_bit(
    net: FoldedNet, layers: dict[int, QuantizedLayer], crops: Codes, last_frozen: int
) -> None:
    (got,) = run(int8_trunk_model(net, layers, last_frozen), samples=crops)
    expected = integer_trunk(layers, crops, last_frozen)
    assert len(np.unique(expected)) > 10
    np.testing.assert_array_equal(got, expected)


@FROZEN
def test_without_graph_optimizations_few_features_differ_and_by_few_steps(
    net: FoldedNet, layers: dict[int, QuantizedLayer], crops: Codes, last_frozen: int
) -> None:
    (got,) = run(int8_trunk_model(net, layers, last_frozen), NONE, samples=crops)
    expected = integer_trunk(layers, crops, last_frozen)
    # In float a sum near a half may round to the next code, and later layers add such steps up.
    moved = np.abs(got.astype(int) - expected)
    assert moved.max() <= 4
    assert moved.mean() < 0.02


@FROZEN
def test_every_convolution_of_the_int8_trunk_runs_in_integers(
    net: FoldedNet, layers: dict[int, QuantizedLayer], last_frozen: int
) -> None:
    model = int8_trunk_model(net, layers, last_frozen)
    refuse_float_products("trunk", model)
    assert integer_operators(model) == ["QLinearConv"] * last_frozen
    assert "Conv" not in {node.op_type for node in optimized_nodes(model)}


def test_a_trunk_with_a_convolution_in_float_is_refused(
    net: FoldedNet, layers: dict[int, QuantizedLayer]
) -> None:
    graph = Graph("trunk")
    x = graph.input("x", np.uint8, ("n", 3, 9, 9))
    int8_layer(graph.within("layer1"), net, 1, layers[1], x)
    conv = next(node for node in graph.nodes if node.op_type == "Conv")
    del graph.nodes[graph.nodes.index(conv) + 1 :]  # no longer rounded: nothing to fuse it with
    graph.output("y", conv.output[0], np.float32, ("n", 8, 3, 3))
    with pytest.raises(QsgmError, match="computes 0 of the 1 int8 products of layer1 in integers"):
        refuse_float_products("trunk", graph.model())


@FROZEN
def test_u8_features_of_the_float_trunk_are_its_float_features_rounded(
    net: FoldedNet, crops: Codes, last_frozen: int
) -> None:
    (got,) = run(trunk_model(net, last_frozen), samples=crops)
    exact = float_features(net, crops, last_frozen) / net.feature_steps[last_frozen]
    assert got.dtype == np.uint8
    # A float32 sum in another order may end on the other side of a half.
    assert np.abs(got - np.clip(exact, 0, 255)).max() < 0.5 + 1e-3


@FROZEN
def test_features_of_the_int8_trunk_are_those_of_the_float_trunk_but_for_rounding(
    net: FoldedNet, layers: dict[int, QuantizedLayer], crops: Codes, last_frozen: int
) -> None:
    exact = float_features(net, crops, last_frozen)
    codes = integer_trunk(layers, crops, last_frozen)
    # 8 bits of activations and weights, five layers one after another.
    assert sqnr_db(exact, codes * net.feature_steps[last_frozen]) > 27


def test_rounding_the_first_layers_weights_costs_nothing_on_grey_pixels(net: FoldedNet) -> None:
    """Grey is zero to the network: times a pixel value of 127 the weights' errors would add up."""
    first = net.layers[0]
    bias = np.full(8, 1.2, np.float32)  # in the middle of the codes
    high = np.full(8, 0.01 * 255 / HEADROOM, np.float32)  # fine steps, so that errors show
    bright = replace(net, layers=(replace(first, bias=bias), *net.layers[1:]))
    layer = quantize_trunk(bright, {1: LayerRange(high, high)})[1]
    for value in (127, 128):
        grey = np.full((1, 3, 5, 5), value, np.uint8)
        exact = bias + first.weight.sum(axis=(1, 2, 3)) * (value / 127.5 - 1)
        codes = integer_layer(GRASPNET.layer(1), layer, grey)[0, :, 0, 0]
        np.testing.assert_allclose(codes, exact / 0.01, atol=0.6)


@pytest.mark.parametrize("tuned", range(1, 6))
def test_a_step_trains_on_u8_features_as_on_their_values_in_float(
    net: FoldedNet, tuned: int
) -> None:
    rng = np.random.default_rng(tuned)
    torch.manual_seed(0)
    sgms = {k: fold_sgm(Sgm(GRASPNET, k, (8,)).eval()) for k in range(7 - tuned, 6)}
    last = GRASPNET.last(tuned)
    blocks = single_layers(last) if tuned > 1 else one_block(last)
    codes, labels, rows = random_batch(net, tuned, rng)
    feeds = {"labels": labels, "rows": rows} | start(net, tuned)
    feeds |= {f"rate{k}": np.array(1e-3, np.float32) for k in range(7 - tuned, 7)}
    model = step_model(net, blocks, sgms, HEADS, Sgd())
    for wanted in model.graph.input:
        if "_" in wanted.name:  # a moment
            shape = [side.dim_value for side in wanted.type.tensor_type.shape.dim]
            feeds[wanted.name] = np.zeros(shape, np.float32)
    got = run(model, features=codes, **feeds)
    values = codes * net.feature_steps[6 - tuned]
    plain = replace(net, feature_steps={})
    expected = run(step_model(plain, blocks, sgms, HEADS, Sgd()), features=values, **feeds)
    # Not bit for bit: the graph multiplies the weights, not the codes, with the steps.
    for one, other in zip(got, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * np.abs(other).max())


@pytest.mark.parametrize("tuned", range(1, 6))
def test_a_head_sees_u8_features_as_their_values_in_float(net: FoldedNet, tuned: int) -> None:
    codes, _, _ = random_batch(net, tuned, np.random.default_rng(tuned))
    got = run(head_model(net, tuned, HEADS), features=codes, **start(net, tuned))
    values, plain = codes * net.feature_steps[6 - tuned], replace(net, feature_steps={})
    expected = run(head_model(plain, tuned, HEADS), features=values, **start(net, tuned))
    np.testing.assert_allclose(got[0], expected[0], rtol=0, atol=1e-5)


def random_batch(
    net: FoldedNet, tuned: int, rng: np.random.Generator
) -> tuple[Codes, FloatArray, np.ndarray]:
    """Features of ten crops, their labels, and the rows of four of them."""
    positions = {1: 1, 2: 1, 3: 169, 4: 841, 5: 3844}[tuned]
    channels = len(net.feature_steps[6 - tuned])
    codes = rng.integers(0, 256, (10, positions, channels), dtype=np.uint8)
    angle = rng.uniform(-np.pi, np.pi, 10)
    labels = np.stack([np.ones(10), np.sin(angle), np.cos(angle)], axis=1).astype(np.float32)
    return codes, labels, np.array([3, 1, 7, 7])


def start(net: FoldedNet, tuned: int) -> dict[str, np.ndarray]:
    weights = {}
    for number in range(7 - tuned, 7):
        weights[f"weight{number}"] = to_step_layout(net.layers[number - 1].weight)
        weights[f"bias{number}"] = net.layers[number - 1].bias
    return weights


def test_ranges_are_the_largest_activations_on_all_frames(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(trunk_ranges, "SAMPLES", 30)
    draw_calibration_set(tmp_path / "calib", 2, 0, lambda *_: None)
    frames, net = CalibrationSet(tmp_path / "calib"), random_net(0)
    lessons = CalibrationLessons(frames, GraspTask())
    got = observe_trunk(fold_net(net), lessons, 5, lambda *_: None)
    crops = [calibration_crops(frames[i], np.random.default_rng([5, i]), 30) for i in range(2)]
    x = as_seen(GRASPNET, torch.tensor(np.concatenate(crops)))
    with torch.no_grad():
        for number in range(1, 6):
            layer = net.layers[number - 1]
            convolved = torch.relu(layer.norm(layer.conv(x))).amax((0, 2, 3))
            x = layer(x)
            np.testing.assert_allclose(got[number].convolved, convolved, rtol=1e-5, atol=1e-5)
            pooled = x.amax((0, 2, 3))
            np.testing.assert_allclose(got[number].pooled, pooled, rtol=1e-5, atol=1e-5)


def test_one_frame_is_in_memory_at_a_time(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(trunk_ranges, "SAMPLES", 2)
    draw_calibration_set(tmp_path / "calib", 3, 0, lambda *_: None)
    events: list[str] = []
    spied(monkeypatch, CalibrationSet, "__getitem__", lambda: events.append("read"))
    spied(monkeypatch, trunk_ranges, "observe_samples", lambda: events.append("observed"))
    lessons = CalibrationLessons(CalibrationSet(tmp_path / "calib"), GraspTask())
    observe_trunk(fold_net(random_net(0)), lessons, 0, lambda *_: None)
    assert events == ["read", "observed"] * 3


def spied(monkeypatch: pytest.MonkeyPatch, owner: Any, name: str, note: Callable[[], None]) -> None:
    original = getattr(owner, name)

    def noting(*arguments: Any) -> Any:
        note()
        return original(*arguments)

    monkeypatch.setattr(owner, name, noting)


def test_a_step_leaves_headroom_and_a_silent_channel_gets_the_median() -> None:
    steps = u8_steps(np.array([2.0, 0.0, 8.0, 4.0], np.float32))
    np.testing.assert_allclose(steps * 255, HEADROOM * np.array([2, 4, 8, 4]), rtol=1e-6)


def test_a_joined_range_covers_both() -> None:
    def span(*high: float) -> LayerRange:
        return LayerRange(np.array(high, np.float32), np.array(high, np.float32) / 2)

    both = join(span(1, 5), span(3, 2))
    np.testing.assert_array_equal(both.convolved, [3, 5])
    np.testing.assert_array_equal(both.pooled, [1.5, 2.5])
