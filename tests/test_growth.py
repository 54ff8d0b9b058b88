"""How cost grows: every series there, wider graphs that are wider, a true line about int8."""

import io
import json
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import onnxruntime as ort
import pytest
from onnx import ModelProto, TensorProto
from rich.console import Console

from qsgm import cli
from qsgm.bench import step_jobs
from qsgm.bench.frames import list_frames
from qsgm.bench.growth import (
    ALONE,
    BP,
    CROPS,
    FEATURES,
    FLOAT,
    FLOAT_WIDER,
    FORWARD,
    INT8,
    INT8_WIDER,
    S8_8,
    S8_16,
    U8_8,
    U8_16,
    GrowthReport,
    milliseconds,
    wins,
)
from qsgm.blocks import single_layers
from qsgm.bundle import Bundle, step_file
from qsgm.runtime import session_options
from qsgm.sgm.float import float_trace
from qsgm.sgm.int8 import ActivationBits, integer_forward
from qsgm.train import growth
from qsgm.train.graphs.inspection import integer_operators, refuse_float_products
from qsgm.train.graphs.trunk import int8_trunk_model
from qsgm.train.growth import Sizes, measure_growth
from qsgm.train.growth_chart import growth_chart, time_ticks, write_growth_chart
from qsgm.train.growth_jobs import sgm_jobs, trunk_jobs, wide_jobs, wide_steps, with_s8_weights
from qsgm.train.wide import quantized, random_net, random_sgm, sgm_model, wide_net, wide_sgms

HIDDEN = 12  # of the test bundle's SGMs
STEPS = {FORWARD, BP, FLOAT, INT8}
BITS = pytest.mark.parametrize("bits", [8, 16])
# Small enough for a test; no time in here is looked at.
SMALL = partial(Sizes, (2, 4), (1, 2, 3), (1, 2), (20, 40), epochs=1, runs=1)
BY_WIDTH = "width x{}"


@pytest.fixture(scope="module")
def report(bundle: Bundle, frames_folder: Path) -> GrowthReport:
    frame = list_frames(frames_folder, 1)[0]
    return measure_growth(frame, bundle, 1, SMALL(repeats=1), lambda *_: None)


def shapes_of(model: ModelProto) -> dict[str, tuple[int, ...]]:
    return {tensor.name: tuple(tensor.dims) for tensor in model.graph.initializer}


def input_shapes(model: ModelProto) -> dict[str, list[int | str]]:
    return {
        value.name: [side.dim_value or side.dim_param for side in value.type.tensor_type.shape.dim]
        for value in model.graph.input
    }


def test_every_series_holds_every_size_and_variant(report: GrowthReport) -> None:
    alone = {ALONE, U8_16, S8_16, U8_8, S8_8}
    expected = [
        (report.batch, {2, 4}, STEPS),
        (report.layers, {1, 2, 3}, STEPS),
        (report.width, {1, 2}, STEPS | {FLOAT_WIDER, INT8_WIDER}),
        (report.crops, {20, 40}, {CROPS, FEATURES, BP, FLOAT, INT8}),
        (report.trunk, {1, 2}, {ALONE, U8_8, S8_8}),
        (report.sgms[1], {HIDDEN, 2 * HIDDEN}, alone),
        (report.sgms[3], {HIDDEN, 2 * HIDDEN}, alone),
    ]
    for series, sizes, variants in expected:
        assert set(series) == sizes
        for some in series.values():
            assert set(some) == variants
            assert all(seconds > 0 for seconds in some.values())
    assert set(report.sgms) == {1, 3}


def test_layers_that_a_bundle_cannot_tune_are_left_out(bundle: Bundle, frames_folder: Path) -> None:
    sgms = {layer: bundle.manifest["sgms"][layer] for layer in ("4", "5")}
    few = replace(bundle, manifest=bundle.manifest | {"most_layers": 3, "sgms": sgms})
    sizes = replace(SMALL(repeats=1), widths=(1,), crops=(20,))
    found = measure_growth(list_frames(frames_folder, 1)[0], few, 1, sizes, lambda *_: None)
    assert set(found.layers) == {1, 2, 3}
    assert set(found.sgms) == {1}  # the 3x3 one is behind layer 3


def test_variants_take_turns_and_the_first_turn_does_not_count(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    calls: list[str] = []
    clock = [0.0]

    def job(name: str, seconds: list[float]) -> None:
        clock[0] += seconds[calls.count(name)]
        calls.append(name)

    monkeypatch.setattr(step_jobs.time, "perf_counter", lambda: clock[0])
    jobs = {"a": partial(job, "a", [900, 1, 5, 2]), "b": partial(job, "b", [0, 7, 8, 9])}
    assert step_jobs.median_seconds(jobs, 3) == {"a": 2, "b": 8}
    assert calls == ["a", "b"] * 4


def test_a_wide_network_has_so_many_times_the_channels_and_three_answers() -> None:
    widths = {k: [layer.weight.shape for layer in random_net(k).layers] for k in (1, 4)}
    assert [shape[:2] for shape in widths[1]] == [(8, 3), (8, 8), (16, 8)] + [(16, 16)] * 2 + [
        (3, 16)
    ]
    assert [shape[:2] for shape in widths[4]] == [(32, 3), (32, 32), (64, 32)] + [(64, 64)] * 2 + [
        (3, 64)
    ]
    assert [a[2:] for a in widths[1]] == [b[2:] for b in widths[4]]


def test_at_width_1_a_step_takes_what_the_bundles_own_step_takes(bundle: Bundle) -> None:
    model = wide_steps(bundle, wide_net(1), 1)[INT8]
    session = bundle.session(step_file("int8", "sgd", single_layers(3)))
    shipped = {value.name: value.shape for value in session.get_inputs()}
    assert input_shapes(model) == shipped


def test_wider_steps_have_wider_weights_and_their_sgms_the_hidden_channels_asked_for(
    bundle: Bundle,
) -> None:
    steps = wide_steps(bundle, wide_net(2), 2)
    for model in steps.values():
        assert input_shapes(model)["weight4"] == [32, 25 * 32]
        assert input_shapes(model)["features"][1:] == [169, 32]
    for name, hidden in ((INT8, HIDDEN), (INT8_WIDER, 2 * HIDDEN)):
        shapes = shapes_of(steps[name])
        assert shapes["sgm4/low"] == (32 + 3,)
        assert shapes["sgm4/0/bias"] == (hidden,)
        assert shapes["sgm4/1/bias"] == (32,)


@pytest.mark.parametrize("name", [INT8, INT8_WIDER])
def test_the_int8_sgms_of_wide_steps_run_in_integers(bundle: Bundle, name: str) -> None:
    model = wide_steps(bundle, wide_net(2), 2)[name]
    refuse_float_products(name, model)
    # Two SGMs of two convolutions, coarse and rest each.
    assert integer_operators(model) == ["QGemm"] * 8


@pytest.mark.parametrize("width", [1, 2])
def test_the_int8_layers_of_wide_trunks_run_in_integers(width: int) -> None:
    wide = wide_net(width)
    model = int8_trunk_model(wide.net, wide.int8_trunk, 3)
    for one in (model, with_s8_weights(model)):
        assert integer_operators(one) == ["QLinearConv"] * 3


@BITS
@pytest.mark.parametrize(("layer", "side"), [(3, 13), (4, 1)])
def test_sgms_alone_run_in_integers_and_s8_weights_stand_for_the_same(
    bits: ActivationBits, layer: int, side: int
) -> None:
    sgm = quantized(random_sgm(layer, 16, (24,)), bits)
    model = sgm_model(sgm, 16, side)
    signed = with_s8_weights(model)
    assert integer_operators(model) == integer_operators(signed) == ["QGemm"] * 4
    matrices = [
        t for t in signed.graph.initializer if t.data_type == TensorProto.INT8 and t.dims[1:]
    ]
    assert len(matrices) == 4
    rng = np.random.default_rng(0)
    feeds = {
        "activation": rng.uniform(0, 1, (2 * side**2, 16)).astype(np.float32),
        "labels": rng.uniform(-1, 1, (2, 3)).astype(np.float32),
    }
    # Without optimizations the runtime computes what is written, in float: no CPU saturates.
    one, other = (run_as_written(graph, feeds) for graph in (model, signed))
    np.testing.assert_array_equal(one, other)


def run_as_written(model: ModelProto, feeds: dict[str, np.ndarray]) -> np.ndarray:
    options = session_options()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = ort.InferenceSession(model.SerializeToString(), options, ["CPUExecutionProvider"])
    return np.asarray(session.run(None, feeds)[0])


def test_a_random_sgms_int8_gradients_are_its_float_ones(bundle: Bundle) -> None:
    for layer, sgm in wide_sgms(bundle, (3, 4), 2, 3).items():
        assert [len(conv.bias) for conv in sgm.convs] == [3 * HIDDEN, 32]
        positions = 169 if layer == 3 else 1
        seen = np.random.default_rng(1).uniform(0, 1, (4, positions, 35)).astype(np.float32)
        floating, _ = float_trace(sgm, seen)
        int8, clipped = integer_forward(quantized(sgm, 16), seen)
        assert clipped == 0
        assert np.abs(int8 - floating).max() < 1e-2 * np.abs(floating).max()


def test_what_is_timed_side_by_side_gives_the_same_answers() -> None:
    # Not by s8: a CPU without VNNI saturates.
    trunk = trunk_jobs(2, 1)
    floating, int8 = (trunk[name]()[0].astype(int) for name in (ALONE, U8_8))
    assert np.abs(floating - int8).mean() < 2
    assert floating.std() > 10
    for layer in (3, 4):
        sgm = sgm_jobs(layer, (24,), 1)
        truth = sgm[ALONE]()[0]
        for name, off in ((U8_16, 1e-3), (U8_8, 5e-2)):
            assert np.abs(sgm[name]()[0] - truth).mean() < off * np.abs(truth).mean()


def test_wide_methods_start_from_the_same_loss(bundle: Bundle) -> None:
    jobs = wide_jobs(bundle, 2, 1)
    losses = [jobs[name]() for name in (BP, FLOAT, INT8, FLOAT_WIDER, INT8_WIDER) for _ in range(2)]
    assert losses == pytest.approx([losses[0]] * 10, rel=1e-6)


@pytest.mark.parametrize(
    ("int8", "place"),
    [
        ((1.0, 1.0, 1.0, 1.0), ""),
        ((0.96, 0.97, 1.5, 0.99), ""),  # less than a twentieth
        ((2.0, 1.0, 0.9, 0.5), "from width x4 on"),
        ((0.5, 0.5, 0.5, 0.5), "everywhere"),
        ((0.5, 0.9, 1.0, 2.0), "up to width x2"),
        ((2.0, 0.5, 1.0, 0.5), "at width x2 and 8"),
        ((2.0, 2.0, 2.0, 0.9), "from width x8 on"),
    ],
)
def test_where_int8_wins_is_told_from_the_times(int8: tuple[float, ...], place: str) -> None:
    series = {
        size: {FLOAT: 3 * size, INT8: 3 * size * share}
        for size, share in zip((1, 2, 4, 8), int8, strict=True)
    }
    assert wins(series, FLOAT, INT8, BY_WIDTH) == place


def known_report(report: GrowthReport, share: float) -> GrowthReport:
    """Every int8 time is this share of float's, but at the smallest size twice of it."""

    def series(some: dict[int, dict[str, float]]) -> dict[int, dict[str, float]]:
        return {
            size: {
                name: 1.0 if "int8" not in name else 2.0 if size == min(some) else share
                for name in times
            }
            for size, times in some.items()
        }

    return replace(
        report,
        width=series(report.width),
        trunk=series(report.trunk),
        sgms={kernel: series(some) for kernel, some in report.sgms.items()},
    )


def test_the_line_names_all_that_win_and_all_that_do_not(report: GrowthReport) -> None:
    line = known_report(report, 0.5).where_int8_wins
    assert "steps from width x2 on; steps with wider SGMs from width x2 on" in line
    assert "frozen layers in 8 u8 from width x2 on" in line
    assert f"3x3 SGMs in 16 s8 from {2 * HIDDEN} hidden channels on" in line
    assert "nowhere" not in line
    line = known_report(report, 1.0).where_int8_wins
    assert "from" not in line
    assert line.startswith("int8 saves 5% of float's time or more: nowhere: steps, steps with")
    assert line.endswith("3x3 SGMs in 16 u8, 3x3 SGMs in 16 s8, 3x3 SGMs in 8 u8, 3x3 SGMs in 8 s8")


def test_the_tables_fit_into_80_columns(report: GrowthReport) -> None:
    texts = []
    for width in (80, 200):
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(report.render())
        texts.append([line.rstrip() for line in console.export_text().splitlines()])
    narrow, wide = texts
    assert max(map(len, narrow)) <= 80
    assert [line for line in narrow if "──" in line] == [line for line in wide if "──" in line]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(1.234e-5, "0.012"), (4.567e-4, "0.457"), (0.0123456, "12.3"), (0.1234, "123"), (2.5, "2500")],
)
def test_times_have_three_digits_and_no_nanoseconds(seconds: float, text: str) -> None:
    assert milliseconds(seconds) == text


def test_the_picture_shows_every_time_and_nothing_sticks_out(
    report: GrowthReport, tmp_path: Path
) -> None:
    figure = growth_chart(report)
    drawn = (report.batch, report.layers, report.width, report.crops)
    for axes, series in zip(figure.axes, drawn, strict=True):
        expected = [
            [1000 * some[name] for some in series.values()] for name in next(iter(series.values()))
        ]
        assert [[*line.get_ydata()] for line in axes.lines] == expected
        assert all([*line.get_xdata()] == [*series] for line in axes.lines)
    figure.draw_without_rendering()
    box = figure.get_tightbbox()
    width, height = figure.get_size_inches()
    assert 0 <= box.x0 < box.x1 <= width
    assert 0 <= box.y0 < box.y1 <= height
    write_growth_chart(report, tmp_path / "new" / "growth.png")
    data = (tmp_path / "new" / "growth.png").read_bytes()
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (1320, 1440, 3)


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (0.086, 1.98, [0.1, 0.2, 0.5, 1, 2]),
        (0.012, 110, [0.01, 0.1, 1, 10, 100]),
        (3, 4, []),
        (0.9, 1.1, [1]),
    ],
)
def test_axes_of_times_are_ticked_by_1_2_5_or_by_tens(
    low: float, high: float, ticks: list[float]
) -> None:
    assert time_ticks(low, high) == pytest.approx(ticks)


def test_bench_growth_runs_from_the_command_line(
    bundle_folder: Path,
    frames_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(growth, "Sizes", SMALL)
    path, picture = tmp_path / "growth.json", tmp_path / "growth.png"
    command = ["bench", "growth", "--bundle", str(bundle_folder), "--frames", str(frames_folder)]
    command += ["--repeats", "2", "--json", "-o", str(path), "--picture", str(picture)]
    assert cli.run(command) == 0
    values = json.loads(capsys.readouterr().out)
    assert values == json.loads(path.read_text())
    assert values["repeats"] == 2
    assert list(values["step_ms"]["width"]) == ["1", "2"]
    assert values["step_ms"]["batch"]["4"][INT8] > 0
    assert list(values["sgm_ms"]["3x3"]) == [str(HIDDEN), str(2 * HIDDEN)]
    assert values["where_int8_wins"].startswith("int8 saves 5%")
    assert cv2.imread(str(picture)) is not None


@pytest.mark.parametrize("library", ["onnx", "torch", "matplotlib"])
def test_without_a_host_library_it_is_refused_in_one_line(
    library: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == library or name.startswith("qsgm.train"):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    picture = tmp_path / "growth.png"
    assert cli.run(["bench", "growth", "--picture", str(picture)]) == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert f"needs {library}" in printed.err
    assert not picture.exists()
