"""The host's commands pass on what they are given, and say what is missing."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from command_line import Run, assert_refused

from qsgm import QsgmError
from qsgm.cli import console


def test_host_commands_say_what_to_install_when_torch_is_missing(
    qsgm: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_torch(_: str) -> None:
        raise ModuleNotFoundError("No module named 'torch'", name="torch.nn")

    monkeypatch.setattr(console, "importlib", SimpleNamespace(import_module=without_torch))
    for command in (("pretrain",), ("teach-comparer", "sgm.pt"), ("fold-and-quantize", "sgm.pt")):
        assert_refused(
            qsgm(*command), 1, "needs torch", "pip install -c constraints.txt '.[train]'"
        )


def test_speed_needs_a_step_to_time(qsgm: Run) -> None:
    assert_refused(qsgm("bench", "speed", "--epochs", 0), 2, "--epochs")


def test_drawing_a_calibration_set_says_where_it_is_or_one_json_object(
    qsgm: Run, tmp_path: Path
) -> None:
    folder = tmp_path / "calib"
    outcome = qsgm("draw-calibration", "--count", 1, "--seed", 3, "-o", folder, "--json")
    assert outcome.json == {"output": str(folder), "frames": 1, "seed": 3}
    assert (folder / "frame_00.jpg").is_file()
    told = qsgm("draw-calibration", "--count", 1, "--seed", 3, "-o", folder)
    assert told.out == f"calibration set: {folder}\n"


def test_pretrain_passes_on_encoding_and_hidden_channels(
    qsgm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from qsgm.train.grasp import pretrain

    given = []
    monkeypatch.setattr(pretrain, "pretrain_grasping", lambda *values: given.append(values))
    common = ("pretrain", "--json", "-o", tmp_path / "sgm.pt")
    assert qsgm(*common).json["output"] == str(tmp_path / "sgm.pt")
    assert qsgm(*common, "--encoding", "paper", "--hidden", "16,8").code == 0
    (task, *_, config), (other_task, *_, other_config) = given
    assert config == pretrain.PretrainConfig()
    assert task.encoding == "double"
    assert other_config.hidden == (16, 8)
    assert other_task.encoding == "paper"


def test_teach_comparer_passes_on_where_it_draws_and_learns(
    qsgm: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from qsgm.train.grasp import teach_comparer

    given = []
    monkeypatch.setattr(teach_comparer, "teach_comparer", lambda *values: given.append(values[:5]))
    output = tmp_path / "comparer.json"
    outcome = qsgm("teach-comparer", "my.pt", "-o", output, "--processes", 3, "--seed", 2, "--json")
    assert outcome.json == {"output": str(output), "seed": 2, "device": "cpu"}
    assert given == [(Path("my.pt"), output, 2, "cpu", 3)]


def test_fold_and_quantize_works_on_every_core_unless_told_otherwise(
    qsgm: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    from qsgm.train import processes
    from qsgm.train.grasp import export

    given = []

    def refuse(*values: Any) -> None:
        given.append(values[-1].processes)
        raise QsgmError("enough")

    monkeypatch.setattr(export, "fold_and_quantize", refuse)
    monkeypatch.setattr(processes, "usual_count", lambda: 3)
    for asked in ((), ("--processes", 2)):
        assert_refused(qsgm("fold-and-quantize", "my.pt", *asked), 1, "enough")
    assert given == [3, 2]
    assert_refused(
        qsgm("fold-and-quantize", "my.pt", "--task", "my.py", "--processes", 2), 1, "--processes"
    )


def test_teach_comparer_refuses_what_is_no_checkpoint_and_leaves_nothing(
    qsgm: Run, tmp_path: Path
) -> None:
    (tmp_path / "sgm.pt").write_text("not one")
    output = tmp_path / "comparer.json"
    assert_refused(qsgm("teach-comparer", tmp_path / "sgm.pt", "-o", output), 1, "sgm.pt")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sgm.pt"]


@pytest.mark.parametrize("hidden", ["", "a", "8,", "0", "-4,4", "8;8", "99999"])
def test_hidden_channels_that_are_none_are_a_usage_error(qsgm: Run, hidden: str) -> None:
    assert_refused(qsgm("pretrain", "--hidden", hidden), 2, "--hidden")
