"""What an object is taught from: frames of any size, the object anywhere in them."""

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from runs import SHORT, Frame, planned, prepared_by
from toys import bump, by_correlation, lay, table, toy, with_decision

from qsgm import QsgmError, finetune, load_object
from qsgm.bundle import Bundle
from qsgm.grasp.crops import cut_crops, plan_crops
from qsgm.grasp.others import other_in
from qsgm.grasp.source import Demonstration
from qsgm.grasp.task import distractors_of
from qsgm.grasp.taught import FinetuneResult, finetune_json
from qsgm.grasp.tuned import MARGIN_PX


@pytest.fixture(scope="module")
def result(frame: Frame, bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, SHORT)


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


def test_what_is_no_frame_is_refused_in_one_line(frame: Frame, bundle: Bundle) -> None:
    for bad, got in ((frame / 255.0, "float64"), (frame[:, :, 0], "uint8")):
        with pytest.raises(
            QsgmError, match=rf"the frame is an array of {got} \(480, 640"
        ) as raised:
            finetune(bad, bundle)
        assert "expected a numpy array of uint8 (height, width, 3)" in str(raised.value)
        assert "\n" not in str(raised.value)


def toy_frame(turn_deg: float = 0.0, seed: int = 0) -> Frame:
    return lay(toy(), table(seed), (320.0, 240.0), turn_deg)


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
