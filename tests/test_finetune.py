"""Fine-tuning end to end on a small bundle: deterministic, honest, and the same at every seam."""

import hashlib
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from toys import bump, by_correlation, lay, table, toy, with_decision

from qsgm import QsgmError, finetune, load_bundle, load_object
from qsgm.blocks import parse_blocks, single_layers
from qsgm.bundle import Bundle
from qsgm.grasp import teach
from qsgm.grasp.angles import encode_angle
from qsgm.grasp.crops import CROPS, TRAIN_CROPS, cut_crops, plan_crops
from qsgm.grasp.lesson import GraspLabels, GraspLesson, Orientation
from qsgm.grasp.others import Other, other_in
from qsgm.grasp.report import finetune_json
from qsgm.grasp.source import CropSource, Demonstration, crop_source
from qsgm.grasp.task import distractors_of
from qsgm.grasp.teach import (
    FinetuneResult,
    PreparedObject,
    prepare_object,
    train_object,
    tune_object,
)
from qsgm.grasp.tuned import MARGIN_PX
from qsgm.manifest import PRECISIONS, FileEntry, Precision, head_file
from qsgm.schedule import BATCH
from qsgm.sgm.int8 import SgmRanges, constants, quantize_sgm
from qsgm.tables import to_json
from qsgm.tune.features import SLICE, StreamedFeatures
from qsgm.tune.plan import peak_activation_bytes, resolve
from qsgm.tune.settings import Settings
from qsgm.weights import to_step_layout

Frame = NDArray[np.uint8]
SHORT = Settings(precision="int8", epochs=2)


def prepared_by(
    settings: Settings, frame: Frame | Demonstration, bundle: Bundle, others: Sequence[Other] = ()
) -> PreparedObject:
    """What a run with these settings starts from."""
    frames = frame if isinstance(frame, np.ndarray) else [frame]
    return prepare_object(frames, bundle, resolve(settings, bundle), others=others)


def tuned_by(settings: Settings, prepared: PreparedObject) -> FinetuneResult:
    """One run on what was prepared."""
    return tune_object(prepared, resolve(settings, prepared.bundle))


def planned(
    frame: Frame,
    bundle: Bundle,
    center_px: tuple[float, float] = (320.0, 240.0),
    count: int = CROPS,
) -> CropSource:
    """The crops of a run with seed 0."""
    shown = Demonstration(frame, center_px)
    return crop_source([shown], distractors_of(bundle), np.random.default_rng(0), count)


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


def test_crops_cut_in_slices_have_the_features_of_crops_cut_at_once(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    crops = planned(frame, bundle).cut(np.arange(60))
    expected = bundle.session("trunk_float_3.onnx").run(None, {"samples": crops})[0]
    assert len(result.prepared.features) == CROPS
    np.testing.assert_allclose(result.prepared.features[:60], expected, atol=1e-5)


def test_the_frozen_layers_run_in_the_precision_asked_for(
    frame: Frame, bundle: Bundle, result: FinetuneResult
) -> None:
    prepared = prepared_by(replace(SHORT, trunk="int8"), frame, bundle)
    crops = planned(frame, bundle).cut(np.arange(20))
    expected = bundle.session("trunk_int8_3.onnx").run(None, {"samples": crops})[0]
    np.testing.assert_array_equal(prepared.features[:20], expected)
    assert not np.array_equal(prepared.features, result.prepared.features)
    trunks = tuned_by(SHORT, prepared).prepared.plan.trunk, result.prepared.plan.trunk
    assert trunks == ("int8", "float")


def test_the_object_may_lie_elsewhere_in_the_frame(frame: Frame, bundle: Bundle) -> None:
    prepared = prepared_by(SHORT, Demonstration(frame, (250.0, 280.0)), bundle)
    crops = planned(frame, bundle, (250.0, 280.0)).cut(np.arange(20))
    expected = bundle.session("trunk_float_3.onnx").run(None, {"samples": crops})[0]
    np.testing.assert_allclose(prepared.features[:20], expected, atol=1e-5)
    with pytest.raises(QsgmError, match="outside of the 640x480 frame"):
        prepared_by(SHORT, Demonstration(frame, (640.5, 240.0)), bundle)


def test_an_object_at_the_border_is_taught_with_its_frame_continued(
    frame: Frame, bundle: Bundle
) -> None:
    prepared = prepared_by(SHORT, Demonstration(frame, (30.0, 240.0)), bundle)
    (shown,) = prepared.shown.demonstrations
    assert shown.frame.shape == (480, 640 + 66, 3)
    assert shown.center_px == (96.0, 240.0)


def test_labels_are_shifted_by_the_orientation_the_network_sees(
    frame: Frame, result: FinetuneResult
) -> None:
    prepared = result.prepared
    plan = planned(frame, prepared.bundle).plan
    positive = plan.quality > 0
    expected = encode_angle(plan.turn_rad + np.float32(prepared.orientation.offset_rad))
    np.testing.assert_allclose(prepared.labels[positive, 1:], expected[positive], atol=1e-5)
    assert (prepared.labels[~positive] == 0).all()
    assert 0 <= prepared.orientation.strength <= 1


def test_detection_counts_both_kinds_of_error_and_angles_are_modulo_180() -> None:
    angles = np.radians([10.0, 80.0, 0.0, 0.0])
    labels = np.array([[1, 0, 0], [1, 0, 0], [0, 0, 0], [0, 0, 0]], np.float32)
    seen = np.concatenate(
        [
            np.array([[0.9], [0.4], [0.8], [0.1]], np.float32),
            encode_angle(np.radians([12.0, -96.0, 50.0, 50.0])),
        ],
        axis=1,
    )
    untouched = Orientation(0.0, 1.0, (0.0,))
    known = GraspLabels(labels, angles, np.zeros(4, np.uint8), untouched, "double")
    scores = known.scores(seen, np.arange(4))
    for ending in ("", "_plain"):
        assert scores[f"detection_accuracy{ending}"] == 0.5
        assert scores[f"angle_mae_deg{ending}"] == pytest.approx((2 + 4) / 2, abs=1e-4)


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


@pytest.fixture
def few_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers 1 to 3 see large maps."""
    monkeypatch.setattr(teach, "GraspLesson", partial(GraspLesson, taught=64))
    monkeypatch.setattr(teach, "crop_source", partial(crop_source, count=96))


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


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            Settings(precision="int8", layers=6, blocks="1-3,4,5,6"),
            "no step for the blocks 1-3,4,5,6; choose one of",
        ),
        (Settings(precision="int8", blocks="1-4,5,6"), "are the last 6 layers, the settings say 3"),
        (Settings(precision="int8", blocks="4-6"), "leave no place for an SGM: pass --method bp"),
        (
            Settings(precision="int8", blocks="4,5-6", method="bp"),
            "trains all layers as one block, 4-6",
        ),
        (Settings(precision="int8", blocks="4,6"), "gives no blocks of layers"),
    ],
)
def test_blocks_that_cannot_be_trained_are_refused_before_any_work(
    frame: Frame, bundle: Bundle, settings: Settings, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(teach, "crop_source", pytest.fail)
    with pytest.raises(QsgmError, match=said) as raised:
        finetune(frame, bundle, settings)
    assert "\n" not in str(raised.value)


def test_backpropagation_may_be_asked_for_by_its_one_block(frame: Frame, bundle: Bundle) -> None:
    asked = finetune(frame, bundle, Settings(method="bp", blocks="4-6", epochs=1))
    assert asked.network() == finetune(frame, bundle, Settings(method="bp", epochs=1)).network()


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


def test_the_tuned_network_answers_like_the_head_with_the_final_weights(
    frame: Frame, bundle: Bundle, result: FinetuneResult, tmp_path: Path
) -> None:
    result.save(tmp_path / "mug", "mug")
    crops = planned(frame, bundle).cut(np.arange(TRAIN_CROPS, TRAIN_CROPS + 20))
    weights = {
        name: to_step_layout(value) if value.ndim > 1 else value
        for name, value in result.weights.items()
    }
    features = result.prepared.features[TRAIN_CROPS : TRAIN_CROPS + 20]
    head = result.prepared.bundle.session(head_file(3))
    expected = head.run(None, {"features": features, **weights})[0]
    tuned = load_object(tmp_path / "mug")
    got = np.stack([tuned.heatmap(crop)[:, 0, 0] for crop in crops])
    np.testing.assert_allclose(got, expected, atol=1e-3)  # features are rounded to u8


def test_a_saved_object_and_the_one_in_memory_find_the_same(
    frame: Frame, result: FinetuneResult, tmp_path: Path
) -> None:
    result.save(tmp_path / "mug", "mug")
    saved = load_object(tmp_path / "mug").locate(frame)[0]
    assert saved == result.tuned_object().locate(frame)[0]


def test_the_report_beside_the_object_keeps_the_whole_run(
    result: FinetuneResult, tmp_path: Path
) -> None:
    result.save(tmp_path / "mug", "mug")
    report = json.loads((tmp_path / "mug" / "report.json").read_text())
    assert [probe["epoch"] for probe in report["fidelity_over_run"]] == [0, 1, 2]
    assert len(report["loss"]) == 2
    mean = np.mean([probe["4"]["cos_int8_true"] for probe in report["fidelity_over_run"]])
    assert report["fidelity"]["4"]["cos_int8_true"] == pytest.approx(mean, abs=1e-4)


def assert_same_run(one: FinetuneResult, other: FinetuneResult) -> None:
    """To the last bit."""
    assert one.network() == other.network()
    assert (one.untouched, one.scores) == (other.untouched, other.scores)
    assert (one.losses, one.probes) == (other.losses, other.probes)
    assert one.prepared.orientation.offset_rad == other.prepared.orientation.offset_rad


@pytest.mark.parametrize(
    "settings",
    [
        replace(SHORT, trunk="float"),
        replace(SHORT, trunk="int8"),
        replace(SHORT, method="bp", layers=2),
        replace(SHORT, layers=1, optimizer="adam"),
        replace(SHORT, recalibrate=True),
    ],
)
def test_streamed_features_give_the_same_run_as_kept_ones(
    frame: Frame, bundle: Bundle, settings: Settings
) -> None:
    streamed = finetune(frame, bundle, replace(settings, stream=True))
    assert_same_run(streamed, finetune(frame, bundle, settings))
    seconds = dict(streamed.seconds)
    assert sum(seconds.values()) - seconds["total"] <= seconds["total"]


@pytest.mark.usefixtures("few_crops")
@pytest.mark.parametrize(("layers", "precision"), [(4, "int8"), (5, "float"), (6, "int8")])
def test_streamed_maps_give_the_same_run_as_kept_ones(
    frame: Frame, bundle: Bundle, layers: int, precision: Precision
) -> None:
    settings = Settings(precision=precision, layers=layers, epochs=1)
    streamed = finetune(frame, bundle, replace(settings, stream=True))
    assert_same_run(streamed, finetune(frame, bundle, settings))


@pytest.mark.parametrize("trunk", ["float", "int8"])
@pytest.mark.parametrize("layers", [1, 3])
def test_features_of_a_crop_are_the_same_in_any_batch(
    frame: Frame, bundle: Bundle, trunk: Precision, layers: int
) -> None:
    settings = Settings(precision="int8", layers=layers, trunk=trunk, stream=True)
    source = prepared_by(settings, frame, bundle).source
    rows = np.random.default_rng(0).permutation(CROPS)[:75]
    together = source.of(rows)
    np.testing.assert_array_equal(source.of(rows[40:72]), together[40:72])
    assert source.of(rows[:0]).shape == (0, *together.shape[1:])
    alone = np.concatenate([source.of(rows[i : i + 1]) for i in range(10)])
    np.testing.assert_array_equal(alone, together[:10])


def test_a_streamed_run_never_makes_more_features_than_a_batch(
    frame: Frame, bundle: Bundle, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []
    plain = StreamedFeatures.of

    def of(self: StreamedFeatures, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        made.append(len(rows))
        return plain(self, rows)

    monkeypatch.setattr(StreamedFeatures, "of", of)
    result = finetune(frame, bundle, replace(SHORT, stream=True, recalibrate=True))
    assert max(made) == BATCH
    kept = {np.size(value) for value in vars(result.prepared.source).values()}
    assert max(kept) < 2 * frame.size


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


def test_more_layers_than_the_bundle_has_are_refused(frame: Frame, bundle: Bundle) -> None:
    small = replace(bundle, manifest=replace(bundle.manifest, most_layers=2))
    with pytest.raises(QsgmError, match="2 layers at most, not 3; pass --layers 2"):
        finetune(frame, small, SHORT)


def test_what_is_no_frame_is_a_programming_error(frame: Frame, bundle: Bundle) -> None:
    with pytest.raises(ValueError, match=r"`frame` must be uint8 \(H, W, 3\), got float64"):
        finetune(frame / 255.0, bundle)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="`frame` must be"):
        finetune(frame[:, :, 0], bundle)


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


def test_a_run_says_what_memory_its_steps_take_where_the_bundle_does(bundle: Bundle) -> None:
    assert peak_activation_bytes(bundle, "int8", parse_blocks("4,5,6")) == {
        "sgm": None,
        "backprop": None,
    }
    sizes = {"step_int8_sgd_4,5-6.onnx": 7, "step_float_adam_4-6.onnx": 9, "head_3.onnx": None}
    files = {name: FileEntry("", size) for name, size in sizes.items()}
    told = replace(bundle, manifest=replace(bundle.manifest, files=files))
    found = peak_activation_bytes(told, "int8", parse_blocks("4,5-6"))
    assert found == {"sgm": 7, "backprop": 9}
    assert told.peak_activation_bytes("head_3.onnx") is None


def test_int8_and_float_sgms_run_different_graphs(frame: Frame, bundle: Bundle) -> None:
    prepared = prepared_by(SHORT, frame, bundle)
    floating = tuned_by(replace(SHORT, precision="float"), prepared).weights["weight4"]
    integers = tuned_by(SHORT, prepared).weights["weight4"]
    assert not np.array_equal(floating, integers)
    np.testing.assert_allclose(floating, integers, atol=0.05)


def test_a_number_that_is_not_finite_becomes_null_not_nan(result: FinetuneResult) -> None:
    broken = replace(result, scores={**result.scores, "angle_mae_deg": math.nan})
    values = json.loads(to_json(finetune_json(broken, "mug", Path("mug"))))
    assert values["angle_mae_deg"] is None


def toy_frame(turn_deg: float = 0.0, seed: int = 0) -> Frame:
    return lay(toy(), table(seed), (320.0, 240.0), turn_deg)


def test_accuracy_is_told_with_other_things_on_the_crops_and_without(
    bundle: Bundle, result: FinetuneResult
) -> None:
    prepared, scores = result.prepared, result.scores
    rows = np.arange(TRAIN_CROPS, CROPS)
    weights = {
        name: to_step_layout(value) if value.ndim > 1 else value
        for name, value in result.weights.items()
    }
    head = bundle.session(head_file(3))
    outputs = head.run(None, {"features": prepared.features[rows], **weights})[0]
    right = (outputs[:, 0] > 0.5) == (prepared.labels[rows, 0] > 0)
    addition, negative = prepared.labelled.addition[rows], prepared.labels[rows, 0] == 0
    assert scores["detection_accuracy"] == pytest.approx(right.mean())
    assert scores["detection_accuracy_plain"] == pytest.approx(right[addition == 0].mean())
    assert scores["told_apart"] == pytest.approx(right[negative & (addition == 1)].mean())
    values = finetune_json(result, "mug", Path("mug"))
    for place in (values, values["zero_shot"]):
        assert {"detection_accuracy_plain", "angle_mae_deg_plain", "told_apart"} <= set(place)


def test_a_bundle_without_things_gives_crops_of_the_frame_alone(
    frame: Frame, bundle: Bundle
) -> None:
    files = {k: v for k, v in bundle.manifest.files.items() if k != "distractors.png"}
    old = replace(bundle, manifest=replace(bundle.manifest, files=files))
    assert distractors_of(old) is None
    result = finetune(frame, old, replace(SHORT, epochs=1))
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0))
    crops = cut_crops(frame, plan[:20])
    expected = bundle.session("trunk_float_3.onnx").run(None, {"samples": crops})[0]
    np.testing.assert_array_equal(result.prepared.features[:20], expected)
    scores = result.scores
    assert scores["detection_accuracy_plain"] == scores["detection_accuracy"]
    assert scores["told_apart"] is None
    assert "no other things" in " ".join(result.verdict.notes)


def test_several_demonstrations_share_one_meaning_of_the_angle(bundle: Bundle) -> None:
    turn = 70.0
    frames = [toy_frame(), toy_frame(turn, 1)]
    result = finetune(frames, bundle, replace(SHORT, epochs=1))
    prepared = result.prepared
    crops = crop_source(
        [Demonstration(frame, (320.0, 240.0)) for frame in frames],
        distractors_of(bundle),
        np.random.default_rng(0),
    )
    true = crops.plan.turn_rad + np.radians(turn) * crops.shown + prepared.orientation.offset_rad
    positive = crops.plan.quality > 0
    np.testing.assert_allclose(
        prepared.labels[positive, 1:], encode_angle(true[positive]), atol=0.02
    )
    assert set(crops.shown) == {0, 1}
    (first, second) = finetune_json(result, "toy", Path("toy"))["demonstrations"]
    assert first == {"turn_deg": 0.0}
    assert second["turn_deg"] == pytest.approx(turn, abs=0.5)
    assert len(result.tuned_object().description.views) == 1


def test_a_demonstration_that_looks_different_is_aligned_by_the_network_and_kept(
    bundle: Bundle, tmp_path: Path
) -> None:
    back = lay(toy()[..., [2, 1, 0, 3]], table(1), (320.0, 240.0), 70)
    result = finetune([toy_frame(), back], bundle, replace(SHORT, epochs=1))
    first, second = result.prepared.orientation.of_each_rad
    assert first == result.prepared.orientation.offset_rad
    result.save(tmp_path / "toy", "toy")
    one, other = load_object(tmp_path / "toy").description.views
    assert (one.turn_rad, one.whole) == (0, True)
    assert (other.turn_rad, other.whole) == (pytest.approx(second - first), False)
    assert finetune_json(result, "toy", Path("toy"))["demonstrations"][1] == {"turn_deg": None}


def test_things_that_are_named_are_put_on_the_crops(bundle: Bundle) -> None:
    other = other_in(Demonstration(toy_frame(), (320.0, 240.0)))
    frame = lay(toy()[..., [1, 2, 0, 3]], table(2), (320.0, 240.0))
    plain, named = (prepared_by(SHORT, frame, bundle, some) for some in ([], [other]))
    again = prepared_by(SHORT, frame, bundle, [other])
    assert not np.array_equal(plain.features, named.features)
    np.testing.assert_array_equal(again.features, named.features)
    addition = plain.labelled.addition
    np.testing.assert_array_equal(addition, named.labelled.addition)
    alone = (addition == 0) | (addition == 2)
    np.testing.assert_array_equal(plain.features[alone], named.features[alone])
    assert named.others_sha256 == (other.sha256,)


def test_a_photograph_with_a_large_object_is_taught_and_found_in_its_own_pixels(
    bundle: Bundle, tmp_path: Path
) -> None:
    """12 megapixels, an object of 800 px."""
    small = lay(toy(), table(0, (378, 504)), (252.0, 189.0), 25, 100 / 90)
    photograph = cv2.resize(small, None, fx=8, fy=8, interpolation=cv2.INTER_CUBIC)
    deciding = with_decision(bundle, by_correlation())
    result = finetune(photograph, deciding, replace(SHORT, epochs=1))
    values = finetune_json(result, "toy", Path("toy"))
    assert values["span_px"] == pytest.approx(800, rel=0.1)
    assert values["scale"] == pytest.approx(90 / 800, rel=0.1)
    shown = result.prepared.shown.demonstrations[0]
    assert max(shown.frame.shape) < 520
    result.save(tmp_path / "toy", "toy")
    tuned = load_object(tmp_path / "toy")
    assert tuned.description.scale == pytest.approx(values["scale"], abs=1e-4)
    x, y = shown.center_px
    height, width = shown.frame.shape[:2]
    wide = height + 2 * MARGIN_PX, width + 2 * MARGIN_PX
    monkey = bump([(x + MARGIN_PX, y + MARGIN_PX)], wide)
    tuned.heatmap = lambda _frame: monkey  # type: ignore[method-assign]
    found, _ = tuned.locate(photograph)
    assert found.refined_by == "patch"
    assert math.dist(found.center_px, (2016, 1512)) < 8
    assert abs(found.angle_deg) < 0.5


def test_an_object_of_the_usual_size_is_not_scaled(frame: Frame, result: FinetuneResult) -> None:
    shown = result.prepared.shown
    assert shown.scale == 1
    assert shown.demonstrations[0].frame is frame


def test_what_the_object_was_made_from_is_kept(
    frame: Frame, bundle_folder: Path, result: FinetuneResult, tmp_path: Path
) -> None:
    result.save(tmp_path / "mug", "mug")
    made = json.loads((tmp_path / "mug" / "object.json").read_text())["made"]
    manifest = (bundle_folder / "manifest.json").read_bytes()
    assert made["bundle_sha256"] == hashlib.sha256(manifest).hexdigest()
    assert made["frames_sha256"] == [hashlib.sha256(frame.tobytes()).hexdigest()]
    assert made["seed"] == 0
    assert {"qsgm", "onnxruntime", "opencv"} <= set(made)


def test_a_run_that_ends_poor_is_warned_about(bundle: Bundle) -> None:
    """A checkerboard of 2 px in a bundle of random weights: nothing can come of it."""
    board = np.kron(np.indices((240, 320)).sum(axis=0) % 2 * 255, np.ones((2, 2)))
    frame = np.repeat(board[..., None], 3, axis=2).astype(np.uint8)
    result = finetune(frame, bundle, replace(SHORT, epochs=1))
    assert not result.verdict.good
    values = finetune_json(result, "board", Path("board"))
    assert values["verdict"]["good"] is False
    assert values["verdict"]["reasons"]
    assert set(values["verdict"]["reasons"]) <= set(values["warnings"])


def test_no_frame_at_all_is_a_programming_error(bundle: Bundle) -> None:
    with pytest.raises(ValueError, match="at least one frame"):
        finetune([], bundle)
