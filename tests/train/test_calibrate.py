"""Ranges along whole runs: what the observers see is what the SGMs saw, frame after frame."""

import itertools
import pickle
import tracemalloc
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from qsgm import QsgmError
from qsgm.blocks import single_layers
from qsgm.cli.options import CalibratorName
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import GraspTask
from qsgm.network import Network, conv
from qsgm.sgm.float import FloatArray, float_trace
from qsgm.sgm.int8 import ACTIVATION_BITS, SgmRanges, integer_forward, quantize_sgm
from qsgm.sgm.ranges import CALIBRATORS, Observer, Span
from qsgm.task import task_record
from qsgm.train import export_report
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.grasp.calibration_set import CalibrationLessons, CalibrationSet
from qsgm.train.grasp.draw_calibration import draw_calibration_set
from qsgm.train.model.fold import fold_sgm, run_folded_sgm
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.processes import in_processes
from qsgm.train.quantization import calibration_runs
from qsgm.train.quantization.calibrate import (
    AUTO,
    Calibration,
    best_calibrator,
    calibrate,
    held_out_frames,
    observe_lesson,
)
from qsgm.train.quantization.calibration_runs import (
    CalibrationRuns,
    RunPlan,
    Trainee,
    one_position,
    prepare,
    run,
    run_plans,
    torch_product,
)
from qsgm.train.quantization.sgm_fidelity import measure

RATES = {str(single_layers(GRASPNET.last(tuned))): (1e-3,) * tuned for tuned in (1, 2, 3)}
EPOCHS = 1
TASK = GraspTask()
# Of quality, sine and cosine of a doubled angle.
LABELS = (np.array([0, -1, -1], np.float32), np.ones(3, np.float32))


def lessons_in(folder: Path) -> CalibrationLessons:
    return CalibrationLessons(CalibrationSet(folder), TASK)


def lesson_of(lessons: CalibrationLessons, i: int, count: int, seed: int = 0) -> GraspLesson:
    """Of a frame, with the crops that calibration cuts."""
    return lessons.lesson(i, np.random.default_rng([seed, i]), count)


@pytest.fixture(autouse=True)
def few_crops(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(calibration_runs, "CROPS", 70)
    monkeypatch.setattr(calibration_runs, "MAP_CROPS", 40)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set") / "calib"
    draw_calibration_set(folder, count=2, seed=3)
    return folder


@pytest.fixture(scope="module")
def trainee() -> Trainee:
    torch.manual_seed(0)
    sgms = {layer: Sgm(GRASPNET, layer, (8, 6)).eval() for layer in (4, 5)}
    return prepare(Checkpoint(task_record(TASK), ConvNet(GRASPNET).eval(), sgms, {}, RATES, {}))


def ignore(_stage: str, _done: int, _of: int) -> None:
    pass


@pytest.mark.parametrize(("layer", "side"), [(4, 1), (3, 13)])
def test_the_float_trace_is_the_folded_sgm(layer: int, side: int) -> None:
    torch.manual_seed(layer)
    sgm = fold_sgm(Sgm(GRASPNET, layer, (8, 6)).eval())
    activation, labels = torch.randn(9, 16, side, side), torch.randn(9, 3)
    filled = labels[:, None].expand(-1, side**2, -1)
    seen = torch.cat([activation.flatten(2).transpose(1, 2), filled], dim=2)
    gradient, hidden = float_trace(sgm, seen.numpy(), torch_product)
    expected = run_folded_sgm(sgm, activation, labels).flatten(2).transpose(1, 2)
    np.testing.assert_allclose(gradient, expected, rtol=1e-5, atol=1e-6)
    assert [tensor.shape for tensor in hidden] == [(9, side**2, 8), (9, side**2, 6)]
    assert min(tensor.min() for tensor in hidden) == 0


def test_ranges_are_those_of_every_step_of_every_run(folder: Path, trainee: Trainee) -> None:
    frames = lessons_in(folder)
    seen: dict[int, list[FloatArray]] = {4: [], 5: []}

    def gradient(layer: int, inputs: FloatArray) -> FloatArray:
        seen[layer].append(inputs)
        return trainee.float_trace(layer, inputs)[0]

    for i in range(2):
        for tuned in (2, 3):
            plan = RunPlan(tuned, 70, EPOCHS, range(7 - tuned, 6))
            lesson = lesson_of(frames, i, 70)
            steps = list(run(trainee, lesson, plan, [0, i], gradient))
            assert [len(moment.labels[0]) for moment in steps] == [32, 32, 6]
    stages: list[tuple[str, int, int]] = []
    watch = lambda *stage: stages.append(stage)  # noqa: E731
    ranges = calibrate(CalibrationRuns(trainee, frames, EPOCHS), watch, "minmax").ranges
    assert stages == [("calibrate", done, 2) for done in (0, 1, 2)]
    assert [len(batches) for batches in seen.values()] == [6, 12]
    for layer, batches in seen.items():
        inputs = np.concatenate(batches)[:, 0]
        np.testing.assert_array_equal(ranges[layer].input_low[:16], inputs[:, :16].min(axis=0))
        np.testing.assert_array_equal(ranges[layer].input_high[:16], inputs[:, :16].max(axis=0))
        np.testing.assert_array_equal(ranges[layer].input_low[16:], [0, -1, -1])
        np.testing.assert_array_equal(ranges[layer].input_high[16:], [1, 1, 1])
        _, hidden = trainee.float_trace(layer, inputs[:, None])
        for high, tensor in zip(ranges[layer].hidden_high, hidden, strict=True):
            np.testing.assert_allclose(high, tensor.max(axis=(0, 1)), rtol=1e-5)


def test_layers_move_during_a_run(folder: Path, trainee: Trainee) -> None:
    def gradient(layer: int, seen: FloatArray) -> FloatArray:
        return trainee.float_trace(layer, seen)[0]

    plan, lesson = RunPlan(3, 70, EPOCHS, range(4, 6)), lesson_of(lessons_in(folder), 0, 70)
    first, *_, last = run(trainee, lesson, plan, [0], gradient)
    for before, after in zip(first.states, last.states, strict=True):
        assert not torch.equal(before.weight, after.weight)


def test_a_frame_alone_gives_part_of_the_ranges(folder: Path, trainee: Trainee) -> None:
    frames = lessons_in(folder)
    both = calibrate(CalibrationRuns(trainee, frames, EPOCHS), ignore, "minmax").ranges
    alone, _ = observe_lesson(CalibrationRuns(trainee, frames, EPOCHS), 1)
    for layer, observers in alone.items():
        ranges = observers.ranges("minmax", 256, LABELS)
        assert (ranges.input_low >= both[layer].input_low).all()
        assert (ranges.input_high <= both[layer].input_high).all()


def test_two_processes_calibrate_and_measure_what_one_does(
    folder: Path, trainee: Trainee, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()  # other processes know nothing of it
    runs, found = CalibrationRuns(trainee, lessons_in(folder), EPOCHS), []
    for processes in (1, 2):
        with in_processes(processes) as in_turn:
            done = calibrate(runs, ignore, in_turn=in_turn)
            sgms = trainee.sgms.items()
            int8 = {layer: quantize_sgm(sgm, done.ranges[layer]) for layer, sgm in sgms}
            fidelity = measure(runs, int8, ignore, in_turn)
        found.append((done, fidelity))
    (one, one_fidelity), (two, two_fidelity) = found
    assert (one.chosen, one.cosines, one_fidelity) == (two.chosen, two.cosines, two_fidelity)
    assert pickle.dumps(one.ranges) == pickle.dumps(two.ranges)


def test_int8_is_faithful_on_the_runs_it_was_calibrated_on(folder: Path, trainee: Trainee) -> None:
    frames = lessons_in(folder)
    ranges = calibrate(CalibrationRuns(trainee, frames, EPOCHS), ignore, "minmax").ranges
    int8 = {layer: quantize_sgm(sgm, ranges[layer]) for layer, sgm in trainee.sgms.items()}
    fidelity = measure(CalibrationRuns(trainee, frames, EPOCHS), int8, ignore)
    assert set(fidelity) == {4, 5}
    for layer in fidelity.values():
        assert layer.cos_int8_float > 0.999
        assert layer.sqnr_db > 25
        assert layer.clipped_fraction < 1e-3
        # Untrained as it is, the SGM's gradient has nothing to do with the true one.
        assert layer.cos_int8_true == pytest.approx(layer.cos_float_true, abs=0.05)


@pytest.mark.parametrize(
    ("count", "held_out"), [(1, []), (3, []), (4, [3]), (8, [3, 7]), (24, [3, 7, 11, 15, 19, 23])]
)
def test_every_fourth_frame_is_held_out(count: int, held_out: list[int]) -> None:
    assert [*held_out_frames(count)] == held_out


@pytest.mark.parametrize(
    ("cosines", "best"),
    [
        ((0.5, 0.9, 0.8, 0.1), "percentile"),
        ((0.99999, 0.999995, 0.999999, 0.5), "minmax"),  # a tie
        ((0.99997, 0.999985, 0.999991, 0.999993), "percentile"),
        ((-0.2, -0.1, -0.1, -0.05), "entropy"),
    ],
)
def test_of_equal_calibrators_the_first_is_taken(cosines: tuple[float, ...], best: str) -> None:
    assert best_calibrator(dict(zip(CALIBRATORS, cosines, strict=True))) == best


def test_the_best_calibrator_on_held_out_frames_gives_the_ranges(
    tmp_path: Path, trainee: Trainee
) -> None:
    draw_calibration_set(tmp_path / "calib", count=4, seed=3)
    frames = lessons_in(tmp_path / "calib")
    result = calibrate(CalibrationRuns(trainee, frames, EPOCHS), ignore, activation_bits=8)
    assert result.held_out == 1
    # By hand: ranges from the first three frames, cosines along the runs on the fourth.
    seen, _ = observe_lesson(CalibrationRuns(trainee, frames, EPOCHS), 0)
    for i in (1, 2):
        for layer, observers in observe_lesson(CalibrationRuns(trainee, frames, EPOCHS), i)[
            0
        ].items():
            seen[layer].merge(observers)
    inputs = []

    def gradient(layer: int, values: FloatArray) -> FloatArray:
        if layer == 4:
            inputs.append(values)
        return trainee.float_trace(layer, values)[0]

    plan = RunPlan(3, 70, EPOCHS, range(4, 6))
    list(run(trainee, lesson_of(frames, 3, 70), plan, [0, 3], gradient))
    floating = trainee.float_trace(4, inputs[0])[0].ravel().astype(np.float64)
    for name, cosine in result.cosines[4].items():
        int8 = quantize_sgm(trainee.sgms[4], seen[4].ranges(name, 256, LABELS), 8)
        got = integer_forward(int8, inputs[0])[0].ravel().astype(np.float64)
        expected = got @ floating / np.linalg.norm(got) / np.linalg.norm(floating)
        assert cosine == pytest.approx(expected, rel=0, abs=1e-12)
    assert [*result.cosines[4]] == [*CALIBRATORS]
    assert result.chosen == {k: best_calibrator(result.cosines[k]) for k in (4, 5)}
    # The frame held out has its part in the ranges all the same.
    for layer, observers in observe_lesson(CalibrationRuns(trainee, frames, EPOCHS), 3)[0].items():
        seen[layer].merge(observers)
        expected = seen[layer].ranges(result.chosen[layer], 256, LABELS)
        assert_same_ranges(result.ranges[layer], expected)


def assert_same_ranges(got: SgmRanges, expected: SgmRanges) -> None:
    np.testing.assert_array_equal(got.input_low, expected.input_low)
    np.testing.assert_array_equal(got.input_high, expected.input_high)
    for tensor, other in zip(got.hidden_high, expected.hidden_high, strict=True):
        np.testing.assert_array_equal(tensor, other)


def test_few_frames_judge_the_ranges_taken_from_them(folder: Path, trainee: Trainee) -> None:
    stages: list[tuple[str, int, int]] = []
    watch = lambda *stage: stages.append(stage)  # noqa: E731
    result = calibrate(CalibrationRuns(trainee, lessons_in(folder), EPOCHS), watch)
    assert result.held_out == 0
    assert stages[3:] == [("choose", done, 2) for done in (0, 1, 2)]
    assert all(0.9 < value <= 1 for value in result.cosines[5].values())


def test_auto_takes_the_calibrator_that_does_best(
    folder: Path, trainee: Trainee, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tenfold(seen: Observer, _levels: int) -> Span:
        return 10 * seen.low, 10 * seen.high

    monkeypatch.setitem(CALIBRATORS, "minmax", tenfold)
    result = calibrate(
        CalibrationRuns(trainee, lessons_in(folder), EPOCHS), ignore, activation_bits=8
    )
    for layer, name in result.chosen.items():
        assert name != "minmax"
        assert result.cosines[layer]["minmax"] < result.cosines[layer][name]


def test_a_named_calibrator_gives_all_ranges_and_is_not_compared(
    folder: Path, trainee: Trainee
) -> None:
    frames = lessons_in(folder)
    seen, _ = observe_lesson(CalibrationRuns(trainee, frames, EPOCHS), 0)
    for layer, observers in observe_lesson(CalibrationRuns(trainee, frames, EPOCHS), 1)[0].items():
        seen[layer].merge(observers)
    for name, bits in itertools.product(CALIBRATORS, ACTIVATION_BITS):
        result = calibrate(CalibrationRuns(trainee, frames, EPOCHS), ignore, name, bits)
        assert result.chosen == {4: name, 5: name}
        assert result.cosines == {4: {}, 5: {}}
        for layer, ranges in result.ranges.items():
            assert_same_ranges(ranges, seen[layer].ranges(name, 2**bits, LABELS))
    narrow, wide = (seen[4].ranges("mse", 2**bits, LABELS) for bits in ACTIVATION_BITS)
    assert (narrow.hidden_high[0] < wide.hidden_high[0]).any()  # bits are not all the same to it
    with pytest.raises(QsgmError, match=r"no calibrator 'median'; take one of auto, minmax, .*mse"):
        calibrate(CalibrationRuns(trainee, frames, EPOCHS), ignore, "median")


@pytest.mark.parametrize(("held_out", "why"), [(6, "held-out frames, 6"), (0, "too few to hold")])
def test_the_report_says_which_calibrator_was_taken_and_why(held_out: int, why: str) -> None:
    cosines = {4: {"minmax": 0.9912341, "mse": 0.99}, 5: {"minmax": 0.98, "mse": 0.9956781}}
    shown = StringIO()
    Console(file=shown, width=80).print(
        export_report.calibrators(Calibration({}, {4: "minmax", 5: "mse"}, cosines, held_out))
    )
    rows = [line.split() for line in shown.getvalue().splitlines()]
    assert ["layer", "minmax", "mse", "taken"] in rows
    assert ["4", "0.991234", "0.990000", "minmax"] in rows
    assert ["5", "0.980000", "0.995678", "mse"] in rows
    assert why in " ".join(shown.getvalue().split())
    asked = Calibration({}, {4: "mse", 5: "mse"}, {4: {}, 5: {}}, 0)
    assert str(export_report.calibrators(asked)) == "ranges: mse, as asked"


def test_the_command_line_offers_every_calibrator() -> None:
    assert [name.value for name in CalibratorName] == [AUTO, *CALIBRATORS]


def test_memory_of_calibration_does_not_grow_with_its_frames(
    tmp_path: Path, trainee: Trainee, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibration_runs, "CROPS", 33)
    draw_calibration_set(tmp_path / "calib", count=6, seed=3)
    frames = lessons_in(tmp_path / "calib")
    entries, peaks = frames.frames._entries, []
    for count in (2, 2, 6):  # the first run fills caches
        frames.frames._entries = entries[:count]
        tracemalloc.start()
        calibrate(CalibrationRuns(trainee, frames, EPOCHS), ignore, activation_bits=8)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # Kept, what SGMs see in a frame's three passes over 33 crops would be 13 KB, the frame 900 KB.
    values = 3 * 33 * (19 + 8 + 6) * 4
    assert peaks[2] - peaks[1] < 4 * values / 2


def test_a_run_that_diverges_is_refused(folder: Path, trainee: Trainee) -> None:
    def gradient(_layer: int, seen: FloatArray) -> FloatArray:
        return np.full((len(seen), 1, 16), np.inf, np.float32)

    lesson, plan = lesson_of(lessons_in(folder), 0, 70), RunPlan(3, 70, EPOCHS, range(4, 6))
    with pytest.raises(QsgmError, match="fine-tuning 3 layers on a calibration lesson diverged"):
        list(run(trainee, lesson, plan, [0], gradient))


def test_sgms_ahead_of_the_last_three_layers_get_a_short_run_of_all_layers() -> None:
    assert run_plans(GRASPNET, 2, 40) == [RunPlan(2, 70, 40, range(5, 6))]
    assert run_plans(GRASPNET, 3, 40) == [
        RunPlan(2, 70, 40, range(5, 6)),
        RunPlan(3, 70, 40, range(4, 6)),
    ]
    *whole, short = run_plans(GRASPNET, 6, 40)
    assert whole == run_plans(GRASPNET, 3, 40)
    assert (short.tuned, short.crops) == (6, 40)
    assert short.epochs < 40
    assert [[*plan.measured] for plan in (*whole, short)] == [[5], [4, 5], [1, 2, 3]]
    assert [*run_plans(GRASPNET, 4, 1)[-1].measured] == [3]
    flat = Network((1, 1, 2), (conv(2, 4), conv(4, 4), conv(4, 3, relu=False)), "numbers")
    assert [plan.tuned for plan in run_plans(flat, 3, 40)] == [2, 3]
    assert (one_position(flat), one_position(GRASPNET)) == (3, 3)


def test_sgms_that_see_maps_are_calibrated_and_measured_as_well(folder: Path) -> None:
    torch.manual_seed(0)
    sgms = {layer: Sgm(GRASPNET, layer, (8,)).eval() for layer in (2, 3, 4, 5)}
    for sgm in sgms.values():  # untrained as they are, keep them from running away
        torch.nn.init.normal_(sgm.convs[-1].weight, std=1e-4)
    rates = {str(single_layers(GRASPNET.last(tuned))): (1e-4,) * tuned for tuned in range(1, 6)}
    of_five = prepare(Checkpoint(task_record(TASK), ConvNet(GRASPNET).eval(), sgms, {}, rates, {}))
    frames = lessons_in(folder)
    done = calibrate(CalibrationRuns(of_five, frames, EPOCHS), ignore, "minmax")
    ranges = done.ranges
    whole = calibrate(CalibrationRuns(of_three(of_five), frames, EPOCHS), ignore, "minmax").ranges
    for layer in (4, 5):  # as if there were no others
        np.testing.assert_array_equal(ranges[layer].input_high, whole[layer].input_high)
    seen: dict[int, list[FloatArray]] = {layer: [] for layer in of_five.sgms}

    def gradient(layer: int, inputs: FloatArray) -> FloatArray:
        seen[layer].append(inputs)
        return of_five.float_trace(layer, inputs)[0]

    for i in range(2):
        plan = run_plans(GRASPNET, 5, EPOCHS)[-1]
        list(run(of_five, lesson_of(frames, i, plan.crops), plan, [0, i], gradient))
    for layer, positions in ((2, 29**2), (3, 13**2)):
        inputs = np.concatenate(seen[layer])
        assert inputs.shape[1] == positions
        high = inputs.max(axis=(0, 1))[:-3]
        np.testing.assert_array_equal(ranges[layer].input_high[:-3], high)
    int8 = {layer: quantize_sgm(sgm, ranges[layer]) for layer, sgm in of_five.sgms.items()}
    fidelity = measure(CalibrationRuns(of_five, frames, EPOCHS), int8, ignore)
    assert set(fidelity) == {2, 3, 4, 5}
    # The runs with maps, taken once and looked at again, say the same.
    assert sorted(done.looks) == [0, 1]
    assert measure(CalibrationRuns(of_five, frames, EPOCHS, done.looks), int8, ignore) == fidelity
    for layer in (2, 3):
        assert fidelity[layer].cos_int8_float > 0.999
        assert fidelity[layer].clipped_fraction < 1e-3


def of_three(trainee: Trainee) -> Trainee:
    """The same checkpoint without the SGMs behind layers 1 to 3."""
    whole = trainee.checkpoint
    sgms = {layer: whole.sgms[layer] for layer in (4, 5)}
    texts = [str(single_layers(GRASPNET.last(tuned))) for tuned in (1, 2, 3)]
    rates = {text: whole.rates[text] for text in texts}
    return prepare(Checkpoint(whole.task, whole.net, sgms, {}, rates, {}))
