"""`qsgm fidelity`: stable keys, and nothing kept."""

import json
from pathlib import Path

from command_line import FIDELITY_KEYS, Run, assert_refused


def test_fidelity_prints_the_table_and_keeps_nothing(
    qsgm: Run, frame_path: Path, bundle_folder: Path, tmp_path: Path
) -> None:
    before = sorted(tmp_path.rglob("*"))
    common = ("fidelity", "--epochs", 1, "--bundle", bundle_folder, frame_path)
    assert "cos" in qsgm(*common).out
    assert sorted(tmp_path.rglob("*")) == before
    values = qsgm(*common, "--json", "-o", tmp_path / "report.json").json
    assert all(layer.keys() >= FIDELITY_KEYS for layer in values["fidelity"].values())
    assert [probe["epoch"] for probe in values["fidelity_over_run"]] == [0, 1]
    assert json.loads((tmp_path / "report.json").read_text()) == values


def test_a_report_does_not_take_the_place_of_the_frame(
    qsgm: Run, bundle_folder: Path, frame_path: Path
) -> None:
    before = frame_path.read_bytes()
    outcome = qsgm("fidelity", "--bundle", bundle_folder, "-o", frame_path, frame_path)
    assert_refused(outcome, 1, "it is an input")
    assert frame_path.read_bytes() == before
