"""The int8 SGM: ONNX Runtime against integer arithmetic in numpy, and that against float."""

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qsgm import QsgmError
from qsgm.train.fold import FloatArray, FoldedSgm
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.inspection import integer_operators, optimized_nodes
from qsgm.train.graphs.sgm import clipped_fraction, int8_sgm, scaled_inputs
from qsgm.train.quantize import (
    QuantizedSgm,
    SgmRanges,
    integer_forward,
    integer_trace,
    quantize_sgm,
)

ALL, NONE = ort.GraphOptimizationLevel.ORT_ENABLE_ALL, ort.GraphOptimizationLevel.ORT_DISABLE_ALL


def random_sgm(rng: np.random.Generator, channels: int, hidden: int, extra: int = 3) -> FoldedSgm:
    inputs = channels + extra
    return FoldedSgm(
        4,
        rng.normal(size=(hidden, inputs, 1, 1)).astype(np.float32),
        rng.normal(size=hidden).astype(np.float32),
        rng.normal(size=(channels, hidden, 1, 1)).astype(np.float32),
        rng.normal(size=channels).astype(np.float32),
    )


def random_inputs(rng: np.random.Generator, sgm: FoldedSgm, rows: int) -> FloatArray:
    """Activations of very different size per channel, then extras in [-1, 1]."""
    channels = len(sgm.conv2_bias)
    activation = np.exp(rng.normal(size=channels)) * np.abs(rng.normal(size=(rows, channels)))
    extra = rng.uniform(-1, 1, (rows, sgm.extra_channels))
    return np.concatenate([activation, extra], axis=1).astype(np.float32)


def float_hidden(sgm: FoldedSgm, inputs: FloatArray) -> FloatArray:
    return np.maximum(inputs @ sgm.conv1_weight[:, :, 0, 0].T + sgm.conv1_bias, 0)


def float_gradient(sgm: FoldedSgm, inputs: FloatArray) -> FloatArray:
    return float_hidden(sgm, inputs) @ sgm.conv2_weight[:, :, 0, 0].T + sgm.conv2_bias


def seen_ranges(sgm: FoldedSgm, inputs: FloatArray) -> SgmRanges:
    hidden = float_hidden(sgm, inputs).max(axis=0)
    return SgmRanges(inputs.min(axis=0), inputs.max(axis=0), hidden)


def int8_model(q: QuantizedSgm) -> onnx.ModelProto:
    """Inputs to gradient, clipped fraction and the u8 hidden tensor."""
    (channels, _), (hidden, inputs) = q.second.weight.shape, q.first.weight.shape
    graph = Graph("int8")
    op = graph.within("sgm")
    scaled = scaled_inputs(op, q, graph.input("inputs", np.float32, ("batch", inputs)))
    graph.output("gradient", int8_sgm(op, q, scaled), np.float32, ("batch", channels))
    graph.output("clipped", clipped_fraction(op, scaled), np.float32, ())
    rounded = [node.output[0] for node in graph.nodes if node.op_type == "QuantizeLinear"]
    graph.output("hidden", rounded[1], np.uint8, ("batch", hidden))
    return graph.model()


def run(
    model: onnx.ModelProto, level: ort.GraphOptimizationLevel, inputs: FloatArray
) -> list[np.ndarray]:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.graph_optimization_level = level
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    return session.run(["gradient", "hidden", "clipped"], {"inputs": inputs})


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    channels=st.integers(1, 24),
    hidden=st.integers(1, 70),
    extra=st.sampled_from([3, 6]),
    rows=st.integers(1, 40),
    outlier=st.sampled_from([1.0, 1.5, 1e3, 1e12]),
)
def test_onnx_runtime_computes_the_int8_sgm_bit_for_bit(
    seed: int, channels: int, hidden: int, extra: int, rows: int, outlier: float
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, channels, hidden, extra)
    inputs = random_inputs(rng, sgm, rows)
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    wild = (inputs * np.where(rng.random(inputs.shape) < 0.1, outlier, 1)).astype(np.float32)
    model = int8_model(q)
    gradient, hidden_u8, clipped = integer_trace(q, wild)
    optimized = run(model, ALL, wild)
    np.testing.assert_array_equal(optimized[1], hidden_u8)
    np.testing.assert_array_equal(optimized[0], gradient)
    assert optimized[2] == pytest.approx(clipped, abs=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_without_graph_optimizations_results_differ_by_float_rounding_only(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, 32)
    inputs = random_inputs(rng, sgm, 64)
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    gradient, hidden, _ = integer_trace(q, inputs)
    # In float a sum may round differently; a hidden value near a half then moves by one step,
    # and with it the gradient by up to 127 steps of the second product.
    plain = run(int8_model(q), NONE, inputs)
    moved = plain[1] != hidden
    assert np.abs(plain[1].astype(int) - hidden).max() <= 1
    assert moved.mean() < 0.001
    steady = ~moved.any(axis=1)
    tolerance = 1e-5 * np.abs(gradient).max()
    np.testing.assert_allclose(plain[0][steady], gradient[steady], rtol=0, atol=tolerance)


def test_both_products_become_integer_operators_and_no_float_product_is_left() -> None:
    rng = np.random.default_rng(0)
    sgm = random_sgm(rng, 16, 32)
    model = int8_model(quantize_sgm(sgm, seen_ranges(sgm, random_inputs(rng, sgm, 50))))
    assert integer_operators(model) == ["QGemm", "QGemm"]
    kinds = [node.op_type for node in optimized_nodes(model)]
    assert not {"Gemm", "MatMul", "Relu", "DequantizeLinear"} & set(kinds)


@pytest.mark.parametrize("seed", range(5))
def test_int8_stays_close_to_float_whatever_the_channels_scales(seed: int) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, 32)
    inputs = random_inputs(rng, sgm, 2000)
    inputs[:, 0] *= 1e4  # one loud channel must not cost the quiet ones anything
    sgm.conv1_weight[:, 0] *= 1e-4
    gradient, clipped = integer_forward(quantize_sgm(sgm, seen_ranges(sgm, inputs)), inputs)
    exact = float_gradient(sgm, inputs)
    noise = gradient - exact
    sqnr_db = 10 * np.log10(np.square(exact).sum() / np.square(noise).sum())
    assert sqnr_db > 35
    assert clipped == 0


def test_inputs_beyond_their_range_are_clipped_and_counted() -> None:
    rng = np.random.default_rng(1)
    sgm = random_sgm(rng, 2, 4)
    ranges = SgmRanges(np.zeros(5, np.float32), np.ones(5, np.float32), np.full(4, 9, np.float32))
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
    q = quantize_sgm(sgm, SgmRanges(low, high, hidden))
    assert q.dead_inputs == (1, 5)
    assert q.dead_hidden == (1, 4)
    np.testing.assert_allclose(255 / q.input_gain, [4, 2, 2, 1, 2, 2])
    # A channel that was silent in calibration is still heard when it wakes up.
    quiet, awake = np.array([[1, 0, 1, 1, 0, 1], [1, 1, 1, 1, 0, 1]], np.float32)[:, None]
    assert integer_forward(q, awake)[1] == 0
    assert not np.array_equal(integer_forward(q, awake)[0], integer_forward(q, quiet)[0])


def test_an_sgm_without_any_live_channel_still_gives_its_bias() -> None:
    rng = np.random.default_rng(3)
    sgm = random_sgm(rng, 2, 4)
    zeros = np.zeros(5, np.float32)
    sgm.conv1_bias[:] = -1
    q = quantize_sgm(sgm, SgmRanges(zeros, zeros, np.zeros(4, np.float32)))
    assert q.dead_inputs == (0, 1, 2, 3, 4)
    assert q.dead_hidden == (0, 1, 2, 3)
    gradient, _ = integer_forward(q, zeros[None])
    np.testing.assert_allclose(gradient[0], sgm.conv2_bias, rtol=0.02)


@pytest.mark.parametrize("bias", [1e9, -1e9, 1e30])
def test_a_bias_that_would_overflow_int32_gets_a_coarser_scale(bias: float) -> None:
    rng = np.random.default_rng(4)
    sgm = random_sgm(rng, 4, 8)
    inputs = random_inputs(rng, sgm, 100)
    sgm.conv2_weight[1] *= 1e-6
    sgm.conv2_weight[2] = 0
    sgm.conv2_bias[1:3] = bias
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    gradient, hidden, _ = integer_trace(q, inputs)
    np.testing.assert_allclose(gradient[:, 1:3], bias, rtol=1e-6)
    np.testing.assert_array_equal(run(int8_model(q), ALL, inputs)[0], gradient)
    sums = hidden.astype(np.int64) @ q.second.weight.T.astype(np.int64) + q.second.bias
    assert np.abs(sums).max() < 2**31


def test_weights_use_the_whole_signed_range_and_never_minus_128() -> None:
    rng = np.random.default_rng(5)
    sgm = random_sgm(rng, 16, 16)
    q = quantize_sgm(sgm, seen_ranges(sgm, random_inputs(rng, sgm, 100)))
    for product in (q.first, q.second):
        assert (np.abs(product.weight.astype(int)).max(axis=1) == 127).all()


def test_padded_kernels_are_refused() -> None:
    weight = np.zeros((8, 11, 3, 3), np.float32)
    back = np.zeros((8, 8, 3, 3), np.float32)
    sgm = FoldedSgm(2, weight, weight[:, 0, 0, 0], back, back[:, 0, 0, 0])
    ones = np.ones(11, np.float32)
    with pytest.raises(QsgmError, match="behind layer 2 has a 3x3 kernel"):
        quantize_sgm(sgm, SgmRanges(0 * ones, ones, ones[:8]))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"input_low": np.full(5, 2, np.float32)}, "low <= high"),
        ({"input_high": np.full(5, np.nan, np.float32)}, "must be finite"),
        ({"hidden_high": np.full(4, -1, np.float32)}, "hidden_high >= 0"),
        ({"hidden_high": np.ones(3, np.float32)}, "expected 5 inputs twice and 4 hidden"),
    ],
)
def test_ranges_that_do_not_fit_are_refused(change: dict[str, FloatArray], message: str) -> None:
    sgm = random_sgm(np.random.default_rng(6), 2, 4)
    good = {
        "input_low": np.zeros(5, np.float32),
        "input_high": np.ones(5, np.float32),
        "hidden_high": np.ones(4, np.float32),
    }
    with pytest.raises(QsgmError, match=message):
        quantize_sgm(sgm, SgmRanges(**{**good, **change}))
