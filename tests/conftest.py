"""What several tests share: a bundle with random weights, and frames with something on them."""

import hashlib
import json
import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import settings
from numpy.typing import NDArray
from torch import nn

from qsgm import bundle as bundles
from qsgm.blocks import one_block, parse_blocks, single_layers, tuned_layers
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp.crops import cut_crops, plan_crops
from qsgm.images import write_png
from qsgm.sgm.float import FoldedSgm, float_trace
from qsgm.sgm.int8 import QuantizedSgm, SgmRanges, quantize_sgm
from qsgm.train.export import build_trunks, bundle_files
from qsgm.train.graphs.optimizers import Adam, Optimizer, Sgd
from qsgm.train.graphs.probe import head_model, probe_model
from qsgm.train.graphs.step import AnySgm, step_model
from qsgm.train.graphs.trunk import initializer_offsets, network_model
from qsgm.train.grasp.draw_distractors import encode_sheet
from qsgm.train.model.fold import FoldedNet, fold_net, fold_sgm
from qsgm.train.model.graspnet import CHANNELS, GraspNet, Loss, normalize
from qsgm.train.model.sgm import Sgm
from qsgm.train.quantization.calibration_set import Demonstration
from qsgm.train.quantization.trunk import QuantizedLayer, feature_steps, quantize_trunk
from qsgm.train.quantization.trunk_ranges import calibration_crops, observe_crops

# Threads that wait for each other on a busy machine take longer than this work does.
torch.set_num_threads(1)
# The same examples every time, however busy the machine is, and nothing kept between runs.
settings.register_profile("qsgm", deadline=None, derandomize=True, database=None)
settings.load_profile("qsgm")

MOST_LAYERS = 6
BLOCKS = [single_layers(tuned) for tuned in range(1, MOST_LAYERS + 1)]
BLOCKS += [parse_blocks(text) for text in ("4,5-6", "1-4,5,6")]
WHOLE = [one_block(tuned) for tuned in range(1, MOST_LAYERS + 1)]
RATES = (1e-4, 1e-4, 1e-3, 0.002, 0.005, 0.02)
OPTIMIZERS: dict[bundles.OptimizerName, Optimizer] = {"sgd": Sgd(), "adam": Adam()}


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
    """Every graph a bundle holds, and the manifest."""
    torch.manual_seed(0)
    net, loss = fold_net(_random_net()), Loss()
    net, int8_trunk = _quantized_trunk(net)
    float_sgms = {layer: _random_sgm(layer) for layer in tuned_layers(MOST_LAYERS)[:-1]}
    int8_sgms = {layer: _quantized(sgm) for layer, sgm in float_sgms.items()}
    models = {bundles.NETWORK: network_model(net, loss.encoding)}
    for tuned in range(1, MOST_LAYERS + 1):
        models |= build_trunks(net, int8_trunk, tuned)
        models[bundles.head_file(tuned)] = head_model(net, tuned, loss.encoding)
        if tuned > 1:
            probe = probe_model(net, tuned, float_sgms, int8_sgms, loss)
            models[bundles.probe_file(tuned)] = probe
    precisions: dict[bundles.Precision, dict[int, AnySgm]] = {
        "float": dict(float_sgms),
        "int8": dict(int8_sgms),
    }
    for precision, name, blocks in product(precisions, OPTIMIZERS, [*BLOCKS, *WHOLE]):
        step = step_model(net, blocks, precisions[precision], loss, OPTIMIZERS[name])
        models[bundles.step_file(precision, name, blocks)] = step
    files, sgms = bundle_files(models, int8_sgms, float_sgms)
    files[bundles.DISTRACTORS] = encode_sheet(draw_things())
    for file, data in files.items():
        (folder / file).write_bytes(data)
    manifest = _manifest(folder, net, loss) | {"sgms": sgms}
    (folder / bundles.MANIFEST).write_text(json.dumps(manifest))


def _manifest(folder: Path, net: FoldedNet, loss: Loss) -> dict[str, object]:
    offsets = initializer_offsets((folder / bundles.NETWORK).read_bytes())
    arrays = {f"weight{k}": layer.weight for k, layer in enumerate(net.layers, 1)}
    arrays |= {f"bias{k}": layer.bias for k, layer in enumerate(net.layers, 1)}
    both = [*BLOCKS, *WHOLE]
    rates = {
        "sgd": {str(blocks): RATES[-len(blocks.layers) :] for blocks in both},
        "adam": {str(blocks): [1e-3] * len(blocks.layers) for blocks in both},
    }
    return {
        "format": bundles.FORMAT,
        "version": bundles.VERSION,
        "encoding": loss.encoding,
        "label_smoothing": loss.label_smoothing,
        "most_layers": MOST_LAYERS,
        "trunk": "float",
        "blocks": [str(blocks) for blocks in BLOCKS],
        "recipes": {
            "sgm": {
                "optimizer": "sgd",
                "rates": rates,
                "short_gains": {str(blocks): 1.0 for blocks in BLOCKS},
            },
            "bp": {"optimizer": "adam", "rates": rates},
        },
        "initializers": {
            name: {"shape": list(array.shape), "offset": offsets[name][0]}
            for name, array in arrays.items()
        },
        "files": {
            path.name: {"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
            for path in sorted(folder.iterdir())
        },
    }


def _random_net() -> GraspNet:
    """Random weights; batchnorm has seen crops, so that every layer's outputs vary."""
    net = GraspNet()
    frame = draw_frame()[0]
    plan = plan_crops((480, 640), (320, 240), np.random.default_rng(0), 64)
    with torch.no_grad():
        for _ in range(20):
            net(normalize(torch.from_numpy(cut_crops(frame, plan))))
    return net.eval()


def _quantized_trunk(net: FoldedNet) -> tuple[FoldedNet, dict[int, QuantizedLayer]]:
    """The network with steps for u8 features, and its frozen layers in int8."""
    demonstration = Demonstration(draw_frame()[0], (320, 240))
    crops = calibration_crops(demonstration, np.random.default_rng(1))
    ranges = dict(observe_crops(net, crops))
    return replace(net, feature_steps=feature_steps(ranges)), quantize_trunk(net, ranges)


def _random_sgm(layer: int) -> FoldedSgm:
    """Gradients of about the size of true ones: untrained SGMs would run away."""
    sgm = Sgm(layer, (12,))
    last = sgm.convs[-1]
    assert isinstance(last, nn.Conv2d)
    nn.init.normal_(last.weight, std=0.01)
    nn.init.zeros_(last.bias)
    return fold_sgm(sgm.eval())


def _quantized(sgm: FoldedSgm) -> QuantizedSgm:
    """Ranges of activations up to 10, any label, and what the hidden layer makes of those."""
    channels = CHANNELS[sgm.layer]
    low = np.array([0.0] * channels + [0, -1, -1], np.float32)
    high = np.array([10.0] * channels + [1, 1, 1], np.float32)
    inputs = np.random.default_rng(0).uniform(low, high, (20, 25, len(low))).astype(np.float32)
    _, (hidden,) = float_trace(sgm, inputs)
    return quantize_sgm(sgm, SgmRanges(low, high, (hidden.max(axis=(0, 1)) + 1,)))
