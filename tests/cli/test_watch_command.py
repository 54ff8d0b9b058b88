"""`qsgm watch`: a JSON line a frame, and a clean end whatever ends it."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from command_line import Run, assert_refused
from toy_objects import TOY_AT, both_on_a_table, hook, teach
from toys import lay, table, toy

from qsgm import paths, watch
from qsgm.cli.watching import _follow
from qsgm.images import write_png

FRAMES = 3
QSGM = (sys.executable, "-m", "qsgm.cli")


@pytest.fixture
def belt(tmp_path: Path) -> Path:
    """A folder of frames, and two objects of which the toy was used last."""
    for name, picture in (("hook", hook()), ("toy", toy())):
        folder = teach(paths.folder_named(name), name, picture)
        paths.remember_object(folder)
    frames = tmp_path / "belt"
    frames.mkdir()
    for number in range(FRAMES):
        write_png(frames / f"{number}.png", both_on_a_table())
    return frames


def test_every_frame_is_a_json_line_and_the_speed_is_on_stderr(qsgm: Run, belt: Path) -> None:
    outcome = qsgm("watch", belt, "--object", "toy", "--object", "hook")
    assert outcome.code == 0
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2]
    for line in lines:
        assert line.keys() == {"frame", "seconds", "latency_ms", "objects"}
        assert [one["object"] for one in line["objects"]] == ["toy", "hook"]
        first = line["objects"][0]
        assert first["found"]
        assert first["center_px"] == pytest.approx(TOY_AT, abs=2)
        assert {"angle_deg", "full_angle_deg", "quality"} <= first.keys()
    assert outcome.err.startswith("3 frames in ")
    assert "frames/s; latency" in outcome.err
    last = qsgm("watch", belt, "--every", 2, "--limit", 1)
    assert [one["object"] for one in json.loads(last.out)["objects"]] == ["toy"]


def test_an_annotated_video_is_written(qsgm: Run, belt: Path, tmp_path: Path) -> None:
    outcome = qsgm("watch", belt, "-o", tmp_path / "seen.avi", "--object", "hook")
    assert outcome.code == 0, outcome.err
    assert "seen.avi" in outcome.err
    (first, *_) = seen = [one.frame for one in watch(tmp_path / "seen.avi", [])]
    assert len(seen) == FRAMES
    assert cv2.absdiff(first, both_on_a_table()).max() > 100


def test_a_video_has_a_videos_name_and_does_not_replace_its_source(
    qsgm: Run, belt: Path, tmp_path: Path
) -> None:
    assert_refused(qsgm("watch", belt, "-o", tmp_path / "a.png"), 1, "ends in .avi")
    source = tmp_path / "a.avi"
    source.write_bytes((belt / "0.png").read_bytes())
    assert_refused(qsgm("watch", source, "-o", source), 1, "will not write over")


def test_a_damaged_frame_leaves_no_video(qsgm: Run, belt: Path, tmp_path: Path) -> None:
    (belt / "2.png").write_bytes(b"")
    outcome = qsgm("watch", belt, "-o", tmp_path / "seen.avi")
    assert (outcome.code, len(outcome.out.splitlines())) == (1, 2)
    assert "2.png is empty" in outcome.err.splitlines()[-1]
    assert not (tmp_path / "seen.avi").exists()


def test_the_summary_of_a_stream_without_frames_is_of_zeros(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert _follow(iter(()), None) is None
    out, err = capsys.readouterr()
    assert out == ""
    frames, latency = err.splitlines()[0].split("; ")
    assert frames.startswith("0 frames in ")
    assert frames.endswith(" s: 0.0 frames/s")
    assert latency == "latency 0 ms median, 0 ms at the 95th percentile"


def test_an_interrupt_ends_with_a_summary_and_a_whole_video(belt: Path, tmp_path: Path) -> None:
    for number in range(FRAMES, 400):
        os.link(belt / "0.png", belt / f"{number}.png")
    command = [*QSGM, "watch", str(belt), "-o", str(tmp_path / "seen.avi")]
    running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert running.stdout is not None
    lines = [running.stdout.readline(), running.stdout.readline()]
    running.send_signal(signal.SIGINT)
    out, err = running.communicate()
    assert running.returncode == 130
    told = err.splitlines()
    assert [told[0].split()[1], told[1][:6], told[2:]] == ["frames", "video:", ["interrupted"]]
    lines += out.splitlines()
    assert [json.loads(line)["frame"] for line in lines] == list(range(len(lines)))
    assert len(lines) - 1 <= len(list(watch(tmp_path / "seen.avi", []))) <= len(lines)
    assert not list(tmp_path.glob(".qsgm-*"))


def test_a_reader_that_goes_away_ends_it_without_a_complaint(belt: Path) -> None:
    command = f"{' '.join(QSGM)} watch {belt} | head -n 1; echo ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    line, code = done.stdout.splitlines()
    assert json.loads(line)["frame"] == 0
    assert code == "141"
    assert "Traceback" not in done.stderr
    assert len(done.stderr.splitlines()) == 1  # the summary


def test_a_full_disk_behind_stdout_is_one_line_and_the_video_is_whole(
    belt: Path, tmp_path: Path
) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full")
    with Path("/dev/full").open("w") as full:
        command = [*QSGM, "watch", str(belt), "-o", str(tmp_path / "seen.avi")]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.returncode == 1
    told = done.stderr.splitlines()
    assert [told[0][:11], told[1][:6]] == ["1 frames in", "video:"]
    assert told[2].startswith("error: cannot write to standard output: no space left on device")
    assert told[3:] == []
    assert len(list(watch(tmp_path / "seen.avi", []))) == 1


def test_without_a_stdout_the_video_is_written_all_the_same(belt: Path, tmp_path: Path) -> None:
    command = f"{' '.join(QSGM)} watch {belt} -o {tmp_path / 'seen.avi'} >&-"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert [line.split()[1] for line in done.stderr.splitlines()][:1] == ["frames"]
    assert len(list(watch(tmp_path / "seen.avi", []))) == FRAMES


def test_any_distance_finds_what_predict_finds_by_itself_at_another_one(
    qsgm: Run, tmp_path: Path
) -> None:
    paths.remember_object(teach(paths.folder_named("toy"), "toy", toy()))
    picture, middle = tmp_path / "near.png", (300.0, 240.0)
    write_png(picture, lay(toy(), table(4), middle, 40, 2.2))
    (here,) = json.loads(qsgm("watch", picture).out)["objects"]
    (near,) = json.loads(qsgm("watch", picture, "--any-distance").out)["objects"]
    assert [here["found"], near["found"]] == [False, True]
    assert near["center_px"] == pytest.approx(middle, abs=3)
    told, same = (
        qsgm("predict", "--json", *how, picture).json for how in ((), ("--same-distance",))
    )
    assert {key: told[key] for key in near} == near
    assert not same["found"]
