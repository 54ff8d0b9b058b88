"""A taught object, in memory and on disk: the network that was tuned, and how it was made."""

import hashlib
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from runs import SHORT, Frame, planned

from qsgm import finetune, load_object
from qsgm.bundle import Bundle
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.grasp.taught import FinetuneResult, finetune_json
from qsgm.manifest import head_file
from qsgm.tables import to_json
from qsgm.weights import to_step_layout


@pytest.fixture(scope="module")
def result(frame: Frame, bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, SHORT)


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


def test_a_number_that_is_not_finite_becomes_null_not_nan(result: FinetuneResult) -> None:
    broken = replace(result, scores={**result.scores, "angle_mae_deg": math.nan})
    values = json.loads(to_json(finetune_json(broken, "mug", Path("mug"))))
    assert values["angle_mae_deg"] is None


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
