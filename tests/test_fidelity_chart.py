"""The fidelity chart: what is drawn is what was measured, and the picture is whole."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from qsgm import cli
from qsgm.bundle import MANIFEST, Bundle, probe_file
from qsgm.train.fidelity_chart import (
    DOTS,
    LABEL_GAP,
    ROWS,
    apart,
    fidelity_chart,
    running_mean,
    write_fidelity_chart,
)
from qsgm.tune.probe import Probe
from qsgm.tune.run import FinetuneResult, finetune
from qsgm.tune.settings import Settings

PANELS = [panel for row in ROWS for panel in row.panels]


@pytest.fixture(scope="module")
def result(frame: NDArray[np.uint8], bundle: Bundle) -> FinetuneResult:
    return finetune(frame, bundle, Settings(epochs=1, probe_every=5))


def of_five_layers(result: FinetuneResult) -> FinetuneResult:
    """Cosines from -1 to 1, no clipping, one SQNR at its cap."""
    some = result.probes[0].layers[4]
    layers = {
        k: replace(some, cos_int8_float=cos, cos_int8_true=-cos, sqnr_db=50.0 * (k - 1))
        for k, cos in enumerate((-1.0, 0.0, 0.9, 0.999_999_9, 1.0), 1)
    }
    settings = replace(result.settings, layers=6)
    return replace(result, settings=settings, probes=(Probe(0, layers), Probe(25, layers)))


def test_every_line_is_a_layers_metric_at_every_probe(result: FinetuneResult) -> None:
    steps = [probe.step for probe in result.probes]
    axes = fidelity_chart(result, "mug").axes
    assert len(axes) == len(PANELS) == 9
    for drawn, panel in zip(axes, PANELS, strict=True):
        lines = [line for line in drawn.lines if len(line.get_xdata()) == len(steps)]
        for k, line in zip((4, 5), lines, strict=True):
            values = [panel.scale * getattr(p.layers[k], panel.key) for p in result.probes]
            np.testing.assert_array_equal(line.get_xdata(), steps)
            np.testing.assert_allclose(line.get_ydata(), values)
            means = [text.get_text() for text in drawn.texts]
            assert panel.form.format(np.mean(values)) in means


def test_many_probes_are_a_mist_around_their_running_mean(result: FinetuneResult) -> None:
    layers = [probe.layers for probe in result.probes]
    probes = tuple(Probe(step, layers[step % len(layers)]) for step in range(DOTS + 1))
    batch = fidelity_chart(replace(result, probes=probes), "mug").axes[0]
    mist, mean, *_ = (np.asarray(line.get_ydata()) for line in batch.lines)
    values = [probe.layers[4].cos_int8_float for probe in probes]
    np.testing.assert_allclose(mist, values)
    assert mean[20] == pytest.approx(np.mean(values[8:33]))
    assert mean[0] == pytest.approx(np.mean(values[:13]))


def test_a_running_mean_over_an_epoch_counts_steps_not_probes() -> None:
    mean = running_mean(np.array([1.0, 2.0, 6.0]), np.array([0, 10, 20]))
    np.testing.assert_allclose(mean, [1.5, 3, 4])


def test_cosines_near_one_can_be_told_apart_and_the_row_shares_its_axis(
    result: FinetuneResult,
) -> None:
    layers = result.probes[0].layers
    near = {
        4: replace(layers[4], cos_int8_float=0.999, cos_sample_int8_float=0.99),
        5: replace(layers[5], cos_int8_float=0.9999, cos_sample_int8_float=0.995),
    }
    near = {k: replace(layer, cos_update_int8_float=0.999) for k, layer in near.items()}
    axes = fidelity_chart(replace(result, probes=(Probe(0, near),)), "mug").axes
    batch, sample, update = axes[:3]
    assert batch.get_ylim() == sample.get_ylim() == update.get_ylim()
    low, high = batch.get_ylim()
    assert low < 0.99 < 0.9999 < high < 1
    height = {y: batch.transData.transform((0, y))[1] for y in (0.99, 0.999, 0.9999)}
    assert height[0.9999] - height[0.999] == pytest.approx(height[0.999] - height[0.99])


@given(st.dictionaries(st.integers(1, 5), st.floats(-2, 3), min_size=1))
def test_labels_stand_apart_in_the_order_of_their_lines(heights: dict[int, float]) -> None:
    moved = apart(heights, LABEL_GAP)
    order = sorted(heights, key=lambda k: heights[k])
    assert sorted(moved, key=lambda k: moved[k]) == order
    places = [moved[k] for k in order]
    assert all(gap >= LABEL_GAP - 1e-9 for gap in np.diff(places))
    assert min(places) >= -1e-9
    assert max(places) <= 1 + 1e-9


@pytest.mark.parametrize("name", ["mug", "$a_{b$" * 30, "杯子\n(x)"])
def test_nothing_sticks_out_of_the_picture_whatever_was_measured(
    result: FinetuneResult, name: str
) -> None:
    for shown in (result, of_five_layers(result), replace(result, probes=result.probes[:1])):
        figure = fidelity_chart(shown, name)
        figure.draw_without_rendering()
        box = figure.get_tightbbox()
        width, height = figure.get_size_inches()
        assert 0 <= box.x0 < box.x1 <= width
        assert 0 <= box.y0 < box.y1 <= height


def test_the_picture_is_written_whole(result: FinetuneResult, tmp_path: Path) -> None:
    path = tmp_path / "new" / "fidelity.png"
    write_fidelity_chart(result, "mug", path)
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape == (1600, 1800, 3)
    for bgr in ((0xB2, 0x72, 0x00), (0x00, 0x5E, 0xD5)):  # layers 5 and 4
        assert (np.abs(picture.astype(int) - bgr).sum(axis=2) < 8).sum() > 1000
    assert [item.name for item in path.parent.iterdir()] == ["fidelity.png"]
    assert "matplotlib.pyplot" not in sys.modules


def command(frame_path: Path, bundle_folder: Path, *options: object) -> list[str]:
    """`qsgm fidelity` of one epoch."""
    where = ("--bundle", bundle_folder, "--epochs", 1, *options, frame_path)
    return ["fidelity", *map(str, where)]


def test_the_command_probes_as_often_as_told_and_draws(
    frame_path: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.png"
    drawing = command(frame_path, bundle_folder, "--picture", path, "--every", 10)
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
    assert cli.run(command(frame_path, bundle_folder, "--every", value)) == 2
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
    assert cli.run(command(frame_path, own_bundle)) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "has no probe for 3 layers" in shown.err


def test_a_picture_that_cannot_be_written_is_refused_in_one_line(
    frame_path: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(command(frame_path, bundle_folder, "--picture", tmp_path)) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "cannot write" in shown.err


def test_without_matplotlib_there_are_tables_but_for_a_picture_one_line(
    frame_path: Path,
    bundle_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == "matplotlib" or name.startswith("qsgm.train.fidelity_chart"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "qsgm.train.charts", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    path = tmp_path / "run.png"
    assert cli.run(command(frame_path, bundle_folder, "--picture", path)) == 1
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.count("\n") == 1
    assert "needs matplotlib" in shown.err
    assert not path.exists()
    assert cli.run(command(frame_path, bundle_folder)) == 0
    assert "weighted" in capsys.readouterr().out
