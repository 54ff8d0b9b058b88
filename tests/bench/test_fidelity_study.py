"""Fidelity over a folder: means and worst cases are those of the runs."""

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from qsgm import cli, finetune
from qsgm.bench.fidelity import LEGEND, measure_fidelity, render
from qsgm.bench.frames import list_frames
from qsgm.bundle import Bundle
from qsgm.tune.report import scores_json
from qsgm.tune.settings import Settings

SHORT = Settings(precision="int8", epochs=1)


@pytest.fixture(scope="module")
def report(frames_folder: Path, bundle: Bundle) -> dict[str, Any]:
    return measure_fidelity(list_frames(frames_folder), bundle, SHORT, lambda *_: None)


def test_means_and_worst_cases_are_those_of_the_runs_that_finetune_makes(
    report: dict[str, Any], frames_folder: Path, bundle: Bundle
) -> None:
    values = json.loads(json.dumps(report, allow_nan=False))
    frames = list_frames(frames_folder)
    runs = [finetune(frame.read(), bundle, SHORT) for frame in frames]
    for layer in (4, 5):
        cosines = [run.fidelity[layer].cos_int8_float for run in runs]
        probes = [p.layers[layer].cos_int8_float for run in runs for p in run.probes]
        row = values["layers"][str(layer)]
        assert row["cos_int8_float"] == pytest.approx(np.mean(cosines), abs=1e-6)
        assert row["cos_int8_float_worst_frame"] == pytest.approx(min(cosines), abs=1e-6)
        assert row["worst_frame"] == frames[int(np.argmin(cosines))].name
        assert row["cos_int8_float_worst_probe"] == pytest.approx(min(probes), abs=1e-6)
    for frame, run in zip(frames, runs, strict=True):
        assert values["per_frame"][frame.name]["int8"] == scores_json(run.scores)
    assert set(values["groups"]["all"]) == {"int8", "float"}


def test_the_tables_fit_into_80_columns(report: dict[str, Any]) -> None:
    texts = []
    for width in (80, 200):
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(render(report))
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
