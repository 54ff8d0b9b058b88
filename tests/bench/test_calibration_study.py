"""The calibration study: every set's ranges tune other frames, and losses are counted right."""

import io
import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console
from toys import draw_frame

from qsgm import QsgmError, cli
from qsgm.bench import calibration
from qsgm.bench.calibration import (
    ANGLE,
    CLIPPED,
    COS_FLOAT,
    DETECTION,
    LEGEND,
    METRICS,
    OWN_CROPS,
    OWN_RUN,
    VARIANTS,
    WARNED,
    CalibrationReport,
    Variant,
    calibration_sets,
    darkened,
    exchanged,
    measure_calibration,
    observe_run,
    parse_variant,
    ranges_seen,
    render,
)
from qsgm.bench.frames import BenchFrame, list_frames
from qsgm.bundle import Bundle
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.grasp.teach import prepare_object
from qsgm.sgm.float import float_trace
from qsgm.sgm.int8 import integer_forward, quantize_sgm
from qsgm.tune.graphs import open_probe
from qsgm.tune.plan import Plan, resolve
from qsgm.tune.prepare import Prepared
from qsgm.tune.probe import activations_of
from qsgm.tune.run import Keeper, train, tune
from qsgm.tune.settings import Settings

SHORT = Settings(precision="int8", epochs=1)
TWO = (Variant(16, 16, "minmax"), Variant(8, 8, "percentile"))


@pytest.fixture(scope="module")
def report(frames_folder: Path, bundle: Bundle) -> CalibrationReport:
    """Calibrated and judged on the same two frames; only the study itself would object."""
    frames = list_frames(frames_folder)
    return measure_calibration(frames, frames_folder, bundle, SHORT, lambda *_: None, TWO)


def made_up(results: np.ndarray, floating: np.ndarray, bundle: Bundle) -> CalibrationReport:
    frames = tuple(
        BenchFrame(Path(f"{i}.png"), None, elongated) for i, elongated in enumerate((True, False))
    )
    return CalibrationReport(SHORT, bundle, frames, ("far", "near"), TWO, results, floating)


def test_every_set_and_variant_is_judged_on_every_frame(report: CalibrationReport) -> None:
    assert report.results.shape == (len(report.sources), 2, 2, len(METRICS))
    assert report.sources[-2:] == (OWN_RUN, OWN_CROPS)
    assert "random noise" in report.sources
    assert (np.abs(report.results[..., COS_FLOAT]) <= 1).all()
    assert (report.floating[:, COS_FLOAT] > 0.99).all()


def test_ranges_of_the_very_object_leave_16_bits_nothing_to_clip(report: CalibrationReport) -> None:
    own = report.results[-2:, 0]
    assert (own[..., CLIPPED] == 0).all()
    assert (own[..., COS_FLOAT] > 0.999).all()


@pytest.fixture(scope="module")
def prepared(bundle: Bundle) -> Prepared:
    return prepare_object(draw_frame()[0], bundle, resolve(SHORT, bundle))


@pytest.fixture(scope="module")
def plan(bundle: Bundle) -> Plan:
    return resolve(SHORT, bundle)


def with_labels(activation: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """What an SGM sees (B, 1, C + 3) of activations (B, 1, C) and labels (B, 3)."""
    return np.concatenate([activation, labels[:, None]], axis=2)


def test_a_run_is_observed_from_its_first_step_to_its_last(
    prepared: Prepared, plan: Plan, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration, "OBSERVED_CROPS", TRAIN_CROPS)
    floating = replace(plan, precision="float")
    ranges_of_run = ranges_seen(observe_run(prepared, floating), prepared.bundle)
    # By hand: all crops before the first of the epoch's 25 steps, and after the last.
    keeper = Keeper((0, 25))
    train(prepared, floating, (keeper,))
    probe, rows = open_probe(prepared.bundle, plan), np.arange(TRAIN_CROPS)
    before, after = (
        activations_of(probe, prepared, plan, keeper.kept[step], rows) for step in (0, 25)
    )
    for layer in (4, 5):
        ranges = ranges_of_run(layer, TWO[0])
        ends = np.array([before[layer].max(axis=(0, 1)), after[layer].max(axis=(0, 1))])
        assert (ends[0] > ends[1]).any()  # each of the two moments has its say
        assert (ends[1] > ends[0]).any()
        np.testing.assert_allclose(ranges.input_high[:-3], ends.max(axis=0), rtol=1e-5)
        both = np.concatenate([before[layer], after[layer]])
        low = both.min(axis=(0, 1))
        np.testing.assert_allclose(ranges.input_low[:-3], low, rtol=1e-5, atol=1e-6)
        seen = with_labels(both, np.tile(prepared.labels[rows], (2, 1)))
        hidden = float_trace(prepared.bundle.float_sgm(layer), seen)[1]
        for high, tensor in zip(ranges.hidden_high, hidden, strict=True):
            np.testing.assert_allclose(high, tensor.max(axis=(0, 1)), rtol=1e-5)


@pytest.mark.parametrize(
    "variant", [Variant(8, 4, "mse"), Variant(8, 16, "minmax"), TWO[0]], ids=str
)
def test_an_exchanged_variant_gives_what_a_bundle_calibrated_so_would_give(
    prepared: Prepared, plan: Plan, variant: Variant
) -> None:
    ranges = ranges_seen(observe_run(prepared, replace(plan, precision="float")), prepared.bundle)
    changed = exchanged(prepared.bundle, plan, ranges, variant)
    probe, rows = open_probe(prepared.bundle, changed), np.arange(32)
    feeds = {"features": prepared.features, "labels": prepared.labels, **prepared.start}
    for layer in (4, 5):
        names = [f"activation{layer}", f"int8{layer}"]
        activation, int8 = probe.run(names, {**feeds, "rows": rows})
        bits = variant.activation_bits, variant.weight_bits
        q = quantize_sgm(prepared.bundle.float_sgm(layer), ranges(layer, variant), *bits)
        seen = with_labels(activation, prepared.labels[rows])
        np.testing.assert_array_equal(int8, integer_forward(q, seen)[0])


def test_a_run_is_driven_and_judged_with_the_exchanged_variant(
    prepared: Prepared, plan: Plan
) -> None:
    ranges = ranges_seen(observe_run(prepared, replace(plan, precision="float")), prepared.bundle)
    coarse, fine = (
        tune(prepared, exchanged(prepared.bundle, plan, ranges, variant))
        for variant in (Variant(8, 4, "mse"), TWO[0])
    )
    for layer in (4, 5):
        assert fine.fidelity[layer].cos_int8_float > 0.9999
        assert 0.5 < coarse.fidelity[layer].cos_int8_float < 0.999
    assert coarse.losses != fine.losses


def test_a_loss_is_a_missed_crop_in_a_hundred_or_an_angle_beyond_what_runs_differ_by(
    bundle: Bundle,
) -> None:
    floating = np.zeros((2, len(METRICS)))
    floating[:, DETECTION], floating[:, ANGLE] = 0.99, [1.0, 40.0]
    results = np.tile(floating, (2, 2, 1, 1))
    results[0, 0, 0, DETECTION] = 0.975  # lost: more than a hundredth
    results[0, 1, 0, ANGLE] = 1.09  # kept: less than a tenth of a degree
    results[1, 0, 0, ANGLE] = 1.11  # lost
    results[1, 1, 1, ANGLE] = 43  # kept: less than a tenth of the error
    results[0, 0, 0, WARNED] = results[1, 1, 1, WARNED] = 1
    report = made_up(results, floating, bundle)
    assert np.argwhere(report.lost).tolist() == [[0, 0, 0], [1, 0, 0]]
    rates = report.watch_rates()
    assert (rates["lost"], rates["kept"]) == (2, 6)
    assert rates["warned_of_lost"] == pytest.approx(1 / 2)
    assert rates["warned_of_kept"] == pytest.approx(1 / 6, abs=1e-4)
    assert report.elongated.tolist() == [True, False]


def test_a_variant_reads_as_it_prints() -> None:
    for variant in VARIANTS:
        assert parse_variant(str(variant)) == variant
    for text in ("", "8/16", "7/16/minmax", "8/16/best", "8/16/minmax/"):
        with pytest.raises(QsgmError, match="is no variant: expected bits of activations"):
            parse_variant(text)


def test_sets_go_from_noise_to_the_whole_set(frames_folder: Path) -> None:
    sets = calibration_sets(frames_folder)
    names = list(sets)
    assert names[0] == "random noise"
    assert names[-1] == "2 mixed frames"
    assert "plain tables only" not in names  # nobody said which tables are plain
    frame = draw_frame()[0]
    assert darkened(frame).mean() < 0.3 * frame.mean()


def test_plain_tables_are_those_that_the_manifest_calls_so(tmp_path: Path) -> None:
    entries = []
    for i, kind in enumerate(("plain", "planks", "gradient")):
        frame = np.full((300, 300, 3), 50 + 50 * i, np.uint8)
        frame[100:200, 100:200] //= 2
        cv2.imwrite(str(tmp_path / f"{i}.png"), frame)
        entries.append({"file": f"{i}.png", "table_kind": kind})
    (tmp_path / "manifest.json").write_text(json.dumps({"frames": entries}))
    plain = calibration_sets(tmp_path)["plain tables only"]
    assert [int(image.max()) for image in plain] == [50, 150]


def test_a_bundle_of_8_bit_activations_is_refused(bundle_folder: Path, bundle: Bundle) -> None:
    sgms = dict(bundle.manifest.sgms)
    sgms[5] = replace(sgms[5], bits=8)
    loaded = replace(bundle, manifest=replace(bundle.manifest, sgms=sgms))
    with pytest.raises(QsgmError, match="8 bit activations, expected 16"):
        measure_calibration([], bundle_folder, loaded, SHORT, lambda *_: None)
    assert bundle.activation_bits(5) == 16


def test_the_tables_fit_into_80_columns(report: CalibrationReport) -> None:
    texts = []
    for width in (80, 200):
        console = Console(width=width, record=True, file=io.StringIO())
        console.print(render(report.to_json()))
        texts.append([line.rstrip() for line in console.export_text().splitlines()])
    narrow, wide = texts
    rules = [line for line in narrow if "──" in line]
    assert len(rules) == len(TWO)
    assert rules == [line for line in wide if "──" in line]
    assert all(str(variant) in "\n".join(narrow) for variant in TWO)
    assert max(map(len, LEGEND.splitlines())) <= 80


def test_the_json_holds_every_run(report: CalibrationReport) -> None:
    values = json.loads(json.dumps(report.to_json(), allow_nan=False))
    row = values["sources"][OWN_RUN][str(TWO[0])]
    assert len(row["per_frame"]) == 2
    assert row["cos_int8_float"] > 0.999


def test_a_folder_without_frames_is_refused_before_any_work(
    tmp_path: Path, bundle_folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["bench", "calibration", "--frames", str(tmp_path), "--bundle", str(bundle_folder)]
    assert cli.run(arguments) == 1
    assert capsys.readouterr().err.count("\n") == 1
