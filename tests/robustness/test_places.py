"""Disks that are full or read-only, folders that nobody may write to, users without a home."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from qsgm import load_object


def qsgm(*arguments: object, before: str = "", **environment: str) -> "subprocess.CompletedProcess":
    """The command line, after shell commands in a name space for mounts of its own if there are."""
    command = [sys.executable, "-m", "qsgm.cli", *map(str, arguments)]
    if before:
        command = ["unshare", "--mount", "bash", "-c", f'{before} && exec "$@"', "bash", *command]
    return subprocess.run(
        command, env=os.environ | environment, capture_output=True, text=True, check=False
    )


def skip_unless_mounted(before: str) -> None:
    if shutil.which("unshare") is None:
        pytest.skip("there is no unshare")
    tried = subprocess.run(
        ["unshare", "--mount", "bash", "-c", before], capture_output=True, text=True, check=False
    )
    if tried.returncode:
        pytest.skip(f"a mount is refused: {tried.stderr.strip()}")


@pytest.fixture
def finetune(bundle_folder: Path, frame_path: Path) -> list[object]:
    return ["finetune", "--epochs", 0, "--bundle", bundle_folder, frame_path]


def refused(done: "subprocess.CompletedProcess", reason: str) -> None:
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("\n") == 1
    assert reason in done.stderr


def test_a_full_disk_is_one_line_and_the_old_object_stays(
    finetune: list[object], tmp_path: Path
) -> None:
    disk, first = tmp_path / "disk", tmp_path / "first"
    disk.mkdir()
    mount = f"mount -t tmpfs -o size=200k tmpfs {disk}"
    skip_unless_mounted(mount)
    assert qsgm(*finetune, "-o", first).returncode == 0
    before = f"{mount} && cp -r {first} {disk}/mug && ! cat /dev/zero >{disk}/filler 2>/dev/null"
    # The mount ends with the process: what is left is compared in the same shell.
    done = qsgm(
        *finetune,
        "-o",
        disk / "mug",
        before=f'{before} && ! "$@" && set -- diff -r {first} {disk}/mug',
    )
    assert (done.returncode, done.stdout) == (0, "")
    assert "no space left on device" in done.stderr


def test_a_read_only_disk_is_one_line(finetune: list[object], tmp_path: Path) -> None:
    before = f"mount --bind {tmp_path} {tmp_path} && mount -o remount,ro,bind {tmp_path}"
    skip_unless_mounted(before)
    refused(qsgm(*finetune, "-o", tmp_path / "mug", before=before), "read-only file system")
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_nobody_may_write_to_is_one_line(
    finetune: list[object], tmp_path: Path
) -> None:
    if os.geteuid() == 0:
        pytest.skip("root may write everywhere")
    tmp_path.chmod(0o555)
    refused(qsgm(*finetune, "-o", tmp_path / "mug"), "permission denied")


def test_without_a_home_objects_go_where_o_says_and_nowhere_else(
    finetune: list[object], tmp_path: Path
) -> None:
    nowhere = {"HOME": "", "XDG_DATA_HOME": ""}
    done = qsgm(*finetune, "-o", tmp_path / "mug", **nowhere)
    assert done.returncode == 0
    assert done.stderr.count("\n") == 1
    assert "will need --object" in done.stderr
    assert load_object(tmp_path / "mug").description.name == "bar"
    refused(qsgm(*finetune, **nowhere), "no home folder")
    refused(qsgm("predict", finetune[-1], **nowhere), "no home folder")
    assert not Path("/.local/share/qsgm").exists()
