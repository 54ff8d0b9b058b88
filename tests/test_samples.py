"""Samples, task files and tuned networks: what is taken, and what is refused in one line."""

import io
import json
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refusal_of

from qsgm import (
    Head,
    Network,
    QsgmError,
    RecordedTask,
    Samples,
    SampleTask,
    conv,
    load_task,
)
from qsgm.samples.arrays import NAME, ArraysTask, read_npz
from qsgm.samples.lesson import fallen, head_scores, lesson_of
from qsgm.samples.taskfile import read_samples, task_for, tuned_of
from qsgm.task import TaskRecord, task_record

NETWORK = Network((2, 3, 1), (conv(1, 4, (2, 3)), conv(4, 3, relu=False)), "numbers")
HEADS = (Head("kind", "cross_entropy", 3, "softmax"),)
TASK = ArraysTask(NAME, NETWORK, HEADS)
RNG = np.random.default_rng(0)
FILE = """
from qsgm import Head, Network, SampleTask, conv
task = SampleTask(
    "mine",
    Network((2, 3, 1), (conv(1, 4, (2, 3)), conv(4, 3, relu=False)), "numbers"),
    (Head("kind", "cross_entropy", 3, "softmax"),),
)
"""


def inputs(count: int = 10) -> np.ndarray[Any, Any]:
    return np.random.default_rng(0).normal(size=(count, 2, 3, 1)).astype(np.float32)


def saved(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def test_classes_and_labels_are_the_same_samples(tmp_path: Path) -> None:
    classes = np.arange(10) % 3
    one = TASK.read(saved(tmp_path / "a.npz", samples=inputs(), labels=classes))
    labels = np.eye(3, dtype=np.float32)[classes]
    other = TASK.read(saved(tmp_path / "b.npz", samples=inputs(), labels=labels))
    assert one.labels is not None
    np.testing.assert_array_equal(one.labels, labels)
    assert other.labels is not None
    np.testing.assert_array_equal(other.labels, labels)
    np.testing.assert_array_equal(one.inputs, inputs())


@pytest.mark.parametrize(
    ("said", "layers"),
    [({"tuned": 1}, 1), ({"tuned": 4}, 4), ({}, 2), *(({"tuned": n}, 2) for n in (0, 5, "2", 2.0))],
)
def test_as_many_layers_are_tuned_as_the_task_said_or_as_usual(
    said: dict[str, Any], layers: int
) -> None:
    network = Network((2, 3, 1), (conv(1, 4, (2, 3)), *(conv(4, 4),) * 2, conv(4, 3, relu=False)))
    assert tuned_of(TaskRecord("mine", network, HEADS, said)) == layers


@pytest.mark.parametrize("labels", [np.eye(3, dtype=np.int64)[np.arange(10) % 3], np.zeros(10)])
def test_only_whole_numbers_in_a_row_are_classes(
    tmp_path: Path, labels: np.ndarray[Any, Any]
) -> None:
    path = saved(tmp_path / "a.npz", samples=inputs(), labels=labels)
    said = refusal_of(lambda: TASK.read(path))
    assert f"labels are {labels.dtype} {labels.shape}, expected float32 (10, 3)" in said


def test_packed_arrays_in_any_order_are_read(tmp_path: Path) -> None:
    path = tmp_path / "packed.npz"
    np.savez_compressed(path, samples=np.asfortranarray(inputs()), more=np.zeros(3))
    np.testing.assert_array_equal(TASK.read(path).inputs, inputs())
    assert TASK.read(path).labels is None


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        ({"labels": np.arange(10) % 3}, "holds no `samples`"),
        ({"samples": inputs().astype(np.float64)}, "float64"),
        ({"samples": inputs()[:, :1]}, "expected float32 (N, 2, 3, 1)"),
        ({"samples": inputs()[:0]}, "expected float32 (N, 2, 3, 1)"),
        ({"samples": np.full((2, 2, 3, 1), np.nan, np.float32)}, "NaN"),
        ({"samples": inputs(), "labels": np.arange(10)}, "classes from 0 to 9, expected 0 to 2"),
        ({"samples": inputs(), "labels": np.zeros(9, int)}, "labels are float32 (9, 3)"),
        ({"samples": inputs(), "labels": np.full((10, 3), 2, np.float32)}, "outside"),
        ({"samples": inputs(), "labels": np.full((10, 3), np.nan, np.float32)}, "outside"),
        ({"samples": np.array([{}], object)}, "no numbers"),
        ({"samples": np.array(["text"])}, "no numbers"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(
    tmp_path: Path, arrays: dict[str, Any], said: str
) -> None:
    path = saved(tmp_path / "bad.npz", **arrays)
    message = refusal_of(lambda: TASK.read(path))
    assert said in message
    assert "bad.npz" in message


def test_an_archive_that_says_more_than_it_holds_is_refused_before_it_is_unpacked(
    tmp_path: Path,
) -> None:
    header = io.BytesIO()
    shape = (10**9, 2, 3, 1)
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f4", "fortran_order": False, "shape": shape}
    )
    path = tmp_path / "large.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("samples.npy", header.getvalue() + bytes(24))
    assert "which is not in it" in refusal_of(lambda: TASK.read(path))


@pytest.mark.parametrize("cut", [0, 10, 200])
def test_a_damaged_archive_is_refused(tmp_path: Path, cut: int) -> None:
    path = saved(tmp_path / "cut.npz", samples=inputs())
    path.write_bytes(path.read_bytes()[:cut])
    assert "cannot be read" in refusal_of(lambda: TASK.read(path))


@pytest.mark.parametrize("seed", range(40))
def test_a_flipped_byte_is_read_or_refused_and_nothing_else(tmp_path: Path, seed: int) -> None:
    path, rng = saved(tmp_path / "flip.npz", samples=inputs()), np.random.default_rng(seed)
    data = bytearray(path.read_bytes())
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    path.write_bytes(data)
    with suppress(QsgmError):
        read_npz(path, ("samples",))


def test_a_fifth_of_the_samples_is_held_out_and_all_are_there() -> None:
    labels = np.eye(3, dtype=np.float32)[np.arange(10) % 3]
    lesson = lesson_of(TASK, [Samples(inputs(), labels)], np.random.default_rng(1))
    assert (len(lesson), lesson.taught) == (10, 8)
    assert sorted(lesson.inputs.ravel()) == sorted(inputs().ravel())
    assert "need labels" in refusal_of(
        lambda: lesson_of(TASK, [Samples(inputs())], np.random.default_rng(1))
    )
    one = Samples(inputs(1), labels[:1])
    assert "1 sample" in refusal_of(lambda: lesson_of(TASK, [one], np.random.default_rng(1)))


def test_scores_go_by_the_names_of_heads_and_count_where_a_head_counts() -> None:
    heads = (
        Head("there", "log_loss", 1, "sigmoid"),
        Head("way", "squared", 1, "tanh", where=0),
        Head("kind", "cross_entropy", 2, "softmax"),
    )
    outputs = np.array([[0.9, 0.5, 0.7, 0.3], [0.8, 0.0, 0.4, 0.6]], np.float32)
    labels = np.array([[1, 1, 1, 0], [0, 0, 1, 0]], np.float32)
    scores = head_scores(heads, outputs, labels)
    assert scores == {"there_accuracy": 0.5, "way_error": 0.5, "kind_accuracy": 0.5}
    assert head_scores(heads, outputs[1:], labels[1:])["way_error"] is None


def test_a_task_file_is_read_and_its_classes_are_found_again(tmp_path: Path) -> None:
    path = tmp_path / "my task.py"
    path.write_text(FILE)
    task = load_task(path)
    assert (task.name, task.network, task.heads) == ("mine", NETWORK, HEADS)
    assert "how x.npz is read" in refusal_of(lambda: task.read(Path("x.npz")))
    assert "nothing to pretrain on" in refusal_of(lambda: task.draw(np.random.default_rng(0), 1))


@pytest.mark.parametrize(
    ("source", "said"),
    [
        (None, "does not exist"),
        ("", "`task` is nothing"),
        ("task = 3", "`task` is a int"),
        ("import nothing_at_all", "ModuleNotFoundError in line 1: No module named"),
        ("\nif", "SyntaxError in line 2"),
        ("\n\nraise ValueError('one\\ntwo')", "ValueError in line 3: one"),
        (FILE.replace('"mine"', '"grasp"'), "no name for a task"),
        (FILE.replace('"mine"', '"a b"'), "no name for a task"),
        (FILE.replace('"mine"', "5"), "`task.name` is a int"),
        (FILE.replace("4, 3, relu", "4, 2, relu"), "have 3 channels, its network gives 2"),
    ],
)
def test_a_task_file_that_is_none_is_refused_in_one_line(
    tmp_path: Path, source: str | None, said: str
) -> None:
    path = tmp_path / "bad.py"
    if source is not None:
        path.write_text(source)
    assert said in refusal_of(lambda: load_task(path))


def test_a_task_file_of_more_than_a_megabyte_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "long.py"
    path.write_text("#" * 999_999 + "\n")
    assert "`task` is nothing" in refusal_of(lambda: load_task(path))  # it was run
    path.write_text("#" * 1_000_000 + "\n")
    assert "at most 1 MB" in refusal_of(lambda: load_task(path))


def test_what_a_task_file_raises_while_it_reads_is_one_line() -> None:
    class Wrong(SampleTask):
        def read(self, path: Path) -> Samples:
            raise KeyError(f"{path}\nand more")

    class Empty(SampleTask):
        def read(self, path: Path) -> Any:  # noqa: ARG002
            return None

    message = refusal_of(lambda: read_samples(Wrong("mine", NETWORK, HEADS), Path("a.npz")))
    assert "the task 'mine' cannot read a.npz: KeyError in line" in message
    message = refusal_of(lambda: read_samples(Empty("mine", NETWORK, HEADS), Path("a.npz")))
    assert "a.npz gives a NoneType, expected qsgm.Samples" in message


def test_another_tasks_file_is_refused_and_so_is_none() -> None:
    kept = TaskRecord("mine", NETWORK, HEADS, {})
    mine, yours = SampleTask("mine", NETWORK, HEADS), SampleTask("yours", NETWORK, HEADS)
    assert task_for(kept, "it", mine) is mine
    assert "pass --task FILE.py" in refusal_of(lambda: task_for(kept, "it", None))
    assert "the task file of 'yours'" in refusal_of(lambda: task_for(kept, "it", yours))
    heads = (Head("other", "cross_entropy", 3, "softmax"),)
    other = SampleTask("mine", NETWORK, heads)
    assert "another network or other heads" in refusal_of(lambda: task_for(kept, "it", other))
    built_in = task_for(task_record(TASK), "it", None)
    assert isinstance(built_in, ArraysTask)
    assert built_in.heads == HEADS


def test_a_pool_of_arrays_is_drawn_group_by_group(tmp_path: Path) -> None:
    from qsgm.train.samples.arrays import load_arrays_task

    groups = np.repeat([4, 9], 5)
    saved(tmp_path / "pool.npz", samples=inputs(), labels=np.arange(10) % 3, groups=groups)
    heads = json.loads(
        '[{"name": "kind", "kind": "cross_entropy", "channels": 3, "activation": '
        '"softmax", "weight": 1, "smoothing": 0, "where": null}]'
    )
    about = {"network": NETWORK.to_json(), "heads": heads, "tuned": 1, "samples": "pool.npz"}
    path = tmp_path / "pool.json"
    path.write_text(json.dumps(about))
    task, rng = load_arrays_task(path), np.random.default_rng(0)
    assert (task.name, task.tuned) == (NAME, 1)
    drawn = [task.draw(rng, 20).inputs for _ in range(10)]
    halves = [set(inputs()[:5].ravel()), set(inputs()[5:].ravel())]
    assert all(any(set(one.ravel()) <= half for half in halves) for one in drawn)
    path.write_text("{}")
    assert "is no task `arrays`" in refusal_of(lambda: load_arrays_task(path))


def test_of_recordings_the_ends_are_held_out_and_no_window_reaches_from_one_part_to_another() -> (
    None
):
    task = RecordedTask("mine", NETWORK, HEADS, overlap=2)
    lengths = (10, 23)
    numbered = [100 * i + np.arange(count) for i, count in enumerate(lengths)]
    shown = [
        Samples(np.zeros((len(one), 2, 3, 1), np.float32) + one[:, None, None, None], labels(one))
        for one in numbered
    ]
    lesson = task.lesson(shown, np.random.default_rng(0))
    seen = lesson.inputs[:, 0, 0, 0]
    assert seen[lesson.taught :].tolist() == [8, 9, *range(118, 123)]
    assert seen[: lesson.taught].tolist() == [*range(6), *range(100, 116)]
    np.testing.assert_array_equal(lesson.labels, labels(seen))


def test_a_recording_without_labels_or_of_too_few_windows_is_refused_in_one_line() -> None:
    task = RecordedTask("mine", NETWORK, HEADS, overlap=2)
    few, enough = (Samples(inputs(count), labels(np.arange(count))) for count in (3, 4))
    assert task.lesson([enough], np.random.default_rng(0)).taught == 1
    said = refusal_of(lambda: task.lesson([enough, few], RNG))
    assert "has 3 windows, expected labelled ones, more than the last fifth" in said
    assert "and 2 before it" in said
    unlabelled = Samples(enough.inputs)
    assert "has no labels" in refusal_of(lambda: task.lesson([enough, unlabelled], RNG))
    assert "nothing was shown" in refusal_of(lambda: task.lesson([], RNG))


def labels(numbers: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    return np.eye(3, dtype=np.float32)[numbers.astype(int) % 3]


def test_a_single_number_in_an_archive_stays_one(tmp_path: Path) -> None:
    found = read_npz(saved(tmp_path / "a.npz", arm=1, kinds=np.arange(3)), ("arm", "kinds"))
    assert (found["arm"].shape, int(found["arm"]), found["kinds"].shape) == ((), 1, (3,))


def test_what_got_worse_is_said_by_head() -> None:
    heads = (*HEADS, Head("size", "squared", 1, "sigmoid"), Head("on", "log_loss", 1, "sigmoid"))
    before = {"kind_accuracy": 0.9, "size_error": 0.1, "on_accuracy": 0.5, "mine": 1.0}
    assert fallen(heads, before, before) == ()
    assert fallen(heads, before, {"kind_accuracy": 1.0, "size_error": 0.05, "mine": 0.0}) == ()
    after = {"kind_accuracy": 0.4, "size_error": 0.2, "on_accuracy": None}
    kind, size = fallen(heads, before, after)
    assert "kind_accuracy 0.900 before, 0.400 now" in kind
    assert "size_error 0.100 before, 0.200 now" in size
    for line in (kind, size, *fallen(heads, before, {"kind_accuracy": float("nan")})):
        assert "got worse" in line or "made it worse" in line
    assert len(fallen(heads, before, {"kind_accuracy": float("nan")})) == 1
