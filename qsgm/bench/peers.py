"""What else a training step could be made with, each measured in processes of its own.

The jobs are scripts under :mod:`qsgm.train.peers`, run by path and possibly by another Python: what
they are given is a file of arrays, and what they print says whether they did the same job. A peer
that is not there, or fails, is a line that says why; it is no reason to stop.
"""

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import qsgm
from qsgm.errors import QsgmError

SCRIPTS = Path(qsgm.__file__).parent / "train" / "peers"
STEPS = 405  # the first five are not timed
SECONDS = 10.0  # of steps in one process at most
TIME_LIMIT_S = 900.0  # of a process
LOSS_TOLERANCE = 1e-3  # relative to the largest: other products' rounding gives 1e-6
LONGEST_REASON = 200
ERROR = re.compile(r"[\w.]*(Error|Exception)\b")  # torch goes on with advice below it

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Peer:
    """How to run one."""

    name: str
    job: tuple[str, ...]  # a script and its first arguments
    losses: str  # those that the data says to expect
    install: str | None = None  # makes its own Python; None: the one that runs this


PEERS = (
    Peer("torch eager", ("torch_steps.py", "eager"), "losses"),
    Peer("torch.compile", ("torch_steps.py", "compile"), "losses"),
    Peer(
        "onnxruntime-training",
        ("ort_training_steps.py",),
        "plain_losses",
        "onnxruntime-training==1.19.2 'onnx<1.18' 'numpy<2' torch",
    ),
    Peer("executorch", ("torch_steps.py", "executorch"), "losses", "executorch torch"),
)


@dataclass(frozen=True)
class PeerRun:
    """One process."""

    step_seconds: float  # median
    total_seconds: float  # of the steps counted
    steps: int
    import_seconds: float  # from the start of the process to the end of its imports
    setup_seconds: float  # graphs, compilation and the first steps
    loss_difference: float  # of the first steps, relative to the largest loss
    version: str
    optimizer: str


def parse_interpreters(texts: Sequence[str]) -> dict[str, Path]:
    """Pythons by peer, such as executorch=/opt/et/bin/python.

    Raises:
        QsgmError: one is no such pair, or its peer needs no Python of its own.
    """
    names = [peer.name for peer in PEERS if peer.install]
    pairs = [text.partition("=")[::2] for text in texts]
    for text, (name, python) in zip(texts, pairs, strict=True):
        if name not in names or not python:
            expected = " or ".join(f"{known}=PYTHON" for known in names)
            raise QsgmError(f"{text!r} names no peer's Python: expected {expected}")
    return {name: Path(python) for name, python in pairs}


def interpreter_of(peer: Peer, interpreters: Mapping[str, Path]) -> Path:
    """The Python that runs a peer.

    Raises:
        QsgmError: it needs one of its own and none was given.
    """
    if peer.install is None:
        return Path(sys.executable)
    if peer.name not in interpreters:
        raise QsgmError(
            f"no Python was given that has it; `python3.11 -m venv DIR && DIR/bin/pip install "
            f"{peer.install}`, then pass --peer {peer.name}=DIR/bin/python"
        )
    return interpreters[peer.name]


def write_job(frame: Path, folder: Path, layers: int, path: Path) -> None:
    """Write what every peer gets, in a process of its own, which needs torch and onnx.

    Raises:
        QsgmError: says why it could not be made.
    """
    job = ["-m", "qsgm.train.peers.step_data", str(frame), str(folder), str(layers), str(STEPS)]
    output([sys.executable, *job, str(path)], os.environ | {"OMP_NUM_THREADS": "1"})


def run_peer(
    peer: Peer, interpreters: Mapping[str, Path], job: Path, threads: int, cache: Path
) -> PeerRun:
    """Some hundred steps in a process of its own, which keeps what it compiles in `cache`.

    Raises:
        QsgmError: says why there is nothing to report.
    """
    python = interpreter_of(peer, interpreters)
    script, *arguments = peer.job
    command = [str(python), str(SCRIPTS / script), *arguments]
    settings = {"OMP_NUM_THREADS": str(threads), "TORCHINDUCTOR_CACHE_DIR": str(cache)}
    # Nothing of this Python's packages may reach the other one.
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    began = time.time()
    printed = output([*command, str(job), str(threads), str(SECONDS)], inherited | settings)
    try:
        result = json.loads(printed.splitlines()[-1])
        with np.load(job) as data:
            expected = data[peer.losses]
        return read_run(result, expected, began)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise QsgmError("its job printed no result") from error


def read_run(result: Mapping[str, Any], expected: Array, began: float) -> PeerRun:
    """What a process printed that started at `began` [s since the epoch].

    Raises:
        QsgmError: its losses are not the `expected` ones (S,).
    """
    found = np.array(result["losses"], np.float64)
    if found.shape != expected.shape:
        raise ValueError(f"expected {expected.shape} losses, got {found.shape}")
    difference = float(np.abs(found - expected).max() / np.abs(expected).max())
    if not difference <= LOSS_TOLERANCE:
        raise QsgmError(f"it does another job: its losses differ by {100 * difference:.2g} %")
    return PeerRun(
        step_seconds=float(result["step_seconds"]),
        total_seconds=float(result["total_seconds"]),
        steps=int(result["steps"]),
        import_seconds=float(result["imported_at"]) - began,
        setup_seconds=float(result["setup_seconds"]),
        loss_difference=difference,
        version=str(result["version"]),
        optimizer=str(result["optimizer"]),
    )


def output(command: Sequence[str], environment: Mapping[str, str]) -> str:
    """What a process prints.

    Raises:
        QsgmError: it cannot be started, takes too long, or fails.
    """
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            check=False,
            env=environment,
            timeout=TIME_LIMIT_S,
        )
    except OSError as error:
        raise QsgmError(f"cannot run {command[0]}: {error.strerror}") from error
    except subprocess.TimeoutExpired as error:
        raise QsgmError(f"it took longer than {TIME_LIMIT_S:.0f} s") from error
    if done.returncode != 0:
        raise QsgmError(reason_in(done.stderr) or f"exit code {done.returncode}")
    return done.stdout


def reason_in(complaints: str) -> str:
    """The last error named on stderr, or the last line of it."""
    lines = [line.strip() for line in complaints.splitlines() if line.strip()]
    errors = [line for line in lines if ERROR.match(line)]
    return (errors or lines or [""])[-1][:LONGEST_REASON]
