"""deploy/native: what it tunes are Python's bits, and each finds the other's objects."""

import hashlib
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
import pytest
from numpy.typing import NDArray

from qsgm import Settings, load_bundle, load_object, resolve
from qsgm.blocks import parse_blocks
from qsgm.bundle import Bundle
from qsgm.grasp.task import distractors_of
from qsgm.grasp.teach import prepare_object, train_object
from qsgm.train.slim import PLAIN, slim_bundle

SOURCE = Path(__file__).parents[2] / "deploy" / "native"
HEADER = "onnxruntime_c_api.h"
SANITIZE = "-O1 -fsanitize=address,undefined -fno-sanitize-recover=all"
# What an object spans that frames are not scaled for: deploy/native does not measure.
SPAN_PX = 90
FUZZED = 25

Frame = NDArray[np.uint8]


@dataclass(frozen=True)
class Program:
    """The program, built."""

    path: Path

    def __call__(
        self, *arguments: object, home: Path | None = None
    ) -> subprocess.CompletedProcess[str]:
        kept = {} if home is None else {"HOME": str(home), "XDG_CACHE_HOME": str(home)}
        return subprocess.run(
            [str(self.path), *map(str, arguments)],
            env=os.environ | kept,
            capture_output=True,
            text=True,
            check=False,
        )


def build(folder: Path, flags: str) -> Program:
    """The program as this machine can build it, else the test is skipped with the reason."""
    compiler = os.environ.get("CC") or shutil.which("cc")
    places = [os.environ.get("ORT_INCLUDE"), SOURCE / "build/include", "/usr/include/onnxruntime"]
    include = next((one for one in places if one and (Path(one) / HEADER).is_file()), None)
    library = next(iter((Path(ort.__file__).parent / "capi").glob("libonnxruntime.so.*")), None)
    for what, there in (("C compiler", compiler), ("make", shutil.which("make"))):
        if there is None:
            pytest.skip(f"there is no {what}: deploy/native is not built")
    if include is None:
        pytest.skip(f"there is no {HEADER}: run deploy/native/get-header or set ORT_INCLUDE")
    if library is None:
        pytest.skip("onnxruntime comes without a libonnxruntime.so that C can link here")
    values = {"ORT_INCLUDE": include, "ORT_LIB": library, "OUT": folder, "CC": compiler}
    command = ["make", "-C", str(SOURCE), *(f"{name}={one}" for name, one in values.items())]
    done = subprocess.run(
        [*command, f"CFLAGS={flags}"], capture_output=True, text=True, check=False
    )
    if done.returncode and "sanitize" in flags and "cannot find" in done.stderr:
        pytest.skip("the compiler comes without sanitizers: deploy/native is not fuzzed")
    assert done.returncode == 0, done.stderr
    return Program(folder / "qsgm-native")


@pytest.fixture(scope="module")
def native(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return build(tmp_path_factory.mktemp("native"), "-O2")


@pytest.fixture(scope="module")
def slim(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    folder = tmp_path_factory.mktemp("slim") / "three"
    slim_bundle(bundle, parse_blocks("4,5,6"), folder)
    return load_bundle(folder)


@pytest.fixture(scope="module")
def ppm(frame: Frame, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("frames") / "object.ppm"
    cv2.imwrite(str(path), frame)
    return path


@pytest.fixture(scope="module")
def own(native: Program, slim: Bundle, ppm: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An object that the program tuned."""
    folder = tmp_path_factory.mktemp("objects") / "own"
    done = native("finetune", "--epochs", 3, "--name", "a bar", slim.folder, ppm, folder)
    assert (done.returncode, done.stderr) == (0, "")
    return folder


@pytest.mark.parametrize(
    ("blocks", "precision", "seed"),
    [("4,5,6", "int8", 0), ("4,5,6", "float", 7), ("3,4,5,6", "int8", 0)],
)
def test_tuned_weights_are_pythons_to_the_last_bit(
    native: Program, bundle: Bundle, frame: Frame, ppm: Path, tmp_path: Path,
    blocks: str, precision: str, seed: int,
) -> None:  # fmt: skip
    slim_bundle(bundle, parse_blocks(blocks), tmp_path / "bundle")
    one = load_bundle(tmp_path / "bundle")
    layers = len(parse_blocks(blocks).layers)
    settings = Settings(precision=precision, layers=layers, epochs=1, seed=seed)  # type: ignore[arg-type]
    plan = resolve(settings, one)
    prepared = prepare_object(frame, one, plan, span_px=SPAN_PX)
    expected = train_object(prepared, plan)
    int8 = ["--int8"] if precision == "int8" else []
    options = [*int8, "--epochs", 1, "--seed", seed]
    done = native("finetune", *options, one.folder, ppm, tmp_path / "object")
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "object/network.onnx").read_bytes() == expected.network()
    about = json.loads((tmp_path / "object/object.json").read_text())
    assert about["offset_rad"] == pytest.approx(prepared.orientation.offset_rad, abs=1e-12)
    found = f"detection {expected.scores['detection_accuracy']:.3f}"
    assert done.stdout.splitlines()[-1].startswith(found)


def test_raw_pixels_are_read_as_a_ppm_is(
    native: Program, frame: Frame, own: Path, ppm: Path, tmp_path: Path
) -> None:
    (tmp_path / "frame.raw").write_bytes(frame.tobytes())
    size = f"{frame.shape[1]}x{frame.shape[0]}"
    answers = [
        native("predict", *options, own, path).stdout
        for options, path in (([], ppm), (["--raw", size], tmp_path / "frame.raw"))
    ]
    assert answers[0]
    assert answers[0] == answers[1]


def test_python_finds_its_object_where_it_does(
    native: Program, own: Path, frame: Frame, ppm: Path
) -> None:
    said = json.loads(native("predict", own, ppm).stdout)
    tuned = load_object(own)
    assert tuned.description.name == "a bar"
    expected, _ = tuned.locate(frame)
    check_same(said, expected.found, expected.quality, expected.center_px, expected.angle_deg)


def test_it_finds_pythons_object_where_pythons_network_does(
    native: Program, slim: Bundle, frame: Frame, ppm: Path, tmp_path: Path
) -> None:
    plan = resolve(Settings(epochs=3), slim)
    result = train_object(prepare_object(frame, slim, plan, span_px=SPAN_PX), plan)
    result.save(tmp_path / "object", "bar")
    said = json.loads(native("predict", tmp_path / "object", ppm).stdout)
    tuned = load_object(tmp_path / "object")
    tuned.description = replace(tuned.description, views=(), decision=None)
    expected, _ = tuned.locate(frame)
    check_same(said, expected.found, expected.quality, expected.center_px, expected.angle_deg)


def check_same(
    said: dict[str, object], found: bool, quality: float, center: object, angle: float
) -> None:
    assert said["found"] == found
    assert said["quality"] == pytest.approx(quality, abs=1e-4)
    assert said["center_px"] == pytest.approx(center, abs=2e-3)
    assert said["angle_deg"] == pytest.approx(angle, abs=2e-3)


def test_its_objects_folder_is_one_that_python_may_replace(own: Path) -> None:
    lines = (own / "SHA256SUMS").read_text().splitlines()
    listed = dict(reversed(line.split("  ")) for line in lines)
    expected = {
        path.name: hashlib.sha256(path.read_bytes()).hexdigest()
        for path in own.iterdir()
        if path.name != "SHA256SUMS"
    }
    assert listed == expected


def test_things_that_it_reads_from_the_sheet_are_on_its_crops(slim: Bundle) -> None:
    things = distractors_of(slim)  # else equal weights say nothing about pasted things
    assert things is not None
    assert "distractors " in (slim.folder / PLAIN).read_text()


@pytest.mark.parametrize("file", ["network.onnx", "head_3.onnx", "distractors.png", "weights.bin"])
def test_an_altered_bundle_is_refused(
    native: Program, slim: Bundle, ppm: Path, tmp_path: Path, file: str
) -> None:
    folder = Path(shutil.copytree(slim.folder, tmp_path / "bundle"))
    data = bytearray((folder / file).read_bytes())
    data[len(data) // 2] ^= 1
    (folder / file).write_bytes(data)
    refused(native("finetune", folder, ppm, tmp_path / "object"), "is altered")
    assert not (tmp_path / "object").exists()


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("qsgm-bundle-text 1", "qsgm-bundle-text 2", "another version"),
        ("task grasp", "task digits", "another version or task"),
        ("layers 4 3", "layers 4 7", "number of 1 to 6"),
        ("layer4 16", "layer4 4000", "number of 0 to"),
        ("rates ", "rates x", "rates"),
        (" head_3.onnx", " ../head_3.onnx", "head"),
        (" head_3.onnx", " head_4.onnx", "cannot read"),
        ("layers 4 3\n", "layers 4 3\nlayers 4 3\n", "twice"),
    ],
)
def test_a_damaged_text_is_refused(
    native: Program, slim: Bundle, ppm: Path, tmp_path: Path, old: str, new: str, said: str
) -> None:
    folder = Path(shutil.copytree(slim.folder, tmp_path / "bundle"))
    text = (folder / PLAIN).read_text()
    assert old in text
    (folder / PLAIN).write_text(text.replace(old, new))
    refused(native("finetune", folder, ppm, tmp_path / "object"), said)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "no PPM"),
        (b"P5 640 480 255\n", "no PPM"),
        (b"P6 640 480 65535\n", "levels"),
        (b"P6 64 64 255\n" + bytes(64 * 64 * 3), "128 to 4096"),
        (b"P6 # a comment\n99999999999 480 255\n", "128 to 4096"),
        (b"P6 640 480 255\n" + bytes(1000), "bytes of pixels"),
        (b"P6 200 200 255\n" + bytes(200 * 200 * 3), "256 at least"),
    ],
)
def test_a_broken_frame_is_refused(
    native: Program, slim: Bundle, tmp_path: Path, data: bytes, said: str
) -> None:
    (tmp_path / "frame.ppm").write_bytes(data)
    refused(native("finetune", slim.folder, tmp_path / "frame.ppm", tmp_path / "object"), said)


def test_what_is_there_is_not_overwritten(
    native: Program, slim: Bundle, ppm: Path, own: Path
) -> None:
    before = {path.name: path.read_bytes() for path in own.iterdir()}
    refused(native("finetune", "--epochs", 1, slim.folder, ppm, own), "cannot write")
    assert {path.name: path.read_bytes() for path in own.iterdir()} == before
    assert [path.name for path in own.parent.iterdir()] == ["own"]


def test_an_object_at_another_scale_is_refused(
    native: Program, own: Path, ppm: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(own, tmp_path / "object"))
    about = json.loads((folder / "object.json").read_text()) | {"scale": 0.5}
    (folder / "object.json").write_text(json.dumps(about, indent=1))
    refused(native("predict", folder, ppm), "another scale")


def refused(done: subprocess.CompletedProcess[str], said: str) -> None:
    assert done.returncode == 1
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: ")
    assert said in line


def test_wrong_usage_is_told_from_bad_input(native: Program) -> None:
    for arguments in ([], ["predict"], ["finetune", "--epochs", "x", "a", "b", "c"], ["--help"]):
        done = native(*arguments)
        assert (done.returncode, done.stdout) == (2, "")
        assert "usage" in done.stderr


def test_nothing_is_written_into_the_users_folders(
    native: Program, own: Path, ppm: Path, tmp_path: Path
) -> None:
    assert native("predict", own, ppm, home=tmp_path).returncode == 0
    assert [*tmp_path.iterdir()] == []


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> Program:
    return build(tmp_path_factory.mktemp("sanitized"), SANITIZE)


@pytest.mark.parametrize("place", ["none/object", "long"])
def test_where_nothing_can_appear_is_refused_before_any_work(
    sanitized: Program, slim: Bundle, ppm: Path, tmp_path: Path, place: str
) -> None:
    room = 4094 - len(f"{tmp_path}/") - len(place)  # just short of what a path may have
    steps = "./" * (room // 2) if place == "long" else ""
    target = f"{tmp_path}/{steps}{place}"
    refused(sanitized("finetune", slim.folder, ppm, target), "cannot write beside")
    assert [*tmp_path.iterdir()] == []


def test_a_folder_may_be_named_with_a_slash_at_its_end(
    native: Program, slim: Bundle, ppm: Path, tmp_path: Path
) -> None:
    done = native("finetune", "--epochs", 1, slim.folder, ppm, f"{tmp_path}/object/")
    assert (done.returncode, done.stderr) == (0, "")
    assert [path.name for path in tmp_path.iterdir()] == ["object"]


def test_broken_files_do_not_crash_it(
    sanitized: Program,
    slim: Bundle,
    own: Path,
    frame: Frame,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    material = tmp_path_factory.mktemp("material")
    shutil.copytree(slim.folder, material / "bundle")
    shutil.copytree(own, material / "object")
    cv2.imwrite(str(material / "frame.ppm"), frame[100:400, 150:450])
    times = int(os.environ.get("QSGM_ROBUSTNESS", "1"))
    command = [sys.executable, Path(__file__).with_name("native_inputs.py"), sanitized.path]
    done = subprocess.run(
        [*map(str, command), str(material), "0", str(FUZZED * times)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    counts = json.loads(done.stdout.splitlines()[-1])
    assert counts["inputs"] == counts["refused"] + counts.get("accepted", 0) == FUZZED * times
