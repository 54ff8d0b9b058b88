"""`qsgm predict`: stable keys, one line for every error, and nothing written unless asked for."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Run, assert_refused, predict_into
from toys import by_correlation

PREDICT_KEYS = {
    "object",
    "quality",
    "center_px",
    "displacement_px",
    "angle_deg",
    "heatmap_shape",
    "found",
}


def test_finetune_and_predict_for_people(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    taught = qsgm("finetune", "--epochs", 1, "--bundle", bundle_folder, frame_path)
    assert taught.code == 0, taught.err
    texts = (
        "untouched",
        "tuned",
        "cos",
        "clipped",
        "verdict: ",
        "seconds: crops",
        "tuned object: ",
    )
    for text in texts:
        assert text in taught.out
    folder = tmp_path / "data" / "qsgm" / "objects" / "bar"
    assert str(folder) in taught.out
    found = qsgm("predict", "-o", tmp_path / "overlay.png", frame_path)
    assert found.code == 0, found.err
    assert "bar" in found.out
    assert "quality" in found.out
    assert cv2.imread(str(tmp_path / "overlay.png")) is not None


def test_predict_prints_one_json_object_with_the_stable_keys(
    qsgm: Run, taught: Path, frame_path: Path
) -> None:
    values = qsgm("predict", "--json", "--object", taught, frame_path).json
    assert values.keys() >= PREDICT_KEYS
    assert values["object"] == "bar"
    assert values["heatmap_shape"] == [3, 29, 39]  # of the frame with its margin
    assert 0 <= values["quality"] <= 1
    assert -90 < values["angle_deg"] <= 90
    x, y = values["center_px"]
    assert values["displacement_px"] == pytest.approx([x - 320, y - 240], abs=0.011)
    assert values["refined_by"] in ("patch", "network")
    assert values["scale"] == 1
    first = values["candidates"][0]
    keys = ("center_px", "quality", "angle_deg", "full_angle_deg")
    assert first == {key: values[key] for key in keys}
    assert "objects" not in values


def test_the_object_tuned_last_is_the_one_predict_uses(
    qsgm: Run, taught: Path, frame_path: Path
) -> None:
    assert taught.is_dir()
    assert qsgm("predict", "--json", frame_path).json["object"] == "bar"


def test_any_distance_is_told_by_the_scale_and_not_for_all_instances(
    qsgm: Run, taught: Path, frame_path: Path
) -> None:
    values = qsgm("predict", "--json", "--any-distance", "--object", taught, frame_path).json
    assert values["scale"] in (1, 0.5, 0.71429, 1.42857, 2)
    both = qsgm("predict", "--all", "--any-distance", "--object", taught, frame_path)
    assert_refused(both, 2, "--all looks at the demonstration's distance only")


def test_predict_writes_nothing_unless_told_to(
    qsgm: Run, taught: Path, frame_path: Path, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    qsgm("predict", "--object", taught, frame_path)
    assert sorted(tmp_path.rglob("*")) == before


def test_an_object_that_is_not_there_is_reported_and_that_is_no_error(
    qsgm: Run, taught: Path, tmp_path: Path
) -> None:
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((480, 640, 3), 200, np.uint8))
    values = qsgm("predict", "--json", "--object", taught, blank).json
    assert values["found"] is False
    assert "not found" in qsgm("predict", "--object", taught, blank).out


def test_all_instances_are_listed_in_json_in_a_table_and_in_the_picture(
    qsgm: Run, toy_paths: list[Path], own_bundle: Path, tmp_path: Path
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["task"]["decision"] = by_correlation(-10).to_json()
    path.write_text(json.dumps(manifest))
    outcome = qsgm(
        "finetune", "--json", "--epochs", 0, "--bundle", own_bundle, "-o", tmp_path / "o",
        toy_paths[0],
    )  # fmt: skip
    assert outcome.code == 0
    common = ("predict", "--object", tmp_path / "o", "--all", toy_paths[0])
    values = qsgm(*common, "--json", "-o", tmp_path / "all.png").json
    assert len(values["objects"]) > 1
    for one in values["objects"]:
        assert set(one) == {
            "quality", "center_px", "displacement_px", "angle_deg", "full_angle_deg",
            "full_angle_confidence", "refined_by",
        }  # fmt: skip
    assert cv2.imread(str(tmp_path / "all.png")) is not None
    assert f"o: {len(values['objects'])} found" in qsgm(*common).out.replace("toy:", "o:")
    manifest["task"]["decision"] = {}
    path.write_text(json.dumps(manifest))
    spoilt = qsgm("finetune", "--bundle", own_bundle, toy_paths[0])
    assert_refused(spoilt, 1, "the decision weighs other evidence")


def test_predict_without_any_object_says_what_to_run(qsgm: Run, frame_path: Path) -> None:
    assert_refused(qsgm("predict", frame_path), 1, "qsgm finetune object.png")


def test_predict_with_something_else_as_object_is_refused(
    qsgm: Run, frame_path: Path, bundle_folder: Path
) -> None:
    assert_refused(qsgm("predict", "--object", bundle_folder, frame_path), 1, "object.json")


def test_a_name_with_a_line_break_still_makes_one_line(qsgm: Run, tmp_path: Path) -> None:
    assert_refused(qsgm("predict", "--object", tmp_path / "a\nb", "x.png"), 1)


def test_an_output_that_cannot_be_written_is_refused(
    qsgm: Run, taught: Path, frame_path: Path, tmp_path: Path
) -> None:
    outcome = qsgm("predict", "--object", taught, "-o", tmp_path, frame_path)
    assert_refused(outcome, 1, "cannot write")


def test_a_reader_that_goes_away_makes_no_noise(taught: Path, frame_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "qsgm.cli", "predict", "--object", str(taught), str(frame_path)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    err = process.stderr.read()
    code = process.wait(timeout=30)
    process.stderr.close()
    assert (code, err) == (141, "")


def test_a_picture_can_be_piped_in(taught: Path, frame_path: Path) -> None:
    piped = predict_into(taught, Path("-"), f"--json <{frame_path}")
    assert piped.json == predict_into(taught, frame_path, "--json").json
    assert_refused(predict_into(taught, Path("-"), "</dev/null"), 1, "- is empty")
    assert_refused(predict_into(taught, Path("-"), "<&-"), 1, "- does not exist")


@pytest.mark.parametrize(
    "options", [("-o", "scene.jpg"), ("-o", "scene"), ("-o", "../scenes/scene.png")]
)
def test_a_picture_that_must_not_be_written_is_refused_before_anything_runs(
    qsgm: Run,
    taught: Path,
    frame_path: Path,
    tmp_path: Path,
    options: tuple[str, ...],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "scenes").mkdir()
    scene = tmp_path / "scenes" / "scene.png"
    scene.write_bytes(frame_path.read_bytes())
    monkeypatch.chdir(tmp_path / "scenes")
    outcome = qsgm("predict", "--object", taught, *options, scene)
    assert_refused(outcome, 1, "scene", "; pass another name" if "../" in options[1] else ".png")
    assert scene.read_bytes() == frame_path.read_bytes()
    assert [path.name for path in scene.parent.iterdir()] == ["scene.png"]


def test_an_overlay_without_a_name_is_refused(qsgm: Run, taught: Path, frame_path: Path) -> None:
    for output in ("/", "."):
        outcome = qsgm("predict", "--object", taught, "-o", output, frame_path)
        assert_refused(outcome, 1, "cannot write")
