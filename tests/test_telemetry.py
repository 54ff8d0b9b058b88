"""ONNX Runtime reports nothing home from a process that runs qsgm, and leaves no trace there.

Seen with 1.32.0 and nothing done against it: two files in the cache as soon as it is imported, a
forked child that never ends, and after nine seconds a first look-up of the collector.
"""

import ast
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
PROC = Path("/proc")
WATCHED_S = 3 if "CI" in os.environ else 12
# The look-up of a collector that cannot be found takes only milliseconds.
BETWEEN_LOOKS_S = 0.002
# What a fresh interpreter needs. None of the variables is among them by which ONNX Runtime knows
# a build machine, on which it keeps quiet by itself, nor the one that qsgm has set in this process.
KEPT = ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV")
OWN_FOLDERS = ("HOME", "TMPDIR", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME")
OWN_FOLDERS += ("XDG_RUNTIME_DIR", "XDG_STATE_HOME")

needs_proc = pytest.mark.skipif(not (PROC / "self/fd").exists(), reason="there is no /proc")

# Tunes, lets a forked child end as any Python ends, says whether it did, and stays for a while.
RUN = """
import os, sys, time
from pathlib import Path
from qsgm import Settings, finetune, load_bundle, read_frame

frame, bundle, watched = sys.argv[1:]
start = time.monotonic()
finetune(read_frame(Path(frame)), load_bundle(Path(bundle)), Settings(epochs=1))
child = os.fork()
if child == 0:
    sys.exit()
give_up = time.monotonic() + 10
while not (ended := os.waitpid(child, os.WNOHANG)[0]) and time.monotonic() < give_up:
    time.sleep(0.01)
if not ended:
    os.kill(child, 9)
    os.waitpid(child, 0)
print("ended" if ended else "hangs")
time.sleep(max(0.0, start + float(watched) - time.monotonic()))
"""


@dataclass(frozen=True)
class Watched:
    """What was seen of a run."""

    files: list[str]
    sockets: set[str]
    child: str


@pytest.fixture(scope="module")
def watched(
    bundle_folder: Path, frames_folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> Watched:
    if not hasattr(os, "fork"):
        pytest.skip("this system does not fork")
    home = tmp_path_factory.mktemp("home")
    environment = fresh_environment()
    for name in OWN_FOLDERS:
        (home / name).mkdir()
        environment[name] = str(home / name)
    arguments = [str(frames_folder / "bar.png"), str(bundle_folder), str(WATCHED_S)]
    with subprocess.Popen(
        [sys.executable, "-c", RUN, *arguments],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        sockets = set()
        while process.poll() is None:
            sockets |= set(open_sockets(process.pid))
            time.sleep(BETWEEN_LOOKS_S)
        said, complaints = process.communicate()
    assert process.returncode == 0, complaints
    files = [str(path.relative_to(home)) for path in home.rglob("*") if not path.is_dir()]
    return Watched(files, sockets, said.strip())


def fresh_environment() -> dict[str, str]:
    return {name: os.environ[name] for name in KEPT if name in os.environ}


def open_sockets(process: int) -> Iterator[str]:
    """Of a process that may end at any moment; nothing where there is no /proc."""
    try:
        for descriptor in (PROC / str(process) / "fd").iterdir():
            try:
                target = str(descriptor.readlink())
            except OSError:
                continue  # closed in the meantime
            if target.startswith("socket:"):
                yield target
    except OSError:
        return


def test_nothing_is_written_into_the_users_folders(watched: Watched) -> None:
    assert watched.files == []


@needs_proc
def test_no_socket_is_opened(watched: Watched) -> None:
    assert watched.sockets == set()


def test_a_forked_child_that_ends_normally_ends(watched: Watched) -> None:
    assert watched.child == "ended"


@needs_proc
def test_a_socket_would_be_seen() -> None:
    before = set(open_sockets(os.getpid()))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM):
        assert len(set(open_sockets(os.getpid())) - before) == 1


@pytest.mark.parametrize(("own", "kept"), [(None, "1"), ("0", "0")])
def test_telemetry_is_off_unless_the_user_has_a_setting(own: str | None, kept: str) -> None:
    name = "ORT_DISABLE_TELEMETRY"
    done = subprocess.run(
        [sys.executable, "-c", f"import os, qsgm; print(os.environ[{name!r}])"],
        env=fresh_environment() | ({} if own is None else {name: own}),
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == kept


def test_no_script_imports_onnx_runtime_before_qsgm() -> None:
    early = []
    for script in BENCHMARKS.glob("*.py"):
        imported = [name for name in top_level_imports(script) if name in ("qsgm", "onnxruntime")]
        if imported[:1] == ["onnxruntime"]:
            early.append(script.name)
    assert early == []


def top_level_imports(script: Path) -> Iterator[str]:
    """Packages, in order."""
    for node in ast.parse(script.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield (node.module or "").partition(".")[0]
