"""`qsgm finetune`: stable keys, one line for every error, and nothing half-written."""

import json
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import FIDELITY_KEYS, Run, assert_refused

from qsgm import paths
from qsgm.cli import commands
from qsgm.errors import QsgmError
from qsgm.manifest import NETWORK, trunk_file
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
    assert_refused(qsgm(*start, "--span", 620, toy_paths[0]), 1, "spans about 620 px", "--span")
    assert_refused(qsgm(*start, "--span", 0, toy_paths[0]), 2, "--span")


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
