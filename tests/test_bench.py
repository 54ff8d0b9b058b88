"""The benchmarks: scenes whose truth is known, folders read right, reports that add up."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm import QsgmError, cli
from qsgm.bench.accuracy import measure_accuracy, statistics
from qsgm.bench.frames import BenchFrame, list_frames
from qsgm.bench.scenes import ON_OBJECT_PX, SceneResult, ScenesReport
from qsgm.bench.speed import measure_speed, ratios
from qsgm.bench.staging import BORDER_PX, CutOut, Scene, cut_out, make_scenes, put_down
from qsgm.bundle import Bundle
from qsgm.finetuning import Settings, finetune
from qsgm.images import write_png
from qsgm.predict import Detection

SHORT = Settings(epochs=1)
CENTER = (320.0, 240.0)


Drawn = tuple[NDArray[np.uint8], NDArray[np.bool_]]


@pytest.fixture(scope="module")
def cut(drawn: Drawn) -> CutOut:
    return cut_out(*drawn, CENTER)


def red(frame: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels of the drawn object: the table is never that red."""
    blue, _, strong = np.moveaxis(frame.astype(int), 2, 0)
    return strong - blue > 120


def axis_of(pixels: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Middle (x, y) and direction [rad], counter-clockwise, of the long axis."""
    rows, cols = np.nonzero(pixels)
    covariance = np.cov(np.stack([cols, -rows]))
    direction = np.linalg.eigh(covariance)[1][:, -1]
    return float(cols.mean()), float(rows.mean()), math.atan2(direction[1], direction[0])


def test_a_folder_with_a_manifest_gives_what_the_manifest_lists(frames_folder: Path) -> None:
    bar, disk = list_frames(frames_folder)
    assert (bar.name, bar.elongated, disk.elongated) == ("bar", True, False)
    assert bar.read().shape == (480, 640, 3)
    assert bar.read_mask().dtype == bool
    assert list_frames(frames_folder, limit=1) == [bar]


def test_a_folder_without_manifest_gives_every_picture_but_the_masks(
    frames_folder: Path, tmp_path: Path
) -> None:
    for name in ("bar.png", "bar_mask.png", "disk.png"):
        (tmp_path / name).write_bytes((frames_folder / name).read_bytes())
    bar, disk = list_frames(tmp_path)
    assert (bar.name, disk.name, bar.elongated) == ("bar", "disk", None)
    assert bar.mask_path == tmp_path / "bar_mask.png"
    with pytest.raises(QsgmError, match=r"has no mask .*disk_mask.png"):
        disk.read_mask()


@pytest.mark.parametrize("content", ["{", "3", '[{"mask": "a.png"}]', "[1]"])
def test_a_manifest_that_lists_nothing_usable_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(QsgmError, match=r"manifest\.json"):
        list_frames(tmp_path)


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(QsgmError, match="found none"):
        list_frames(tmp_path / "empty")
    with pytest.raises(QsgmError, match="no such folder"):
        list_frames(tmp_path / "nowhere")


def test_the_object_is_gone_from_the_empty_table(cut: CutOut, drawn: Drawn) -> None:
    frame, mask = drawn
    assert red(frame).sum() > 1000
    assert red(cut.table).sum() == 0
    away = np.ones(mask.shape, bool)
    away[120:360, 180:460] = False
    np.testing.assert_array_equal(cut.table[away], frame[away])


def test_an_object_put_back_where_it_was_makes_the_same_frame(cut: CutOut, drawn: Drawn) -> None:
    frame, mask = drawn
    again = put_down(cut, CENTER, 0.0).frame.astype(int)
    assert np.abs(again - frame)[mask].mean() < 8


@pytest.mark.parametrize("degrees", [0, 30, 90, -60, 170])
def test_an_object_is_put_down_where_and_turned_as_the_scene_says(
    cut: CutOut, drawn: Drawn, degrees: float
) -> None:
    turn = math.radians(degrees)
    x, y, axis = axis_of(red(put_down(cut, (450.0, 150.0), turn).frame))
    _, _, before = axis_of(red(drawn[0]))
    assert (x, y) == pytest.approx((450, 150), abs=1.5)
    difference = math.degrees(axis - before - turn) % 180
    assert min(difference, 180 - difference) < 1.5


def test_scenes_are_inside_the_frame_and_the_last_one_is_empty(cut: CutOut) -> None:
    scenes = make_scenes(cut, 8, np.random.default_rng(0))
    assert [scene.center_px is None for scene in scenes] == [False] * 8 + [True]
    for scene in scenes[:-1]:
        assert scene.center_px is not None
        x, y = scene.center_px
        assert BORDER_PX <= x <= 640 - BORDER_PX
        assert BORDER_PX <= y <= 480 - BORDER_PX


def test_the_same_seed_makes_the_same_scenes(cut: CutOut) -> None:
    first, second = (make_scenes(cut, 2, np.random.default_rng(7)) for _ in range(2))
    for a, b in zip(first, second, strict=True):
        np.testing.assert_array_equal(a.frame, b.frame)
        assert a.turn_rad == b.turn_rad


def test_a_mask_of_another_size_is_refused(drawn: Drawn) -> None:
    frame, mask = drawn
    with pytest.raises(QsgmError, match="does not fit"):
        cut_out(frame, mask[:100], CENTER)


def seen(
    center: tuple[float, float] | None, *, found: bool = True, elongated: bool = True
) -> SceneResult:
    """An object at (200, 200), turned by 170 degrees, or none; detected at (203, 204), -14°."""
    blank = np.zeros((480, 640, 3), np.uint8)
    return SceneResult(
        BenchFrame(Path("bar.png"), None, elongated),
        Scene(blank, center, math.radians(170)),
        Detection(found, 0.9, (203.0, 204.0), (0.0, 0.0), -14.0),
    )


def test_scene_errors_are_distances_and_turns_modulo_180() -> None:
    hit = seen((200.0, 200.0))
    assert hit.center_error_px == 5
    assert hit.turn_error_deg == pytest.approx(4)
    assert hit.on_object
    assert not hit.false_detection


def test_detections_elsewhere_and_on_the_empty_table_are_false(bundle: Bundle) -> None:
    elsewhere, nothing = seen((200.0, 200.0 - 2 * ON_OBJECT_PX)), seen(None)
    missed, quiet = seen((200.0, 200.0), found=False), seen(None, found=False)
    assert elsewhere.false_detection
    assert nothing.false_detection
    assert not missed.false_detection
    assert not missed.on_object
    assert not quiet.false_detection
    hit = seen((200.0, 200.0))
    report = ScenesReport(SHORT, bundle, (hit, elsewhere, missed, nothing, quiet))
    summary = report.summary()
    assert (summary["scenes"], summary["empty_scenes"]) == (3, 2)
    assert summary["found_share"] == pytest.approx(1 / 3, abs=1e-4)
    assert (summary["missed"], summary["false_detections"]) == (1, 2)
    assert summary["free_of_false_detections"] == 0.6
    json.dumps(report.to_json(), allow_nan=False)


def test_turns_of_round_objects_do_not_count(bundle: Bundle) -> None:
    report = ScenesReport(SHORT, bundle, (seen((200.0, 200.0), elongated=False),))
    assert report.summary()["median_turn_error_deg"] is None


def test_accuracy_is_measured_for_every_method_on_the_same_crops(
    frames_folder: Path, bundle: Bundle
) -> None:
    told: list[tuple[str, int, int]] = []
    frames = list_frames(frames_folder)
    report = measure_accuracy(frames, bundle, SHORT, lambda *what: told.append(what))
    assert told == [("frames", 1, 2), ("frames", 2, 2)]
    methods = ["untouched", "sgm int8", "sgm float", "bp sgd", "bp adam"]
    assert list(report.frames[0].accuracy) == methods
    alone = finetune(frames[0].read(), bundle, SHORT)
    assert report.frames[0].accuracy["sgm int8"] == alone.accuracy
    assert report.frames[0].accuracy["untouched"] == alone.zero_shot
    values = report.to_json()
    assert (values["all"]["frames"], values["elongated"]["frames"]) == (2, 1)
    json.dumps(values, allow_nan=False)


def test_statistics_are_mean_median_spread_and_both_ends() -> None:
    assert statistics([1.0, 2.0, 6.0]) == {
        "mean": 3.0,
        "median": 2.0,
        "spread": pytest.approx(2.1602, abs=1e-4),
        "min": 1.0,
        "max": 6.0,
    }


def test_bench_accuracy_and_scenes_run_from_the_command_line(
    frames_folder: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--frames", str(frames_folder), "--bundle", str(bundle_folder), "--epochs", "0"]
    report = tmp_path / "report.json"
    assert cli.run(["bench", "accuracy", *common, "--json", "-o", str(report)]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(report.read_text())
    assert cli.run(["bench", "accuracy", *common, "--limit", "1", "--per-frame"]) == 0
    assert "sgm int8" in capsys.readouterr().out
    pictures = tmp_path / "pictures"
    assert cli.run(["bench", "scenes", *common, "--scenes", "1", "-o", str(pictures)]) == 0
    assert "detected on the empty table" in capsys.readouterr().out
    assert len(list(pictures.glob("*.png"))) == 4


def test_ratios_compare_tuning_with_forward_passes() -> None:
    medians = {
        name: {"features": 1.0, "tuning": tuning, "process": 2.0}
        for name, tuning in (("sgm int8", 2.0), ("sgm float", 1.6), ("bp", 3.0), ("torch bp", 5.0))
    }
    found = ratios(medians, 1.0)
    assert found["qsgm_step_over_forward"] == 2
    assert found["int8_step_over_float_step"] == 1.25
    assert found["bp_step_over_qsgm_step"] == 1.5
    assert found["torch_bp_step_over_qsgm_step"] == 2.5
    del medians["torch bp"]
    assert "torch_bp_step_over_qsgm_step" not in ratios(medians, 1.0)


def test_speed_runs_the_same_job_in_processes_of_their_own(
    frame_path: Path, bundle: Bundle
) -> None:
    settings = Settings(layers=2, epochs=1)
    report = measure_speed(frame_path, bundle, settings, 1, lambda *_: None)
    assert set(report["seconds"]) >= {"sgm int8", "sgm float", "bp"}
    assert report["steps"] == 25
    assert report["ratios"]["torch_bp_step_over_qsgm_step"] > 0


def test_speed_names_the_variant_that_failed(bundle: Bundle, tmp_path: Path) -> None:
    write_png(tmp_path / "small.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(QsgmError, match=r"sgm int8 failed with exit code 1: error: .*small\.png"):
        measure_speed(tmp_path / "small.png", bundle, SHORT, 1, lambda *_: None)


def test_the_torch_job_learns_what_backpropagation_here_learns(
    frame_path: Path, bundle: Bundle
) -> None:
    from qsgm.train import torchjob

    settings = Settings(method="bp", layers=2, epochs=2)
    own = finetune(BenchFrame(frame_path, None, None).read(), bundle, settings)
    other = torchjob.run(frame_path, bundle, 2, 2, 0, 1)
    assert other["detection_accuracy"] == pytest.approx(own.accuracy.detection_accuracy, abs=0.006)
    assert other["angle_mae_deg"] == pytest.approx(own.accuracy.angle_mae_deg, abs=0.1)


def test_a_frame_that_cannot_serve_as_a_demonstration_is_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "small.png", np.random.default_rng(0).integers(0, 255, (200, 200, 3)))
    write_png(tmp_path / "flat.png", np.full((480, 640, 3), 90, np.uint8))
    flat, small = list_frames(tmp_path)
    with pytest.raises(QsgmError, match="one flat colour"):
        flat.read()
    with pytest.raises(QsgmError, match="too small for a demonstration"):
        small.read()
