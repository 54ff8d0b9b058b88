"""The fidelity metrics on gradients whose relation is known."""

from dataclasses import asdict

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from torch.nn import functional as F

from qsgm.fidelity import (
    PROBED,
    Gradients,
    LayerFidelity,
    angle_between_deg,
    compare,
    compare_probe,
    cosine,
    mean_cosine,
    mean_over_run,
    sqnr_db,
    weighted_error,
)
from qsgm.grasp.network import GRASPNET
from qsgm.train.model.local import LayerState, columns, layer_forward
from qsgm.train.quantization.sgm_fidelity import update_from

RNG = np.random.default_rng(0)
GRADIENT = RNG.normal(size=(32, 16)).astype(np.float32)
NOTHING = np.zeros_like(GRADIENT)
BATCHES = arrays.arrays(
    np.float32, (5, 3, 2), elements=st.floats(-100, 100, width=32, allow_subnormal=False)
)


def fidelity_of(int8: NDArray, floating: NDArray, true: NDArray) -> LayerFidelity:
    """Where the updates are the gradients themselves."""
    return compare(Gradients(int8, floating, true), Gradients(int8, floating, true), 0.0, 0.0)


def test_equal_gradients_are_perfect() -> None:
    same = asdict(fidelity_of(GRADIENT, GRADIENT, GRADIENT))
    perfect = {key: 1.0 for key in same if key.startswith(("cos", "norm", "sign"))}
    perfect |= {"sqnr_db": 200.0}
    none = (
        *("weighted_error", "direction_deviation_deg", "clipped_fraction", "underflow_fraction"),
    )
    assert same == pytest.approx(perfect | dict.fromkeys(none, 0.0), abs=1e-12)


def test_the_cosine_sees_direction_only() -> None:
    assert cosine(GRADIENT, 3 * GRADIENT) == pytest.approx(1)
    assert cosine(GRADIENT, -0.1 * GRADIENT) == pytest.approx(-1)
    assert cosine(np.array([[1, 0]], np.float32), np.array([[0, 2]], np.float32)) == 0


@pytest.mark.parametrize("size", [1e-6, 1e3])
def test_gradients_of_any_size_are_compared_alike(size: float) -> None:
    quantized = GRADIENT + RNG.normal(scale=0.1, size=GRADIENT.shape).astype(np.float32)
    usual = asdict(fidelity_of(quantized, GRADIENT, 2 * GRADIENT))
    scale = np.float32(size)
    other = fidelity_of(scale * quantized, scale * GRADIENT, 2 * scale * GRADIENT)
    assert asdict(other) == pytest.approx(usual, rel=1e-4)
    assert usual["norm_ratio_int8_true"] == pytest.approx(0.5, abs=0.02)


def test_a_vanishing_gradient_gives_zeros_not_nan() -> None:
    values = fidelity_of(GRADIENT, NOTHING, NOTHING)
    assert values.cos_int8_true == values.norm_ratio_int8_true == values.weighted_error == 0
    assert values.cos_sample_int8_true == values.cos_update_int8_true == 0
    assert values.direction_deviation_deg == 90
    assert np.isfinite(values.sqnr_db)


@given(BATCHES, BATCHES)
def test_a_samples_cosine_is_torchs_and_samples_without_a_reference_do_not_count(
    a: NDArray[np.float32], reference: NDArray[np.float32]
) -> None:
    reference[2] = 0
    x, y = (torch.from_numpy(batch).double().flatten(1) for batch in (a, reference))
    there = y.abs().sum(dim=1) > 0
    expected = F.cosine_similarity(x, y, eps=0)[there].nan_to_num()
    mean = float(expected.mean()) if there.any() else 0.0
    assert mean_cosine(a, reference) == pytest.approx(mean, abs=1e-9)


def test_a_sample_counts_as_much_as_any_other_however_small() -> None:
    large, small = 1000 * GRADIENT[:1], GRADIENT[1:2]
    reference, other = np.concatenate([large, small]), np.concatenate([large, -small])
    assert cosine(other, reference) == pytest.approx(1, abs=1e-5)
    assert mean_cosine(other, reference) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("slope", [1e-12, 1e-9, 1e-4, 0.3, 1.0, 50.0])
def test_the_angle_is_right_to_the_last_digits_however_small(slope: float) -> None:
    along, turned = np.array([[3.0, 0.0]]), np.array([[2.0, 2 * slope]])
    expected = np.degrees(np.arctan(slope))
    assert angle_between_deg(turned, along) == pytest.approx(expected, rel=1e-12)
    assert angle_between_deg(-turned, along) == pytest.approx(180 - expected, rel=1e-12)


@given(BATCHES, BATCHES)
def test_the_angle_is_the_arccosine_of_the_cosine(
    a: NDArray[np.float32], b: NDArray[np.float32]
) -> None:
    expected = np.degrees(np.arccos(np.clip(cosine(a, b), -1, 1)))
    assert angle_between_deg(a, b) == pytest.approx(expected, abs=1e-5)


def test_the_weighted_error_is_a_mean_of_relative_errors_weighted_by_squares() -> None:
    other = GRADIENT + 0.1 * RNG.normal(size=GRADIENT.shape).astype(np.float32)
    relative = np.abs(other / GRADIENT - 1)
    expected = np.average(relative, weights=GRADIENT.astype(np.float64) ** 2)
    assert weighted_error(other, GRADIENT) == pytest.approx(expected, rel=1e-5)
    assert weighted_error(0.9 * GRADIENT, GRADIENT) == pytest.approx(0.1, rel=1e-5)


def test_the_update_is_compared_on_its_own() -> None:
    rng = np.random.default_rng(1)
    update = Gradients(*(rng.normal(size=(4, 10)).astype(np.float32) for _ in range(3)))
    values = compare(Gradients(GRADIENT, GRADIENT, GRADIENT), update, 0.0, 0.0)
    found = values.cos_update_int8_float, values.cos_update_int8_true, values.cos_update_float_true
    pairs = ((update.int8, update.floating), (update.int8, update.true))
    for cos, (a, b) in zip(found, (*pairs, (update.floating, update.true)), strict=True):
        correlation = np.corrcoef([[*a.flat, *(-a).flat], [*b.flat, *(-b).flat]])  # mean 0
        assert cos == pytest.approx(correlation[0, 1])
    assert values.cos_int8_true == pytest.approx(1)


def test_the_norm_ratio_is_int8_over_true() -> None:
    values = fidelity_of(GRADIENT, GRADIENT, 4 * GRADIENT)
    assert values.norm_ratio_int8_true == pytest.approx(0.25)


def test_signs_are_compared_component_by_component() -> None:
    flipped = GRADIENT.copy()
    flipped[:8] *= -1
    assert fidelity_of(flipped, GRADIENT, GRADIENT).sign_agreement_int8_float == 0.75


def test_an_error_of_a_tenth_is_twenty_decibel() -> None:
    assert sqnr_db(1.1 * GRADIENT, GRADIENT) == pytest.approx(20, abs=1e-3)


def test_the_mean_over_a_run_is_taken_metric_by_metric() -> None:
    count = len(LayerFidelity.__dataclass_fields__)
    first, second = RNG.normal(size=(2, count))
    mean = mean_over_run([LayerFidelity(*first), LayerFidelity(*second)])
    assert list(asdict(mean).values()) == pytest.approx((first + second) / 2)


def test_a_probes_outputs_are_sorted_into_layers() -> None:
    outputs = {
        f"{start}{kind}{k}": sign * GRADIENT
        for k in (4, 5)
        for start, of in (("", 4), ("update_", 5))
        for kind, sign in (("int8", 1), ("float", 1), ("true", 1 if k == of else -1))
    }
    outputs |= {"clipped4": np.float32(0.25), "clipped5": np.float32(0)}
    outputs |= {"underflow4": np.float32(0), "underflow5": np.float32(0.5)}
    assert set(outputs) == {f"{kind}{k}" for kind in PROBED for k in (4, 5)}
    layers = compare_probe(outputs, (4, 5))
    assert layers[4].cos_int8_true == layers[5].cos_update_int8_true == pytest.approx(1)
    assert layers[5].cos_int8_true == layers[4].cos_update_int8_true == pytest.approx(-1)
    assert (layers[4].clipped_fraction, layers[5].clipped_fraction) == (0.25, 0)
    assert (layers[4].underflow_fraction, layers[5].underflow_fraction) == (0, 0.5)


@pytest.mark.parametrize("layer", [3, 4, 5])
def test_on_the_host_an_update_is_what_autograd_gives_with_that_gradient_behind_the_layer(
    layer: int,
) -> None:
    torch.manual_seed(layer)
    positions, width = {3: (29**2, 8 * 25), 4: (13**2, 16 * 25), 5: (1, 16)}[layer]
    state = LayerState.start(torch.randn(1, width, 16) / 9, torch.randn(1, 16))
    for part in (state.weight, state.bias):
        part.requires_grad_()
    windows = columns(GRASPNET, layer, torch.randn(1, 6, positions, 8 if layer == 3 else 16))
    before, after = layer_forward(GRASPNET, layer, state, windows)
    gradient = torch.randn(after.shape)
    expected = torch.autograd.grad((after * gradient).sum() / 6, [state.weight, state.bias])
    found = update_from(GRASPNET, layer, windows, before.detach(), gradient[0].numpy())
    flat = torch.cat([part.flatten() for part in expected]).numpy()
    np.testing.assert_allclose(found, flat, atol=1e-4 * np.abs(flat).max())
