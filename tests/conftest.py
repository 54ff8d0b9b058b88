"""What several tests share: a bundle with random weights, and frames with something on them."""

import json
import shutil
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import Outcome, Run
from hypothesis import settings
from numpy.typing import NDArray
from torch import nn
from toys import lay, table, toy

from qsgm import cli
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp import teach
from qsgm.grasp.crops import cut_crops, plan_crops
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.images import write_png
from qsgm.manifest import MANIFEST
from qsgm.sgm.float import FoldedSgm, float_trace
from qsgm.sgm.int8 import QuantizedSgm, SgmRanges, quantize_sgm
from qsgm.task import label_span, task_record
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.export import build_graphs, bundle_files, describe, exported_blocks
from qsgm.train.grasp.draw_distractors import encode_sheet
from qsgm.train.grasp.task import DrawnGrasping, shipped_things
from qsgm.train.model.net import ConvNet, as_seen
from qsgm.train.model.sgm import Sgm
from qsgm.train.quantization.calibration_runs import prepare
from qsgm.train.quantization.trunk import feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import observe_samples

# Threads that wait for each other on a busy machine take longer than this work does.
torch.set_num_threads(1)
# The same examples every time, however busy the machine is, and nothing kept between runs.
settings.register_profile("qsgm", deadline=None, derandomize=True, database=None)
settings.load_profile("qsgm")

# As a shell starts what it puts into the background, tests of interrupts would fail.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

MOST_LAYERS = 6
RATES = (1e-4, 1e-4, 1e-3, 0.002, 0.005, 0.02)


@pytest.fixture(scope="session")
def bundle_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A whole bundle; nothing in it was trained. Not to be changed: copy it."""
    folder = tmp_path_factory.mktemp("bundle") / "export"
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


def draw_frame(length: int = 90) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """A bar (or, of length 0, a disk) on a noisy table, and its mask."""
    rng = np.random.default_rng(0)
    table = np.array([120, 140, 160]) + cv2.GaussianBlur(
        rng.normal(0, 60, (480, 640, 3)), (0, 0), 3
    )
    mask = np.zeros((480, 640), np.uint8)
    along = np.array([np.cos(0.4), -np.sin(0.4)]) * length / 2
    ends = [tuple(int(v) for v in np.rint(np.array([320, 240]) + s * along)) for s in (-1, 1)]
    cv2.line(mask, ends[0], ends[1], 255, 26, cv2.LINE_AA)
    table[mask > 127] = (40, 60, 200)
    return np.clip(table, 0, 255).astype(np.uint8), np.where(mask > 127, 255, 0).astype(np.uint8)


def draw_things() -> NDArray[np.uint8]:
    """A sheet of two things, a green bar and a blue disk: (128, 256, 4) BGRA."""
    sheet = np.zeros((128, 256, 4), np.uint8)
    cv2.rectangle(sheet, (24, 52), (104, 76), (60, 200, 40, 255), cv2.FILLED)
    cv2.circle(sheet, (192, 64), 30, (220, 90, 30, 255), cv2.FILLED)
    return sheet


def write_bundle(folder: Path) -> None:
    """What the exporter makes of a random checkpoint; ranges are made up."""
    trainee = prepare(random_checkpoint())
    shown, rng = Demonstration(draw_frame()[0], (320, 240)), np.random.default_rng(1)
    crops = crop_source([shown], shipped_things(), rng, 200).cut(np.arange(200))
    ranges = dict(observe_samples(trainee.net, crops))
    trainee = replace(trainee, net=replace(trainee.net, feature_steps=feature_steps(ranges)))
    int8_sgms = {layer: _quantized(sgm) for layer, sgm in trainee.sgms.items()}
    exported = exported_blocks(GRASPNET, MOST_LAYERS, ())
    graphs = build_graphs(trainee, int8_sgms, quantize_trunk(trainee.net, ranges), exported)
    files, sgms = bundle_files(graphs, int8_sgms, trainee.sgms)
    files[DISTRACTORS] = encode_sheet(draw_things())
    for file, data in files.items():
        (folder / file).write_bytes(data)
    (folder / MANIFEST).write_text(describe(trainee, exported, files, sgms).text())


def random_checkpoint() -> Checkpoint:
    """Nothing in it was trained; rates are those at which nothing diverges."""
    torch.manual_seed(0)
    net = _random_net()
    sgms = {layer: _random_sgm(layer) for layer in range(1, MOST_LAYERS)}
    rates = {
        str(single_layers(GRASPNET.last(tuned))): RATES[-tuned:]
        for tuned in range(1, MOST_LAYERS + 1)
    }
    return Checkpoint(task_record(DrawnGrasping()), net, sgms, {}, rates, {})


def _random_net() -> ConvNet:
    """Random weights; batchnorm has seen crops, so that every layer's outputs vary."""
    net = ConvNet(GRASPNET)
    frame = draw_frame()[0]
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), 64)
    with torch.no_grad():
        for _ in range(20):
            net(as_seen(GRASPNET, torch.from_numpy(cut_crops(frame, plan))))
    return net.eval()


def _random_sgm(layer: int) -> Sgm:
    """Gradients of about the size of true ones: untrained SGMs would run away."""
    sgm = Sgm(GRASPNET, layer, (12,))
    last = sgm.convs[-1]
    assert isinstance(last, nn.Conv2d)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return sgm.eval()


def _quantized(sgm: FoldedSgm) -> QuantizedSgm:
    """Ranges of activations up to 10, any label, and what the hidden layer makes of those."""
    channels, span = GRASPNET.layer(sgm.layer).out, label_span(DrawnGrasping().heads)
    low = np.concatenate([np.zeros(channels, np.float32), span[0]])
    high = np.concatenate([np.full(channels, 10, np.float32), span[1]])
    shape = (20, GRASPNET.positions_after(sgm.layer), len(low))
    inputs = np.random.default_rng(0).uniform(low, high, shape).astype(np.float32)
    _, (hidden,) = float_trace(sgm, inputs)
    return quantize_sgm(sgm, SgmRanges(low, high, (hidden.max(axis=(0, 1)) + 1,)))
