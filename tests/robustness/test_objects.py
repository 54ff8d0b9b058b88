"""Whatever ends the handling of an object, it is whole, and there unless it was to go."""

from pathlib import Path

import pytest

from robustness.conftest import Campaign


@pytest.mark.parametrize("name", ["rename", "remove", "export"])
def test_a_signal_before_any_file_event_tears_and_loses_nothing(
    campaign: Campaign, networks: list[Path], tmp_path: Path, name: str
) -> None:
    counts = campaign("objects", name, tmp_path / "data", networks[0])
    assert counts["signals"] > 5
    left = {key: number for key, number in counts.items() if key != "signals"}
    assert len(left) > 1, "every signal came too early, or too late"
