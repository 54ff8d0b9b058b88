"""Fidelity over a folder: means and worst cases are those of the runs."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from qsgm import cli, finetune
from qsgm.bench.fidelity import LEGEND, FidelityReport, measure_fidelity
from qsgm.bench.frames import list_frames
from qsgm.bundle import Bundle
from qsgm.tune.settings import Settings

SHORT = Settings(precision="int8", epochs=1)


@pytest.fixture(scope="module")
def report(frames_folder: Path, bundle: Bundle) -> FidelityReport:
    return measure_fidelity(list_frames(frames_folder), bundle, SHORT, lambda *_: None)


def test_every_frame_is_tuned_as_finetune_tunes_it(report: FidelityReport, bundle: Bundle) -> None:
    for frame, int8 in zip(report.frames, report.int8, strict=True):
        alone = finetune(frame.read(), bundle, SHORT)
        assert int8.accuracy == alone.accuracy
        assert int8.fidelity == alone.fidelity
        assert len(int8.prepared.features) == 0


def test_the_worst_frame_and_probe_are_named(report: FidelityReport) -> None:
    values = json.loads(json.dumps(report.to_json(), allow_nan=False))
    for layer in (4, 5):
        cosines = [run.fidelity[layer].cos_int8_float for run in report.int8]
        probes = [p.layers[layer].cos_int8_float for run in report.int8 for p in run.probes]
        row = values["layers"][str(layer)]
        assert row["cos_int8_float"] == pytest.approx(np.mean(cosines), abs=1e-6)
        assert row["cos_int8_float_worst_frame"] == pytest.approx(min(cosines), abs=1e-6)
        assert row["worst_frame"] == report.frames[int(np.argmin(cosines))].name
        assert row["cos_int8_float_worst_probe"] == pytest.approx(min(probes), abs=1e-6)
    assert set(values["per_frame"]) == {frame.name for frame in report.frames}
    assert set(values["groups"]["all"]) == {"int8", "float"}


def test_the_tables_fit_into_80_columns(report: FidelityReport) -> None:
    texts = []
    for width in (80, 200):
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(report.render())
        texts.append([line.rstrip() for line in console.export_text().splitlines()])
    narrow, wide = texts
    rules = [line for line in narrow if "──" in line]
    assert len(rules) == 2
    assert rules == [line for line in wide if "──" in line]
    assert max(map(len, LEGEND.splitlines())) <= 80
    assert "the drift watch fired on 0 of 2 frames" in narrow


def test_bench_fidelity_runs_from_the_command_line(
    frames_folder: Path, bundle_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = ["--frames", str(frames_folder), "--bundle", str(bundle_folder)]
    assert cli.run(["bench", "fidelity", *folders, "--epochs", "1", "--limit", "1", "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["layers"]) == ["4", "5"]
