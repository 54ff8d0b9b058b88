"""What several tests share: a bundle with random weights, and frames with something on them."""

import ast
import importlib.util
import json
import os
import shutil
import signal
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import Outcome, Run
from hypothesis import settings
from numpy.typing import NDArray
from toys import draw_frame, lay, table, toy

from qsgm import cli
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp import teach
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.source import crop_source
from qsgm.images import write_png

# The same examples every time, however busy the machine is, and nothing kept between runs.
settings.register_profile("qsgm", deadline=None, derandomize=True, database=None)
settings.load_profile("qsgm")

# As a shell starts what it puts into the background, tests of interrupts would fail.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

HERE = Path(__file__).parent
# The host side's: without them the tests of the device side are what is left, on the bundle that
# random_bundle.py wrote elsewhere and this names.
HOST_PACKAGES = ("torch", "onnx", "matplotlib", "sklearn")
GIVEN_BUNDLE = "QSGM_TEST_BUNDLE"


def needs(file: Path, missing: set[str]) -> bool:
    """Whether a test or what it imports of its neighbours imports one of some packages."""
    neighbours = {one.stem: one for at in (HERE, file.parent) for one in at.glob("*.py")}
    for module in imported(file):
        if module.split(".")[0] in missing or module.startswith("qsgm.train"):
            return True
        if module in neighbours and needs(neighbours[module], missing):
            return True
    return False


def imported(file: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield str(node.module)


MISSING = {name for name in HOST_PACKAGES if importlib.util.find_spec(name) is None}
collect_ignore = [str(one) for one in HERE.rglob("test_*.py") if MISSING and needs(one, MISSING)]
if "torch" not in MISSING:
    import torch

    # Threads that wait for each other on a busy machine take longer than this work does.
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def bundle_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole bundle; nothing in it was trained. Not to be changed: copy it."""
    folder = tmp_path_factory.mktemp("bundle") / "export"
    if GIVEN_BUNDLE in os.environ:
        return Path(shutil.copytree(os.environ[GIVEN_BUNDLE], folder))
    from random_bundle import write_bundle

    folder.mkdir()
    write_bundle(folder)
    return folder


@pytest.fixture(scope="session")
def bundle(bundle_folder: Path) -> Bundle:
    return load_bundle(bundle_folder)


@pytest.fixture
def own_bundle(bundle_folder: Path, tmp_path: Path) -> Path:
    """A copy to spoil."""
    return Path(shutil.copytree(bundle_folder, tmp_path / "own_bundle"))


@pytest.fixture(scope="session")
def drawn() -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """A frame with a red bar in its middle, and where the bar is."""
    frame, mask = draw_frame()
    return frame, mask > 0


@pytest.fixture(scope="session")
def frame(drawn: tuple[NDArray[np.uint8], NDArray[np.bool_]]) -> NDArray[np.uint8]:
    return drawn[0]


@pytest.fixture(scope="session")
def frames_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two frames with masks and a manifest: one elongated object, one round."""
    folder = tmp_path_factory.mktemp("frames")
    for name, length in (("bar", 90), ("disk", 0)):
        picture, mask = draw_frame(length)
        write_png(folder / f"{name}.png", picture)
        write_png(folder / f"{name}_mask.png", mask)
    entries = [
        {"file": "bar.png", "mask": "bar_mask.png", "elongated": True},
        {"file": "disk.png", "mask": "disk_mask.png", "elongated": False},
    ]
    (folder / "manifest.json").write_text(json.dumps(entries))
    return folder


@pytest.fixture
def frame_path(frames_folder: Path) -> Path:
    return frames_folder / "bar.png"


@pytest.fixture
def few_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    """Layers 1 to 3 see large maps."""
    monkeypatch.setattr(teach, "GraspLesson", partial(GraspLesson, taught=64))
    monkeypatch.setattr(teach, "crop_source", partial(crop_source, count=96))


@pytest.fixture
def qsgm(capsys: pytest.CaptureFixture[str]) -> Run:
    """The command line in this process."""

    def run(*arguments: object) -> Outcome:
        code = cli.run([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Outcome(code, captured.out, captured.err)

    return run


@pytest.fixture
def taught(qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path) -> Path:
    """An object that the command line tuned."""
    folder = tmp_path / "taught"
    outcome = qsgm(
        "finetune", "--epochs", 1, "--bundle", bundle_folder, "-o", folder, "--json", frame_path
    )
    assert outcome.code == 0, outcome.err
    return folder


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


@pytest.fixture(autouse=True)
def _own_data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever a test tunes stays out of the user's objects."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
