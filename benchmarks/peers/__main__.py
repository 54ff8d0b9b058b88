"""A training step here and in other frameworks, by threads: the same job on the same batches.

    python benchmarks/peers FRAMES [--peer NAME=PYTHON] [--threads 1,2] [--repeats 5] [--layers 3]
        [--json FILE]

torch and torch.compile run in this Python; onnxruntime-training and executorch need one of their
own, which `--peer` names. Own steps take turns in this process, peers take turns with that in
processes of their own, so that whatever else the machine does hits all of them. A peer is given a
file of arrays, and its first losses say whether it did the same job; one that is not there, or
fails, is a line that says why.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from qsgm import load_bundle
from qsgm.bench.frames import list_frames
from qsgm.bench.timing import step_seconds
from qsgm.bundle import Bundle
from qsgm.tables import table

SCRIPTS = Path(__file__).parent
# A script and its first arguments, and which losses its data says to expect.
PEERS = {
    "torch": (("torch_steps.py", "eager"), "losses"),
    "torch.compile": (("torch_steps.py", "compile"), "losses"),
    "onnxruntime-training": (("ort_training_steps.py",), "plain_losses"),
    "executorch": (("torch_steps.py", "executorch"), "losses"),
}
INSTALL = {
    "onnxruntime-training": "onnxruntime-training==1.19.2 'onnx<1.18' 'numpy<2' torch",
    "executorch": "executorch torch",
}
OWN_STEP = "sgm_float"  # that others are compared with
TURNS = 400  # of every kind of own step
STEPS = 405  # of a peer; the first five are not timed
SECONDS = 10.0  # of steps in one process at most
TIME_LIMIT_S = 900.0  # of a process
LOSS_TOLERANCE = 1e-3  # relative to the largest: other products' rounding gives 1e-6
ERROR = re.compile(r"[\w.]*(Error|Exception)\b")  # torch goes on with advice below it


class PeerError(Exception):
    """Why a peer is not measured."""


def write_job(frame: Path, bundle: Bundle, layers: int, path: Path) -> None:
    """Write what every peer gets, in a process of its own: torch must not slow down this one."""
    job = [str(frame), str(bundle.folder), str(layers), str(STEPS), str(path)]
    output([sys.executable, str(SCRIPTS / "step_data.py"), *job], os.environ)


def run_peer(name: str, python: Path, job: Path, threads: int) -> dict[str, Any]:
    """Some hundred steps in a process of its own, which keeps what it compiles beside its job."""
    (script, *arguments), losses = PEERS[name]
    command = [str(python), str(SCRIPTS / script), *arguments, str(job), str(threads), str(SECONDS)]
    cache = str(job.parent / f"compiled_{threads}")
    # Nothing of this Python's packages may reach the other one.
    inherited = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    began = time.time()
    printed = output(
        command, inherited | {"OMP_NUM_THREADS": str(threads), "TORCHINDUCTOR_CACHE_DIR": cache}
    )
    try:
        result: dict[str, Any] = json.loads(printed.splitlines()[-1])
        result["import_seconds"] = result.pop("imported_at") - began
        with np.load(job) as data:
            expected = data[losses]
        difference = np.abs(result.pop("losses") - expected).max() / np.abs(expected).max()
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise PeerError("its job printed no result") from error
    if not difference <= LOSS_TOLERANCE:
        raise PeerError(f"it does another job: its losses differ by {100 * difference:.2g} %")
    return result | {"loss_difference": float(difference)}


def output(command: Sequence[str], environment: Mapping[str, str]) -> str:
    """What a process prints; PeerError where it cannot be started, takes too long, or fails."""
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env=environment,
            timeout=TIME_LIMIT_S,
        )  # fmt: skip
    except OSError as error:
        raise PeerError(f"cannot run {command[0]}: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise PeerError(f"it took longer than {TIME_LIMIT_S:.0f} s") from error
    if done.returncode != 0:
        lines = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        errors = [line for line in lines if ERROR.match(line)]
        raise PeerError((errors or lines or [f"exit code {done.returncode}"])[-1][:200])
    return done.stdout


def measure(asked: argparse.Namespace, pythons: Mapping[str, Path]) -> dict[str, Any]:
    """Own steps and the peers', by number of threads; and which peers are not measured, and why."""
    bundle, missing = load_bundle(asked.bundle), {}
    own: dict[int, list[dict[str, float]]] = {count: [] for count in asked.threads}
    runs: dict[int, dict[str, list[dict[str, Any]]]] = {count: {} for count in asked.threads}
    for name in PEERS.keys() - pythons.keys():
        missing[name] = (
            f"no Python was given that has it; `python3.11 -m venv DIR && DIR/bin/pip install "
            f"{INSTALL[name]}`, then pass --peer {name}=DIR/bin/python"
        )
    with tempfile.TemporaryDirectory() as home:
        job = Path(home, "job.npz")
        write_job(list_frames(asked.frames, 1)[0].path, bundle, asked.layers, job)
        turns = [count for _ in range(asked.repeats) for count in asked.threads]
        for count in track(turns, console=Console(stderr=True)):
            own[count].append(step_seconds(bundle, asked.layers, asked.turns, count))
            for name in [name for name in pythons if name not in missing]:
                try:
                    result = run_peer(name, pythons[name], job, count)
                    runs[count].setdefault(name, []).append(result)
                except PeerError as error:
                    missing[name] = str(error)
    steps = {
        count: {name: 1000 * median(turn[name] for turn in some) for name in some[0]}
        | {
            name: 1000 * median(run["step_seconds"] for run in results)
            for name, results in runs[count].items()
            if name not in missing
        }
        for count, some in own.items()
    }
    return {"layers": asked.layers, "step_ms": steps, "peers": runs, "not_measured": missing}


def rows_of(values: Mapping[str, Any]) -> list[list[object]]:
    """A row per kind of step: ms and ratio by threads, what a peer takes before its first step."""
    counts = [*values["step_ms"]]
    rows: list[list[object]] = []
    for name in values["step_ms"][counts[0]]:
        row: list[object] = [name]
        for steps in values["step_ms"].values():
            row += [steps.get(name), steps[name] / steps[OWN_STEP]]
        runs = values["peers"][counts[0]].get(name, [{}])
        rows.append([*row, runs[0].get("import_seconds"), runs[0].get("setup_seconds")])
    return rows


def parsed_peer(text: str) -> tuple[str, Path]:
    """A peer and its Python, such as executorch=ET/bin/python."""
    name, _, python = text.partition("=")
    if name not in PEERS or not python:
        expected = " or ".join(f"{known}=PYTHON" for known in PEERS)
        raise argparse.ArgumentTypeError(f"{text!r} names no peer's Python: expected {expected}")
    return name, Path(python)


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("frames", type=Path)
    parser.add_argument("--peer", type=parsed_peer, action="append", default=[])
    parser.add_argument("--threads", type=lambda text: [*map(int, text.split(","))], default=[1, 2])
    parser.add_argument("--repeats", type=int, default=5, help="processes of every peer")
    parser.add_argument("--turns", type=int, default=TURNS, help="own steps in each repeat")
    parser.add_argument("--layers", type=int, default=3)
    parser.add_argument("--bundle", type=Path, default=Path("export"))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    here = {name: Path(sys.executable) for name in PEERS if name not in INSTALL}
    values = measure(asked, here | dict(asked.peer))
    columns: list[str | tuple[str, str]] = [""]
    for count in asked.threads:
        columns += [(f"ms,\nthreads: {count}", "{:.3f}"), (f"over\n{OWN_STEP}", "{:.2f}")]
    columns += [("import\n[s]", "{:.1f}"), ("set-up\n[s]", "{:.1f}")]
    console = Console()
    title = f"a training step of {asked.layers} layers, 32 crops"
    console.print(table(title, columns, rows_of(values)))
    for name, why in values["not_measured"].items():
        console.print(f"{name} is not measured: {why}", markup=False)
    if asked.json is not None:
        asked.json.write_text(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
