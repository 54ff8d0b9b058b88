"""`sgm.pt` is read without trusting it."""

import os
import pickle
from pathlib import Path
from typing import Any

import pytest
import torch

from qsgm.errors import QsgmError
from qsgm.train.checkpoint import Checkpoint, load_checkpoint, save_checkpoint
from qsgm.train.graspnet import GraspNet, Loss
from qsgm.train.sgm import Sgm


@pytest.fixture
def checkpoint() -> Checkpoint:
    torch.manual_seed(0)
    sgms = {4: Sgm(4, (8, 8)).eval(), 5: Sgm(5).eval()}
    rates = {1: (0.03,), 2: (0.01, 0.03), 3: (0.005, 0.001, 0.003)}
    return Checkpoint(GraspNet().eval(), sgms, Loss(label_smoothing=0.1), rates, {"seed": 0})


def test_a_checkpoint_comes_back_as_it_was_saved(tmp_path: Path, checkpoint: Checkpoint) -> None:
    save_checkpoint(tmp_path / "sgm.pt", checkpoint)
    back = load_checkpoint(tmp_path / "sgm.pt")
    assert (back.loss, back.rates, back.card) == (
        checkpoint.loss,
        checkpoint.rates,
        checkpoint.card,
    )
    assert back.sgms[4].hidden == (8, 8)
    assert not back.net.training
    for mine, theirs in ((back.net, checkpoint.net), (back.sgms[4], checkpoint.sgms[4])):
        for name, value in theirs.state_dict().items():
            assert torch.equal(mine.state_dict()[name], value)


def refuse(path: Path) -> str:
    """The one-line refusal of a file."""
    with pytest.raises(QsgmError) as caught:
        load_checkpoint(path)
    text = str(caught.value)
    assert "\n" not in text
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
        ("hidden", {4: [7, 7], 5: [16]}),
        ("rates", "fast"),
        ("card", "{"),
        ("loss", {"nonsense": 1}),
    ],
)
def test_a_checkpoint_with_a_wrong_part_is_refused(
    tmp_path: Path, checkpoint: Checkpoint, key: str, value: Any
) -> None:
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    data = torch.load(path, weights_only=True)
    torch.save(data | {key: value}, path)
    assert "does not fit" in refuse(path)


def test_weights_that_are_not_finite_are_refused_by_name(
    tmp_path: Path, checkpoint: Checkpoint
) -> None:
    with torch.no_grad():
        checkpoint.net.layers[2].conv.bias[0] = float("nan")
    save_checkpoint(tmp_path / "sgm.pt", checkpoint)
    assert "layers.2.conv.bias" in refuse(tmp_path / "sgm.pt")
