"""Outputs appear whole or not at all, and nothing of the user's is ever deleted."""

import hashlib
import os
import re
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from qsgm import files
from qsgm.errors import QsgmError, as_text
from qsgm.files import (
    LISTING,
    check_replaceable,
    is_plain,
    new_folder,
    read_file,
    read_whole,
    remove_folder,
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


def refused_read(path: Path, most: int = 100) -> str:
    with pytest.raises(QsgmError, match="expected a note") as raised:
        read_file(path, most, "a note")
    assert str(raised.value).isprintable()
    return str(raised.value)


def test_only_a_regular_file_within_its_budget_is_read(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"x" * 100)
    assert read_file(tmp_path / "file", 100, "a note") == b"x" * 100
    assert read_file(tmp_path / "file", 1000, "a note") == b"x" * 100
    assert "has 0.0001 MB" in refused_read(tmp_path / "file", 99)


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")  # opening it would wait for a writer
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(tmp_path / "socket"))
    expected = {
        "pipe": "is not a regular file",
        "": "is a folder",
        "none": "does not exist",
        "one": "too many levels of symbolic links",
        "n" * 300: "file name too long",
        "file/below": "not a directory",
        "null\0byte": "null byte",
        "socket": "cannot read",
    }
    (tmp_path / "file").touch()
    for name, reason in expected.items():
        assert reason in refused_read(tmp_path / name)
    for device in ("/dev/zero", "/dev/null", "/dev/tty", "/dev/full"):
        if Path(device).exists():
            assert re.search("is not a regular file|cannot read", refused_read(Path(device)))


def test_a_file_that_says_it_has_no_size_is_read_to_its_end_or_its_budget() -> None:
    if not Path("/proc/self/status").exists():
        pytest.skip("there is no /proc")
    assert b"VmHWM" in read_file(Path("/proc/self/status"), 100_000, "a note")
    assert "expected a note of at most" in refused_read(Path("/proc/self/status"), 10)


def test_a_file_that_grows_to_its_budget_while_it_is_read_is_read_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"x" * 20)
    status = os.fstat

    def of_before(descriptor: int) -> os.stat_result:
        return os.stat_result([*status(descriptor)[:6], 10, *status(descriptor)[7:10]])

    monkeypatch.setattr(os, "fstat", of_before)
    assert len(read_file(tmp_path / "file", 20, "a note")) == 20
    assert "has 2e-05 MB" in refused_read(tmp_path / "file", 11)  # what was read at first fits


def test_a_file_nobody_may_read_or_memory_is_too_small_for_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for error, reason in (
        (PermissionError(13, "Permission denied"), "permission denied"),
        (OSError(5, "Input/output error"), "input/output error"),
        (MemoryError(), "memoryerror"),
    ):

        def fail(*_: object, error: BaseException = error) -> int:
            raise error

        monkeypatch.setattr(os, "open", fail)
        assert reason in refused_read(tmp_path / "file")


def test_links_in_a_circle_are_refused_as_a_place_to_write_to(tmp_path: Path) -> None:
    (tmp_path / "one").symlink_to("two")
    (tmp_path / "two").symlink_to("one")
    for path in (tmp_path / "one", tmp_path / "one" / "below", tmp_path / "null\0byte"):
        with pytest.raises(QsgmError, match="cannot write"):
            write_bytes_atomic(path, b"x")
        with pytest.raises(QsgmError, match="cannot write"):
            check_replaceable(path, MARKER)


def test_a_name_as_long_as_the_system_allows_can_be_written(tmp_path: Path) -> None:
    write_bytes_atomic(tmp_path / ("f" * 255), b"x")
    write_object(tmp_path / ("d" * 255))
    write_object(tmp_path / ("d" * 255), "again")
    assert (tmp_path / ("d" * 255) / MARKER).read_text() == "again"


@pytest.mark.parametrize("name", ["../x", "/x", "a/b", "a\\b", "", ".", "..", "a\nb", None, 3])
def test_only_a_name_without_a_way_is_plain(name: object) -> None:
    assert not is_plain(name)
    assert is_plain("日本 語.png")


def test_a_stale_workshop_is_swept_and_one_at_work_is_left_alone(tmp_path: Path) -> None:
    stale = tmp_path / ".qsgm-0123456789abcdef"
    (stale / "old" / "mug").mkdir(parents=True)
    (stale / "old" / "mug" / MARKER).write_text("what was to be replaced")
    (tmp_path / ".qsgm-mine").mkdir()
    with new_folder(tmp_path / "cup", MARKER) as inside:
        write_bytes_atomic(tmp_path / "file", b"x")
        (inside / MARKER).write_text("{}")
    assert names(tmp_path) == [".qsgm-mine", "cup", "file", "mug"]
    assert (tmp_path / "mug" / MARKER).read_text() == "what was to be replaced"


def test_what_is_removed_is_gone_from_the_disk_before_any_of_it_is_torn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not Path("/proc/self/fd").exists():
        pytest.skip("there is no /proc")
    write_object(tmp_path / "mug")
    synced: list[tuple[Path, bool, bool]] = []

    def note(descriptor: int) -> None:
        folder = Path(f"/proc/self/fd/{descriptor}").readlink()
        whole = any(tmp_path.rglob(f".qsgm-*/**/{MARKER}"))
        synced.append((folder, (tmp_path / "mug").exists(), whole))

    monkeypatch.setattr(os, "fsync", note)
    remove_folder(tmp_path / "mug", MARKER)
    assert (tmp_path, False, True) in synced


def test_a_removal_that_the_disk_did_not_confirm_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: int) -> None:
        raise OSError(5, "Input/output error")

    write_object(tmp_path / "mug")
    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(QsgmError, match="input/output error"):
        remove_folder(tmp_path / "mug", MARKER)


def test_a_folder_is_read_again_only_if_it_was_replaced(tmp_path: Path) -> None:
    write_object(tmp_path / "mug", "old")
    tried = 0

    def load() -> str:
        nonlocal tried
        tried += 1
        if tried == 1:
            write_object(tmp_path / "mug", "new")
            raise QsgmError("half of this, half of that")
        return (tmp_path / "mug" / MARKER).read_text()

    def damaged() -> str:
        nonlocal tried
        tried += 1
        raise QsgmError("damaged")

    assert read_whole(tmp_path / "mug", load) == "new"
    tried = 0
    with pytest.raises(QsgmError, match="damaged"):
        read_whole(tmp_path / "mug", damaged)
    assert tried == 1


def test_a_message_is_one_printable_line_whatever_is_in_it() -> None:
    message = str(QsgmError("mug\x1b[31m\nred\u202e\udcff" + "x" * 10**6))
    assert message.isprintable()
    assert message.startswith("mug\\x1b[31m\\nred\\u202e\\udcff")
    assert len(message) < 10_000
    assert as_text("日本語 grüße") == "日本語 grüße"


def test_a_folder_that_another_process_is_about_to_replace_is_waited_for(tmp_path: Path) -> None:
    write_object(tmp_path / "mug", "old")
    tried = 0

    with files._workshop(tmp_path) as workshop:  # held, as by another process
        taken_away = workshop / "old" / "mug"
        taken_away.parent.mkdir()
        (tmp_path / "mug").rename(taken_away)

        def load() -> str:
            nonlocal tried
            tried += 1
            if tried == 3:
                taken_away.rename(tmp_path / "mug")
            if not (tmp_path / "mug").exists():
                raise QsgmError("there is nothing")
            return (tmp_path / "mug" / MARKER).read_text()

        assert read_whole(tmp_path / "mug", load) == "old"
    assert tried == 3


def test_an_output_that_is_replaced_while_it_is_checked_is_checked_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_object(tmp_path / "mug", "old")
    entries, replaced = files._entries, False

    def replacing(folder: Path) -> Iterator[str]:
        nonlocal replaced
        if not replaced and folder == tmp_path / "mug":
            replaced = True
            write_object(folder, "new")
            raise FileNotFoundError(2, "No such file or directory")
        return entries(folder)

    monkeypatch.setattr(files, "_entries", replacing)
    check_replaceable(tmp_path / "mug", MARKER)
    assert replaced
