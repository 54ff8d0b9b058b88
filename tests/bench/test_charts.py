"""Charts: what is drawn is what the JSON says, and the picture is whole."""

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from qsgm import cli
from qsgm.bench.charts import (
    DOTS,
    LABEL_GAP,
    ROWS,
    apart,
    calibration,
    fidelity_over_run,
    in_units,
    learning_curves,
    memory,
    running_mean,
    write_chart,
)
from qsgm.bundle import Bundle
from qsgm.grasp.teach import finetune
from qsgm.manifest import MANIFEST, probe_file
from qsgm.tune.report import fidelity_command_json
from qsgm.tune.settings import Settings

Values = dict[str, Any]


def run_json(epochs: int, steps: list[int], angle: list[float], detection: list[float]) -> Values:
    """A run of `bench accuracy`, backpropagation's errors being nine tenths of the SGMs'."""

    def lines(scale: float, at: slice) -> Values:
        metrics = {"angle_mae_deg": [scale * value for value in angle[at]]}
        metrics["detection_accuracy"] = [1 - scale * (1 - value) for value in detection[at]]
        three = ("mean", "lower_quartile", "upper_quartile")
        return {metric: dict.fromkeys(three, some) for metric, some in metrics.items()}

    methods = {"untouched": lines(1, slice(1)), "sgm int8": lines(1, slice(None))}
    methods["bp best"] = lines(0.9, slice(None))
    curves = {"frames": "elongated", "steps": steps, "methods": methods}
    best = {"optimizer": "adam", "rate": 0.002}
    return {"epochs": epochs, "steps": steps[-1], "bp_best": best, "curves": curves}


@pytest.fixture(scope="module")
def accuracy() -> Values:
    runs = [
        run_json(1, [0, 25], [4.0, 3.3], [0.97, 0.98]),
        run_json(20, [0, 5, 25, 500], [4.0, 3.0, 2.0, 1.3], [0.97, 0.98, 0.99, 1.0]),
    ]
    return {"chosen_on": "elongated", "elongated": {"frames": 2}, "runs": runs}


@pytest.fixture(scope="module")
def fidelity(frame: NDArray[np.uint8], bundle: Bundle) -> Values:
    result = finetune(frame, bundle, Settings(precision="int8", epochs=1, probe_every=5))
    return fidelity_command_json(result, "mug")


def of_five_layers(values: Values) -> Values:
    """Cosines from -1 to 1, one SQNR at its cap."""
    some = values["fidelity_over_run"][0]["4"]
    layers = {
        str(k): some | {"cos_int8_float": cos, "cos_int8_true": -cos, "sqnr_db": 50.0 * (k - 1)}
        for k, cos in enumerate((-1.0, 0.0, 0.9, 0.999_999_9, 1.0), 1)
    }
    probes = [{"step": step} | layers for step in (0, 25)]
    return values | {"layers": 6, "fidelity": layers, "fidelity_over_run": probes}


@pytest.fixture(scope="module")
def peaks() -> Values:
    """1000 bytes a layer and crop by backpropagation, half of it in float, a quarter in int8."""

    def step(batch: int, layers: int) -> Values:
        shares = {"sgm int8": 250, "sgm float": 500, "bp": 1000}
        ratios = {"bp_over_sgm_int8": 4.0, "bp_over_sgm_float": 2.0, "outputs_alone": 1.32}
        peaks = {name: {"peak_bytes": share * batch * layers} for name, share in shares.items()}
        return peaks | ratios

    steps = {str(b): {str(k): step(b, k) for k in range(1, 7)} for b in (1, 8, 32)}
    return {"steps": steps}


@pytest.fixture(scope="module")
def study() -> Values:
    def cell(angle: float) -> Values:
        return {"angle_mae_deg": angle, "cos_int8_float": 0.9 + angle / 1000}

    variants = ("16/16/minmax", "8/8/entropy")
    sources = {
        name: {variant: cell(scale * (k + 1)) for k, variant in enumerate(variants)}
        for name, scale in (("random noise", 20.0), ("one object", 2.0), ("24 mixed frames", 1.0))
    }
    about = {"frames": ["a", "b"], "angles_of_frames": 1, "layers": 3, "epochs": 20}
    return about | {"float": {"angle_mae_deg": 1.0}, "sources": sources}


@pytest.fixture(scope="module")
def every_chart(accuracy: Values, fidelity: Values, peaks: Values, study: Values) -> list[Any]:
    """Every chart with its values, and some with others."""
    mist = [fidelity["fidelity_over_run"][0] | {"step": step} for step in range(DOTS + 1)]
    runs = [fidelity, of_five_layers(fidelity), fidelity | {"fidelity_over_run": mist}]
    runs += [fidelity | {"object": name} for name in ("$a_{b$" * 30, "杯子\n(x)")]
    runs.append(fidelity | {"fidelity_over_run": fidelity["fidelity_over_run"][:1]})
    charts: list[tuple[Callable[[Values], Figure], Values]] = [(fidelity_over_run, v) for v in runs]
    charts += [(learning_curves, accuracy), (memory, peaks), (calibration, study)]
    return charts


def lines_of(axes: Axes) -> list[NDArray[np.float64]]:
    """Points (n, 2) of every line."""
    return [np.asarray(line.get_xydata()) for line in axes.lines]


def test_nothing_sticks_out_of_any_picture(every_chart: list[Any]) -> None:
    for chart, values in every_chart:
        figure = chart(values)
        figure.draw_without_rendering()
        box = figure.get_tightbbox()
        width, height = figure.get_size_inches()
        assert 0 <= box.x0 < box.x1 <= width
        assert 0 <= box.y0 < box.y1 <= height


def test_learning_curves_are_means_and_dots_are_ends(accuracy: Values) -> None:
    angle, detection = learning_curves(accuracy).axes
    untouched, sgm, sgm_ends, _, bp_ends = lines_of(angle)
    np.testing.assert_allclose(sgm, [(0, 4), (5, 3), (25, 2), (500, 1.3)])
    np.testing.assert_allclose(untouched[:, 1], 4)
    np.testing.assert_allclose(sgm_ends, [(25, 3.3), (500, 1.3)])
    np.testing.assert_allclose(bp_ends[:, 1], 0.9 * sgm_ends[:, 1])
    np.testing.assert_allclose(lines_of(detection)[2], [(25, 2), (500, 0)], atol=1e-9)
    texts = {text.get_text() for text in (*angle.texts, *detection.texts)}
    assert texts >= {"SGM int8 1.30°", "backprop 1.17°", "untouched 4.00°", "untouched 3.00 %"}
    caption = learning_curves(accuracy).texts[0].get_text()
    assert "2 elongated objects" in caption
    assert "Adam 0.002, Adam 0.002" in caption


def test_every_line_of_fidelity_is_a_layers_metric_at_every_probe(fidelity: Values) -> None:
    probes = fidelity["fidelity_over_run"]
    steps = [probe["step"] for probe in probes]
    panels = [panel for row in ROWS.values() for panel in row]
    for axes, panel in zip(fidelity_over_run(fidelity).axes, panels, strict=True):
        lines = [line for line in lines_of(axes) if len(line) == len(steps)]
        for k, line in zip(("4", "5"), lines, strict=True):
            values = [panel.scale * probe[k][panel.key] for probe in probes]
            np.testing.assert_allclose(line, np.stack([steps, values], axis=1))
            assert panel.form.format(np.mean(values)) in {text.get_text() for text in axes.texts}


def test_a_running_mean_over_an_epoch_counts_steps_not_probes() -> None:
    mean = running_mean(np.array([1.0, 2.0, 6.0]), np.array([0, 10, 20]))
    np.testing.assert_allclose(mean, [1.5, 3, 4])


def test_cosines_near_one_can_be_told_apart_and_the_row_shares_its_axis(fidelity: Values) -> None:
    probe = {"step": 0} | {
        k: fidelity["fidelity"][k]
        | {"cos_int8_float": cos, "cos_sample_int8_float": 0.99, "cos_update_int8_float": 0.999}
        for k, cos in (("4", 0.999), ("5", 0.9999))
    }
    batch, sample, update = fidelity_over_run(fidelity | {"fidelity_over_run": [probe]}).axes[:3]
    assert batch.get_ylim() == sample.get_ylim() == update.get_ylim()
    low, high = batch.get_ylim()
    assert low < 0.99 < 0.9999 < high < 1
    height = {y: batch.transData.transform((0, y))[1] for y in (0.99, 0.999, 0.9999)}
    assert height[0.9999] - height[0.999] == pytest.approx(height[0.999] - height[0.99])


def test_memory_shows_every_peak_of_the_smallest_and_the_largest_batch(peaks: Values) -> None:
    left, right = memory(peaks).axes
    ends = sorted(line[-1, 1] for line in lines_of(left))
    assert ends == [1500, 3000, 6000, 48_000, 96_000, 192_000]
    texts = {text.get_text() for text in right.texts}
    assert texts == {"SGM int8 4.00", "SGM float 2.00", "outputs 1.32"}


def test_a_calibration_cell_says_angle_and_cosine(study: Values) -> None:
    (axes,) = calibration(study).axes
    cells = [text.get_text() for text in axes.texts]
    assert len(cells) == 6
    assert cells[-1] == "2.00°\n0.9020"
    assert [axes.texts[k].get_color() for k in (0, 5)] == ["white", "black"]


@given(st.lists(st.floats(-2, 3), min_size=1, max_size=5), st.sampled_from((LABEL_GAP, 0.13)))
def test_labels_stand_apart_in_the_order_of_their_lines(heights: list[float], gap: float) -> None:
    moved = apart(heights, gap)
    order = np.argsort(heights, kind="stable")
    places = np.array(moved)[order]
    assert (np.diff(places) >= gap - 1e-9).all()
    assert places.min() >= -1e-9
    assert places.max() <= 1 + 1e-9


@pytest.mark.parametrize(
    ("count", "text"),
    [(74_053_600, "74.1 MB"), (4480, "4.48 kB"), (12, "12 bytes"), (0, "0 bytes")],
)
def test_bytes_have_three_digits_and_a_unit(count: int, text: str) -> None:
    assert in_units(count) == text


def test_a_picture_is_written_whole(every_chart: list[Any], tmp_path: Path) -> None:
    path = tmp_path / "new" / "chart.png"
    for chart, values in every_chart[-3:]:
        write_chart(chart(values), path)
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.shape[1] == 1800
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50
    assert [item.name for item in path.parent.iterdir()] == ["chart.png"]
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


def fidelity_command(frame_path: Path, bundle_folder: Path, *options: object) -> list[str]:
    """`qsgm fidelity` of one epoch."""
    where = ("--bundle", bundle_folder, "--epochs", 1, *options, frame_path)
    return ["fidelity", *map(str, where)]


def test_fidelity_probes_as_often_as_told_and_draws(
    frame_path: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.png"
    drawing = fidelity_command(frame_path, bundle_folder, "--picture", path, "--every", 10)
    assert cli.run([*drawing, "--json"]) == 0
    values = json.loads(capsys.readouterr().out)
    assert [probe["step"] for probe in values["fidelity_over_run"]] == [0, 10, 20]
    assert cv2.imread(str(path)) is not None
    assert cli.run(drawing) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    for text in ("weighted", "update", "probes: 3, at steps 0 to 20 by 10", f"picture: {path}"):
        assert text in shown.out


@pytest.mark.parametrize("value", ["0", "-1", "often"])
def test_a_distance_that_is_none_is_a_usage_error_in_one_line(
    frame_path: Path, bundle_folder: Path, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(fidelity_command(frame_path, bundle_folder, "--every", value)) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "--every" in shown.err


def test_a_bundle_without_a_probe_is_refused_in_one_line(
    frame_path: Path, own_bundle: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    manifest = json.loads((own_bundle / MANIFEST).read_text())
    del manifest["files"][probe_file(3)]
    (own_bundle / MANIFEST).write_text(json.dumps(manifest))
    assert cli.run(fidelity_command(frame_path, own_bundle)) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "has no probe for 3 layers" in shown.err


def test_a_picture_that_cannot_be_written_is_refused_in_one_line(
    frame_path: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(fidelity_command(frame_path, bundle_folder, "--picture", tmp_path)) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "cannot write" in shown.err


@pytest.mark.parametrize("command", ["accuracy", "fidelity"])
def test_without_matplotlib_there_are_tables_but_for_pictures_one_line(
    command: str,
    frame_path: Path,
    frames_folder: Path,
    bundle_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == "matplotlib":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    what = ["--frames", str(frames_folder), "--bundle", str(bundle_folder), "--limit", "1"]
    plain = fidelity_command(frame_path, bundle_folder)
    option = "--picture"
    if command == "accuracy":
        plain, option = ["bench", "accuracy", *what, "--epochs", "0"], "--pictures"
    assert cli.run([*plain, option, str(tmp_path / "picture")]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert "needs matplotlib" in printed.err
    assert "'.[report]'" in printed.err
    assert not (tmp_path / "picture").exists()
    assert cli.run(plain) == 0
    assert capsys.readouterr().out
