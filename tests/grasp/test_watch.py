"""Frames of a video, of pictures: each is read, in order, and looked at by every object."""

import math
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from toy_objects import HOOK_AT, TOY_AT, both_on_a_table, hook, teach
from toys import toy

import qsgm
from qsgm import QsgmError, load_object, watch
from qsgm.grasp import watch as watching
from qsgm.grasp.watch import new_video, open_stream
from qsgm.images import write_png

FRAMES, RATE, STEP_PX = 6, 20.0, 12.0


@pytest.fixture
def belt(tmp_path: Path) -> Path:
    """A video in which the toy moves to the right and the hook lies still."""
    return write_video(
        tmp_path / "belt.avi", [both_on_a_table(STEP_PX * number) for number in range(FRAMES)]
    )


@pytest.fixture
def objects(tmp_path: Path) -> list[qsgm.TunedObject]:
    pictures = {"toy": toy(), "hook": hook()}
    return [load_object(teach(tmp_path / name, name, one)) for name, one in pictures.items()]


def write_video(path: Path, frames: list[NDArray[np.uint8]]) -> Path:
    codec = cv2.VideoWriter.fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), cv2.CAP_OPENCV_MJPEG, codec, RATE, frames[0].shape[1::-1])
    if not writer.isOpened():
        pytest.skip("this OpenCV writes no MJPG in AVI")
    for frame in frames:
        writer.write(frame)
    writer.release()
    return path


def test_every_frame_of_a_video_says_where_each_object_is(
    belt: Path, objects: list[qsgm.TunedObject]
) -> None:
    number = 0
    for number, seen in enumerate(watch(belt, objects)):
        assert (seen.number, seen.seconds) == (number, number / RATE)
        assert 0 < seen.latency_ms < 60_000
        first, second = seen.sights
        assert (first.name, second.name) == ("toy", "hook")
        where = TOY_AT[0] + STEP_PX * number, TOY_AT[1]
        assert math.dist(first.detection.center_px, where) < 3
        assert math.dist(second.detection.center_px, HOOK_AT) < 3
    assert number == FRAMES - 1


@pytest.mark.parametrize(
    ("every", "limit", "numbers"),
    [(1, None, [0, 1, 2, 3, 4, 5]), (2, None, [0, 2, 4]), (4, None, [0, 4]), (2, 2, [0, 2])],
)
def test_one_frame_in_so_many_is_looked_at_and_at_most_so_many(
    belt: Path, tmp_path: Path, every: int, limit: int | None, numbers: list[int]
) -> None:
    assert [seen.number for seen in watch(belt, [], every, limit)] == numbers
    for number in range(FRAMES):
        write_png(tmp_path / f"{number}.png", both_on_a_table())
    assert [seen.number for seen in watch(tmp_path, [], every, limit)] == numbers


def test_pictures_come_in_the_order_of_the_numbers_in_their_names(tmp_path: Path) -> None:
    for number in (10, 9, 1):
        write_png(tmp_path / f"f{number}.png", np.full((128, 128, 3), number, np.uint8))
    (tmp_path / "notes.txt").write_text("mine")
    for source in (tmp_path, str(tmp_path / "f*.png"), tmp_path / "f*"):
        levels = [int(seen.frame.max()) for seen in watch(source, [])]
        assert levels == [1, 9, 10]
    assert [seen.number for seen in watch(tmp_path / "f9.png", [])] == [0]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.avi", b"RIFF\x10\0\0\0AVI garbage"),
        ("a.mp4", b"\0\0\0\x18ftypisom" + bytes(40)),
        ("a.mkv", b"\x1a\x45\xdf\xa3garbage"),
        ("playlist.avi", b"#EXTM3U\n#EXTINF:1,\nhttp://localhost:1/a.ts\n"),
        ("list.avi", b"ffconcat version 1.0\nfile /etc/passwd\n"),
        ("a.txt", b"words"),
        ("empty.avi", b""),
        ("none*.png", None),
        ("missing.avi", None),
        ("http://localhost:1/a.avi", None),
        ("98", None),
        ("9" * 30, None),
    ],
)
def test_what_is_no_stream_is_refused_in_one_line(
    tmp_path: Path,
    name: str,
    content: bytes | None,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    if content is not None:
        Path(name).write_bytes(content)
    with pytest.raises(QsgmError, match=r"expected a camera's number, a video file") as raised:
        list(watch(name, []))
    assert "\n" not in str(raised.value)
    assert capfd.readouterr().err == ""


def test_a_number_is_a_camera_unless_there_is_something_of_that_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("7").mkdir()
    write_png(Path("7/0.png"), both_on_a_table())
    assert len(list(watch("7", []))) == 1
    for camera in ("98", 7):
        with pytest.raises(QsgmError, match=f"cannot open camera {camera}:"):
            open_stream(camera)


def test_a_video_that_is_cut_off_ends_where_it_ends(
    belt: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    data = belt.read_bytes()
    belt.write_bytes(data[: len(data) // 2])
    seen = list(watch(belt, []))
    assert 0 < len(seen) < FRAMES
    assert capfd.readouterr().err == ""


def test_a_video_of_huge_frames_is_refused_before_any_is_decoded(
    belt: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(watching, "MAX_SIDE_PX", 500)
    with pytest.raises(QsgmError, match="frames of 640x480 px: expected at most 500"):
        open_stream(belt)


def test_a_picture_that_is_none_ends_the_stream_by_its_name(tmp_path: Path) -> None:
    write_png(tmp_path / "0.png", both_on_a_table())
    (tmp_path / "1.png").write_bytes(b"no picture")
    stream = watch(tmp_path, [])
    assert next(stream).number == 0
    with pytest.raises(QsgmError, match=r"1\.png is not a PNG"):
        next(stream)


def test_one_object_used_by_several_threads_gives_the_same_answers(
    objects: list[qsgm.TunedObject], tmp_path: Path
) -> None:
    scenes = [both_on_a_table(STEP_PX * number) for number in range(4)] * 2
    alone = [load_object(tmp_path / "toy").locate(scene)[0] for scene in scenes]
    with ThreadPoolExecutor(4) as pool:  # nothing of it was used before
        together = list(pool.map(lambda scene: objects[0].locate(scene)[0], scenes))
    assert together == alone


def test_a_video_appears_whole_when_it_is_finished(tmp_path: Path) -> None:
    path = tmp_path / "seen.avi"
    with new_video(path, RATE) as write:
        for side in (200, 200, 160):  # of another size than the first one: scaled
            assert write(np.full((side, 2 * side, 3), 90, np.uint8))
        assert not path.exists()
    read = [seen.frame for seen in watch(path, [])]
    assert [frame.shape for frame in read] == [(200, 400, 3)] * 3
    assert open_stream(path).rate == RATE
    assert [one.name for one in tmp_path.iterdir()] == ["seen.avi"]


def test_a_video_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "seen.avi"
    path.write_bytes(b"old")

    def fail() -> None:
        with new_video(path, RATE) as write:
            write(np.zeros((200, 200, 3), np.uint8))
            raise QsgmError("a frame is damaged")

    with pytest.raises(QsgmError, match="a frame is damaged"):
        fail()
    with pytest.raises(QsgmError, match="0 frames did not make a whole video"), new_video(path, 1):
        pass
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["seen.avi"]


def test_a_video_that_lost_its_end_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a disk that is full, of which OpenCV says nothing."""
    check = watching._check_written

    def cut(path: Path, new: Path, frames: int) -> None:
        new.write_bytes(new.read_bytes()[:-100])
        check(path, new, frames)

    monkeypatch.setattr(watching, "_check_written", cut)
    with (
        pytest.raises(QsgmError, match="1 frames did not make a whole video"),
        new_video(tmp_path / "seen.avi", None) as write,
    ):
        write(np.zeros((200, 200, 3), np.uint8))
    assert list(tmp_path.iterdir()) == []
