"""The fidelity metrics on gradients whose relation is known, and along a run."""

import hashlib
import json
from dataclasses import asdict, replace
from io import StringIO
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from numpy.typing import NDArray
from rich.console import Console
from torch.nn import functional as F

from qsgm import QsgmError, defaults
from qsgm.bundle import Bundle, load_bundle
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
from qsgm.grasp.teach import FinetuneResult, finetune, prepare_object, train_object, tune_object
from qsgm.manifest import MANIFEST, probe_file
from qsgm.schedule import BATCH, steps_per_epoch
from qsgm.train.model.local import LayerState, columns, layer_forward
from qsgm.train.quantization.sgm_fidelity import update_from
from qsgm.tune import probe as probing
from qsgm.tune.plan import resolve
from qsgm.tune.report import fidelity_command_json, fidelity_command_report
from qsgm.tune.settings import Settings

RNG = np.random.default_rng(0)
GRADIENT = RNG.normal(size=(32, 16)).astype(np.float32)
NOTHING = np.zeros_like(GRADIENT)
SHORT = Settings(precision="int8", epochs=2)
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


@pytest.fixture(scope="module")
def result(frame: NDArray[np.uint8], bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, replace(SHORT, probe_every=20))


def test_probes_are_taken_every_so_many_steps_and_once_an_epoch_by_default(
    result: FinetuneResult, bundle: Bundle
) -> None:
    assert [probe.step for probe in result.probes] == [0, 20, 40]
    assert [probe.epoch for probe in result.probes] == [0, 0.8, 1.6]
    usual = tune_object(result.prepared, resolve(SHORT, bundle))
    assert [probe.step for probe in usual.probes] == [0, 25, 50]
    an_epoch = steps_per_epoch(result.prepared.taught)
    assert defaults.PROBE_EVERY == an_epoch == result.steps / SHORT.epochs == 25
    assert usual.probes[0] == result.probes[0]


def test_probing_changes_nothing_but_what_it_costs(result: FinetuneResult) -> None:
    never = train_object(result.prepared, resolve(SHORT, result.prepared.bundle))
    assert never.network() == result.network()
    assert (never.losses, never.probes) == (result.losses, ())


def test_a_run_without_any_distance_between_probes_is_a_programming_error(
    result: FinetuneResult,
) -> None:
    plan = resolve(replace(SHORT, probe_every=0), result.prepared.bundle)
    with pytest.raises(ValueError, match="`probe_every` must be 1 step or more, got 0"):
        tune_object(result.prepared, plan)


def test_json_has_every_probe_with_its_step_epoch_and_metrics(result: FinetuneResult) -> None:
    values = fidelity_command_json(result, "mug")
    assert values["every"] == 20
    first, second, _ = values["fidelity_over_run"]
    assert (second["step"], second["epoch"]) == (20, 0.8)
    assert set(first) == {"step", "epoch", "4", "5"}
    for layer in (first["4"], values["fidelity"]["5"]):
        assert set(layer) == set(LayerFidelity.__dataclass_fields__)
    probes = [probe["5"]["weighted_error"] for probe in values["fidelity_over_run"]]
    mean = np.mean(probes)
    assert values["fidelity"]["5"]["weighted_error"] == pytest.approx(mean, abs=2e-5)


def test_both_tables_fit_a_terminal_of_80_columns_and_show_every_metric(
    result: FinetuneResult,
) -> None:
    probes = tuple(
        replace(probe, layers=dict.fromkeys(range(1, 6), probe.layers[4]))
        for probe in result.probes
    )
    shown = StringIO()
    five = replace(result, probes=probes)
    Console(file=shown, width=80).print(fidelity_command_report(five))
    lines = shown.getvalue().splitlines()
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines if line.split()[:1] == ["4"]]
    mean = five.fidelity[4]
    assert [len(row) for row in rows] == [8, 8]
    assert rows[0][1:3] == [f"{mean.cos_int8_float:.5f}", f"{mean.cos_int8_true:.3f}"]
    assert rows[1][1:3] == [f"{mean.direction_deviation_deg:.2f}", f"{mean.weighted_error:.4f}"]
    assert rows[1][5:] == [
        f"{mean.cos_update_int8_float:.4f}",
        f"{mean.cos_update_int8_true:.3f}",
        f"{mean.cos_update_float_true:.3f}",
    ]
    assert "probes: 3, at steps 0 to 40 by 20" in lines


def without_output(folder: Path, name: str, output: str) -> Bundle:
    """The bundle with a graph that gives less, as if an earlier version had written it."""
    model = onnx.load(str(folder / name))
    kept = [one for one in model.graph.output if one.name != output]
    assert len(kept) == len(model.graph.output) - 1
    del model.graph.output[:]
    model.graph.output.extend(kept)
    data = model.SerializeToString()
    (folder / name).write_bytes(data)
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["files"][name]["sha256"] = hashlib.sha256(data).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))
    return load_bundle(folder)


def test_a_bundle_whose_probe_gives_less_is_refused_in_one_line(
    frame: NDArray[np.uint8], own_bundle: Path
) -> None:
    old = without_output(own_bundle, probe_file(3), "update_true5")
    with pytest.raises(QsgmError) as caught:
        finetune(frame, old, SHORT)
    said = str(caught.value)
    assert "probe_3.onnx of the bundle" in said
    assert "has no output update_true5" in said
    assert "export it again with `qsgm fold-and-quantize`" in said
    assert "\n" not in said
    plan = resolve(replace(SHORT, epochs=0), old)
    assert train_object(prepare_object(frame, old, plan), plan).probes == ()


def test_a_probe_in_pieces_says_what_a_probe_of_the_whole_batch_says(
    frame: NDArray[np.uint8], bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = resolve(Settings(precision="int8", layers=4, epochs=1), bundle)
    prepared = prepare_object(frame, bundle, plan)
    pieces = tune_object(prepared, plan).probes
    monkeypatch.setattr(probing, "PROBE_SLICE", BATCH)
    for piece, whole in zip(pieces, tune_object(prepared, plan).probes, strict=True):
        for layer, expected in whole.layers.items():
            found, wanted = asdict(piece.layers[layer]), asdict(expected)
            # Pieces have different numbers of values other than zero, of which this is a share.
            shares = found.pop("underflow_fraction"), wanted.pop("underflow_fraction")
            assert shares[0] == pytest.approx(shares[1], abs=0.01)
            assert found == pytest.approx(wanted, rel=1e-3, abs=1e-6)
