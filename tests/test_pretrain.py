"""Pretraining as a whole, in a size that takes seconds."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from qsgm.errors import QsgmError
from qsgm.train.backbone import BackboneConfig
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.maml import MamlConfig
from qsgm.train.matching import MatchingConfig
from qsgm.train.pretrain import PretrainConfig, pretrain

TINY = PretrainConfig(
    hidden=(8,),
    tasks=2,
    crops_per_task=50,
    trial_tasks=1,
    trial_epochs=1,
    backbone=BackboneConfig(steps=4, frames_per_batch=2, crops_per_frame=8, loader_processes=0),
    matching=MatchingConfig(epochs=1, record_every=1, fit_steps=4, fit_batch=16),
    maml=MamlConfig(outer_steps=2, tasks_per_step=2, unroll=2, warm_up=1),
)


def silent(stage: str, done: int, total: int, figures: dict[str, float]) -> None:
    """Watch without a word."""


def test_pretraining_ends_in_a_checkpoint_that_loads_and_says_how_it_was_made(
    tmp_path: Path,
) -> None:
    stages: list[str] = []

    def watch(stage: str, done: int, total: int, _: dict[str, float]) -> None:
        assert 0 < done <= total
        stages.append(stage)

    pretrain(tmp_path / "sgm.pt", 3, "cpu", watch, TINY)
    checkpoint = load_checkpoint(tmp_path / "sgm.pt")
    assert sorted(checkpoint.sgms) == [4, 5]
    assert {n: len(rates) for n, rates in checkpoint.rates.items()} == {1: 1, 2: 2, 3: 3}
    assert checkpoint.card["command"] == "qsgm pretrain -o sgm.pt --seed 3"
    assert list(dict.fromkeys(stages)) == ["backbone", "tasks", "matching", "meta", "rates"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sgm.md", "sgm.pt"]
    assert checkpoint.card["command"] in (tmp_path / "sgm.md").read_text()


def test_the_same_seed_gives_the_same_checkpoint_and_another_seed_another(tmp_path: Path) -> None:
    nets = [
        pretrain(tmp_path / f"{i}.pt", seed, "cpu", silent, TINY).net.state_dict()
        for i, seed in enumerate((0, 0, 1))
    ]
    assert all(torch.equal(a, nets[1][name]) for name, a in nets[0].items())
    assert not all(torch.equal(a, nets[2][name]) for name, a in nets[0].items())


def test_an_interrupted_pretraining_goes_on_where_it_stopped(tmp_path: Path) -> None:
    def interrupt(stage: str, *_: object) -> None:
        if stage == "meta":
            raise KeyboardInterrupt

    output = tmp_path / "sgm.pt"
    with pytest.raises(KeyboardInterrupt):
        pretrain(output, 0, "cpu", interrupt, TINY)
    assert not output.exists()
    stages: set[str] = set()
    resumed = pretrain(output, 0, "cpu", lambda stage, *_: stages.add(stage), TINY)
    assert "backbone" not in stages
    assert "matching" not in stages
    unbroken = pretrain(tmp_path / "other.pt", 0, "cpu", silent, TINY)
    for name, value in unbroken.net.state_dict().items():
        assert torch.equal(resumed.net.state_dict()[name], value)


def test_a_partial_of_another_seed_is_not_taken_up(tmp_path: Path) -> None:
    output = tmp_path / "sgm.pt"
    first = replace(TINY, maml=replace(TINY.maml, outer_steps=1))
    with pytest.raises(ZeroDivisionError):
        pretrain(output, 0, "cpu", lambda stage, *_: 1 // (stage != "meta"), first)
    stages: set[str] = set()
    pretrain(output, 1, "cpu", lambda stage, *_: stages.add(stage), first)
    assert "backbone" in stages


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_device_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(QsgmError, match="--device cpu"):
        pretrain(tmp_path / "sgm.pt", 0, "cuda", silent, TINY)
    assert not list(tmp_path.iterdir())
