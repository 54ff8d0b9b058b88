"""The command line: stable keys, one line for every error, and nothing half-written."""

import json
import os
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from toys import by_correlation, lay, table, toy

from qsgm import __version__, cli, paths
from qsgm.cli import app, commands, console
from qsgm.errors import QsgmError
from qsgm.manifest import NETWORK, trunk_file
from qsgm.tune import run as tuning
from qsgm.tune.settings import Settings

FINETUNE_KEYS = {
    "object",
    "method",
    "precision",
    "layers",
    "epochs",
    "seed",
    "bundle",
    "output",
    "detection_accuracy",
    "angle_mae_deg",
    "zero_shot",
    "fidelity",
    "seconds",
    "peak_activation_bytes",
    "stream",
}
FIDELITY_KEYS = {
    "cos_int8_float",
    "cos_int8_true",
    "cos_float_true",
    "norm_ratio_int8_true",
    "sign_agreement_int8_float",
    "clipped_fraction",
}
PREDICT_KEYS = {
    "object",
    "quality",
    "center_px",
    "displacement_px",
    "angle_deg",
    "heatmap_shape",
    "found",
}


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def json(self) -> dict:
        assert self.code == 0, self.err
        assert self.out.count("\n") == 1
        return json.loads(self.out)


Run = Callable[..., Outcome]


@pytest.fixture
def qsgm(capsys: pytest.CaptureFixture[str]) -> Run:
    """The command line in this process."""

    def run(*arguments: object) -> Outcome:
        code = cli.run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run


def in_a_process(*arguments: object) -> Outcome:
    done = subprocess.run(
        [sys.executable, "-m", "qsgm.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


def assert_refused(outcome: Outcome, code: int, *said: str) -> None:
    """One line that says what is wrong, and nothing else anywhere."""
    assert outcome.code == code, outcome.err
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1, outcome.err
    assert "Traceback" not in outcome.err
    for text in said:
        assert text in outcome.err


@pytest.fixture
def taught(qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path) -> Path:
    folder = tmp_path / "taught"
    outcome = qsgm(
        "finetune", "--epochs", 1, "--bundle", bundle_folder, "-o", folder, "--json", frame_path
    )
    assert outcome.code == 0, outcome.err
    return folder


@pytest.mark.parametrize(
    ("options", "used"),
    [((), "float"), (("--trunk", "int8"), "int8"), (("--trunk", "float"), "float")],
)
def test_the_frozen_layers_precision_is_the_bundles_unless_it_is_given(
    qsgm: Run,
    frame_path: Path,
    bundle_folder: Path,
    tmp_path: Path,
    options: tuple[str, ...],
    used: str,
) -> None:
    common = ("--json", "--epochs", 0, "--bundle", bundle_folder, *options, frame_path)
    assert qsgm("finetune", "-o", tmp_path / "bar", *common).json["trunk"] == used
    assert qsgm("fidelity", *common).json["trunk"] == used


def test_finetune_prints_one_json_object_with_the_stable_keys(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "bar"
    outcome = qsgm(
        "finetune", "--json", "--int8", "--epochs", 2, "--seed", 5, "--bundle", bundle_folder,
        "-o", folder, frame_path,
    )  # fmt: skip
    values = outcome.json
    assert values.keys() >= FINETUNE_KEYS
    assert outcome.err == ""
    given = {key: values[key] for key in ("object", "method", "precision", "layers", "epochs")}
    assert given == {
        "object": "bar",
        "method": "sgm",
        "precision": "int8",
        "layers": 3,
        "epochs": 2,
    }
    assert (values["seed"], values["output"]) == (5, str(folder))
    assert values["bundle"] == str(bundle_folder)
    accuracy = {"detection_accuracy", "angle_mae_deg", "told_apart"}
    accuracy |= {"detection_accuracy_plain", "angle_mae_deg_plain"}
    assert set(values["zero_shot"]) == accuracy <= values.keys()
    assert set(values["verdict"]) == {"good", "reasons", "notes"}
    assert (values["scale"], values["others"]) == (1.0, 0)
    assert set(values["fidelity"]) == {"4", "5"}
    assert all(layer.keys() >= FIDELITY_KEYS for layer in values["fidelity"].values())
    assert values["seconds"].keys() >= {"crops", "features", "tuning", "probes", "total"}
    assert set(values["peak_activation_bytes"]) == {"sgm", "backprop"}


def test_a_streamed_object_is_the_same_object(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    start = ("finetune", "--json", "--epochs", 1, "--bundle", bundle_folder, "-o")
    kept, streamed = tmp_path / "kept", tmp_path / "streamed"
    assert qsgm(*start, kept, frame_path).json["stream"] is False
    assert qsgm(*start, streamed, "--stream", frame_path).json["stream"] is True
    networks = [(folder / "network.onnx").read_bytes() for folder in (kept, streamed)]
    assert networks[0] == networks[1]


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


def test_the_same_seed_prints_the_same_numbers(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    runs = []
    for name in ("a", "b"):
        values = qsgm(
            "finetune", "--json", "--epochs", 1, "--bundle", bundle_folder,
            "-o", tmp_path / name, frame_path,
        ).json  # fmt: skip
        runs.append({key: values[key] for key in values.keys() - {"seconds", "output"}})
    assert runs[0] == runs[1]
    networks = [(tmp_path / name / NETWORK).read_bytes() for name in ("a", "b")]
    assert networks[0] == networks[1]


def test_backpropagation_is_reported_as_float(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    outcome = qsgm(
        "finetune", "--json", "--method", "bp", "--int8", "--epochs", 0, "--bundle",
        bundle_folder, "-o", tmp_path / "bar", frame_path,
    )  # fmt: skip
    assert outcome.json["precision"] == "float"
    assert outcome.err == "note: backpropagation runs in float; --int8 concerns SGMs only\n"


def test_fidelity_prints_the_table_and_keeps_nothing(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    common = ("fidelity", "--epochs", 1, "--bundle", bundle_folder, frame_path)
    assert "cos" in qsgm(*common).out
    assert sorted(tmp_path.rglob("*")) == before
    values = qsgm(*common, "--json", "-o", tmp_path / "report.json").json
    assert all(layer.keys() >= FIDELITY_KEYS for layer in values["fidelity"].values())
    assert [probe["epoch"] for probe in values["fidelity_over_run"]] == [0, 1]
    assert json.loads((tmp_path / "report.json").read_text()) == values


def png_header(width: int, height: int) -> bytes:
    """A small PNG that says it is large."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + checksum

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def encoded(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


NOISE = np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)
BAD_FRAMES = {
    "empty": b"",
    "truncated": encoded(NOISE)[:-5000],
    "text": b"this is a shopping list, not a picture",
    "tiny": encoded(NOISE[:8, :8]),
    "flat": encoded(np.full((480, 640, 3), 90, np.uint8)),
    "huge": png_header(60_000, 60_000),
}


@pytest.mark.parametrize("kind", ["missing", "folder", *BAD_FRAMES])
def test_a_bad_frame_is_refused_in_one_line_and_nothing_is_written(
    qsgm: Run, kind: str, bundle_folder: Path, tmp_path: Path
) -> None:
    path = tmp_path / f"{kind}.png"
    if kind == "folder":
        path.mkdir()
    elif kind != "missing":
        path.write_bytes(BAD_FRAMES[kind])
    before = sorted(tmp_path.rglob("*"))
    folder = tmp_path / "out"
    outcome = qsgm("finetune", "--bundle", bundle_folder, "-o", folder, path)
    assert_refused(outcome, 1, "error: ", kind)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("kind", ["grey", "four channels", "16 bit"])
def test_unusual_pictures_that_show_an_object_are_used(
    qsgm: Run, kind: str, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    image = cv2.imread(str(frame_path))
    unusual = {
        "grey": image[:, :, 1],
        "four channels": cv2.cvtColor(image, cv2.COLOR_BGR2BGRA),
        "16 bit": image.astype(np.uint16) * 257,
    }
    path = tmp_path / "unusual.png"
    cv2.imwrite(str(path), unusual[kind])
    outcome = qsgm(
        "finetune", "--json", "--epochs", 0, "--bundle", bundle_folder, "-o", tmp_path / "o", path
    )
    assert outcome.json["object"] == "unusual"


USAGE_ERRORS = [
    ("--layers", "99"),
    ("--layers", "0"),
    ("--epochs", "-1"),
    ("--epochs", "many"),
    ("--seed", "abc"),
    ("--seed", "-1"),
    ("--seed", "2147483648"),
    ("--center", "5"),
    ("--center", "5,x"),
    ("--center", "1,2,3"),
    ("--method", "magic"),
    ("--optimizer", "lion"),
    ("--threads", "0"),
    ("--no-such-option", "1"),
]


@pytest.mark.parametrize(("option", "value"), USAGE_ERRORS)
def test_a_value_out_of_range_is_a_usage_error_in_one_line(
    qsgm: Run, option: str, value: str, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    outcome = qsgm("finetune", option, value, "--bundle", bundle_folder, frame_path)
    assert_refused(outcome, 2, option, "see `qsgm finetune --help`")
    assert sorted(tmp_path.rglob("*")) == before


def test_no_frame_at_all_is_a_usage_error(qsgm: Run) -> None:
    assert_refused(qsgm("finetune"), 2)
    assert_refused(qsgm("predict", "a.png", "b.png"), 2)


@pytest.fixture
def toy_paths(tmp_path: Path) -> list[Path]:
    """A toy, the same one turned on another table, and another thing."""
    frames = [
        lay(toy(), table(), (320.0, 240.0)),
        lay(toy(), table(1), (260.0, 200.0), 70),
        lay(toy()[..., [2, 1, 0, 3]], table(2), (320.0, 240.0)),
    ]
    paths = [tmp_path / f"{name}.png" for name in ("toy", "turned", "other")]
    for path, frame in zip(paths, frames, strict=True):
        cv2.imwrite(str(path), frame)
    return paths


def test_several_frames_are_demonstrations_of_one_object(
    qsgm: Run, toy_paths: list[Path], bundle_folder: Path, tmp_path: Path
) -> None:
    start = ("finetune", "--json", "--epochs", 0, "--bundle", bundle_folder, "-o", tmp_path / "o")
    centers = ("--center", "320,240", "--center", "260,200")
    values = qsgm(*start, *centers, *toy_paths[:2]).json
    assert values["object"] == "toy"
    assert [one["turn_deg"] for one in values["demonstrations"]] == [
        0,
        pytest.approx(70, abs=0.5),
    ]
    three = qsgm(*start, *centers, *toy_paths)
    assert_refused(three, 2, "--center", "2 points for 3 frames: expected one, or one for every")


def test_things_to_tell_it_apart_from_are_frames_or_tuned_objects(
    qsgm: Run, toy_paths: list[Path], bundle_folder: Path, tmp_path: Path
) -> None:
    start = ("finetune", "--json", "--epochs", 0, "--bundle", bundle_folder, "-o")
    first, *_, other = toy_paths
    assert qsgm(*start, tmp_path / "other", other).code == 0
    named = ("--not", other, "--not", tmp_path / "other")
    assert qsgm(*start, tmp_path / "o", *named, first).json["others"] == 2
    made = json.loads((tmp_path / "o" / "object.json").read_text())["made"]
    assert len(set(made["others_sha256"])) == 1
    missing = qsgm(*start, tmp_path / "p", "--not", tmp_path / "nowhere.png", first)
    assert_refused(missing, 1, "nowhere.png")
    assert_refused(qsgm(*start, tmp_path / "p", "--not", bundle_folder, first), 1, "object.json")
    assert not (tmp_path / "p").exists()


def test_the_objects_size_is_measured_unless_it_is_said(
    qsgm: Run, toy_paths: list[Path], bundle_folder: Path, tmp_path: Path
) -> None:
    start = ("finetune", "--json", "--epochs", 0, "--bundle", bundle_folder, "-o", tmp_path / "o")
    measured = qsgm(*start, toy_paths[0]).json
    assert measured["span_px"] == pytest.approx(90, abs=5)
    said = qsgm(*start, "--span", 150, toy_paths[0]).json
    assert (said["span_px"], said["scale"]) == (150.0, pytest.approx(0.6))
    assert_refused(qsgm(*start, "--span", 460, toy_paths[0]), 1, "spans about 460 px", "--span")
    assert_refused(qsgm(*start, "--span", 0, toy_paths[0]), 2, "--span")


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


def test_blocks_say_how_many_layers_to_tune(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    outcome = qsgm(
        "finetune", "--json", "--epochs", 0, "--blocks", "4,5-6", "--layers", 3, "--bundle",
        bundle_folder, "-o", tmp_path / "bar", frame_path,
    )  # fmt: skip
    assert (outcome.json["layers"], outcome.json["blocks"]) == (3, "4,5-6")
    assert set(outcome.json["fidelity"]) == {"4"}
    shown = qsgm(
        "finetune", "--epochs", 0, "--blocks", "4,5-6", "--bundle", bundle_folder, "-o",
        tmp_path / "bar", frame_path,
    )  # fmt: skip
    assert "bar: blocks 4,5-6, sgm float" in shown.out


def test_blocks_that_are_none_or_contradict_the_layers_are_a_usage_error(
    qsgm: Run, frame_path: Path, bundle_folder: Path
) -> None:
    command = ("finetune", "--bundle", bundle_folder, frame_path)
    assert_refused(qsgm(*command, "--blocks", "4,6"), 2, "--blocks", "expected every layer")
    contradiction = qsgm(*command, "--blocks", "4,5-6", "--layers", 2)
    assert_refused(contradiction, 2, "--blocks", "4,5-6 is 3 layers, but --layers says 2")
    assert_refused(qsgm("fold-and-quantize", "sgm.pt", "--blocks", "6-7,"), 2, "--blocks")
    # Only the network says how many layers there are.
    assert_refused(qsgm(*command, "--blocks", "7"), 1, "to layer 6, alone or in ranges")


def test_blocks_that_the_bundle_lacks_are_refused_with_those_it_has(
    qsgm: Run, frame_path: Path, bundle_folder: Path
) -> None:
    outcome = qsgm("finetune", "--bundle", bundle_folder, "--blocks", "4-5,6", frame_path)
    assert_refused(outcome, 1, "no step for the blocks 4-5,6; choose one of 6 or 5,6 or 4,5,6")


def test_an_unknown_command_is_a_usage_error(qsgm: Run) -> None:
    assert_refused(qsgm("fine-tune"), 2, "fine-tune", "see `qsgm --help`")


def test_a_centre_outside_of_the_frame_is_refused(
    qsgm: Run, frame_path: Path, bundle_folder: Path
) -> None:
    for center in ("650,10", "-5,240", "nan,nan", "inf,240"):
        outcome = qsgm("finetune", "--bundle", bundle_folder, "--center", center, frame_path)
        assert_refused(outcome, 1, "is outside of the 640x480 frame", "--center")


def test_a_spoilt_bundle_is_refused_in_one_line(
    qsgm: Run, frame_path: Path, own_bundle: Path, tmp_path: Path
) -> None:
    command = ("finetune", "--bundle", own_bundle, "-o", tmp_path / "out", frame_path)
    (own_bundle / trunk_file("float", range(4, 7))).write_bytes(b"altered")
    assert_refused(qsgm(*command), 1, "trunk_float_3.onnx", "qsgm fold-and-quantize")
    (own_bundle / trunk_file("float", range(4, 7))).unlink()
    assert_refused(qsgm(*command), 1, "trunk_float_3.onnx does not exist")
    (own_bundle / "manifest.json").unlink()
    assert_refused(qsgm(*command), 1, "manifest.json")
    missing = ("finetune", "--bundle", tmp_path / "nowhere", frame_path)
    assert_refused(qsgm(*missing), 1, "there is no such folder")
    assert not (tmp_path / "out").exists()


def test_a_folder_that_is_in_the_way_is_noticed_before_anything_runs(
    qsgm: Run, bundle_folder: Path, tmp_path: Path
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    outcome = qsgm(
        "finetune", "--bundle", bundle_folder, "-o", tmp_path / "mine", tmp_path / "missing.png"
    )
    assert_refused(outcome, 1, "did not write 'thesis.txt'")
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"


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


def test_host_commands_say_what_to_install_when_torch_is_missing(
    qsgm: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_torch(_: str) -> None:
        raise ModuleNotFoundError("No module named 'torch'", name="torch.nn")

    monkeypatch.setattr(console, "importlib", SimpleNamespace(import_module=without_torch))
    for command in (("pretrain",), ("fold-and-quantize", "sgm.pt")):
        assert_refused(
            qsgm(*command), 1, "needs torch", "pip install -c constraints.txt '.[train]'"
        )


def test_a_bug_is_not_hidden(qsgm: Run, monkeypatch: pytest.MonkeyPatch, frame_path: Path) -> None:
    def broken(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(commands, "open_bundle", broken)
    with pytest.raises(ZeroDivisionError):
        qsgm("finetune", frame_path)


def test_the_progress_says_nothing_unless_it_is_on_a_terminal(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with console.progress() as watch:
        watch("crops", 1, 2)
        watch("meta", 1, 2, {"loss": 0.5})
    assert capsys.readouterr() == ("", "")


def test_the_version_and_the_help_are_printed(qsgm: Run) -> None:
    assert qsgm("--version").out == f"qsgm {__version__}\n"
    assert "finetune" in qsgm("--help").out
    assert "finetune" in qsgm().out
    for command in ("finetune", "predict", "fidelity", "pretrain", "fold-and-quantize"):
        assert qsgm(command, "--help").code == 0


def test_exit_codes_and_single_lines_hold_in_a_process_of_its_own(
    bundle_folder: Path, tmp_path: Path
) -> None:
    path = tmp_path / "empty.png"
    path.write_bytes(b"")
    outcome = in_a_process("finetune", "--bundle", bundle_folder, path)
    assert_refused(outcome, 1, "empty.png")
    assert_refused(in_a_process("finetune", "--layers", 99, path), 2, "--layers")


def test_json_is_all_there_is_on_stdout_of_a_process(
    bundle_folder: Path, frame_path: Path, tmp_path: Path
) -> None:
    outcome = in_a_process(
        "finetune", "--json", "--epochs", 1, "--bundle", bundle_folder,
        "-o", tmp_path / "bar", frame_path,
    )  # fmt: skip
    assert outcome.json["object"] == "bar"
    assert outcome.err == ""


def test_an_interrupt_exits_with_130_and_writes_nothing(
    qsgm: Run,
    bundle_folder: Path,
    frame_path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr(tuning, "run_epochs", interrupted)
    outcome = qsgm("finetune", "--bundle", bundle_folder, "-o", tmp_path / "out", frame_path)
    assert (outcome.code, outcome.out, outcome.err) == (130, "", "interrupted\n")
    assert sorted(tmp_path.rglob("*")) == before


def environment(**changes: str | None) -> dict[str, str]:
    values = {**os.environ, **changes}
    return {name: value for name, value in values.items() if value is not None}


def predict_into(taught: Path, frame: Path, redirection: str, **changes: str | None) -> Outcome:
    """`predict` in a shell, its streams as the shell's words have them."""
    command = [sys.executable, "-m", "qsgm.cli", "predict", "--object", str(taught), str(frame)]
    done = subprocess.run(
        ["bash", "-c", f'"$@" {redirection}', "bash", *command],
        env=environment(**changes),
        capture_output=True,
        text=True,
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


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


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("options", ["", "--json", "--help"])
def test_a_full_disk_behind_stdout_is_one_line(
    taught: Path, frame_path: Path, options: str
) -> None:
    outcome = predict_into(taught, frame_path, f"{options} >/dev/full")
    assert_refused(outcome, 1, "cannot write to standard output: no space left on device")


@pytest.mark.parametrize("streams", [">&-", "<&- >&- 2>&-"])
def test_closed_streams_are_nobodys_and_no_files(
    taught: Path, frame_path: Path, tmp_path: Path, streams: str
) -> None:
    outcome = predict_into(taught, frame_path, f"-o {tmp_path}/picture.png {streams}")
    assert (outcome.code, outcome.err) == (0, "")
    assert cv2.imread(str(tmp_path / "picture.png")) is not None


@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_a_table_is_printed_in_any_encoding(taught: Path, frame_path: Path, encoding: str) -> None:
    outcome = predict_into(taught, frame_path, "", PYTHONIOENCODING=encoding, PYTHONUTF8="0")
    assert (outcome.code, outcome.err) == (0, "")
    assert "quality" in outcome.out


@pytest.mark.parametrize("columns", ["0", "100000000000"])
def test_a_table_is_printed_whatever_columns_says(
    taught: Path, frame_path: Path, columns: str
) -> None:
    outcome = predict_into(taught, frame_path, "", COLUMNS=columns)
    assert (outcome.code, outcome.err) == (0, "")
    assert "quality" in outcome.out


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


def test_a_report_does_not_take_the_place_of_the_frame(
    qsgm: Run, bundle_folder: Path, frame_path: Path
) -> None:
    before = frame_path.read_bytes()
    outcome = qsgm("fidelity", "--bundle", bundle_folder, "-o", frame_path, frame_path)
    assert_refused(outcome, 1, "it is an input")
    assert frame_path.read_bytes() == before


@pytest.mark.parametrize("output", [".", "", "../here", "/"])
def test_the_working_folder_is_never_replaced(
    qsgm: Run,
    bundle_folder: Path,
    frame_path: Path,
    tmp_path: Path,
    output: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    outcome = qsgm("finetune", "--bundle", bundle_folder, "-o", output, frame_path)
    assert_refused(outcome, 1, "will not replace the folder")
    assert list(tmp_path.glob("*")) == [tmp_path / "here"]


NAMES = [
    "mug\udcff",
    "mug\x1b[31m",
    "mug\nmug",
    "[red]mug[]",
    "日本語",
    "m" * 240,
    " mug ",
    "\u202egum",
]


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_any_name_is_taught_found_and_drawn_as_text(
    qsgm: Run, bundle_folder: Path, frame_path: Path, tmp_path: Path, name: str
) -> None:
    frame = tmp_path / f"{name}.png"
    frame.write_bytes(frame_path.read_bytes())
    options = ("-o", tmp_path / f"{name}-out") if name in NAMES[::2] else ()
    taught = qsgm("finetune", "--epochs", 0, "--bundle", bundle_folder, *options, frame)
    assert taught.code == 0, taught.err
    found = qsgm("predict", "-o", tmp_path / f"{name}2.png", frame)
    assert found.code == 0, found.err
    for text in (taught, found):
        assert text.err == ""
        assert all(line.isprintable() for line in text.out.splitlines())


def test_an_interrupt_that_became_another_error_while_modules_loaded_is_an_interrupt(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(_: object) -> int:
        raise ImportError("numpy.core.multiarray failed to import")

    monkeypatch.setattr(app, "call", broken)
    for signals, code in (((2,), 130), ((15,), 143), ((1,), 129)):
        assert cli.run(["predict"], signals) == code
        assert capsys.readouterr().err == "interrupted\n"


@pytest.mark.parametrize(
    "error",
    [
        ImportError("libGL.so.1: cannot open shared object file", name="cv2"),
        ImportError("libGL.so.1: cannot open shared object file"),
        ModuleNotFoundError("No module named 'onnxruntime'", name="onnxruntime"),
        AttributeError("module 'cv2' has no attribute 'imdecode'", obj=cv2),
    ],
)
def test_a_broken_installation_is_one_line(
    error: Exception, monkeypatch: pytest.MonkeyPatch, qsgm: Run
) -> None:
    def broken(_: object) -> int:
        raise error

    monkeypatch.setattr(app, "call", broken)
    assert_refused(qsgm("predict"), 1, "the installation of", "is broken", str(error))


@pytest.mark.parametrize(
    "error", [ImportError("no", name="qsgm.nothing"), AttributeError("no", obj=None)]
)
def test_a_module_of_our_own_that_is_missing_is_a_bug(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object) -> int:
        raise error

    monkeypatch.setattr(app, "call", broken)
    with pytest.raises(type(error)):
        cli.run(["predict"])


def test_an_object_that_cannot_be_remembered_is_still_written(
    qsgm: Run,
    frame_path: Path,
    bundle_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fail(_: Path) -> None:
        raise QsgmError("no home")

    monkeypatch.setattr(paths, "remember_object", fail)
    outcome = qsgm(
        "finetune", "--json", "--epochs", 0, "--bundle", bundle_folder,
        "-o", tmp_path / "bar", frame_path,
    )  # fmt: skip
    assert outcome.json["output"] == str(tmp_path / "bar")
    assert "will need --object" in outcome.err
    assert (tmp_path / "bar" / NETWORK).is_file()


def test_speed_needs_a_step_to_time(qsgm: Run) -> None:
    assert_refused(qsgm("bench", "speed", "--epochs", 0), 2, "--epochs")


def test_drawing_a_calibration_set_prints_one_json_object(qsgm: Run, tmp_path: Path) -> None:
    folder = tmp_path / "calib"
    outcome = qsgm("draw-calibration", "--count", 1, "--seed", 3, "-o", folder, "--json")
    assert outcome.json == {"output": str(folder), "frames": 1, "seed": 3}
    assert (folder / "frame_00.jpg").is_file()


def test_pretrain_passes_on_encoding_and_hidden_channels(
    qsgm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from qsgm.train.grasp import pretrain

    given = []
    monkeypatch.setattr(pretrain, "pretrain_grasping", lambda *values: given.append(values))
    common = ("pretrain", "--json", "-o", tmp_path / "sgm.pt")
    assert qsgm(*common).json["output"] == str(tmp_path / "sgm.pt")
    assert qsgm(*common, "--encoding", "paper", "--hidden", "16,8").code == 0
    (task, *_, config), (other_task, *_, other_config) = given
    assert config == pretrain.PretrainConfig()
    assert task.encoding == "double"
    assert other_config.hidden == (16, 8)
    assert other_task.encoding == "paper"


@pytest.mark.parametrize("hidden", ["", "a", "8,", "0", "-4,4", "8;8", "99999"])
def test_hidden_channels_that_are_none_are_a_usage_error(qsgm: Run, hidden: str) -> None:
    assert_refused(qsgm("pretrain", "--hidden", hidden), 2, "--hidden")


def test_defaults_of_the_command_line_are_those_of_the_library(
    qsgm: Run, frame_path: Path, bundle_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def stop(frames: list[Path], centers: object, others: object, _: object, *how: object) -> None:
        seen.append((frames, centers, others, *how))
        raise QsgmError("enough")

    monkeypatch.setattr(commands, "_finetune", stop)
    qsgm("finetune", "--bundle", bundle_folder, frame_path)
    assert seen == [([frame_path], [None], (), Settings(), None)]


def test_an_overlay_without_a_name_is_refused(qsgm: Run, taught: Path, frame_path: Path) -> None:
    for output in ("/", "."):
        outcome = qsgm("predict", "--object", taught, "-o", output, frame_path)
        assert_refused(outcome, 1, "cannot write")
