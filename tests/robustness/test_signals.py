"""A signal at any moment, from the first module that is loaded on, is one line."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from qsgm import load_object
from robustness.conftest import HERE, SEED, TIMES

CODES = {"SIGINT": 130, "SIGTERM": 143}
LOOK_UPS = 900  # `qsgm finetune` has some more


@pytest.mark.parametrize("name", CODES)
def test_a_signal_while_modules_load_is_one_line_and_a_code_of_its_own(
    name: str, bundle_folder: Path, frame_path: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng([SEED, CODES[name]])
    folder, ended = tmp_path / "mug", 0
    for number in rng.integers(1, LOOK_UPS, 2 * TIMES):
        script = [sys.executable, HERE / "signalled.py", name, number]
        command = [*script, "finetune", "--epochs", 0, "--bundle", bundle_folder, "-o", folder]
        done = subprocess.run(
            [*map(str, command), str(frame_path)],
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            assert (done.returncode, done.stdout) == (CODES[name], ""), (number, done.stderr)
            assert done.stderr == "interrupted\n", number
            ended += 1
        else:
            assert load_object(folder).description.name == "bar"
        assert not list(tmp_path.glob(".qsgm-*"))
    assert ended or TIMES == 1
