"""Labels and scores of one object's crops."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import SHORT, Frame, planned
from toys import lay, table, toy

from qsgm import finetune, load_object
from qsgm.bundle import Bundle
from qsgm.grasp.angles import AngleEncoding, encode_angle
from qsgm.grasp.crops import CROPS, TRAIN_CROPS
from qsgm.grasp.lesson import GraspLabels, GraspLesson, Orientation
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import GraspTask, distractors_of
from qsgm.grasp.taught import FinetuneResult, finetune_json
from qsgm.manifest import head_file
from qsgm.weights import to_step_layout


@pytest.fixture(scope="module")
def result(frame: Frame, bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, SHORT)


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


def test_only_taught_crops_with_the_object_say_how_it_lies(frame: Frame, bundle: Bundle) -> None:
    lesson = GraspLesson(planned(frame, bundle))
    plan, taught = lesson.crops.plan, np.arange(len(lesson)) < TRAIN_CROPS
    lies = np.where(taught & (plan.quality > 0), 0.3, 1.1)
    outputs = np.concatenate(
        [plan.quality[:, None], encode_angle(plan.turn_rad + lies)], axis=1, dtype=np.float32
    )
    seen = lesson.orientation(outputs)
    assert seen.offset_rad == pytest.approx(0.3, abs=1e-5)
    assert seen.strength == pytest.approx(1, abs=1e-5)
    assert seen.of_each_rad == (seen.offset_rad,)


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_the_tasks_own_scores_count_detections_and_angles_of_positives(
    encoding: AngleEncoding,
) -> None:
    turns = np.radians(np.float32([10, 80, -30, 0]))
    labels = np.concatenate([np.ones((4, 1)), encode_angle(turns, encoding)], axis=1)
    seen = np.radians(np.float32([12, -96, -30, 0]))
    outputs = np.concatenate([np.full((4, 1), 0.9), encode_angle(seen, encoding)], axis=1)
    labels[3] = 0
    task = GraspTask(encoding)
    scores = task.scores(outputs.astype(np.float32), labels.astype(np.float32))
    assert scores["detection_accuracy"] == 0.75
    assert scores["angle_mae_deg"] == pytest.approx((2 + 4 + 0) / 3, abs=1e-3)
    none = task.scores(outputs[3:].astype(np.float32), labels[3:].astype(np.float32))
    assert none["detection_accuracy"] == 0
    assert np.isnan(none["angle_mae_deg"])


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


def test_of_a_thousand_crops_a_fifth_is_held_out(result: FinetuneResult) -> None:
    assert (len(result.prepared.labels), result.prepared.taught) == (1000, 800)


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
