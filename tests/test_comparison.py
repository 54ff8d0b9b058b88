"""`qsgm bench baselines`: every system starts from the same and is given its best."""

import json
from pathlib import Path

import pytest
import torch
from nets import random_net

from qsgm import cli
from qsgm.bench.frames import list_frames
from qsgm.train.baselines import comparison
from qsgm.train.baselines.comparison import GRID, all_systems, compare, tasks_of
from qsgm.train.checkpoint import Checkpoint, save_checkpoint
from qsgm.train.model.graspnet import Loss
from qsgm.train.model.sgm import Sgm
from qsgm.train.model.start import folded_start
from qsgm.train.paper.baselines.backpropagation import Backpropagation
from qsgm.train.paper.baselines.tuning import Recipe, run_baseline
from qsgm.train.pretraining.tasks import TaskSet


@pytest.fixture(scope="module")
def checkpoint() -> Checkpoint:
    net = random_net(3)
    sgms = {layer: Sgm(layer, (8,)).eval() for layer in (4, 5)}
    rates = {"6": (0.01,), "5,6": (1e-4, 0.01), "4,5,6": (1e-5, 1e-4, 0.01)}
    return Checkpoint(net, sgms, {}, Loss(), rates, {})


@pytest.fixture(scope="module")
def tasks(checkpoint: Checkpoint, frames_folder: Path) -> TaskSet:
    return tasks_of(checkpoint, list_frames(frames_folder), 2, 0, lambda *_: None)


def test_backpropagation_is_given_the_best_of_the_grid(
    checkpoint: Checkpoint, tasks: TaskSet, monkeypatch: pytest.MonkeyPatch
) -> None:
    some = TaskSet(tasks.features[:, :80], tasks.labels[:, :80], 60)
    only = {"backpropagation": all_systems(checkpoint, 2, 0)["backpropagation"]}
    monkeypatch.setattr(comparison, "all_systems", lambda *_: only)
    rows = {row.system: row for row in compare(checkpoint, some, 2, 1, 0, lambda *_: None)}
    assert list(rows) == ["untouched", "static SGMs, as shipped", "backpropagation"]
    start, runs = folded_start(checkpoint.net, 2), {}
    for name, (optimizer, rates) in GRID.items():
        for rate in rates:
            recipe = Recipe(optimizer, (rate, rate), 1)
            runs[f"{name} {rate:g}"] = run_baseline(
                some, start, Backpropagation(), recipe, Loss(), 0
            )
    best = min(runs, key=lambda recipe: float(runs[recipe][:, 0].mean()))
    assert rows["backpropagation"].recipe == best
    assert rows["backpropagation"].angle_mae_deg == pytest.approx(float(runs[best][:, 2].mean()))


def test_all_systems_run_from_the_command_line(
    checkpoint: Checkpoint,
    frames_folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(comparison, "GRID", {"sgd": (GRID["sgd"][0], (0.003,))})
    path = tmp_path / "sgm.pt"
    save_checkpoint(path, checkpoint)
    arguments = ["bench", "baselines", str(path), "--frames", str(frames_folder), "--json"]
    arguments += ["--layers", "2", "--epochs", "1", "--limit", "1"]
    with torch.random.fork_rng():
        assert cli.run(arguments) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["frames"] == 1
    assert len(report["systems"]) == 10
    for figures in report["systems"].values():
        assert 0 <= figures["detection_accuracy"] <= 1
    assert report["systems"]["direct feedback"]["recipe"] == "sgd 0.003"
