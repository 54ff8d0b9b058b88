"""Charts: what is drawn is what was measured, and the picture is whole."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.axes import Axes
from numpy.typing import NDArray

from qsgm import cli
from qsgm.bench.accuracy import AccuracyReport, Runs, curve_steps, groups_of
from qsgm.bench.frames import BenchFrame
from qsgm.bundle import Bundle, Recipe
from qsgm.train.charts import LINE_HEIGHT, learning_curves, write_learning_curves
from qsgm.tune.settings import Settings

Floats = NDArray[np.float64]


def runs_of(epochs: int, end_deg: float, end_detection: float) -> Runs:
    """Three frames; all methods go from 0.97 and about 4 degrees to these ends."""
    steps = curve_steps(epochs)
    way = np.linspace(0, 1, len(steps))
    spread = np.array([0.9, 1.0, 1.3])[:, None]
    angle = spread * (4 + (end_deg - 4) * way)
    detection = np.broadcast_to(0.97 + (end_detection - 0.97) * way, angle.shape)
    curves: Floats = np.stack([detection, angle], axis=-1)
    best = Recipe("adam", (0.002,) * 3)
    start = np.repeat(curves[:, :1], len(steps), axis=1)
    faster = curves * [1, 0.9]
    methods = {"untouched": start, "sgm int8": curves, "sgm float": curves, "bp best": faster}
    return Runs(epochs, steps, methods, {best: faster}, best)


@pytest.fixture
def report(bundle: Bundle) -> AccuracyReport:
    """The first and the last frame are elongated, and judged."""
    frames = tuple(BenchFrame(Path(f"{k}.png"), None, k != 1) for k in range(3))
    runs = (runs_of(1, 3, 0.98), runs_of(3, 2, 0.99), runs_of(20, 1.2, 1.0))
    return AccuracyReport(Settings(epochs=20), bundle, frames, groups_of(frames), runs)


def lines_of(axes: Axes) -> list[Floats]:
    """Points (n, 2) of every line, the level line of the untouched network first."""
    return [np.asarray(line.get_xydata()) for line in axes.lines]


def test_lines_are_means_over_the_judged_frames_and_dots_are_ends(report: AccuracyReport) -> None:
    angle, detection = learning_curves(report).axes
    main = report.runs[-1]
    untouched, sgm, sgm_ends, _, bp_ends = lines_of(angle)
    errors = main.methods["sgm int8"][[0, 2], :, 1].mean(axis=0)
    np.testing.assert_allclose(sgm, np.stack([main.steps, errors], axis=1))
    np.testing.assert_allclose(untouched[:, 1], 4 * 1.1)
    np.testing.assert_allclose(sgm_ends, [(25, 3.3), (75, 2.2), (500, 1.32)])
    np.testing.assert_allclose(bp_ends[:, 1], 0.9 * sgm_ends[:, 1])
    _, _, percent, *_ = lines_of(detection)
    np.testing.assert_allclose(percent, [(25, 2), (75, 1), (500, 0)], atol=1e-9)


def test_labels_say_the_last_values_and_stand_apart(report: AccuracyReport) -> None:
    for axes, values in zip(
        learning_curves(report).axes,
        (["backprop 1.19°", "SGM int8 1.32°", "untouched 4.40°"], ["0.00 %", "0.00 %", "3.00 %"]),
        strict=True,
    ):
        labels = sorted((text.xy[1], text.get_text()) for text in axes.texts)
        assert all(label.endswith(value) for (_, label), value in zip(labels, values, strict=True))
        gaps = np.diff([height for height, _ in labels])
        assert gaps.min() >= LINE_HEIGHT - 1e-9


def test_a_picture_shows_the_best_recipe_and_the_number_of_frames(report: AccuracyReport) -> None:
    caption = learning_curves(report).texts[0].get_text()
    assert "2 elongated objects" in caption
    assert "Adam 0.002, Adam 0.002, Adam 0.002" in caption


def test_nothing_sticks_out_of_the_picture(report: AccuracyReport) -> None:
    figure = learning_curves(report)
    box = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert 0 <= box.x0 < box.x1 <= width
    assert 0 <= box.y0 < box.y1 <= height


def test_the_picture_is_written_whole(report: AccuracyReport, tmp_path: Path) -> None:
    path = tmp_path / "new" / "curves.png"
    write_learning_curves(report, path)
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape == (900, 1800, 3)
    blue = np.abs(picture.astype(int) - (0xB2, 0x72, 0x00)).sum(axis=2) < 8  # BGR
    assert blue.sum() > 1000
    assert [item.name for item in path.parent.iterdir()] == ["curves.png"]
    assert "matplotlib.pyplot" not in sys.modules


def test_bench_accuracy_draws_a_picture_and_puts_its_figures_beside_it(
    frames_folder: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    what = ["--frames", str(frames_folder), "--bundle", str(bundle_folder), "--limit", "1"]
    pictures = tmp_path / "pictures"
    command = ["bench", "accuracy", *what, "--epochs", "1", "--short", ""]
    assert cli.run([*command, "--pictures", str(pictures), "--json"]) == 0
    values = json.loads((pictures / "accuracy.json").read_text())
    assert values == json.loads(capsys.readouterr().out)
    assert [runs["epochs"] for runs in values["runs"]] == [1]
    assert cv2.imread(str(pictures / "learning_curves.png")) is not None


def test_without_matplotlib_there_are_tables_but_for_pictures_one_line(
    frames_folder: Path,
    bundle_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == "matplotlib" or name == "qsgm.train.charts":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    what = ["--frames", str(frames_folder), "--bundle", str(bundle_folder), "--limit", "1"]
    command = ["bench", "accuracy", *what, "--epochs", "0"]
    assert cli.run([*command, "--pictures", str(tmp_path / "pictures")]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "needs matplotlib" in printed.err
    assert "'.[report]'" in printed.err
    assert not (tmp_path / "pictures").exists()
    assert cli.run(command) == 0
    assert "bp best" in capsys.readouterr().out
