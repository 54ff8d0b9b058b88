"""`sgm.pt` is read without trusting it."""

import json
import os
import pickle
import re
import zipfile
from collections.abc import Callable
from copy import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from refusals import refusal_of

from qsgm.errors import QsgmError
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask, grasp_task
from qsgm.manifest import Recipe
from qsgm.network import Network, conv
from qsgm.task import Head, TaskRecord, task_record
from qsgm.train import checkpoint as module
from qsgm.train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm


@pytest.fixture
def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    sgms = {4: Sgm(GRASPNET, 4, (8, 8)).eval(), 5: Sgm(GRASPNET, 5).eval()}
    rates = {"6": (0.03,), "5,6": (0.01, 0.03), "4,5,6": (0.005, 0.001, 0.003)}
    rates["4,5-6"] = (0.02, 0.001, 0.004)
    task = task_record(GraspTask("paper", label_smoothing=0.1))
    recipes = {
        "6": (Recipe("adam", (0.01,), ((5, 2.0), (100, 1.0))), Recipe("sgd", (0.03,))),
        "5,6": (Recipe("sgd", (0.01, 0.03), ((5, 4.0),)),),
    }
    net = ConvNet(GRASPNET).eval()
    return Checkpoint(task, net, sgms, {}, rates, {"seed": 0}, recipes=recipes)


def test_a_checkpoint_comes_back_as_it_was_saved(tmp_path: Path, checkpoint: Checkpoint) -> None:
    save_checkpoint(tmp_path / "sgm.pt", checkpoint)
    back = load_checkpoint(tmp_path / "sgm.pt")
    assert (back.task, back.rates, back.card) == (
        checkpoint.task,
        checkpoint.rates,
        checkpoint.card,
    )
    assert (back.recipes, checkpoint.recipes["6"]) == (
        checkpoint.recipes,
        (Recipe("adam", (0.01,), ((5, 2.0), (100, 1.0))), Recipe("sgd", (0.03,))),
    )
    assert grasp_task(back.task, "it") == GraspTask("paper", label_smoothing=0.1)
    assert back.sgms[4].hidden == (8, 8)
    assert not back.net.training
    for mine, theirs in ((back.net, checkpoint.net), (back.sgms[4], checkpoint.sgms[4])):
        for name, value in theirs.state_dict().items():
            assert torch.equal(mine.state_dict()[name], value)


GOOD_RATES = {"6": [0.1], "5,6": [0.1, 0.1], "4,5,6": [0.1, 0.1, 0.1]}


def refuse(path: Path) -> str:
    """The one-line refusal of a file."""
    text = refusal_of(load_checkpoint, path)
    assert "qsgm pretrain" in text
    return text


def test_a_file_that_would_run_code_is_refused_and_runs_none(tmp_path: Path) -> None:
    class Hostile:
        def __reduce__(self) -> tuple[Any, ...]:
            return os.mkdir, (str(tmp_path / "owned"),)

    torch.save({"format": Hostile()}, tmp_path / "zip.pt")
    (tmp_path / "bare.pt").write_bytes(pickle.dumps(Hostile()))
    for name in ("zip.pt", "bare.pt"):
        assert "not a readable checkpoint" in refuse(tmp_path / name)
    assert not (tmp_path / "owned").exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"hello", b"\x80\x02}q\x00."])
def test_a_broken_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "sgm.pt"
    path.write_bytes(content)
    refuse(path)


def test_a_truncated_file_is_refused(tmp_path: Path, checkpoint: Checkpoint) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    path.write_bytes(path.read_bytes()[:-2000])
    refuse(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    refuse(tmp_path / "none.pt")
    refuse(tmp_path)


def test_someone_elses_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "sgm.pt"
    torch.save(torch.nn.Linear(2, 2).state_dict(), path)
    assert "no qsgm checkpoint" in refuse(path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("net", {}),
        ("sgms", {9: {}}),
        ("sgms", {}),
        ("hidden", {4: [7, 7], 5: [16]}),
        ("rates", "fast"),
        ("card", "{"),
        ("card", "[" * 100_000),
        ("net", {"layers.0.conv.weight": 1}),
        ("sgms", [4, 5]),
        ("sgms", {4.0: {}}),
        ("version", torch.ones(2)),
        ("heads", '[{"nonsense": 1}]'),
        ("heads", "[]"),
        ("heads", "{"),
        ("heads", 7),
        ("task", "{}"),
        ("task", "[" * 100_000),
        ("network", '{"layers": []}'),
        ("network", "null"),
        ("recipes", "{"),
        ("recipes", "7"),
        ("recipes", '{"6": [{"optimizer": "lion", "rates": [0.1], "gains": []}]}'),
        ("recipes", '{"6": [{"optimizer": "adam", "rates": [-0.1], "gains": []}]}'),
        ("recipes", '{"6": [{"optimizer": "adam", "rates": [0.1, 0.1], "gains": []}]}'),
        ("recipes", '{"6": [{"optimizer": "adam", "rates": [0.1], "gains": [[9, 1], [5, 1]]}]}'),
    ],
)
def test_a_checkpoint_with_a_wrong_part_is_refused(
    tmp_path: Path, checkpoint: Checkpoint, key: str, value: Any
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    data = torch.load(path, weights_only=True)
    torch.save(data | {key: value}, path)
    text = refuse(path)
    assert "does not fit" in text or "no qsgm checkpoint" in text


@pytest.mark.parametrize(
    "widths",
    [[0, 8], [-1], [8.0], [True], [1025], [10**12], [8] * 5, [8] * 10**6, [], 8, "88", None],
)
def test_hidden_widths_are_checked_before_anything_of_that_width_is_made(
    tmp_path: Path, checkpoint: Checkpoint, widths: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    data = torch.load(path, weights_only=True)
    torch.save(data | {"hidden": {4: widths, 5: widths}}, path)
    monkeypatch.setattr(module, "Sgm", lambda *_: pytest.fail("an SGM was made"))
    assert re.search("hidden width|not a readable checkpoint", refuse(path))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("smoothing", 1.0),
        ("smoothing", -0.1),
        ("smoothing", float("nan")),
        ("smoothing", "0.1"),
        ("smoothing", True),
        ("weight", 0.0),
        ("weight", float("inf")),
        ("weight", 10**400),
        ("weight", [1.0]),
        ("weight", None),
        ("channels", 2),
        ("channels", 1.0),
        ("channels", 0),
        ("kind", "guess"),
        ("kind", ["log_loss"]),
        ("activation", "tanh"),
        ("name", 7),
        ("where", 3),
        ("where", -1),
        ("where", 0.0),
    ],
)
def test_a_loss_that_cannot_be_is_refused(
    tmp_path: Path, checkpoint: Checkpoint, field: str, value: Any
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    data = torch.load(path, weights_only=True)
    heads = json.loads(data["heads"])
    heads[0][field] = value
    torch.save(data | {"heads": json.dumps(heads)}, path)
    assert "does not fit" in refuse(path)


@pytest.mark.parametrize("encoding", ["triple", ["double"], None])
def test_angles_encoded_in_no_known_way_are_refused(
    tmp_path: Path, checkpoint: Checkpoint, encoding: Any
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    data = torch.load(path, weights_only=True)
    task = json.loads(data["task"]) | {"encoding": encoding}
    torch.save(data | {"task": json.dumps(task)}, path)
    with pytest.raises(QsgmError, match="'encoding' is damaged: expected double or paper"):
        grasp_task(load_checkpoint(path).task, str(path))


def test_a_network_too_large_for_a_checkpoint_is_refused_before_it_is_made(
    tmp_path: Path, checkpoint: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    data = torch.load(path, weights_only=True)
    network = Network((64, 64, 3), (conv(3, 4096, 64), conv(4096, 3, relu=False)))
    torch.save(data | {"network": json.dumps(network.to_json())}, path)
    monkeypatch.setattr(module, "ConvNet", lambda *_: pytest.fail("a network was made"))
    assert "more weights than a checkpoint could hold" in refuse(path)


def test_a_checkpoint_of_another_task_comes_back_as_it_was_saved(tmp_path: Path) -> None:
    network = Network((1, 30, 2), (conv(2, 4, (1, 5)), conv(4, 2, (1, 26), relu=False)), "numbers")
    heads = (Head("class", "cross_entropy", 2, "softmax", weight=2.0, smoothing=0.1),)
    task = TaskRecord("other", network, heads, {"classes": ["a", "b"]})
    net = ConvNet(network).eval()
    made = Checkpoint(task, net, {1: Sgm(network, 1)}, {}, {"2": (0.1,), "1,2": (0.1, 0.1)}, {})
    save_checkpoint(tmp_path / "sgm.pt", made)
    back = load_checkpoint(tmp_path / "sgm.pt")
    assert back.task == task
    for name, value in net.state_dict().items():
        assert torch.equal(back.net.state_dict()[name], value)


@pytest.mark.parametrize(
    "rates",
    [
        {"6": [0.1], "5,6": [0.1, 0.1]},
        GOOD_RATES | {"4,5,6": [0.1, 0.1]},
        GOOD_RATES | {"4,5,6": [0.1, 0.1, 0.0]},
        GOOD_RATES | {"6": [-0.1]},
        GOOD_RATES | {"6": [float("nan")]},
        GOOD_RATES | {"6": [float("inf")]},
        GOOD_RATES | {"6": [10**400]},
        GOOD_RATES | {"6": ["0.1"]},
        GOOD_RATES | {"6": 0.1},
        GOOD_RATES | {"": []},
        GOOD_RATES | {1: [0.1]},
        GOOD_RATES | {"4,5": [0.1, 0.1]},
        GOOD_RATES | {"4-5,6": [0.1, 0.1]},
        GOOD_RATES | {"3,4,5,6": [0.1] * 4},
    ],
)
def test_rates_that_cannot_be_are_refused(
    tmp_path: Path, checkpoint: Checkpoint, rates: Any
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    torch.save(torch.load(path, weights_only=True) | {"rates": rates}, path)
    assert "does not fit" in refuse(path)


@pytest.mark.parametrize("layers", [(4,), (3, 4, 5), (3, 5), (1, 2, 3, 4, 5)])
def test_sgms_and_rates_of_other_layers_do_not_go_together(layers: tuple[int, ...]) -> None:
    sgms = {layer: Sgm(GRASPNET, layer) for layer in layers}
    rates = {text: tuple(values) for text, values in GOOD_RATES.items()}
    with pytest.raises(ValueError, match=r"SGMs stand behind|no rates for layers 3,4,5,6"):
        Checkpoint(task_record(GraspTask()), ConvNet(GRASPNET), sgms, {}, rates, {})


def test_the_number_of_layers_that_can_be_tuned_is_that_of_the_sgms_and_the_last(
    checkpoint: Checkpoint,
) -> None:
    assert checkpoint.most_layers == 3
    alone = Checkpoint(checkpoint.task, checkpoint.net, {}, {}, {"6": (0.1,)}, {})
    assert alone.most_layers == 1


def packed(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("sgm/data/0", bytes(2**20))


def nested(path: Path) -> None:
    """Lists in lists in 2 MB, 60 times as much in memory."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("sgm/data.pkl", b"\x80\x02]" + b"]a" * 2**20 + b".")


def overlapping(path: Path) -> None:
    """Two thousand names for one MB."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("sgm/data/0", bytes(2**20))
        for number in range(1, 2000):
            entry = copy(archive.filelist[0])
            entry.filename = f"sgm/data/{number}"
            archive.filelist.append(entry)


def large(path: Path) -> None:
    with path.open("wb") as sparse:
        sparse.truncate(module.LARGEST_BYTES + 1)


@pytest.mark.parametrize("make", [packed, nested, overlapping, large])
def test_a_file_that_would_fill_the_memory_is_refused_unread(
    tmp_path: Path, make: Callable[[Path], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    make(tmp_path / "sgm.pt")
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("it was read"))
    assert re.search("not a readable checkpoint|has 67.* MB", refuse(tmp_path / "sgm.pt"))


def test_the_shipped_checkpoint_is_far_from_every_limit() -> None:
    with zipfile.ZipFile(Path(__file__).parents[2] / "sgm.pt") as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    assert 10 * sum(sizes.values()) < module.LARGEST_BYTES
    assert 10 * max(v for k, v in sizes.items() if "pkl" in k) < module.LARGEST_PICKLE_BYTES


def test_a_name_that_no_file_can_have_is_refused(tmp_path: Path) -> None:
    assert "cannot read" in refuse(tmp_path / ("x" * 5000))


@pytest.mark.parametrize("error", [MemoryError(), OverflowError("too large"), RecursionError()])
def test_whatever_torch_raises_becomes_one_line(
    tmp_path: Path, checkpoint: Checkpoint, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise error

    save_checkpoint(tmp_path / "sgm.pt", checkpoint)
    with monkeypatch.context() as patch:
        patch.setattr(torch, "load", fail)
        assert "not a readable checkpoint" in refuse(tmp_path / "sgm.pt")
    monkeypatch.setattr(Sgm, "load_state_dict", fail)
    assert (str(error) or type(error).__name__) in refuse(tmp_path / "sgm.pt")


def test_weights_that_are_not_finite_are_refused_by_name(
    tmp_path: Path, checkpoint: Checkpoint
) -> None:
    with torch.no_grad():
        checkpoint.net.layers[2].conv.bias[0] = float("nan")
    save_checkpoint(tmp_path / "sgm.pt", checkpoint)
    assert "layers.2.conv.bias" in refuse(tmp_path / "sgm.pt")


def test_a_checkpoint_from_before_recipes_were_kept_is_read(
    tmp_path: Path, checkpoint: Checkpoint
) -> None:
    save_checkpoint(tmp_path / "sgm.pt", checkpoint)
    data = torch.load(tmp_path / "sgm.pt", weights_only=True)
    torch.save({key: value for key, value in data.items() if key != "recipes"}, tmp_path / "old.pt")
    assert load_checkpoint(tmp_path / "old.pt").recipes == {}
