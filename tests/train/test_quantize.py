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
from qsgm.network import ONE, Pair, area
from qsgm.runtime import session_options
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm
from qsgm.sgm.int8 import (
    ACTIVATION_BITS,
    ActivationBits,
    QuantizedSgm,
    SgmRanges,
    integer_forward,
    integer_trace,
    quantize_product,
    quantize_sgm,
    to_u8,
    underflow_fraction,
    with_zero,
)
from qsgm.train.graphs.build import Graph
from qsgm.train.graphs.inspection import (
    integer_operators,
    optimized_nodes,
    refuse_float_products,
)
from qsgm.train.graphs.sgm import clipped_fraction, int8_sgm, scaled_inputs
from qsgm.train.graphs.sgm import underflow_fraction as underflow

ALL, NONE = ort.GraphOptimizationLevel.ORT_ENABLE_ALL, ort.GraphOptimizationLevel.ORT_DISABLE_ALL


DEPTHS = pytest.mark.parametrize("hidden", [(16,), (64, 64), (12, 20, 8)])
BITS = pytest.mark.parametrize("bits", ACTIVATION_BITS)
KERNELS = pytest.mark.parametrize(
    ("kernel", "side"), [(ONE, ONE), ((3, 3), (5, 5))], ids=["1x1", "3x3"]
)


def random_sgm(
    rng: np.random.Generator, channels: int, *hidden: int, kernel: Pair = ONE, side: Pair = ONE
) -> FoldedSgm:
    widths, convs = (channels + 3, *hidden, channels), []
    for into, out in pairwise(widths):
        weight, bias = rng.normal(size=(out, into, *kernel)), rng.normal(size=out)
        size = np.sqrt(area(kernel))
        convs.append(FoldedConv((weight / size).astype(np.float32), bias.astype(np.float32)))
    return FoldedSgm(4 if kernel == ONE else 2, side, tuple(convs))


def random_inputs(
    rng: np.random.Generator, sgm: FoldedSgm, rows: int, positions: int = 1
) -> FloatArray:
    """Activations of very different size per channel, then labels in [-1, 1] of each row."""
    channels = len(sgm.convs[-1].bias)
    spread = np.exp(rng.normal(size=channels))
    activation = spread * np.abs(rng.normal(size=(rows, positions, channels)))
    labels = rng.uniform(-1, 1, (rows, 1, 3)).repeat(positions, axis=1)
    return np.concatenate([activation, labels], axis=2).astype(np.float32)


def float_product(conv: FoldedConv, side: Pair, x: FloatArray) -> FloatArray:
    """A padded convolution of maps (N, P, I), tap by tap: (N, P, O)."""
    count, positions, _ = x.shape
    (height, width), kernel = side, conv.weight.shape[2:]
    up, left = (length // 2 for length in kernel)
    maps = np.pad(x.reshape(count, height, width, -1), ((0, 0), (up, up), (left, left), (0, 0)))
    total = np.broadcast_to(conv.bias, (count, height, width, len(conv.bias)))
    for dy, dx in np.ndindex(*kernel):
        total = total + maps[:, dy : dy + height, dx : dx + width] @ conv.weight[:, :, dy, dx].T
    return total.reshape(count, positions, -1)


def float_hidden(sgm: FoldedSgm, inputs: FloatArray) -> list[FloatArray]:
    """Every hidden tensor, behind its ReLU."""
    tensors = [inputs]
    for conv in sgm.convs[:-1]:
        tensors.append(np.maximum(float_product(conv, sgm.side, tensors[-1]), 0))
    return tensors[1:]


def float_gradient(sgm: FoldedSgm, inputs: FloatArray) -> FloatArray:
    return float_product(sgm.convs[-1], sgm.side, [inputs, *float_hidden(sgm, inputs)][-1])


def seen_ranges(sgm: FoldedSgm, inputs: FloatArray) -> SgmRanges:
    hidden = tuple(tensor.max(axis=(0, 1)) for tensor in float_hidden(sgm, inputs))
    return SgmRanges(inputs.min(axis=(0, 1)), inputs.max(axis=(0, 1)), hidden)


def gradient_of_rounded_activations(
    sgm: FoldedSgm, q: QuantizedSgm, ranges: SgmRanges, inputs: FloatArray
) -> FloatArray:
    """Inputs and hidden tensors rounded as the 8 bit SGM does, the weights left as they are."""
    x = q.input_low + to_u8((inputs - q.input_low) * q.input_gain) / q.input_gain
    for conv, high in zip(sgm.convs, ranges.hidden_high, strict=False):
        step = np.where(high > 0, high, 1) / 255
        x = step * to_u8(float_product(conv, sgm.side, x) / step)
    return float_product(sgm.convs[-1], sgm.side, x)


def int8_model(q: QuantizedSgm) -> onnx.ModelProto:
    """Inputs to gradient, clipped fraction and the hidden tensors' planes."""
    inputs, channels, positions = len(q.input_low), len(q.products[-1].bias), area(q.side)
    graph = Graph("int8")
    op = graph.within("layer2")
    maps = graph.input("inputs", np.float32, ("batch", positions, inputs))
    seen, shape = op.Reshape(maps, op.shape(-1, inputs)), (positions, channels)
    gradient = op.Reshape(int8_sgm(op, q, seen), op.shape(-1, *shape))
    graph.output("gradient", gradient, np.float32, ("batch", *shape))
    clipped = clipped_fraction(op, q, scaled_inputs(op, q, seen))
    graph.output("clipped", clipped, np.float32, ())
    graph.output("underflow", underflow(op, q, seen), np.float32, ())
    rounded = [node.output[0] for node in graph.nodes if node.op_type == "QuantizeLinear"]
    planes = q.bits // 8
    widths = [len(product.bias) for product in q.products[:-1] for _ in range(planes)]
    for i, (value, width) in enumerate(zip(rounded[planes:], widths, strict=True)):
        graph.output(f"hidden{i}", value, np.uint8, ("positions", width))
    return graph.model()


def run(
    model: onnx.ModelProto, level: ort.GraphOptimizationLevel, inputs: FloatArray
) -> tuple[FloatArray, float, list[np.ndarray]]:
    """Gradient, clipped fraction and hidden planes."""
    options = session_options()
    options.graph_optimization_level = level
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    gradient, clipped, _, *hidden = session.run(None, {"inputs": inputs})
    return gradient, clipped, [u8.reshape(*inputs.shape[:2], -1) for u8 in hidden]


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    channels=st.integers(1, 24),
    hidden=st.lists(st.integers(1, 70), min_size=1, max_size=3),
    rows=st.integers(1, 40),
    kernel_and_side=st.sampled_from(
        [
            (ONE, ONE),
            ((3, 3), ONE),
            ((3, 3), (2, 2)),
            ((3, 3), (7, 7)),
            ((3, 3), (2, 5)),
            ((3, 3), (4, 1)),
            ((1, 3), (1, 9)),
            ((3, 1), (6, 1)),
        ]
    ),
    bits=st.sampled_from(ACTIVATION_BITS),
    outlier=st.sampled_from([1.0, 1.5, 1e3, 1e12]),
)
def test_onnx_runtime_computes_the_int8_sgm_bit_for_bit(
    seed: int,
    channels: int,
    hidden: list[int],
    rows: int,
    kernel_and_side: tuple[Pair, Pair],
    bits: ActivationBits,
    outlier: float,
) -> None:
    rng, (kernel, side) = np.random.default_rng(seed), kernel_and_side
    sgm = random_sgm(rng, channels, *hidden, kernel=kernel, side=side)
    inputs = random_inputs(rng, sgm, rows, area(side))
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs), bits)
    wild = (inputs * np.where(rng.random(inputs.shape) < 0.1, outlier, 1)).astype(np.float32)
    model = int8_model(q)
    gradient, hidden_u8, clipped = integer_trace(q, wild)
    optimized = run(model, ALL, wild)
    for got, expected in zip(optimized[2], [u8 for both in hidden_u8 for u8 in both], strict=True):
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
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs), 8)
    gradient, expected, _ = integer_trace(q, inputs)
    # In float a sum may round differently; a hidden value near a half then moves by one step,
    # and with it what follows by up to 127 steps of the next product.
    plain, _, got = run(int8_model(q), NONE, inputs)
    assert np.abs(got[0].astype(int) - expected[0][0]).max() <= 1
    moved = np.concatenate(got, axis=2) != np.concatenate([u8 for (u8,) in expected], axis=2)
    assert moved.mean() < 0.002
    steady = ~moved.any(axis=2)
    tolerance = 1e-5 * np.abs(gradient).max()
    np.testing.assert_allclose(plain[steady], gradient[steady], rtol=0, atol=tolerance)


@DEPTHS
@pytest.mark.parametrize("seed", range(3))
def test_without_graph_optimizations_16_bit_gradients_stay_the_same_to_a_ten_thousandth(
    seed: int, hidden: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, *hidden)
    inputs = random_inputs(rng, sgm, 64)
    q = quantize_sgm(sgm, seen_ranges(sgm, inputs))
    plain, _, _ = run(int8_model(q), NONE, inputs)
    gradient, _ = integer_forward(q, inputs)
    np.testing.assert_allclose(plain, gradient, rtol=0, atol=1e-4 * np.abs(gradient).max())


@BITS
@DEPTHS
@KERNELS
def test_all_products_become_integer_operators_and_no_float_product_is_left(
    hidden: tuple[int, ...], kernel: Pair, side: Pair, bits: ActivationBits
) -> None:
    rng = np.random.default_rng(0)
    sgm = random_sgm(rng, 16, *hidden, kernel=kernel, side=side)
    inputs = random_inputs(rng, sgm, 50, area(side))
    model = int8_model(quantize_sgm(sgm, seen_ranges(sgm, inputs), bits))
    assert integer_operators(model) == ["QGemm"] * 2 * (len(hidden) + 1)
    refuse_float_products("one SGM", model)
    kinds = [node.op_type for node in optimized_nodes(model)]
    assert not {"Gemm", "MatMul", "Conv", "Relu"} & set(kinds)
    assert kinds.count("Add") == len(hidden) + 1
    # Each tensor's low plane is what its high plane leaves.
    assert kinds.count("DequantizeLinear") == (len(hidden) + 1 if bits == 16 else 0)


@DEPTHS
@KERNELS
@pytest.mark.parametrize(("bits", "least_sqnr_db"), [(8, 38), (16, 55)])
def test_int8_stays_close_to_float_whatever_the_channels_scales(
    bits: ActivationBits,
    least_sqnr_db: float,
    hidden: tuple[int, ...],
    kernel: Pair,
    side: Pair,
) -> None:
    # On average: of one random SGM the gradient is a small difference of large terms, of another
    # it is not, and the ratio of one is 10 dB from another's (a standard deviation of 1 to 2.7).
    ratios = [
        sqnr_db_with_a_loud_channel(1e4, seed, bits, hidden, kernel, side) for seed in range(25)
    ]
    assert np.mean(ratios) > least_sqnr_db


@BITS
@DEPTHS
@KERNELS
@pytest.mark.parametrize("seed", range(3))
def test_how_loud_a_channel_is_costs_the_others_nothing(
    seed: int, bits: ActivationBits, hidden: tuple[int, ...], kernel: Pair, side: Pair
) -> None:
    # Both times it is the loudest: what the typical channel is, does not change.
    loud, louder = (
        sqnr_db_with_a_loud_channel(loudness, seed, bits, hidden, kernel, side)
        for loudness in (1e2, 1e4)
    )
    assert louder == pytest.approx(loud, abs=0.1)


def sqnr_db_with_a_loud_channel(
    loudness: float,
    seed: int,
    bits: ActivationBits,
    hidden: tuple[int, ...],
    kernel: Pair,
    side: Pair,
) -> float:
    """Of a random SGM, one of whose channels is so many times louder and weighs as much less."""
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, *hidden, kernel=kernel, side=side)
    inputs = random_inputs(rng, sgm, 600 // area(side), area(side))
    inputs[:, :, 0] *= loudness
    sgm.convs[0].weight[:, 0] /= loudness
    gradient, clipped = integer_forward(quantize_sgm(sgm, seen_ranges(sgm, inputs), bits), inputs)
    assert clipped == 0
    exact = float_gradient(sgm, inputs)
    return float(10 * np.log10(np.square(exact).sum() / np.square(gradient - exact).sum()))


@DEPTHS
@pytest.mark.parametrize("seed", range(3))
def test_rounding_the_weights_costs_next_to_nothing_beside_rounding_the_activations(
    seed: int, hidden: tuple[int, ...]
) -> None:
    rng = np.random.default_rng(seed)
    sgm = random_sgm(rng, 16, *hidden)
    inputs = random_inputs(rng, sgm, 2000)
    ranges = seen_ranges(sgm, inputs)
    q = quantize_sgm(sgm, ranges, 8)
    coarse = [replace(product, fine=np.zeros_like(product.fine)) for product in q.products]
    exact = float_gradient(sgm, inputs)

    def lost(gradient: FloatArray) -> float:
        return float(np.square(gradient - exact).sum())

    both = lost(integer_forward(q, inputs)[0])
    alone = lost(integer_forward(replace(q, products=tuple(coarse)), inputs)[0])
    # Measured: 0.994 to 1.004 times, and 2.4 to 7.0 times (4 to 8 dB).
    assert both < 1.02 * lost(gradient_of_rounded_activations(sgm, q, ranges, inputs))
    assert alone > 10 ** (2 / 10) * both


@pytest.mark.parametrize(("bits", "edge_of_range"), [(8, 1), (16, 8)])
def test_inputs_beyond_their_range_are_clipped_and_counted(
    bits: ActivationBits, edge_of_range: float
) -> None:
    rng = np.random.default_rng(1)
    sgm = random_sgm(rng, 2, 4)
    ranges = SgmRanges(*np.float32([[0] * 5, [1] * 5]), (np.full(4, 9, np.float32),))
    q = quantize_sgm(sgm, ranges, bits)
    inside = np.full((1, 1, 5), 0.5, np.float32)
    beyond, edge = inside.copy(), inside.copy()
    beyond[..., 1], beyond[..., 4] = 7 * edge_of_range, -3
    edge[..., 1], edge[..., 4] = edge_of_range, 0
    assert integer_forward(q, beyond)[1] == pytest.approx(2 / 5)
    assert integer_forward(q, edge)[1] == 0
    np.testing.assert_array_equal(integer_forward(q, beyond)[0], integer_forward(q, edge)[0])


@BITS
def test_inputs_too_small_for_a_step_are_counted(bits: ActivationBits) -> None:
    rng = np.random.default_rng(1)
    sgm = random_sgm(rng, 2, 4)
    ranges = SgmRanges(*np.float32([[0] * 5, [1] * 5]), (np.full(4, 9, np.float32),))
    q = quantize_sgm(sgm, ranges, bits)
    step = 1 / float(q.input_gain[0])
    inputs = np.float32([[[0, 0.4 * step, 0, 1, 0]], [[0.6 * step, 0.1 * step, 0, 1, 0]]])
    assert underflow_fraction(q, inputs) == pytest.approx(2 / 5)  # of those other than 0
    assert underflow_fraction(q, 0 * inputs) == 0
    options = session_options()
    model = int8_model(q).SerializeToString()
    session = ort.InferenceSession(model, options, ["CPUExecutionProvider"])
    assert session.run(["underflow"], {"inputs": inputs})[0] == pytest.approx(2 / 5)
    assert session.run(["underflow"], {"inputs": 0 * inputs})[0] == 0


def test_dead_channels_get_the_typical_range_and_are_named() -> None:
    rng = np.random.default_rng(2)
    sgm = random_sgm(rng, 3, 5)
    low = np.array([0, 0, 0, 0, -1, 1], np.float32)
    high = np.array([4, 0, 2, 1, 1, 1], np.float32)
    hidden = np.array([3, 0, 5, 4, 0], np.float32)
    ranges = SgmRanges(low, high, (hidden,))
    q = quantize_sgm(sgm, ranges, 8)
    assert q.dead_inputs == (1, 5)
    assert q.dead_hidden == ((1, 4),)
    np.testing.assert_allclose(255 / q.input_gain, [4, 2, 2, 1, 2, 2])
    # With codes to spare no activation has less than the typical one, times eight.
    wide = quantize_sgm(sgm, ranges)
    np.testing.assert_allclose(65535 / wide.input_gain, [32, 24, 24, 1, 2, 24])
    # A channel that was silent in calibration is still heard when it wakes up.
    quiet, awake = np.array([[1, 0, 1, 1, 0, 1], [1, 1, 1, 1, 0, 1]], np.float32)[:, None, None]
    assert integer_forward(q, awake)[1] == 0
    assert not np.array_equal(integer_forward(q, awake)[0], integer_forward(q, quiet)[0])


def test_an_sgm_without_any_live_channel_still_gives_its_bias() -> None:
    rng = np.random.default_rng(3)
    sgm = random_sgm(rng, 2, 4, 3)
    zeros = np.zeros(5, np.float32)
    sgm.convs[0].bias[:] = sgm.convs[1].bias[:] = -1
    q = quantize_sgm(sgm, SgmRanges(zeros, zeros, (zeros[:4], zeros[:3])), 8)
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
    gradient, ((high, low),), _ = integer_trace(q, inputs)
    np.testing.assert_allclose(gradient[..., 1:3], bias, rtol=1e-6)
    np.testing.assert_array_equal(run(int8_model(q), ALL, inputs)[0], gradient)
    last, coarse, fine = q.products[1], *(plane.astype(np.int64) for plane in (high, low))
    rest = coarse @ last.fine.T.astype(np.int64) + fine @ last.coarse.T + last.bias
    for sums in (coarse @ last.coarse.T, rest):
        assert np.abs(sums).max() < 2**31


def test_weights_use_the_whole_signed_range() -> None:
    rng = np.random.default_rng(5)
    sgm = random_sgm(rng, 16, 16, 12)
    q = quantize_sgm(sgm, seen_ranges(sgm, random_inputs(rng, sgm, 100)))
    for product in q.products:
        assert (np.abs(product.coarse.astype(int)).max(axis=1) == 127).all()
        assert (product.fine.min(), product.fine.max()) < (-120, 120)


@given(
    weight=arrays(
        np.float64,
        array_shapes(min_dims=2, max_dims=2, max_side=12),
        elements=st.floats(-1e20, 1e20),
    ),
    bias=st.floats(-1e24, 1e24),
)
@example(weight=np.array([[127, 0.5, -63.5, 1.5]]), bias=0.0)
def test_two_planes_hold_a_weight_to_half_a_step_of_the_fine_one(
    weight: np.ndarray, bias: float
) -> None:
    product = quantize_product(weight, np.full(len(weight), bias))
    scale, coarse_scale = (s.astype(float)[:, None] for s in (product.scale, product.coarse_scale))
    held = product.coarse * coarse_scale + product.fine * scale
    assert (np.abs(held - weight) <= 0.501 * scale).all()


@given(
    low=st.floats(-1e6, 1e6, width=32),
    span=st.floats(1e-3, 1e6),
    top=st.sampled_from([255, 65535]),
)
@example(low=-1.0, span=2.0, top=255)
@example(low=-1.0, span=2.0, top=65535)
@example(low=-1e-6, span=1.0, top=255)
def test_zero_has_an_exact_code_in_a_range_that_covers_the_given_one(
    low: float, span: float, top: int
) -> None:
    got_low, got_span = with_zero(np.array([low], np.float32), np.array([span]), top)
    code = -got_low[0] * top / got_span[0]
    assert code == pytest.approx(round(code), rel=1e-6, abs=1e-4)
    step = got_span[0] / top
    assert got_low[0] <= low + step  # within a step: where `low` is next to zero, it becomes zero
    assert got_low[0] + got_span[0] >= (np.float32(low) + span) * (1 - 1e-6)
    if low == -1:
        assert (code, top / got_span[0]) == pytest.approx((top // 2, top // 2))


def test_what_lies_around_a_map_is_zero_to_the_last_digit() -> None:
    # Weights that only see the frame: any code but that of zero would show.
    sgm = random_sgm(np.random.default_rng(8), 2, 4, kernel=(3, 3))
    low, high = np.array([0.5, 0, 0, -1, -1]), np.array([3, 2, 1, 1, 1])
    sgm.convs[0].weight[:] = 0
    sgm.convs[0].weight[:, :, 0, 0] = 1
    sgm.convs[0].bias[:] = 2
    hidden_high = np.full(4, 2.55, np.float32)  # a step is 0.01
    ranges = SgmRanges(low.astype(np.float32), high.astype(np.float32), (hidden_high,))
    q = quantize_sgm(sgm, ranges, 8)
    assert q.input_low[0] == 0
    np.testing.assert_array_equal(q.input_gain[3:], 127)
    inputs = np.random.default_rng(9).uniform(low, high, (3, 1, 5)).astype(np.float32)
    _, ((hidden,),), _ = integer_trace(q, inputs)
    np.testing.assert_array_equal(hidden, 200)


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
