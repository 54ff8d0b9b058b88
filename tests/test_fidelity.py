"""The fidelity metrics on gradients whose relation is known."""

import numpy as np
import pytest

from qsgm.fidelity import LayerFidelity, compare, compare_probe, cosine, mean_over_run, sqnr_db

RNG = np.random.default_rng(0)
GRADIENT = RNG.normal(size=(32, 16)).astype(np.float32)


def test_equal_gradients_are_perfect() -> None:
    same = compare(GRADIENT, GRADIENT, GRADIENT, 0.0)
    assert same.cos_int8_float == pytest.approx(1)
    assert same.cos_int8_true == pytest.approx(1)
    assert same.norm_ratio_int8_true == pytest.approx(1)
    assert same.sign_agreement_int8_float == 1
    assert same.sqnr_db == 200


def test_the_cosine_sees_direction_only() -> None:
    assert cosine(GRADIENT, 3 * GRADIENT) == pytest.approx(1)
    assert cosine(GRADIENT, -0.1 * GRADIENT) == pytest.approx(-1)
    assert cosine(np.array([[1, 0]], np.float32), np.array([[0, 2]], np.float32)) == 0


def test_a_vanishing_gradient_gives_zeros_not_nan() -> None:
    nothing = np.zeros_like(GRADIENT)
    values = compare(GRADIENT, nothing, nothing, 0.0)
    assert values.cos_int8_true == values.norm_ratio_int8_true == 0
    assert np.isfinite(values.sqnr_db)


def test_the_norm_ratio_is_int8_over_true() -> None:
    assert compare(GRADIENT, GRADIENT, 4 * GRADIENT, 0.0).norm_ratio_int8_true == pytest.approx(
        0.25
    )


def test_signs_are_compared_component_by_component() -> None:
    flipped = GRADIENT.copy()
    flipped[:8] *= -1
    assert compare(flipped, GRADIENT, GRADIENT, 0.0).sign_agreement_int8_float == 0.75


def test_an_error_of_a_tenth_is_twenty_decibel() -> None:
    assert sqnr_db(1.1 * GRADIENT, GRADIENT) == pytest.approx(20, abs=1e-3)


def test_the_mean_over_a_run_is_taken_metric_by_metric() -> None:
    first = LayerFidelity(1.0, 0.5, 0.5, 2.0, 1.0, 40.0, 0.0)
    second = LayerFidelity(0.0, 0.1, 0.3, 1.0, 0.5, 20.0, 0.02)
    assert mean_over_run([first, second]) == LayerFidelity(
        *(pytest.approx(value) for value in (0.5, 0.3, 0.4, 1.5, 0.75, 30.0, 0.01))
    )


def test_a_probes_outputs_are_sorted_into_layers() -> None:
    outputs = {
        f"{kind}{k}": sign * GRADIENT
        for k in (4, 5)
        for kind, sign in (("int8", 1), ("float", 1), ("true", 1 if k == 4 else -1))
    }
    outputs |= {"clipped4": np.float32(0.25), "clipped5": np.float32(0)}
    layers = compare_probe(outputs, (4, 5))
    assert layers[4].cos_int8_true == pytest.approx(1)
    assert layers[5].cos_int8_true == pytest.approx(-1)
    assert (layers[4].clipped_fraction, layers[5].clipped_fraction) == (0.25, 0)
