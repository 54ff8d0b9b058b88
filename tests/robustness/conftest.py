"""Counts of what was tried, printed at the end, and how much of it to try.

CI tries a little, the same every time. `make robustness` tries fifty times as much; another number
and another seed are set by QSGM_ROBUSTNESS and QSGM_ROBUSTNESS_SEED.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from qsgm.bundle import Bundle

TIMES = int(os.environ.get("QSGM_ROBUSTNESS", "1"))
SEED = int(os.environ.get("QSGM_ROBUSTNESS_SEED", "0"))
HERE = Path(__file__).parent
_COUNTS = pytest.StashKey[list[str]]()
Campaign = Callable[..., dict[str, int]]


def pytest_configure(config: pytest.Config) -> None:
    config.stash[_COUNTS] = []


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    if config.stash[_COUNTS]:
        terminalreporter.section("robustness: what was tried")
        for line in config.stash[_COUNTS]:
            terminalreporter.write_line(line)


@pytest.fixture
def campaign(request: pytest.FixtureRequest) -> Campaign:
    """A script of this folder in a process of its own: the counts that it prints, as JSON.

    What it finds it says by failing; a crash is one more way to fail. `rounds` grow with TIMES.
    """

    def run(script: str, *arguments: object, rounds: int = 1) -> dict[str, int]:
        command = [sys.executable, "-m", f"robustness.{script}", *map(str, arguments)]
        done = subprocess.run(
            [*command, str(SEED), str(rounds * TIMES)],
            env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{done.returncode}\n{done.stdout}\n{done.stderr[-4000:]}"
        counts: dict[str, int] = json.loads(done.stdout.splitlines()[-1])
        said = ", ".join(f"{number} {name}" for name, number in counts.items())
        request.config.stash[_COUNTS].append(f"{request.node.name}: {said}")
        return counts

    return run


@pytest.fixture(scope="session")
def networks(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two, of which one differs in a bias."""
    folder = tmp_path_factory.mktemp("networks")
    weights = bundle.start_weights(bundle.network.last(1))
    weights["bias6"] = weights["bias6"] + 1
    for name, changed in (("old", {}), ("new", weights)):
        (folder / f"{name}.onnx").write_bytes(bundle.network_with(changed))
    return [folder / "old.onnx", folder / "new.onnx"]
