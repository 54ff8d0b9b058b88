"""Answers to scenes are judged right: outcomes, ROC, thresholds, intervals, reports, rivals."""

import ast
import io
import json
import math
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rich.console import Console

from qsgm import QsgmError, cli
from qsgm.bench.composing import CONDITIONS, Composer, Scene, Subject
from qsgm.bench.frames import list_frames
from qsgm.bench.judging import (
    ON_OBJECT_PX,
    ON_THING_PX,
    Answer,
    Judged,
    Tally,
    Truth,
    equal_error_rate,
    errors,
    intervals,
    judge,
    paired_difference,
    roc_area,
    shares,
    threshold_for,
)
from qsgm.bench.rivals import Rival, keep_scenes, parse_rival, write_subject
from qsgm.bench.scenes import MethodResults, ScenePlan, measure_scenes
from qsgm.bench.scenes_picture import Album, draw_scenes
from qsgm.bench.scenes_report import render, report_json
from qsgm.bench.subjects import drawn_subjects, subjects_of
from qsgm.cli.bench import SceneCondition
from qsgm.tune.settings import Settings

RIVALS = Path(__file__).parents[2] / "benchmarks" / "rivals"
NOTHING = np.zeros((480, 640), bool)
HERE = (200.0, 200.0)


def truth(
    center: tuple[float, float] | None = HERE, number: int = 0, condition: Any = "beside"
) -> Truth:
    return Truth("bar", condition, number, center, 170.0, 1.0, False, True, True)


def answer(
    at: tuple[float, float] = (203.0, 204.0), quality: float = 0.9, found: bool = True
) -> Answer:
    return Answer(found, quality, at, -14.0, 166.0, 0.01)


def judged(center: tuple[float, float] | None = HERE, **how: Any) -> Judged:
    return judge(truth(center), answer(**how), NOTHING)


def pair(number: int, present: Answer, absent: Answer, condition: Any = "beside") -> list[Judged]:
    """The same scene with the object and without it."""
    return [
        judge(truth(HERE, number, condition), present, NOTHING),
        judge(truth(None, number, condition), absent, NOTHING),
    ]


def test_errors_are_distances_and_turns_modulo_180_and_over_the_full_circle() -> None:
    hit = judged()
    assert hit.center_error_px == 5
    assert hit.turn_error_deg == pytest.approx(4)
    assert hit.full_turn_error_deg == pytest.approx(4)
    other_way = replace(hit, answer=replace(hit.answer, full_turn_deg=-14.0))
    assert other_way.full_turn_error_deg == pytest.approx(176)
    assert judged(None).center_error_px == math.inf


def test_every_answer_has_one_outcome() -> None:
    thing = NOTHING.copy()
    thing[300:320, 400:420] = True
    near, far = (400.0 - ON_THING_PX + 0.4, 310.0), (400.0 - ON_THING_PX - 2, 310.0)
    elsewhere = (200.0 + ON_OBJECT_PX + 1, 200.0)
    for at, found, outcome in (
        ((200.0 + ON_OBJECT_PX, 200.0), True, "right_place"),
        (elsewhere, True, "background"),
        (near, True, "wrong_thing"),
        (far, True, "background"),
        (HERE, False, "missed"),
        ((math.nan, math.nan), False, "missed"),
        ((-50.0, 900.0), True, "background"),
    ):
        assert judge(truth(), answer(at, found=found), thing).outcome == outcome
    assert judge(truth(None), answer(near), thing).outcome == "false_alarm"
    assert judge(truth(None), answer(near), thing).spot == "thing"
    assert judge(truth(None), answer(near, found=False), thing).outcome == "quiet"


def test_shares_count_outcomes() -> None:
    results = [
        *pair(0, answer(), answer(found=False, quality=0.1)),
        *pair(1, answer((500.0, 100.0)), answer()),
        *pair(2, answer(found=False, quality=0.2), answer(found=False, quality=0.3)),
        *pair(3, answer(), answer(found=False, quality=0.1)),
    ]
    found = shares(Tally.of(results[::-1]))
    assert (found["right_place"], found["background"], found["missed"]) == (0.5, 0.25, 0.25)
    assert (found["wrong_thing"], found["false_alarm"]) == (0, 0.25)
    assert found["false_alarm_background"] == 0.25
    with pytest.raises(ValueError, match="with the object and without"):
        Tally.of(results[:-1])


def brute_roc(positives: NDArray[np.float64], negatives: NDArray[np.float64]) -> float:
    wins = [(p > n) + 0.5 * (p == n) for p in positives for n in negatives]
    return float(np.mean(wins))


def brute_equal_error_rate(positives: NDArray[np.float64], negatives: NDArray[np.float64]) -> float:
    """Walks along the curve through all thresholds in tiny steps."""
    levels = [math.inf, *sorted({*positives, *negatives}, reverse=True)]
    alarms = [np.mean(negatives >= level) for level in levels]
    misses = [np.mean(positives < level) for level in levels]
    steps = np.linspace(0, len(levels) - 1, 400_001)
    rows = np.arange(len(levels))
    a, m = np.interp(steps, rows, alarms), np.interp(steps, rows, misses)
    return float(a[np.abs(a - m).argmin()])


@pytest.mark.parametrize("seed", range(6))
def test_roc_area_and_equal_error_rate_are_what_their_definitions_say(seed: int) -> None:
    rng = np.random.default_rng(seed)
    positives = np.round(rng.normal(1.0, 1.0, 23), 1)  # rounded: ties
    negatives = np.round(rng.normal(0.0, 1.0, 31), 1)
    positives[: 3 * seed] = -np.inf
    assert roc_area(positives, negatives) == pytest.approx(brute_roc(positives, negatives))
    expected = brute_equal_error_rate(positives, negatives)
    assert equal_error_rate(positives, negatives) == pytest.approx(expected, abs=1e-4)


def test_perfect_and_useless_qualities_have_the_areas_everyone_knows() -> None:
    high, low = np.array([0.8, 0.9]), np.array([0.1, 0.2])
    assert (roc_area(high, low), equal_error_rate(high, low)) == (1, 0)
    assert (roc_area(low, high), equal_error_rate(low, high)) == (0, 1)
    assert (roc_area(high, high), equal_error_rate(high, high)) == (0.5, 0.5)


@pytest.mark.parametrize("count", [1, 49, 50, 51, 500])
def test_a_threshold_lets_two_in_a_hundred_through_and_no_lower_one_does(count: int) -> None:
    negatives = np.round(np.random.default_rng(count).normal(size=count), 2)
    threshold = threshold_for(negatives)
    assert (negatives > threshold).mean() <= 0.02
    below = threshold - 0.005
    assert (negatives > below).mean() > 0.02


def test_intervals_of_a_share_are_as_wide_as_the_binomial_ones() -> None:
    hits = np.arange(400) < 300
    results = [
        one
        for k, hit in enumerate(hits)
        for one in pair(k, answer(found=bool(hit)), answer(found=False, quality=0.1))
    ]
    low, high = intervals(Tally.of(results), seed=0, resamples=400)["right_place"]
    half = 1.96 * math.sqrt(0.75 * 0.25 / 400)
    assert (low, high) == pytest.approx((0.75 - half, 0.75 + half), abs=0.012)
    assert intervals(Tally.of(results), seed=0, resamples=20)["false_alarm"] == (0, 0)


def test_differences_are_paired_by_scene() -> None:
    first = np.arange(200) % 2 == 0
    assert paired_difference(first, first, seed=0) == (0, (0, 0))
    second = first.copy()
    second[:10] = False  # right in 5 scenes fewer, the others alike
    difference, (low, high) = paired_difference(first, second, seed=0)
    assert difference == 0.025
    half = 1.96 * math.sqrt(0.025 * 0.975 / 200)
    assert (low, high) == pytest.approx((0.025 - half, 0.025 + half), abs=0.008)
    with pytest.raises(ValueError, match="equally many"):
        paired_difference(first, second[:5], seed=0)


def test_only_elongated_objects_count_for_turns_and_unique_ones_for_the_way_round() -> None:
    hit = judged()
    round_one = replace(hit, truth=replace(hit.truth, elongated=False, unique=False, turn_deg=90))
    found = errors([hit, round_one])
    assert found["median_turn_error_deg"] == pytest.approx(4)
    assert found["full_turn_right"] == 1
    assert math.isnan(found["fallback"])
    coarse = replace(hit, answer=replace(hit.answer, refined=False))
    fine = replace(hit, answer=replace(hit.answer, refined=True))
    assert errors([coarse, fine, fine, fine])["fallback"] == 0.25
    assert math.isnan(errors([round_one])["full_turn_right"])


class Knowing:
    """Answers what the plan's truths say, and is sure of things that are not there at times."""

    def __init__(self, plan: ScenePlan, name: str = "knowing", alarms: int = 0) -> None:
        self.plan, self.name, self.alarms = plan, name, alarms

    def answers(self, subject: Subject, scenes: Sequence[NDArray[np.uint8]]) -> list[Answer]:
        numbers = [s.name for s in self.plan.subjects]
        staged = self.plan.scenes_of(Composer(self.plan.subjects), numbers.index(subject.name))
        answers = []
        for (scene, what), shown in zip(staged, scenes, strict=True):
            np.testing.assert_array_equal(scene.frame, shown)
            alarm = not what.present and len(answers) < 2 * self.alarms
            center = what.center_px or (100.0, 100.0)
            quality = 0.95 if alarm else 0.9 if what.present else 0.1
            answers.append(Answer(quality > 0.5, quality, center, what.turn_deg, what.turn_deg))
        return answers


@pytest.fixture(scope="module")
def plan(frames_folder: Path) -> ScenePlan:
    """Two conditions of a bar and a disk, in small frames."""
    part = np.s_[120:360, 160:480]
    subjects = tuple(
        replace(subject, frame=subject.frame[part], mask=subject.mask[part])
        for subject in subjects_of(list_frames(frames_folder))
    )
    return ScenePlan(subjects, (0, 1), ("same_table", "hidden"), count=2)


@pytest.fixture(scope="module")
def report(plan: ScenePlan) -> tuple[dict[str, Any], Album]:
    album = Album(tuple(subject.name for subject in plan.subjects))
    told: list[tuple[str, int, int]] = []
    methods = [Knowing(plan), Knowing(plan, "alarming", alarms=1)]
    results = measure_scenes(plan, methods, lambda *what: told.append(what), album.look)
    assert told == [("frames", 1, 2), ("frames", 2, 2)]
    return report_json(plan, Settings(), Path("export"), "drawn", results), album


@pytest.fixture(scope="module")
def values(report: tuple[dict[str, Any], Album]) -> dict[str, Any]:
    return report[0]


def test_who_knows_the_truth_is_right_everywhere(values: dict[str, Any]) -> None:
    json.dumps(values, allow_nan=False)
    for row in (*values["conditions"].values(), values["pooled"]):
        assert (row["right_place"], row["false_alarm"], row["roc_area"]) == (1, 0, 1)
        assert row["right_place_95"] == [1, 1]
        assert row["median_center_error_px"] == 0
    assert (values["scenes"], values["empty_scenes"], values["found_share"]) == (8, 8, 1)
    assert values["false_detections"] == values["missed"] == 0
    assert len(values["per_scene"]) == 16


def test_at_equal_false_alarms_who_is_sure_of_what_is_not_there_finds_nothing(
    values: dict[str, Any],
) -> None:
    rated = values["at_false_alarm_rate"]
    knowing, alarming = rated["methods"]["knowing"], rated["methods"]["alarming"]
    assert (knowing["pooled"]["right_place"], alarming["pooled"]["right_place"]) == (1, 0)
    assert rated["right_place_minus"]["alarming"] == {"difference": 1, "interval_95": [1, 1]}


def test_the_tables_fit_80_columns(
    values: dict[str, Any],
) -> None:
    console = Console(width=80, file=io.StringIO(), record=True)
    console.print(render(values))
    text = console.export_text()
    assert "same table" in text
    assert "pooled" in text
    assert "knowing minus alarming: +100.0 points" in text
    assert "…" not in text


def test_the_picture_shows_a_row_for_every_condition(
    report: tuple[dict[str, Any], Album], values: dict[str, Any], plan: ScenePlan
) -> None:
    album = report[1]
    picture = draw_scenes(values, album)
    fewer = values | {"conditions": {"hidden": values["conditions"]["hidden"]}}
    assert picture.shape[0] - draw_scenes(fewer, album).shape[0] == 132
    assert not album.failures
    green = (picture == (110, 160, 46)).all(axis=2).any(axis=1)
    assert (np.diff(green.astype(int)) == 1).sum() >= len(plan.conditions) + 1


def test_pictures_of_failures_are_few_and_named_by_what_went_wrong() -> None:
    album = Album(("bar",))
    scene = Scene(np.zeros((480, 640, 3), np.uint8), HERE, condition="beside")
    for number in range(5):
        album.look(scene, judge(truth(HERE, number), answer((500.0, 100.0)), NOTHING))
    assert list(album.failures) == ["beside_background_bar_0", "beside_background_bar_1"]


def test_neither_a_limit_nor_other_conditions_change_a_scene(plan: ScenePlan) -> None:
    composer = Composer(plan.subjects)
    fewer = replace(plan, taught=(1,), conditions=("hidden",), count=1)
    first, _ = next(fewer.scenes_of(composer, 1))
    all_of_them = [s for s, what in plan.scenes_of(composer, 1) if what.condition == "hidden"]
    np.testing.assert_array_equal(first.frame, all_of_them[0].frame)


def script(folder: Path, body: str) -> Rival:
    path = folder / "rival.py"
    path.write_text(f"import json, pathlib, sys\nfolder, output = sys.argv[1:]\n{body}\n")
    return parse_rival(f"mine={sys.executable} {path}")


def test_a_rival_is_asked_about_every_scene(tmp_path: Path, plan: ScenePlan) -> None:
    rival = script(
        tmp_path,
        "listing = json.loads((pathlib.Path(folder) / 'scenes.json').read_text())\n"
        "answers = [{'file': f, 'score': k, 'center_px': None if k else listing['center_px'],"
        " 'turn_deg': 10} for k, f in enumerate(listing['scenes'])]\n"
        "pathlib.Path(output).write_text(json.dumps({'answers': answers}))",
    )
    subject = plan.subjects[0]
    first, second = rival.answers(subject, [subject.frame, subject.frame])
    assert first == Answer(False, 0.0, (160.0, 120.0), 10.0, 10.0, None)
    assert second.quality == -math.inf


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("print('to see'); sys.exit('no such thing')", "mine ended with 1, saying: no such thing"),
        ("pass", "mine left no usable answers: expected one to each of 1 scenes"),
        ("pathlib.Path(output).write_text('{\"answers\": []}')", "mine left no usable answers"),
    ],
)
def test_a_rival_that_fails_is_named(
    tmp_path: Path, plan: ScenePlan, body: str, message: str
) -> None:
    subject = plan.subjects[0]
    with pytest.raises(QsgmError, match=message):
        script(tmp_path, body).answers(subject, [subject.frame])
    with pytest.raises(QsgmError, match="cannot start /no/such"):
        parse_rival("x=/no/such thing").answers(subject, [subject.frame])


@pytest.mark.parametrize("text", ["", "ncc", "=python", "ncc=", "ncc='"])
def test_a_rival_without_name_or_command_is_wrong_usage(
    text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.run(["bench", "scenes", "--rival", text]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "--rival" in message


def covered_with_squares(subject: Subject) -> Subject:
    """Corners that every version of OpenCV sees."""
    squares = np.random.default_rng(0).integers(40, 216, (120, 160, 3), np.uint8)
    painted = squares.repeat(4, axis=0).repeat(4, axis=1)
    return replace(subject, frame=np.where(subject.mask[..., None], painted, subject.frame))


@pytest.mark.parametrize("name", ["ncc", "orb"])
def test_rivals_find_an_object_where_it_is(tmp_path: Path, name: str) -> None:
    subjects = [covered_with_squares(one) for one in drawn_subjects(0, 3)]
    scenes = [
        Composer(subjects).pair(0, "same_table", np.random.default_rng(k)).present for k in (1, 2)
    ]
    write_subject(tmp_path, subjects[0], [scene.frame for scene in scenes])
    command = [sys.executable, str(RIVALS / f"{name}.py"), str(tmp_path), str(tmp_path / "a.json")]
    subprocess.run(command, check=True)
    found = json.loads((tmp_path / "a.json").read_text())["answers"]
    for scene, item in zip(scenes, found, strict=True):
        assert scene.center_px is not None
        assert math.dist(item["center_px"], scene.center_px) < (1 if name == "ncc" else 4)
        difference = item["turn_deg"] - math.degrees(scene.turn_rad)
        assert abs((difference + 180) % 360 - 180) < 2


def test_rivals_import_nothing_of_qsgm() -> None:
    paths = [*RIVALS.glob("*.py")]
    assert paths
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.partition(".")[0] == "qsgm" for name in names)


def test_kept_scenes_come_with_their_truth(tmp_path: Path, plan: ScenePlan) -> None:
    keep_scenes(replace(plan, taught=(0,), count=1), tmp_path, lambda *_: None)
    told = json.loads((tmp_path / "bar" / "truth.json").read_text())["scenes"]
    assert [item["condition"] for item in told] == 2 * ["same_table"] + 2 * ["hidden"]
    assert [item["center_px"] is None for item in told] == [False, True, False, True]
    for item in told:
        assert cv2.imread(str(tmp_path / "bar" / item["file"])).shape == (240, 320, 3)
    assert cv2.imread(str(tmp_path / "bar" / "mask.png")).max() == 255


def test_the_command_offers_every_condition() -> None:
    assert [choice.value for choice in SceneCondition] == list(CONDITIONS)


def test_bench_scenes_runs_from_the_command_line(
    frames_folder: Path, bundle_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = ["bench", "scenes", "--frames", str(frames_folder), "--bundle", str(bundle_folder)]
    few = [*common, "--epochs", "0", "--scenes", "1", "--condition", "same_table"]
    assert cli.run([*few, "--json", "-o", str(tmp_path)]) == 0
    values = json.loads(capsys.readouterr().out)
    assert values == json.loads((tmp_path / "scenes.json").read_text())
    assert (list(values["conditions"]), values["scenes"]) == (["same_table"], 2)
    assert cv2.imread(str(tmp_path / "scenes.png")) is not None
    assert cli.run([*few, "--limit", "1"]) == 0
    assert "objects looked for, 1 in number: 1 scenes" in capsys.readouterr().out


def test_a_methods_threshold_is_its_own() -> None:
    results = [*pair(0, answer(), answer(quality=0.7)), *pair(1, answer(), answer(quality=0.2))]
    level = MethodResults("mine", tuple(results)).at_false_alarm_rate()
    assert level.threshold == 0.7
    assert [r.outcome for r in level.results] == ["right_place", "quiet"] * 2


def test_examples_show_other_subjects_in_every_column_and_the_last_without_the_object() -> None:
    album = Album(tuple("abcdefgh"))
    scene = Scene(np.zeros((480, 640, 3), np.uint8), HERE, condition="beside")
    for frame in album.subjects:
        for number, center in ((0, HERE), (0, None), (1, HERE), (1, None)):
            told = replace(truth(center, number), frame=frame)
            marked = replace(scene, frame=np.full((480, 640, 3), ord(frame), np.uint8))
            album.look(marked, judge(told, answer(found=False), NOTHING))
    kept = album.examples["beside"]
    assert [chr(int(np.median(kept[k]))) for k in range(4)] == ["a", "c", "e", "g"]
