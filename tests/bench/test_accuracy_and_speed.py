"""The benchmarks: scenes whose truth is known, folders read right, reports that add up."""

import io
import json
import math
from dataclasses import replace
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from qsgm import QsgmError, cli
from qsgm.bench import accuracy, speed, timing
from qsgm.bench.accuracy import (
    ANGLE,
    METRICS,
    AccuracyReport,
    curve_steps,
    measure_accuracy,
    render,
    report_json,
    statistics,
)
from qsgm.bench.frames import BenchFrame, list_frames
from qsgm.bench.speed import measure_speed, ratios
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.teach import finetune, prepare_object
from qsgm.images import write_png
from qsgm.manifest import Recipe, step_file
from qsgm.schedule import batches
from qsgm.tune.loop import StepLoop
from qsgm.tune.plan import resolve
from qsgm.tune.run import Keeper, train
from qsgm.tune.settings import Settings

SHORT = Settings(epochs=1)
MAIN = Settings(precision="int8", epochs=2)


def test_a_folder_with_a_manifest_gives_what_the_manifest_lists(frames_folder: Path) -> None:
    bar, disk = list_frames(frames_folder)
    assert (bar.name, bar.elongated, disk.elongated) == ("bar", True, False)
    assert bar.read().shape == (480, 640, 3)
    assert bar.read_mask().dtype == bool
    assert list_frames(frames_folder, limit=1) == [bar]


def test_a_folder_without_manifest_gives_every_picture_but_the_masks(
    frames_folder: Path, tmp_path: Path
) -> None:
    for name in ("bar.png", "bar_mask.png", "disk.png"):
        (tmp_path / name).write_bytes((frames_folder / name).read_bytes())
    bar, disk = list_frames(tmp_path)
    assert (bar.name, disk.name, bar.elongated) == ("bar", "disk", None)
    assert bar.mask_path == tmp_path / "bar_mask.png"
    with pytest.raises(QsgmError, match=r"has no mask .*disk_mask.png"):
        disk.read_mask()


@pytest.mark.parametrize("content", ["{", "3", '[{"mask": "a.png"}]', "[1]"])
def test_a_manifest_that_lists_nothing_usable_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "manifest.json").write_text(content)
    with pytest.raises(QsgmError, match=r"manifest\.json"):
        list_frames(tmp_path)


def test_a_folder_without_frames_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(QsgmError, match="found none"):
        list_frames(tmp_path / "empty")
    with pytest.raises(QsgmError, match="no such folder"):
        list_frames(tmp_path / "nowhere")


@pytest.fixture(scope="module")
def accuracy_report(frames_folder: Path, bundle: Bundle) -> AccuracyReport:
    """Runs of one and two epochs on a bar and a disk, with a small grid whose last rate blows up.

    Of the short lengths asked for, those that are not below the main one are left out.
    """
    told: list[tuple[str, int, int]] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(accuracy, "GRID", {"adam": (0.001, 0.003), "sgd": (0.01, 1e12)})
        report = measure_accuracy(
            list_frames(frames_folder), bundle, MAIN, (5, 1, 2), lambda *what: told.append(what)
        )
    assert told == [("frames", 1, 2), ("frames", 2, 2)]
    return report


def ends_of(report: AccuracyReport, metric: int = ANGLE) -> list[dict[Recipe, float]]:
    """Per run length: the mean of a metric over the judged frames, for all of the grid."""
    places = report.groups[report.judged]
    return [
        {recipe: float(curves[places, -1, metric].mean()) for recipe, curves in runs.grid.items()}
        for runs in report.runs
    ]


def test_accuracy_is_measured_for_every_run_length_and_method(
    accuracy_report: AccuracyReport,
) -> None:
    assert [(runs.epochs, runs.steps[-1]) for runs in accuracy_report.runs] == [(1, 25), (2, 50)]
    methods = ["untouched", "sgm int8", "sgm float", "bp sgd", "bp adam", "bp best"]
    for runs in accuracy_report.runs:
        assert list(runs.methods) == methods
        shapes = {curves.shape for curves in (*runs.methods.values(), *runs.grid.values())}
        assert shapes == {(2, len(runs.steps), 2)}
        for name in methods[:-1]:
            assert np.isfinite(runs.methods[name]).all()


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("sgm int8", {}),
        ("sgm float", {"precision": "float"}),
        ("bp sgd", {"method": "bp", "optimizer": "sgd"}),
        ("bp adam", {"method": "bp", "optimizer": "adam"}),
    ],
)
def test_a_learning_curve_goes_from_the_untouched_network_to_what_finetune_gives(
    accuracy_report: AccuracyReport, bundle: Bundle, name: str, changes: dict[str, Any]
) -> None:
    frame = accuracy_report.frames[0].read()
    for runs in accuracy_report.runs:
        alone = finetune(frame, bundle, replace(MAIN, epochs=runs.epochs, **changes))
        curve = runs.methods[name][0]
        for place, scores in ((0, alone.untouched), (-1, alone.scores)):
            assert list(curve[place]) == [scores[metric] for metric in METRICS]
        np.testing.assert_array_equal(runs.methods["untouched"][0], curve[:1].repeat(len(curve), 0))


def test_weights_on_the_way_are_those_of_a_run_cut_short_there(
    frame_path: Path, bundle: Bundle
) -> None:
    recipe = Recipe("sgd", (0.003, 0.004, 0.005))
    plan = resolve(MAIN, bundle, recipe)
    prepared = prepare_object(BenchFrame(frame_path, None, None).read(), bundle, plan)
    keeper = Keeper((0, 7))
    train(prepared, plan, (keeper,))
    session = bundle.session(step_file("int8", "sgd", single_layers(plan.layers)))
    rates = dict(zip((4, 5, 6), recipe.rates, strict=True))
    loop = StepLoop(session, prepared.features, prepared.labels, prepared.start, rates)
    for step, rows in enumerate(islice(batches(800, np.random.default_rng([0, 1])), 7)):
        loop.step(rows, 1 - step / 50)
    assert set(keeper.kept) == {0, 7}
    for name, value in loop.weights().items():
        np.testing.assert_array_equal(keeper.kept[7][name], value)
        np.testing.assert_array_equal(keeper.kept[0][name], prepared.start[name])


def test_a_run_is_looked_at_twice_a_doubling_and_at_both_ends() -> None:
    assert curve_steps(0) == (0,)
    assert curve_steps(1) == (0, 1, 2, 3, 4, 6, 8, 11, 16, 23, 25)
    assert curve_steps(20)[-5:] == (128, 181, 256, 362, 500)


def test_the_best_backpropagation_is_not_worse_than_any_of_the_grid(
    accuracy_report: AccuracyReport,
) -> None:
    assert accuracy_report.judged == "elongated"
    for runs, errors in zip(accuracy_report.runs, ends_of(accuracy_report), strict=True):
        assert len(errors) == 4
        assert errors[runs.best] == min(error for error in errors.values() if error == error)
        np.testing.assert_array_equal(runs.methods["bp best"], runs.grid[runs.best])


def test_rates_that_blow_up_are_reported_and_never_the_best(
    accuracy_report: AccuracyReport,
) -> None:
    for runs, errors in zip(accuracy_report.runs, ends_of(accuracy_report), strict=True):
        assert math.isnan(errors[Recipe("sgd", (1e12,) * 3)])
        assert runs.best.rates[0] < 1
    grid = report_json(accuracy_report)["runs"][0]["grid"]
    assert [(entry["optimizer"], entry["rate"]) for entry in grid] == [
        *(("adam", rate) for rate in (0.001, 0.003)),
        *(("sgd", rate) for rate in (0.01, 1e12)),
    ]
    assert grid[-1]["elongated"] == {"detection_accuracy": None, "angle_mae_deg": None}
    assert grid[0]["all"]["angle_mae_deg"] > 0


def test_the_accuracy_report_adds_up(accuracy_report: AccuracyReport) -> None:
    values = report_json(accuracy_report)
    json.dumps(values, allow_nan=False)
    assert (values["all"]["frames"], values["elongated"]["frames"]) == (2, 1)
    main = values["runs"][-1]
    assert values["elongated"]["methods"] == main["elongated"]
    bar, disk = values["per_frame"]
    for runs in values["runs"]:
        of_length = [frame["runs"][str(runs["epochs"])] for frame in (bar, disk)]
        for name, metrics in runs["all"].items():
            for metric, found in metrics.items():
                both = [methods[name][metric] for methods in of_length]
                assert found["mean"] == pytest.approx(np.mean(both), abs=1e-4)
                curve = runs["curves"]["methods"][name][metric]
                assert curve["mean"][-1] == curve["upper_quartile"][-1] == both[0]
        best = runs["elongated"]["bp best"]["angle_mae_deg"]["mean"]
        ours = runs["elongated"]["sgm int8"]["angle_mae_deg"]["mean"]
        ratio = runs["sgm_int8_over_bp_best"]["elongated"]["angle_mae_deg"]
        assert ratio == pytest.approx(ours / best, abs=1e-3)
    assert bar["methods"] == bar["runs"]["2"]


def test_the_tables_of_the_defaults_fit_into_80_columns(accuracy_report: AccuracyReport) -> None:
    one, main = accuracy_report.runs
    lengths = (one, replace(one, epochs=3), replace(main, epochs=20))
    console = Console(width=200, record=True, file=io.StringIO())
    console.print(render(report_json(replace(accuracy_report, runs=lengths)), per_frame=True))
    lines = [line.rstrip() for line in console.export_text().splitlines()]
    assert max(map(len, lines)) <= 80
    rows = [line.split() for line in lines if line.startswith(" sgm int8")]
    assert len(rows) == 2  # all, elongated
    ends = [runs.methods["sgm int8"][0, -1] for runs in lengths]
    means = [f"{end[metric]:.{3 - metric}f}" for end in ends for metric in (0, 1)]
    assert rows[1][2:8] == means


def test_statistics_are_mean_median_spread_and_both_ends() -> None:
    assert statistics([1.0, 2.0, 6.0]) == {
        "mean": 3.0,
        "median": 2.0,
        "spread": pytest.approx(2.1602, abs=1e-4),
        "min": 1.0,
        "max": 6.0,
    }


def test_bench_accuracy_runs_from_the_command_line(
    frames_folder: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["--frames", str(frames_folder), "--bundle", str(bundle_folder), "--epochs", "0"]
    report = tmp_path / "report.json"
    assert cli.run(["bench", "accuracy", *common, "--json", "-o", str(report)]) == 0
    assert json.loads(capsys.readouterr().out) == json.loads(report.read_text())
    assert cli.run(["bench", "accuracy", *common, "--limit", "1", "--per-frame"]) == 0
    assert "sgm int8" in capsys.readouterr().out


@pytest.mark.parametrize("lengths", ["1,", "1;3", "0", "-1,3", "x"])
def test_run_lengths_that_are_no_numbers_of_epochs_are_refused(
    frames_folder: Path, lengths: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["bench", "accuracy", "--frames", str(frames_folder), "--short", lengths]
    assert cli.run(command) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--short" in message


def test_ratios_compare_whole_jobs_and_steps_that_took_turns() -> None:
    medians = {
        name: {"features": 1.0, "tuning": tuning, "total": 4.0, "process": 2.0}
        for name, tuning in (("sgm int8", 2.0), ("sgm float", 1.6), ("bp", 3.0), ("torch bp", 5.0))
    }
    turns = {"forward": 1.0, "backprop": 3.5, "sgm_float": 2.0, "sgm_int8": 2.5}
    found = ratios(medians, turns)
    assert found["qsgm_step_over_forward"] == found["float_step_over_forward"] == 2
    assert found["int8_step_over_forward"] == 2.5
    assert found["int8_step_over_float_step"] == 1.25
    assert found["bp_step_over_qsgm_step"] == 1.75
    assert found["torch_bp_step_over_qsgm_step"] == 3.125
    assert found["qsgm_tuning_over_total"] == 0.4
    del medians["torch bp"]
    assert "torch_bp_step_over_qsgm_step" not in ratios(medians, turns)


def test_speed_runs_the_same_job_in_processes_of_their_own(
    frame_path: Path, bundle: Bundle
) -> None:
    settings = Settings(layers=2, epochs=1)
    report = measure_speed(frame_path, bundle, settings, 1, lambda *_: None)
    assert set(report["seconds"]) >= {"sgm int8", "sgm float", "bp"}
    assert report["steps"] == 25
    assert report["ratios"]["torch_bp_step_over_qsgm_step"] > 0
    assert report["step_table_ms"] == {"1": report["in_turns_ms"]}
    assert report["step_over_qsgm_step"]["1"]["sgm_float"] == 1


def test_single_steps_are_timed_with_further_numbers_of_threads(
    frames_folder: Path,
    bundle_folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    stages = dict.fromkeys(("crops", "features", "tuning", "total", "process"), 1.0)
    monkeypatch.setattr(speed, "run_once", lambda *_: stages)
    monkeypatch.setattr(speed, "TURNS", 2)
    command = ["bench", "speed", "--frames", str(frames_folder), "--bundle", str(bundle_folder)]
    command += ["--thread-counts", "1,2", "--repeats", "1"]
    assert cli.run([*command, "--json"]) == 0
    assert list(json.loads(capsys.readouterr().out)["step_table_ms"]) == ["1", "2"]
    assert cli.run(command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("threads: 2" in line for line in lines)


@pytest.mark.parametrize("counts", ["0", "1;2"])
def test_thread_counts_that_are_none_are_refused(
    counts: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["bench", "speed", "--thread-counts", counts]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--thread-counts" in message


def test_variants_take_turns_and_the_first_turn_does_not_count() -> None:
    calls: list[str] = []
    clock = [0.0]

    def job(name: str, seconds: list[float]) -> None:
        clock[0] += seconds[calls.count(name)]
        calls.append(name)

    jobs = {"a": partial(job, "a", [900, 1, 5, 2]), "b": partial(job, "b", [0, 7, 8, 9])}
    assert timing.median_seconds(jobs, 3, lambda: clock[0]) == {"a": 2, "b": 8}
    assert calls == ["a", "b"] * 4


def test_speed_hands_its_settings_to_every_process(
    monkeypatch: pytest.MonkeyPatch, frame_path: Path, bundle: Bundle
) -> None:
    jobs: list[list[str]] = []

    def record(job: list[str], **_: object) -> SimpleNamespace:
        jobs.append(job)
        return SimpleNamespace(returncode=0, stdout='{"seconds": {}}')

    monkeypatch.setattr(speed.subprocess, "run", record)
    settings = Settings(layers=2, trunk="int8", epochs=7, seed=3, threads=2)
    speed.run_once("sgm float", frame_path, bundle, settings)
    options = dict(pairwise(jobs[0]))
    names = ("--layers", "--trunk", "--epochs", "--seed", "--threads")
    assert [options[name] for name in names] == ["2", "int8", "7", "3", "2"]


def test_speed_names_the_variant_that_failed(bundle: Bundle, tmp_path: Path) -> None:
    write_png(tmp_path / "small.png", np.zeros((8, 8, 3), np.uint8))
    with pytest.raises(QsgmError, match=r"sgm int8 failed with exit code 1: error: .*small\.png"):
        measure_speed(tmp_path / "small.png", bundle, SHORT, 1, lambda *_: None)


def test_the_torch_job_learns_what_backpropagation_here_learns(
    frame_path: Path, bundle: Bundle
) -> None:
    from qsgm.train.grasp import torch_job

    settings = Settings(method="bp", layers=2, epochs=2)
    own = finetune(BenchFrame(frame_path, None, None).read(), bundle, settings)
    other = torch_job.run(frame_path, bundle, 2, 2, 0, 1)
    assert other["detection_accuracy"] == pytest.approx(own.scores["detection_accuracy"], abs=0.006)
    assert other["angle_mae_deg"] == pytest.approx(own.scores["angle_mae_deg"], abs=0.1)


def test_a_frame_that_cannot_serve_as_a_demonstration_is_refused(tmp_path: Path) -> None:
    write_png(tmp_path / "small.png", np.random.default_rng(0).integers(0, 255, (200, 200, 3)))
    write_png(tmp_path / "flat.png", np.full((480, 640, 3), 90, np.uint8))
    flat, small = list_frames(tmp_path)
    with pytest.raises(QsgmError, match="one flat colour"):
        flat.read()
    with pytest.raises(QsgmError, match="too small for a demonstration"):
        small.read()
