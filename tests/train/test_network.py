"""Exported trunk, head and network against torch and against each other."""

import subprocess
import sys

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch
from losses import GraspLoss
from nets import random_net
from torch import nn

from qsgm import QsgmError
from qsgm.grasp.angles import AngleEncoding
from qsgm.grasp.network import GRASPNET
from qsgm.train.graphs.probe import head_model
from qsgm.train.graphs.trunk import initializer_offsets, network_model, trunk_model
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net
from qsgm.train.model.net import ConvNet, Convolution, as_seen
from qsgm.weights import to_conv_layout, to_step_layout

HEADS = GraspLoss().heads


@pytest.fixture(scope="module")
def net() -> ConvNet:
    return random_net(0)


@pytest.fixture(scope="module")
def frame() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (480, 640, 3), dtype=np.uint8)


def run(model: bytes, **feeds: np.ndarray) -> np.ndarray:
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(model, options, ["CPUExecutionProvider"])
    return session.run(None, feeds)[0]


def head_outputs(net: FoldedNet, features: np.ndarray, tuned: int) -> np.ndarray:
    feeds = {"features": features}
    for number in range(7 - tuned, 7):
        feeds[f"weight{number}"] = to_step_layout(net.layers[number - 1].weight)
        feeds[f"bias{number}"] = net.layers[number - 1].bias
    return run(head_model(net, tuned, HEADS).SerializeToString(), **feeds)


@pytest.mark.parametrize(
    ("last_frozen", "positions", "channels"),
    [(1, 3844, 8), (2, 841, 8), (3, 169, 16), (4, 1, 16), (5, 1, 16)],
)
def test_trunk_equals_torch(net: ConvNet, last_frozen: int, positions: int, channels: int) -> None:
    crops = np.random.default_rng(1).integers(0, 256, (5, 128, 128, 3), dtype=np.uint8)
    got = run(trunk_model(fold_net(net), last_frozen).SerializeToString(), samples=crops)
    with torch.no_grad():
        maps = net.between(as_seen(GRASPNET, torch.tensor(crops)), 1, last_frozen)
    assert got.shape == (5, positions, channels)
    expected = maps.flatten(2).transpose(1, 2).numpy()
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_network_on_a_frame_equals_torch(
    net: ConvNet, frame: np.ndarray, encoding: AngleEncoding
) -> None:
    got = run(
        network_model(fold_net(net), GraspLoss(encoding).heads).SerializeToString(), frame=frame
    )
    with torch.no_grad():
        raw = net(as_seen(GRASPNET, torch.tensor(frame)[None]))
    assert got.shape == (3, 23, 33)
    expected = GraspLoss(encoding).activate(raw)[0].numpy()
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-5)


def test_where_nothing_is_frozen_the_trunk_leaves_pixels_as_they_are(net: ConvNet) -> None:
    crops = np.random.default_rng(1).integers(0, 256, (5, 128, 128, 3), dtype=np.uint8)
    got = run(trunk_model(fold_net(net), 0).SerializeToString(), samples=crops)
    assert got.dtype == np.uint8
    np.testing.assert_array_equal(got, crops.reshape(5, 128 * 128, 3))


@pytest.mark.parametrize("tuned", range(1, 7))
def test_every_cell_equals_trunk_and_head_on_its_window(
    net: ConvNet, frame: np.ndarray, tuned: int
) -> None:
    folded = fold_net(net)
    heatmap = run(network_model(folded, HEADS).SerializeToString(), frame=frame)
    cells = [(row, col) for row in range(0, 23, 11) for col in range(0, 33, 8)]
    windows = [frame[16 * row :][:128, 16 * col :][:, :128] for row, col in cells]
    trunk = trunk_model(folded, 6 - tuned).SerializeToString()
    got = head_outputs(folded, run(trunk, samples=np.stack(windows)), tuned)
    rows, cols = np.transpose(cells)
    np.testing.assert_allclose(got, heatmap[:, rows, cols].T, rtol=1e-5, atol=1e-5)


def test_network_takes_frames_of_other_sizes(net: ConvNet) -> None:
    model = network_model(fold_net(net), HEADS).SerializeToString()
    assert run(model, frame=np.zeros((128, 128, 3), np.uint8)).shape == (3, 1, 1)
    assert run(model, frame=np.zeros((144, 200, 3), np.uint8)).shape == (3, 2, 5)


def test_patching_bytes_in_the_file_makes_the_tuned_network(
    net: ConvNet, frame: np.ndarray
) -> None:
    data = network_model(fold_net(net), HEADS).SerializeToString()
    torch.manual_seed(1)
    tuned = ConvNet(GRASPNET).eval()
    for number in (1, 2, 3):
        tuned.layers[number - 1] = net.layers[number - 1]
    patched = bytearray(data)
    offsets = initializer_offsets(data)
    for number in (4, 5, 6):
        layer = fold_net(tuned).layers[number - 1]
        for name, array in ((f"weight{number}", layer.weight), (f"bias{number}", layer.bias)):
            start, size = offsets[name]
            assert size == array.nbytes
            patched[start : start + size] = array.astype("<f4").tobytes()
    expected = network_model(fold_net(tuned), HEADS)
    onnx.checker.check_model(onnx.load_model_from_string(bytes(patched)), full_check=True)
    assert bytes(patched) == expected.SerializeToString()
    heatmap = run(expected.SerializeToString(), frame=frame)
    np.testing.assert_array_equal(run(bytes(patched), frame=frame), heatmap)


def test_offsets_are_found_even_where_two_initializers_hold_equal_numbers(net: ConvNet) -> None:
    folded = fold_net(net)
    for layer in folded.layers[3:5]:
        layer.bias[:] = 0
    data = network_model(folded, HEADS).SerializeToString()
    offsets = initializer_offsets(data)
    model = onnx.load_model_from_string(data)
    assert offsets["bias4"] != offsets["bias5"]
    for tensor in model.graph.initializer:
        start, size = offsets[tensor.name]
        assert data[start : start + size] == tensor.raw_data


@pytest.mark.parametrize("layer", range(1, 7))
def test_weights_survive_the_way_into_the_steps_layout_and_back(net: ConvNet, layer: int) -> None:
    weight = fold_net(net).layers[layer - 1].weight
    windows = to_step_layout(weight)
    out, into, *kernel = weight.shape
    assert windows.shape == (out, kernel[0] * kernel[1] * into)
    np.testing.assert_array_equal(windows[:, :into], weight[:, :, 0, 0])
    np.testing.assert_array_equal(to_conv_layout(windows, (kernel[0], kernel[1])), weight)


def test_initializers_outside_raw_data_are_refused(net: ConvNet) -> None:
    model = network_model(fold_net(net), HEADS)
    tensor = next(tensor for tensor in model.graph.initializer if tensor.name == "bias6")
    tensor.ClearField("raw_data")
    tensor.float_data.extend([1.0, 2.0, 3.0])
    with pytest.raises(QsgmError, match="'bias6' cannot be located"):
        initializer_offsets(model.SerializeToString())


STRIDED = """
import torch
from qsgm.train.model.net import Convolution
for stride in ((1, 2), (1, 3), (2, 1), (2, 2)):
    own = Convolution(3, 1, 1, stride)
    x = torch.randn(8, 3, 2, 12).contiguous(memory_format=torch.channels_last)
    for _ in range(200):
        own(x).square().sum().backward()
"""


def test_windows_of_one_position_learn_without_spoiling_memory() -> None:
    """In a process of its own, which would be killed."""
    assert subprocess.run([sys.executable, "-c", STRIDED], check=False).returncode == 0


@pytest.mark.parametrize("stride", [(1, 1), (1, 3), (2, 1), (2, 3)])
@pytest.mark.parametrize("padding", [(0, 0), (0, 1)])
def test_a_convolution_is_torchs(stride: tuple[int, int], padding: tuple[int, int]) -> None:
    own = Convolution(3, 4, 1, stride, padding).double()
    x = torch.randn(2, 3, 5, 7, dtype=torch.float64, requires_grad=True)
    expected = nn.functional.conv2d(x, own.weight, own.bias, stride, padding)
    found = own(x)
    torch.testing.assert_close(found, expected)
    for got, wanted in zip(
        torch.autograd.grad(found.square().sum(), [x, own.weight]),
        torch.autograd.grad(expected.square().sum(), [x, own.weight]),
        strict=True,
    ):
        torch.testing.assert_close(got, wanted)
