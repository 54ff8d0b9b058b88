"""The watch in small: synthetic recordings go the whole way, real ones where they are installed."""

import importlib.util
import json
import runpy
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import qsgm
from qsgm import cli, load_task
from qsgm.manifest import Recipe
from qsgm.train.samples import build as building
from qsgm.train.samples.drawn import quicker

EXAMPLES = Path(qsgm.__file__).parent.parent / "examples" / "watch"
FILE = EXAMPLES / "watch_task.py"
PEOPLE, ARMS, EXERCISES = 10, 2, 7
MIRROR = np.array([-1, 1, 1, 1, -1, -1])
STRANGER = 4


def recording(person: int, arm: int, exercise: int) -> np.ndarray[Any, Any]:
    """Exercises differ in tempo and axis, people in strength, arms by their mirror images."""
    rng = np.random.default_rng([person, arm, exercise])
    at = np.arange(rng.integers(900, 1100)) / 50
    phase = 2 * np.pi * (0.4 + 0.1 * exercise) * at
    axis = np.roll([1, 0.6, 0.3, 0, 0, 0], exercise)
    motion = (1 + 0.05 * person) * np.sin(phase)[:, None] * axis + np.roll(axis, 3)
    noisy = motion + rng.normal(0, 0.05, motion.shape)
    return noisy if arm == 1 else noisy * MIRROR


def seglearn_of(folder: Path, found: dict[str, Any]) -> Path:
    """A package whose code must not run, with recordings in it."""
    home = folder / "seglearn" / "data"
    home.mkdir(parents=True)
    (home.parent / "__init__.py").write_text("raise ImportError")
    np.save(home / "watch_dataset.npy", np.array(found), allow_pickle=True)
    return folder


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    grid = np.stack(np.meshgrid(range(10), range(2), range(7), indexing="ij")).reshape(3, -1)
    grid = grid[:, np.random.default_rng(0).permutation(140)]
    found = {
        "X": [recording(*one) for one in grid.T],
        "subject": grid[0] + 1,
        "side": grid[1].astype(float),
        "y": grid[2],
        "y_labels": [f"E{one}" for one in range(7)],
    }
    return seglearn_of(tmp_path_factory.mktemp("package"), found)


@pytest.fixture(autouse=True)
def synthetic(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(package)
    monkeypatch.delitem(sys.modules, "seglearn", raising=False)


def the_task() -> Any:
    return replace(load_task(FILE), left_out=STRANGER)


def module_of(task: object) -> Any:
    return sys.modules[type(task).__module__]


def comparing() -> ModuleType:
    spec = importlib.util.spec_from_file_location("watch_compare", EXAMPLES / "compare.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["watch_compare"] = module
    spec.loader.exec_module(module)
    return module


def small(task: Any) -> Any:
    config = quicker(comparing().sizes(task), 0.1)
    early = replace(config.early, tasks=2, crops_per_task=20, epochs=1, looks=(1,), steps=2)
    rates = replace(config.rates, tasks=2, epochs=2, short_epochs=1, early_epochs=1)
    sizes = {"early": early, "rates": rates, "maml": replace(config.maml, outer_steps=1)}
    return replace(config, crops_per_task=100, backbone=replace(config.backbone, steps=60), **sizes)


@pytest.fixture(scope="module")
def made(package: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the bundle of a host that does not know the stranger."""
    folder = tmp_path_factory.mktemp("watch")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(package)
        task = the_task()
        options = building.ExportOptions(epochs=1)
        building.build(task, folder / str(STRANGER), config=small(task), options=options)
    return folder


def test_the_task_file_is_short_and_a_device_needs_neither_torch_nor_the_recordings() -> None:
    assert len(FILE.read_text().splitlines()) <= 80
    code = f"import sys, qsgm, pathlib; qsgm.load_task(pathlib.Path({str(FILE)!r})); "
    code += "sys.exit(any(name in sys.modules for name in ('torch', 'onnx', 'seglearn')))"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_set_of_the_left_arm_is_seen_as_its_mirror_image(tmp_path: Path) -> None:
    motion, task = recording(0, 1, 3), the_task()
    np.savez(tmp_path / "right.npz", motion=motion, arm=1, exercise=3)
    np.savez(tmp_path / "left.npz", motion=motion * MIRROR, arm=0)
    right, left = (task.read(tmp_path / f"{name}.npz") for name in ("right", "left"))
    np.testing.assert_allclose(left.inputs, right.inputs, rtol=1e-6)
    assert left.labels is None
    assert (right.labels.argmax(axis=1) == 3).all()
    pairs = motion[: len(motion) // 2 * 2].reshape(-1, 2, 6).mean(axis=1)
    np.testing.assert_allclose(right.inputs[2, 0, :, :3], pairs[16:80, :3], rtol=1e-5)
    np.testing.assert_allclose(right.inputs[2, 0, :, 3:], 0.3 * pairs[16:80, 3:], rtol=1e-5)


def test_nothing_of_whom_the_host_does_not_know_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    task = the_task()
    motion, start, length = module_of(task).pool()
    marked = np.zeros_like(motion)
    for first, count in zip(start[STRANGER].flat, length[STRANGER].flat, strict=True):
        marked[first : first + count] = 1
    assert 0.05 < marked.mean() < 0.15
    monkeypatch.setattr(module_of(task), "pool", lambda: (marked, start, length))
    for seed in range(30):
        rng = np.random.default_rng(seed)
        assert not task.draw(rng, 50).inputs.any()
        assert not task.example(rng, 50).inputs.any()
    assert replace(task, left_out=0).example(rng, 200).inputs.any()


def test_no_window_that_is_asked_overlaps_one_that_is_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task, compare = the_task(), comparing()
    motion, start, length = module_of(task).pool()
    numbered = np.repeat(np.arange(len(motion), dtype=np.float32)[:, None], 6, axis=1)
    monkeypatch.setattr(module_of(task), "pool", lambda: (numbered, start, length))
    lesson = compare.lesson_by(task, STRANGER, 1)
    rows = [{int(at) for at in one[0, :, 0]} for one in lesson.inputs]
    shown = set.union(*rows[: lesson.taught])
    rest, other = (
        set.union(*some) for some in (rows[lesson.taught : lesson.other], rows[lesson.other :])
    )
    assert not shown & rest
    assert not shown & other
    for arm, seen in ((1, shown), (1, rest), (0, other)):
        for exercise in range(EXERCISES):
            first = start[STRANGER, arm, exercise]
            assert seen & {*range(first, first + length[STRANGER, arm, exercise])}
    within = {i for e in range(7) for i in range(start[4, 1, e], start[4, 1, e] + length[4, 1, e])}
    assert shown | rest <= within
    for row, label in zip(rows, lesson.labels, strict=True):
        (_, _, exercise), *_ = np.argwhere((start <= min(row)) & (max(row) < start + length))
        assert exercise == label.argmax()


def test_a_stranger_is_learnt_from_files_on_the_command_line(
    made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["wearer.py", str(STRANGER)])
    runpy.run_path(str(EXAMPLES / "wearer.py"))
    shown, asked = ([*sorted(Path(name).iterdir())] for name in ("shown", "asked"))
    assert [one.stem for one in shown] == [f"E{i}" for i in range(EXERCISES)]
    bundle = ["--bundle", str(made / str(STRANGER)), "--task", str(FILE)]
    assert cli.run(["finetune", "--int8", *bundle, *map(str, shown), "-o", "tuned", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["fidelity"]["3"]["cos_int8_float"] > 0.999
    right = []
    for one in asked:
        assert (
            cli.run(["predict", "--object", "tuned", "--task", str(FILE), str(one), "--json"]) == 0
        )
        right.append(json.loads(capsys.readouterr().out)["scores"]["exercise_accuracy"])
    assert np.mean(right) > 0.6  # one in seven by chance


def test_the_comparison_goes_on_where_it_stopped_and_prints_a_table(
    made: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    compare = comparing()
    monkeypatch.setattr(compare, "EPOCHS", (1,))
    monkeypatch.setattr(compare, "GRID", [Recipe("adam", (0.003, 0.03)), Recipe("sgd", (0.1, 0.1))])
    monkeypatch.setattr(compare, "ALONE", [Recipe("adam", (0.03,))])
    compare.main(str(made), str(STRANGER))
    first = capsys.readouterr().out
    figures = json.loads((made / f"{STRANGER}.json").read_text())
    monkeypatch.setattr(compare, "figures_of", None)
    compare.main(str(made), str(STRANGER))
    assert capsys.readouterr().out == first
    before, after = figures["untouched//"], figures["int8 SGMs/1/adam 0.003 0.03"]
    assert all(0 <= one <= 1 for one in (*before, *after))
    assert figures["cosine int8,float, layer 3"] > 0.999
    for row in (
        "untouched",
        "int8 SGMs",
        "float SGMs",
        "backpropagation at its best",
        "neighbours",
        "errors over backpropagation's",
    ):
        assert row in first


def test_errors_over_those_of_who_made_none_are_no_number() -> None:
    assert comparing().quotient(np.array([0.9, 0.7]), np.array([1.0, 1.0])) == "-"
    assert comparing().quotient(np.array([0.9, 0.7]), np.array([0.9, 0.9])) == "2.00"


def test_of_a_grid_each_person_gets_what_is_best_for_the_others() -> None:
    grid = {"a": np.array([[1.0], [0.0], [0.0]]), "b": np.array([[0.2], [0.3], [0.4]])}
    # Without the first person b is best; for the other two a is, which gave the first one 1.
    np.testing.assert_array_equal(comparing().chosen_by_others(grid, 0), [0.2, 0, 0])


@pytest.mark.skipif(find_spec("seglearn") is None, reason="seglearn is not installed")
def test_the_real_recordings_are_the_grid_that_is_counted_on(
    package: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one != str(package)])
    importlib.invalidate_caches()
    task = load_task(FILE)
    motion, start, length = module_of(task).pool()
    assert start.shape == length.shape == (PEOPLE, ARMS, EXERCISES)
    assert length.sum() == len(motion)
    # An arm that hangs down feels gravity along its own axis; which way says the mirror.
    assert all(
        0.6 < -motion[s : s + n, 0].mean() < 1.6
        for s, n in zip(start[:, :, 0].flat, length[:, :, 0].flat, strict=True)
    )
