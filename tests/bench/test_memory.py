"""What memory is reported: reports that add up, processes that tell the truth, a picture."""

import io
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rich.console import Console

from qsgm import cli
from qsgm.bench import memory
from qsgm.bench.memory import (
    BP,
    FLOAT,
    INT8,
    agreement,
    measure_memory,
    render,
    resident_bytes,
    step_json,
    without_probes,
)
from qsgm.bench.resident import peak_resident_bytes
from qsgm.bench.speed import TORCH
from qsgm.blocks import Blocks
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp.teach import finetune
from qsgm.images import read_frame
from qsgm.manifest import Precision
from qsgm.train.graphs.memory import StepMemory
from qsgm.tune.settings import Settings

MB = 1_000_000


def known_step(
    _bundle: Bundle, precision: Precision, blocks: Blocks, batch: int, _threads: int
) -> StepMemory:
    """1000 bytes a layer and crop by backpropagation, half of it in float, a quarter in int8."""
    share = 4 if not blocks.sgm_layers else 1 if precision == "int8" else 2
    peak = 250 * share * batch * len(blocks.layers)
    alive = {"layer1/Gather_1": peak - peak // 50, "layer1/Mul_2": peak // 50}
    return StepMemory(peak, "layer1/Mul_2", alive, peak + 7, peak + peak // 10)


@pytest.fixture
def report(bundle: Bundle, monkeypatch: pytest.MonkeyPatch, frame_path: Path) -> dict[str, Any]:
    def known_bytes(name: str, _frame: Path, used: Bundle, settings: Settings) -> int:
        probes = 2 if used is bundle else 1
        return (400 if name == TORCH else 100) * MB * settings.layers * probes

    monkeypatch.setattr(memory, "resident_bytes", known_bytes)
    return measure_memory(frame_path, bundle, Settings(epochs=1), (3, 6), known_step, ignore)


def ignore(_stage: str, _done: int, _of: int) -> None:
    """Watch nothing."""


def test_ratios_and_processes_are_reported_by_layers_and_batch(report: dict[str, Any]) -> None:
    values = report
    assert list(values["steps"]) == ["1", "8", "32"]
    for batch, by in values["steps"].items():
        assert list(by) == ["1", "2", "3", "4", "5", "6"]
        for tuned in range(2, 7):
            some = by[str(tuned)]
            assert some[BP]["peak_bytes"] == 1000 * int(batch) * tuned
            assert (some["bp_over_sgm_int8"], some["bp_over_sgm_float"]) == (4, 2)
            assert some[INT8]["alive_at_peak"] == {
                "layer1/Gather_1": 245 * int(batch) * tuned  # the other one is too small
            }
    assert values["processes"]["6"] == {INT8: 1200 * MB, FLOAT: 1200 * MB, BP: 1200 * MB} | {
        TORCH: 4800 * MB
    }
    assert values["processes_without_probes"]["3"] == dict.fromkeys((INT8, FLOAT, BP), 300 * MB)


def test_counting_outputs_alone_sgms_save_all_but_the_largest_layers(
    report: dict[str, Any],
) -> None:
    # Convolution and ReLU: 8x62x62, 8x29x29, 16x13x13, 16x5x5, 16x1x1, twice each; the pool behind
    # layer 4, 16x1x1; layer 6, 3x1x1. That is 61504, 13456, 5408, 816, 32 and 3 numbers.
    found = [some["outputs_alone"] for some in report["steps"]["1"].values()]
    expected = [1, 35 / 32, 851 / 816, 6259 / 5408, 19_715 / 13_456, 81_219 / 61_504]
    assert found == pytest.approx(expected, abs=1e-4)


def test_the_tables_fit_into_80_columns_and_name_what_is_alive(report: dict[str, Any]) -> None:
    texts = []
    for width in (80, 200):
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(render(report))
        texts.append([line.rstrip() for line in console.export_text().splitlines()])
    narrow, wide = texts
    assert max(map(len, narrow)) <= 80
    assert [line for line in narrow if "──" in line] == [line for line in wide if "──" in line]
    assert any("layer1/Gather_1" in line for line in narrow)
    assert any(line.split()[:2] == ["6", "yes"] for line in narrow)


def test_the_runtimes_own_figures_are_compared_where_it_gives_some(
    report: dict[str, Any],
) -> None:
    def steps(first: int | None, later: int | None) -> dict[str, Any]:
        step = step_json(StepMemory(2 * MB, "", {}, first, later))
        return dict.fromkeys((INT8, FLOAT, BP), step)

    assert "by 7 bytes at most" in agreement(report["steps"])
    large = {"32": {"5": steps(2 * MB - 20_000, 3 * MB), "6": steps(2 * MB, 4 * MB)}}
    assert "by 1.00% at most" in agreement(large)
    assert "1.50 to 2.00 times" in agreement(large)
    assert "does not say" in agreement({"32": {"6": steps(None, None)}})


def run_resident(file: Path, script: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A script as a module, by the launcher."""
    return subprocess.run(
        [sys.executable, "-m", "qsgm.bench.resident", str(file), script.stem, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=script.parent,
        env={"PYTHONPATH": f"{Path(memory.__file__).parents[2]}:{script.parent}"},
    )


def test_a_process_tells_its_own_memory_and_not_its_parents(tmp_path: Path) -> None:
    script = tmp_path / "holder.py"
    script.write_text("import sys\nheld = bytearray(b'x') * int(sys.argv[1])\nprint(len(held))\n")
    mine = np.ones(40 * MB, np.float64)  # 320 MB that are really there
    found = []
    for size in (1, 100 * MB):
        file = tmp_path / str(size)
        done = run_resident(file, script, str(size))
        assert (done.returncode, done.stdout) == (0, f"{size}\n")
        found.append(int(file.read_text()))
    assert peak_resident_bytes() > mine.nbytes > found[0]
    assert found[1] - found[0] == pytest.approx(100 * MB, rel=0.05)


def test_memory_is_written_down_even_if_the_module_fails(tmp_path: Path) -> None:
    script = tmp_path / "failing.py"
    script.write_text("raise SystemExit(3)\n")
    assert run_resident(tmp_path / "bytes", script).returncode == 3
    assert int((tmp_path / "bytes").read_text()) > MB


def test_a_bundle_without_probes_trains_the_same_and_looks_at_no_gradient(
    bundle: Bundle, tmp_path: Path, frame_path: Path
) -> None:
    copy = without_probes(bundle, tmp_path)
    assert load_bundle(tmp_path).manifest == copy.manifest
    frame, settings = read_frame(frame_path), Settings(epochs=1, layers=2)
    with_probes, without = (finetune(frame, one, settings) for one in (bundle, copy))
    assert with_probes.probes
    assert not without.probes
    for name, value in with_probes.weights.items():
        np.testing.assert_array_equal(value, without.weights[name])


def test_a_variants_memory_is_that_of_its_whole_process(bundle: Bundle, frame_path: Path) -> None:
    found = resident_bytes(INT8, frame_path, bundle, Settings(layers=2, epochs=1))
    assert 40 * MB < found < 400 * MB


def test_bench_memory_runs_from_the_command_line(
    bundle_folder: Path, frames_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, picture = tmp_path / "memory.json", tmp_path / "memory.png"
    command = ["bench", "memory", "--bundle", str(bundle_folder), "--frames", str(frames_folder)]
    command += ["--processes", "", "--json", "-o", str(path), "--picture", str(picture)]
    assert cli.run(command) == 0
    values = json.loads(capsys.readouterr().out)
    assert values == json.loads(path.read_text())
    assert values["processes"] == {}
    six = values["steps"]["32"]["6"]
    assert six["bp_over_sgm_float"] > 1
    assert next(iter(six[BP]["alive_at_peak"])).startswith("layer1/")
    assert cv2.imread(str(picture)) is not None


@pytest.mark.parametrize("counts", ["65", "0", "3;6", "x", "3,"])
def test_numbers_of_layers_that_are_none_are_refused(
    counts: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["bench", "memory", "--processes", counts]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--processes" in message


def test_more_layers_than_the_bundle_has_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["bench", "memory", "--processes", "7"]) == 1
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "cannot tune the last 7 layers: choose 1 to 6" in message


@pytest.mark.parametrize("library", ["onnx", "matplotlib"])
def test_without_a_host_library_it_is_refused_in_one_line(
    library: str,
    bundle_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == library or name == "qsgm.train.graphs.memory":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    picture = tmp_path / "memory.png"
    command: Sequence[str] = ["bench", "memory", "--bundle", str(bundle_folder), "--processes", ""]
    assert cli.run([*command, "--picture", str(picture)]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert f"needs {library}" in printed.err
    assert not picture.exists()
