"""Whatever happens while an object is saved, what is left is the old one or the new one, whole."""

from pathlib import Path

import pytest

from qsgm.bundle import Bundle
from robustness.conftest import Campaign


@pytest.fixture(scope="session")
def networks(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two, of which one differs in a bias."""
    folder = tmp_path_factory.mktemp("networks")
    weights = bundle.start_weights(bundle.network.last(1))
    weights["bias6"] = weights["bias6"] + 1
    for name, changed in (("old", {}), ("new", weights)):
        (folder / f"{name}.onnx").write_bytes(bundle.network_with(changed))
    return [folder / "old.onnx", folder / "new.onnx"]


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
