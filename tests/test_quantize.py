"""The int8 SGM: ONNX Runtime against integer arithmetic in numpy, and that against float."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from qsgm import QsgmError
from qsgm.runtime import session_options
from qsgm.train.fold import FloatArray, FoldedConv, FoldedSgm
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.inspection import integer_operators, optimized_nodes
from qsgm.train.graphs.sgm import clipped_fraction, int8_sgm, scaled_inputs
from qsgm.train.quantize import (
    QuantizedSgm,
    SgmRanges,
    integer_forward,
    integer_trace,
    quantize_product,
    quantize_sgm,
    to_u8,
)

ALL, NONE = ort.GraphOptimizationLevel.ORT_ENABLE_ALL, ort.GraphOptimizationLevel.ORT_DISABLE_ALL


DEPTHS = pytest.mark.parametrize("hidden", [(16,), (64, 64), (12, 20, 8)])


def random_conv(rng: np.random.Generator, into: int, out: int) -> FoldedConv:
    weight, bias = rng.normal(size=(out, into, 1, 1)), rng.normal(size=out)
    return FoldedConv(weight.astype(np.float32), bias.astype(np.float32))


def random_sgm(rng: np.random.Generator, channels: int, *hidden: int) -> FoldedSgm:
    widths = (channels + 3, *hidden, channels)
    return FoldedSgm(4, tuple(random_conv(rng, into, out) for into, out in pairwise(widths)))


def random_inputs(rng: np.random.Generator, sgm: FoldedSgm, rows: int) -> FloatArray:
    """Activations of very different size per channel, then labels in [-1, 1]."""
    channels = len(sgm.convs[-1].bias)
    activation = np.exp(rng.normal(size=channels)) * np.abs(rng.normal(size=(rows, channels)))
    labels = rng.uniform(-1, 1, (rows, 3))
    return np.concatenate([activation, labels], axis=1).astype(np.float32)


def float_hidden(sgm: FoldedSgm, inputs: FloatArray) -> list[FloatArray]:
    """Every hidden tensor, behind its ReLU."""
    tensors = [inputs]
    for conv in sgm.convs[:-1]:
        tensors.append(np.maximum(tensors[-1] @ conv.weight[:, :, 0, 0].T + conv.bias, 0))
    return tensors[1:]


def float_gradient(sgm: FoldedSgm, inputs: FloatArray) -> FloatArray:
    last = sgm.convs[-1]
    return float_hidden(sgm, inputs)[-1] @ last.weight[:, :, 0, 0].T + last.bias


def seen_ranges(sgm: FoldedSgm, inputs: FloatArray) -> SgmRanges:
    hidden = tuple(tensor.max(axis=0) for tensor in float_hidden(sgm, inputs))
    return SgmRanges(inputs.min(axis=0), inputs.max(axis=0), hidden)


def gradient_of_rounded_activations(
    sgm: FoldedSgm, q: QuantizedSgm, ranges: SgmRanges, inputs: FloatArray
) -> FloatArray:
    """Inputs and hidden tensors rounded as the int8 SGM does, the weights left as they are."""
    x = q.input_low + to_u8((inputs - q.input_low) * q.input_gain) / q.input_gain
    for conv, high in zip(sgm.convs, ranges.hidden_high, strict=False):
        step = np.where(high > 0, high, 1) / 255
        x = step * to_u8((x @ conv.weight[:, :, 0, 0].T + conv.bias) / step)
    last = sgm.convs[-1]
    return x @ last.weight[:, :, 0, 0].T + last.bias


def int8_model(q: QuantizedSgm) -> onnx.ModelProto:
    """Inputs to gradient, clipped fraction and the u8 hidden tensors."""
    inputs, channels = len(q.input_low), len(q.products[-1].bias)
    graph = Graph("int8")
    op = graph.within("sgm")
    scaled = scaled_inputs(op, q, graph.input("inputs", np.float32, ("batch", inputs)))
    graph.output("gradient", int8_sgm(op, q, scaled), np.float32, ("batch", channels))
    graph.output("clipped", clipped_fraction(op, scaled), np.float32, ())
    rounded = [node.output[0] for node in graph.nodes if node.op_type == "QuantizeLinear"]
    for i, (value, product) in enumerate(zip(rounded[1:], q.products, strict=False)):
        graph.output(f"hidden{i}", value, np.uint8, ("batch", len(product.bias)))
    return graph.model()


def run(
    model: onnx.ModelProto, level: ort.GraphOptimizationLevel, inputs: FloatArray
) -> tuple[FloatArray, float, list[np.ndarray]]:
    """Gradient, clipped fraction and hidden tensors."""
    options = session_options()
    options.graph_optimization_level = level
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    gradient, clipped, *hidden = session.run(None, {"inputs": inputs})
    return gradient, clipped, hidden


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    channels=st.integers(1, 24),
    hidden=st.lists(st.integers(1, 70), min_size=1, max_size=3),
    rows=st.integers(1, 40),
    outlier=st.sampled_from([1.0, 1.5, 1e3, 1e12]),
)
def test_onnx_runtime_computes_the_int8_sgm_bit_for_bit(
    seed: int, channels: int, hidden: list[int], rows: int, outlier: float
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, channels, *hidden)
    inputs = random_inputs(rng, sgm, rows)
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    wild = (inputs * np.where(rng.random(inputs.shape) < 0.1, outlier, 1)).astype(np.float32)
    model = int8_model(q)
    gradient, hidden_u8, clipped = integer_trace(q, wild)
    optimized = run(model, ALL, wild)
    for got, expected in zip(optimized[2], hidden_u8, strict=True):
        np.testing.assert_array_equal(got, expected)
    np.testing.assert_array_equal(optimized[0], gradient)
    assert optimized[1] == pytest.approx(clipped, abs=1e-6)


@DEPTHS
@pytest.mark.parametrize("seed", range(3))
def test_without_graph_optimizations_results_differ_by_float_rounding_only(
    seed: int, hidden: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, *hidden)
    inputs = random_inputs(rng, sgm, 64)
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    gradient, expected, _ = integer_trace(q, inputs)
    # In float a sum may round differently; a hidden value near a half then moves by one step,
    # and with it what follows by up to 127 steps of the next product.
    plain, _, got = run(int8_model(q), NONE, inputs)
    assert np.abs(got[0].astype(int) - expected[0]).max() <= 1
    moved = np.concatenate(got, axis=1) != np.concatenate(expected, axis=1)
    assert moved.mean() < 0.002
    steady = ~moved.any(axis=1)
    tolerance = 1e-5 * np.abs(gradient).max()
    np.testing.assert_allclose(plain[steady], gradient[steady], rtol=0, atol=tolerance)


@DEPTHS
def test_all_products_become_integer_operators_and_no_float_product_is_left(
    hidden: tuple[int, ...],
) -> None:
    rng = np.random.default_rng(0)
    sgm = random_sgm(rng, 16, *hidden)
    model = int8_model(quantize_sgm(sgm, seen_ranges(sgm, random_inputs(rng, sgm, 50))))
    assert integer_operators(model) == ["QGemm"] * 2 * (len(hidden) + 1)
    kinds = [node.op_type for node in optimized_nodes(model)]
    assert not {"Gemm", "MatMul", "Relu", "DequantizeLinear"} & set(kinds)
    assert kinds.count("Add") == len(hidden) + 1


@DEPTHS
@pytest.mark.parametrize("seed", range(3))
def test_int8_stays_close_to_float_whatever_the_channels_scales(
    seed: int, hidden: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, *hidden)
    inputs = random_inputs(rng, sgm, 2000)
    inputs[:, 0] *= 1e4  # one loud channel must not cost the quiet ones anything
    sgm.convs[0].weight[:, 0] *= 1e-4
    gradient, clipped = integer_forward(quantize_sgm(sgm, seen_ranges(sgm, inputs)), inputs)
    exact = float_gradient(sgm, inputs)
    noise = gradient - exact
    sqnr_db = 10 * np.log10(np.square(exact).sum() / np.square(noise).sum())
    assert sqnr_db > 36
    assert clipped == 0


@DEPTHS
@pytest.mark.parametrize("seed", range(3))
def test_rounding_the_weights_costs_next_to_nothing_beside_rounding_the_activations(
    seed: int, hidden: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, *hidden)
    inputs = random_inputs(rng, sgm, 2000)
    ranges = seen_ranges(sgm, inputs)
    q = quantize_sgm(sgm, ranges)
    coarse = [replace(product, fine=np.zeros_like(product.fine)) for product in q.products]
    exact = float_gradient(sgm, inputs)

    def lost(gradient: FloatArray) -> float:
        return float(np.square(gradient - exact).sum())

    both = lost(integer_forward(q, inputs)[0])
    alone = lost(integer_forward(replace(q, products=tuple(coarse)), inputs)[0])
    # Measured: 0.994 to 1.004 times, and 2.4 to 7.0 times (4 to 8 dB).
    assert both < 1.02 * lost(gradient_of_rounded_activations(sgm, q, ranges, inputs))
    assert alone > 10 ** (2 / 10) * both


def test_inputs_beyond_their_range_are_clipped_and_counted() -> None:
    rng = np.random.default_rng(1)
    sgm = random_sgm(rng, 2, 4)
    ranges = SgmRanges(*np.float32([[0] * 5, [1] * 5]), (np.full(4, 9, np.float32),))
    q = quantize_sgm(sgm, ranges)
    inside = np.full((1, 5), 0.5, np.float32)
    beyond, edge = inside.copy(), inside.copy()
    beyond[0, 1], beyond[0, 4], edge[0, 1], edge[0, 4] = 7, -3, 1, 0
    assert integer_forward(q, beyond)[1] == pytest.approx(2 / 5)
    assert integer_forward(q, edge)[1] == 0
    np.testing.assert_array_equal(integer_forward(q, beyond)[0], integer_forward(q, edge)[0])


def test_dead_channels_get_the_typical_range_and_are_named() -> None:
    rng = np.random.default_rng(2)
    sgm = random_sgm(rng, 3, 5)
    low = np.array([0, 0, 0, 0, -1, 1], np.float32)
    high = np.array([4, 0, 2, 1, 1, 1], np.float32)
    hidden = np.array([3, 0, 5, 4, 0], np.float32)
    q = quantize_sgm(sgm, SgmRanges(low, high, (hidden,)))
    assert q.dead_inputs == (1, 5)
    assert q.dead_hidden == ((1, 4),)
    np.testing.assert_allclose(255 / q.input_gain, [4, 2, 2, 1, 2, 2])
    # A channel that was silent in calibration is still heard when it wakes up.
    quiet, awake = np.array([[1, 0, 1, 1, 0, 1], [1, 1, 1, 1, 0, 1]], np.float32)[:, None]
    assert integer_forward(q, awake)[1] == 0
    assert not np.array_equal(integer_forward(q, awake)[0], integer_forward(q, quiet)[0])


def test_an_sgm_without_any_live_channel_still_gives_its_bias() -> None:
    rng = np.random.default_rng(3)
    sgm = random_sgm(rng, 2, 4, 3)
    zeros = np.zeros(5, np.float32)
    sgm.convs[0].bias[:] = sgm.convs[1].bias[:] = -1
    q = quantize_sgm(sgm, SgmRanges(zeros, zeros, (zeros[:4], zeros[:3])))
    assert q.dead_inputs == (0, 1, 2, 3, 4)
    assert q.dead_hidden == ((0, 1, 2, 3), (0, 1, 2))
    gradient, _ = integer_forward(q, zeros[None])
    np.testing.assert_allclose(gradient[0], sgm.convs[2].bias, rtol=0.02)


@pytest.mark.parametrize("bias", [1e9, -1e9, 1e30])
def test_a_bias_that_would_overflow_int32_gets_a_coarser_scale(bias: float) -> None:
    rng = np.random.default_rng(4)
    sgm = random_sgm(rng, 4, 8)
    inputs = random_inputs(rng, sgm, 100)
    sgm.convs[1].weight[1] *= 1e-6
    sgm.convs[1].weight[2] = 0
    sgm.convs[1].bias[1:3] = bias
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    gradient, (hidden,), _ = integer_trace(q, inputs)
    np.testing.assert_allclose(gradient[:, 1:3], bias, rtol=1e-6)
    np.testing.assert_array_equal(run(int8_model(q), ALL, inputs)[0], gradient)
    last, wide = q.products[1], hidden.astype(np.int64)
    for sums in (wide @ last.weight.T.astype(np.int64) + last.bias, wide @ last.fine.T):
        assert np.abs(sums).max() < 2**31


def test_weights_use_the_whole_signed_range_and_never_minus_128() -> None:
    rng = np.random.default_rng(5)
    sgm = random_sgm(rng, 16, 16, 12)
    q = quantize_sgm(sgm, seen_ranges(sgm, random_inputs(rng, sgm, 100)))
    for product in q.products:
        assert (np.abs(product.weight.astype(int)).max(axis=1) == 127).all()
        assert 120 < np.abs(product.fine.astype(int)).max() <= 127


@given(
    weight=arrays(
        np.float64,
        array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.floats(-1e20, 1e20),
    ),
    bias=st.floats(-1e24, 1e24),
)
@example(weight=np.array([[127, 0.5, -63.5, 1.5]]), bias=0.0)
def test_two_planes_hold_a_weight_to_a_five_hundredth_of_a_coarse_step(
    weight: np.ndarray, bias: float
) -> None:
    product = quantize_product(weight, np.full(len(weight), bias))
    scale, fine_scale = (s.astype(float)[:, None] for s in (product.scale, product.fine_scale))
    held = product.weight * scale + product.fine * fine_scale
    assert (np.abs(held - weight) <= scale / 500).all()
    for plane in (product.weight, product.fine):
        assert np.abs(plane.astype(int)).max() <= 127


def test_padded_kernels_are_refused() -> None:
    convs = [np.zeros(shape, np.float32) for shape in ((8, 11, 3, 3), (8, 8, 3, 3))]
    sgm = FoldedSgm(2, tuple(FoldedConv(weight, weight[:, 0, 0, 0]) for weight in convs))
    ones = np.ones(11, np.float32)
    with pytest.raises(QsgmError, match="behind layer 2 has a 3x3 kernel"):
        quantize_sgm(sgm, SgmRanges(0 * ones, ones, (ones[:8],)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"input_low": np.full(5, 2, np.float32)}, "low <= high"),
        ({"input_high": np.full(5, np.nan, np.float32)}, "must be finite"),
        ({"hidden_high": (np.full(4, -1, np.float32),)}, "hidden_high >= 0"),
        ({"hidden_high": (np.ones(3, np.float32),)}, r"expected 5 inputs twice and \[4\] hidden"),
        ({"hidden_high": ()}, r"expected 5 inputs twice and \[4\] hidden"),
    ],
)
def test_ranges_that_do_not_fit_are_refused(change: dict[str, Any], message: str) -> None:
    sgm = random_sgm(np.random.default_rng(6), 2, 4)
    good: dict[str, Any] = {
        "input_low": np.zeros(5, np.float32),
        "input_high": np.ones(5, np.float32),
        "hidden_high": (np.ones(4, np.float32),),
    }
    with pytest.raises(QsgmError, match=message):
        quantize_sgm(sgm, SgmRanges(**{**good, **change}))
