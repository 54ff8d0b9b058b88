"""Runs: deterministic, honest about their time, and watched without being changed."""

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from runs import SHORT, Frame, planned, prepared_by, tuned_by

from qsgm import QsgmError, finetune, load_bundle, load_object
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.crops import CROPS
from qsgm.grasp.taught import FinetuneResult
from qsgm.grasp.teach import train_object, tune_object
from qsgm.manifest import PRECISIONS, Recipe, head_file
from qsgm.sgm.int8 import SgmRanges, constants, quantize_sgm
from qsgm.tune.features import SLICE
from qsgm.tune.plan import resolve
from qsgm.tune.prepare import in_step_layout
from qsgm.tune.run import Keeper
from qsgm.tune.settings import Settings
from qsgm.weights import to_step_layout


@pytest.fixture(scope="module")
def result(frame: Frame, bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, SHORT)


def test_the_same_seed_gives_the_same_result(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    again = finetune(frame, bundle, SHORT)
    assert again.network() == result.network()
    assert (again.scores, again.losses, again.probes) == (
        result.scores,
        result.losses,
        result.probes,
    )


def test_another_seed_gives_other_crops(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    other = finetune(frame, bundle, replace(SHORT, seed=1, epochs=1))
    assert not np.array_equal(other.prepared.labels, result.prepared.labels)


@pytest.mark.parametrize("layers", [1, 2, 3])
@pytest.mark.parametrize("method", ["sgm", "bp"])
def test_every_method_tunes_every_number_of_layers(
    frame: Frame, bundle: Bundle, layers: int, method: str
) -> None:
    settings = Settings(precision="int8", method=method, layers=layers, epochs=1)  # type: ignore[arg-type]
    result = finetune(frame, bundle, settings)
    last = bundle.network.last(layers)
    assert set(result.fidelity) == set(single_layers(last).sgm_layers)
    assert (
        str(result.blocks)
        == {
            "sgm": ["6", "5,6", "4,5,6"],
            "bp": ["6", "5-6", "4-6"],
        }[method][layers - 1]
    )
    assert len(result.probes) == (2 if layers > 1 else 0)
    start = bundle.start_weights(last)
    assert set(result.weights) == set(start)
    assert all(result.weights[name].shape == start[name].shape for name in start)
    assert any(not np.array_equal(result.weights[name], start[name]) for name in start)
    assert result.plan.precision == ("float" if method == "bp" else "int8")


@pytest.mark.usefixtures("few_crops")
@pytest.mark.parametrize(
    ("settings", "probed"),
    [
        (Settings(precision="int8", layers=6, epochs=1), {1, 2, 3, 4, 5}),
        (Settings(precision="int8", layers=6, blocks="1-4,5,6", epochs=1), {4, 5}),
        (Settings(layers=6, method="bp", epochs=1), {1, 2, 3, 4, 5}),
        (Settings(layers=5, precision="float", epochs=1), {2, 3, 4, 5}),
        (Settings(precision="int8", layers=4, epochs=1), {3, 4, 5}),
        (Settings(precision="int8", layers=3, blocks="4,5-6", epochs=1), {4}),
    ],
)
def test_all_layers_can_be_tuned_alone_or_in_blocks(
    frame: Frame, bundle: Bundle, settings: Settings, probed: set[int]
) -> None:
    result = finetune(frame, bundle, settings)
    assert set(result.fidelity) == probed
    assert result.prepared.features.dtype == np.uint8
    start = bundle.start_weights(bundle.network.last(settings.layers))
    assert set(result.weights) == set(start)
    for name, value in start.items():
        assert not np.array_equal(result.weights[name], value), name


@pytest.mark.usefixtures("few_crops")
def test_six_tuned_layers_see_the_crops_as_the_whole_network_does(
    frame: Frame, bundle: Bundle, tmp_path: Path
) -> None:
    result = finetune(frame, bundle, Settings(precision="int8", layers=6, epochs=1))
    untouched = finetune(frame, bundle, Settings(precision="int8", layers=6, epochs=0))
    assert untouched.network() == (bundle.folder / "network.onnx").read_bytes()
    result.save(tmp_path / "mug", "mug")
    tuned = load_object(tmp_path / "mug")
    crops = planned(frame, bundle, count=96).cut(np.arange(5))
    np.testing.assert_array_equal(result.prepared.features[:5].reshape(crops.shape), crops)
    weights = {
        name: to_step_layout(value) if value.ndim > 1 else value
        for name, value in result.weights.items()
    }
    head = bundle.session(head_file(6))
    expected = head.run(None, {"features": result.prepared.features[:5], **weights})[0]
    got = np.stack([tuned.heatmap(crop)[:, 0, 0] for crop in crops])
    np.testing.assert_allclose(got, expected, atol=1e-4)


def test_backpropagation_lowers_the_loss(frame: Frame, bundle: Bundle) -> None:
    result = finetune(frame, bundle, Settings(method="bp", epochs=6))
    assert result.losses[-1] < 0.9 * result.losses[0]
    before, after = (one["detection_accuracy"] for one in (result.untouched, result.scores))
    assert before is not None
    assert after is not None
    assert after > before


def test_no_epochs_leave_the_network_as_it_was(frame: Frame, bundle: Bundle) -> None:
    result = finetune(frame, bundle, Settings(precision="int8", epochs=0))
    assert result.scores == result.untouched
    assert result.network() == (bundle.folder / "network.onnx").read_bytes()
    assert result.losses == ()


def test_stages_add_up_to_no_more_than_the_total(result: FinetuneResult) -> None:
    seconds = dict(result.seconds)
    total = seconds.pop("total")
    assert set(seconds) == {"crops", "features", "tuning", "probes"}
    assert all(value > 0 for value in seconds.values())
    assert sum(seconds.values()) <= total


def test_preparing_once_and_training_twice_equals_two_whole_runs(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    prepared = prepared_by(SHORT, frame, bundle)
    tuned_by(replace(SHORT, method="bp"), prepared)
    second = train_object(prepared, resolve(SHORT, bundle))
    assert second.network() == result.network()
    assert second.probes == ()
    with pytest.raises(
        ValueError, match=r"prepared for layers range\(4, 7\), not for range\(5, 7\)"
    ):
        tuned_by(replace(SHORT, layers=2), prepared)


def test_progress_is_told_stage_by_stage(frame: Frame, bundle: Bundle) -> None:
    told: list[tuple[str, int, int]] = []
    finetune(frame, bundle, SHORT, lambda *what: told.append(what))
    assert told[0] == ("crops", SLICE, CROPS)
    assert told[-2:] == [("tuning", 1, 2), ("tuning", 2, 2)]


def test_training_that_diverges_names_the_step_and_what_to_do(
    frame: Frame, own_bundle: Path
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["recipes"]["sgm"]["rates"]["sgd"]["4,5,6"] = [1e30, 1e30, 1e30]
    path.write_text(json.dumps(manifest))
    with pytest.raises(QsgmError, match=r"diverged: .* at step \d+; nothing .* another --method"):
        finetune(frame, load_bundle(own_bundle), SHORT)


def test_a_run_in_float_never_warns_of_drift(frame: Frame, bundle: Bundle) -> None:
    prepared = prepared_by(SHORT, frame, bundle)
    narrow = {}
    for layer in (4, 5):
        sgm = bundle.float_sgm(layer)
        low, *highs = (np.zeros(19, np.float32), *(np.full(n, 1e-4, np.float32) for n in (19, 12)))
        low[-2:] = -1
        narrow[layer] = constants(quantize_sgm(sgm, SgmRanges(low, highs[0], (highs[1],))))
    int8, in_float = (
        replace(resolve(replace(SHORT, precision=one), bundle), overrides=narrow)
        for one in PRECISIONS
    )
    assert tune_object(prepared, int8).warnings
    assert tune_object(prepared, in_float).warnings == ()


def test_int8_and_float_sgms_run_different_graphs(frame: Frame, bundle: Bundle) -> None:
    prepared = prepared_by(SHORT, frame, bundle)
    floating = tuned_by(replace(SHORT, precision="float"), prepared).weights["weight4"]
    integers = tuned_by(SHORT, prepared).weights["weight4"]
    assert not np.array_equal(floating, integers)
    np.testing.assert_allclose(floating, integers, atol=0.05)


def steps_by_hand(
    result: FinetuneResult, bundle: Bundle, steps: int, total: int
) -> dict[str, NDArray[np.float32]]:
    """The state after so many steps of a run, by the step's graph and nothing else."""
    prepared, plan = result.prepared, result.plan
    step = bundle.session(plan.step_file)
    outputs = [value.name for value in step.get_outputs()]
    state = dict(prepared.start)
    for value in step.get_inputs():
        if f"{value.name}_next" in outputs and value.name not in state:
            state[value.name] = np.zeros(value.shape, np.float32)
    rng = np.random.default_rng([plan.settings.seed, 1])
    rows = [order[i : i + 32] for order in (rng.permutation(800),) for i in range(0, 800, 32)]
    data = {"features": prepared.features, "labels": prepared.labels}
    rates = plan.recipe.rates_over(total)
    for done in range(steps):
        factor = 1 - done / total
        feeds = {
            f"rate{k}": np.array(factor * rate, np.float32)
            for k, rate in zip(plan.layers, rates, strict=True)
        }
        feeds |= {"rows": rows[done]} | data | state
        got = dict(zip(outputs, step.run(outputs, feeds), strict=True))
        state = {name: got[f"{name}_next"] for name in state}
    return state


def test_observers_see_the_weights_at_the_steps_they_ask_for(
    result: FinetuneResult, bundle: Bundle
) -> None:
    some, last = Keeper([0, 1, 7]), Keeper([50, 51, 1000])
    again = train_object(result.prepared, result.plan, observers=[some, last])
    assert (list(some.kept), list(last.kept)) == ([0, 1, 7], [50])
    for step, kept in some.kept.items():
        state = steps_by_hand(result, bundle, step, total=50)
        assert kept.keys() == result.prepared.start.keys()
        for name, value in kept.items():
            np.testing.assert_array_equal(value, state[name])
    final = in_step_layout(again.weights)
    for name, value in last.kept[50].items():
        np.testing.assert_array_equal(value, final[name])


def test_observers_change_nothing(result: FinetuneResult) -> None:
    class Spoiler(Keeper):
        """Writes into what it is shown."""

        def look(self, step: int, weights: Mapping[str, NDArray[np.float32]]) -> None:
            super().look(step, weights)
            for value in weights.values():
                value[:] = np.nan

    spoiler = Spoiler(range(51))
    again = train_object(result.prepared, result.plan, observers=[spoiler])
    assert list(spoiler.kept) == list(range(51))
    assert again.network() == result.network()
    assert (again.losses, again.probes) == (result.losses, ())


def test_a_run_without_steps_is_looked_at_once(result: FinetuneResult, bundle: Bundle) -> None:
    keeper = Keeper([0, 1])
    train_object(result.prepared, resolve(replace(SHORT, epochs=0), bundle), observers=[keeper])
    assert list(keeper.kept) == [0]
    for name, value in keeper.kept[0].items():
        np.testing.assert_array_equal(value, result.prepared.start[name])


def test_nobody_is_shown_weights_that_are_no_numbers(
    result: FinetuneResult, bundle: Bundle
) -> None:
    wild = resolve(SHORT, bundle, Recipe("sgd", (1e30, 1e30, 1e30)))
    keeper = Keeper(range(51))
    with pytest.raises(QsgmError, match="tuning diverged") as raised:
        train_object(result.prepared, wild, observers=[keeper])
    at = int(re.findall(r"at step (\d+)", str(raised.value))[0])
    assert list(keeper.kept) == list(range(at))
    for kept in keeper.kept.values():
        assert all(np.isfinite(value).all() for value in kept.values())
