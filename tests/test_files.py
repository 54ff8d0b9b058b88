"""Outputs appear whole or not at all, and nothing of the user's is ever deleted."""

import hashlib
import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from qsgm import files
from qsgm.errors import QsgmError
from qsgm.files import (
    LISTING,
    new_folder,
    write_bytes_atomic,
    write_text_atomic,
)

MARKER = "object.json"


def names(folder: Path) -> list[str]:
    return sorted(item.name for item in folder.iterdir())


def write_object(folder: Path, text: str = "{}") -> None:
    with new_folder(folder, MARKER) as inside:
        (inside / MARKER).write_text(text)


def refusal(folder: Path, marker: str = MARKER) -> str:
    with pytest.raises(QsgmError) as raised, new_folder(folder, marker):
        pytest.fail("the block must not run")
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_a_file_is_written_with_the_folders_on_the_way(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / "text"
    write_text_atomic(target, "grüße\n")
    assert target.read_bytes() == "grüße\n".encode()
    assert names(target.parent) == ["text"]


def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "file"
    target.write_bytes(b"old")

    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(QsgmError, match=r"cannot write .*file: no space left on device; pass"):
        write_bytes_atomic(target, b"new")
    assert target.read_bytes() == b"old"
    assert names(tmp_path) == ["file"]


def test_whoever_reads_the_old_file_reads_it_to_its_end(tmp_path: Path) -> None:
    target = tmp_path / "file"
    target.write_bytes(b"old content")
    with target.open("rb", buffering=0) as reader:
        assert reader.read(3) == b"old"
        write_bytes_atomic(target, b"new")
        assert reader.read() == b" content"
    assert target.read_bytes() == b"new"


def test_a_file_below_a_file_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x")
    with pytest.raises(QsgmError, match=r"cannot write .*; pass a place") as raised:
        write_bytes_atomic(tmp_path / "file" / "below", b"y")
    assert "\n" not in str(raised.value)


def test_a_device_is_never_replaced_by_a_file() -> None:
    before = Path("/dev/null").stat().st_mode
    with pytest.raises(QsgmError, match=r"cannot write /dev/null: it exists and is not a file"):
        write_bytes_atomic(Path("/dev/null"), b"x")
    assert Path("/dev/null").stat().st_mode == before


def test_writing_through_a_link_keeps_the_link(tmp_path: Path) -> None:
    (tmp_path / "real").write_bytes(b"old")
    (tmp_path / "link").symlink_to("real")
    write_bytes_atomic(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real").read_bytes() == b"new"


def test_a_name_that_is_too_long_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(QsgmError, match="file name too long"):
        write_bytes_atomic(tmp_path / ("n" * 300), b"x")
    assert "file name too long" in refusal(tmp_path / ("n" * 300))


def test_a_new_folder_appears_only_when_the_block_has_ended(tmp_path: Path) -> None:
    final = tmp_path / "out" / "mug"
    with new_folder(final, MARKER) as inside:
        (inside / MARKER).write_text("{}")
        assert not final.exists()
    assert names(final) == [LISTING, MARKER]
    assert names(tmp_path / "out") == ["mug"]


def test_an_empty_folder_is_used(tmp_path: Path) -> None:
    write_object(tmp_path / "mug")
    (tmp_path / "empty").mkdir()
    write_object(tmp_path / "empty")
    assert names(tmp_path / "empty") == [LISTING, MARKER]


def test_a_failed_block_leaves_the_old_folder_and_nothing_else(tmp_path: Path) -> None:
    def interrupted() -> None:
        with new_folder(tmp_path / "mug", MARKER) as inside:
            (inside / MARKER).write_text("half")
            raise KeyboardInterrupt

    write_object(tmp_path / "mug", "old")
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert (tmp_path / "mug" / MARKER).read_text() == "old"
    assert names(tmp_path) == ["mug"]


def test_an_earlier_output_is_replaced_with_all_its_files(tmp_path: Path) -> None:
    with new_folder(tmp_path / "mug", MARKER) as inside:
        (inside / MARKER).write_text("old")
        (inside / "graphs").mkdir()
        (inside / "graphs" / "stale.onnx").write_bytes(b"x")
    write_object(tmp_path / "mug", "new")
    assert (tmp_path / "mug" / MARKER).read_text() == "new"
    assert names(tmp_path / "mug") == [LISTING, MARKER]
    assert names(tmp_path) == ["mug"]


def test_the_listing_has_the_checksum_of_every_file(tmp_path: Path) -> None:
    with new_folder(tmp_path / "mug", MARKER) as inside:
        (inside / MARKER).write_text("{}")
        (inside / "graphs").mkdir()
        (inside / "graphs" / "step.onnx").write_bytes(b"step")
    lines = (tmp_path / "mug" / LISTING).read_text().splitlines()
    assert lines == [
        f"{hashlib.sha256(b'step').hexdigest()}  graphs/step.onnx",
        f"{hashlib.sha256(b'{}').hexdigest()}  {MARKER}",
    ]


def test_a_folder_with_a_file_of_the_users_is_refused(tmp_path: Path) -> None:
    write_object(tmp_path / "mug")
    (tmp_path / "mug" / "notes.txt").write_text("mine")
    text = refusal(tmp_path / "mug")
    assert "'notes.txt'" in text
    assert "pass a new or an empty folder" in text
    assert (tmp_path / "mug" / "notes.txt").read_text() == "mine"


def test_a_foreign_folder_is_refused_even_when_it_has_a_file_named_like_the_marker(
    tmp_path: Path,
) -> None:
    (tmp_path / MARKER).write_text("something else")
    assert f"did not write '{MARKER}'" in refusal(tmp_path)


def test_another_kind_of_output_is_refused(tmp_path: Path) -> None:
    write_object(tmp_path / "mug")
    assert "(no manifest.json)" in refusal(tmp_path / "mug", "manifest.json")


def test_a_file_in_the_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("x")
    assert "expected a folder or a new name, got a file" in refusal(tmp_path / "file")


def test_a_file_that_appears_while_the_block_runs_is_kept(tmp_path: Path) -> None:
    final = tmp_path / "mug"

    def overtaken() -> None:
        with new_folder(final, MARKER) as inside:
            (inside / MARKER).write_text("{}")
            final.mkdir()
            (final / "notes.txt").write_text("mine")

    with pytest.raises(QsgmError, match=r"notes\.txt"):
        overtaken()
    assert names(final) == ["notes.txt"]
    assert names(tmp_path) == ["mug"]


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (OSError(5, "Input/output error"), QsgmError("input/output error")),
        (KeyboardInterrupt(), KeyboardInterrupt()),
    ],
)
def test_whatever_ends_a_replacement_in_two_steps_the_old_folder_comes_back(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: BaseException,
    expected: BaseException,
) -> None:
    write_object(tmp_path / "mug", "old")
    rename = Path.rename

    def fails_for_the_new_one(self: Path, target: Path) -> Path:
        if self.name == "new":
            raise error
        return rename(self, target)

    monkeypatch.setattr(files, "_exchange", lambda *_: False)
    monkeypatch.setattr(Path, "rename", fails_for_the_new_one)
    with pytest.raises(type(expected), match=str(expected) or None):
        write_object(tmp_path / "mug", "new")
    assert (tmp_path / "mug" / MARKER).read_text() == "old"
    assert names(tmp_path) == ["mug"]


def test_a_folder_without_its_marker_is_a_programming_error(tmp_path: Path) -> None:
    with (
        pytest.raises(ValueError, match=f"{MARKER} was not written"),
        new_folder(tmp_path / "final", MARKER),
    ):
        pass
    assert names(tmp_path) == []


def test_a_place_without_a_name_is_refused_in_one_line() -> None:
    with pytest.raises(QsgmError, match="cannot write /: it exists and is not a file"):
        write_bytes_atomic(Path("/"), b"x")
    assert "will not replace the folder /" in refusal(Path("/"))


def test_a_disk_that_fills_up_while_the_block_runs_is_reported_in_one_line(tmp_path: Path) -> None:
    def fill() -> None:
        with new_folder(tmp_path / "mug", MARKER):
            raise OSError(28, "No space left on device")

    with pytest.raises(QsgmError, match=r"cannot write .*mug: no space left on device; pass"):
        fill()
    assert names(tmp_path) == []


def test_a_foreign_folder_is_refused_without_looking_further_than_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a" / "deep").mkdir(parents=True)
    (tmp_path / "a" / "deep" / "file").write_text("x")
    (tmp_path / "thesis.txt").write_text("mine")
    looked_into: list[Path] = []
    iterdir = Path.iterdir

    def watched(self: Path) -> Iterator[Path]:
        looked_into.append(self)
        return iterdir(self)

    monkeypatch.setattr(Path, "iterdir", watched)
    monkeypatch.setattr(Path, "rglob", pytest.fail)
    assert "'thesis.txt'" in refusal(tmp_path)
    assert looked_into
    assert set(looked_into) == {tmp_path}
