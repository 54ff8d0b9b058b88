"""Whatever happens while an object is saved, what is left is the old one or the new one, whole."""

from pathlib import Path

import pytest

from robustness.conftest import Campaign


@pytest.mark.parametrize("name", ["kills", "kills_between_two_steps", "interrupts"])
def test_a_signal_before_any_file_event_leaves_the_old_or_the_new(
    campaign: Campaign, networks: list[Path], tmp_path: Path, name: str
) -> None:
    counts = campaign("saves", name, tmp_path / "save", *networks)
    assert counts["signals"] > 10
    assert counts["left the new"] < counts["signals"]


def test_a_power_loss_before_any_file_event_leaves_the_old_or_the_new(
    campaign: Campaign, networks: list[Path], tmp_path: Path
) -> None:
    assert campaign("saves", "power_loss", tmp_path / "save", *networks)["power losses"] > 60


def test_a_disk_that_fills_up_leaves_the_old_or_the_new(
    campaign: Campaign, networks: list[Path], tmp_path: Path
) -> None:
    counts = campaign("saves", "full_disk", tmp_path / "save", *networks, rounds=12)
    assert counts["refused"]


def test_eight_processes_save_and_load_one_object(
    campaign: Campaign, networks: list[Path], tmp_path: Path
) -> None:
    campaign("saves", "eight", tmp_path / "save", *networks, rounds=3)
