"""The command line as tests call it, and what it must not do."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# Of every layer with an SGM.
FIDELITY_KEYS = {
    "cos_int8_float",
    "cos_int8_true",
    "cos_float_true",
    "norm_ratio_int8_true",
    "sign_agreement_int8_float",
    "clipped_fraction",
}


@dataclass(frozen=True)
class Outcome:
    code: int
    out: str
    err: str

    @property
    def json(self) -> dict:
        assert self.code == 0, self.err
        assert self.out.count("\n") == 1
        return json.loads(self.out)


Run = Callable[..., Outcome]


def in_a_process(*arguments: object) -> Outcome:
    done = subprocess.run(
        [sys.executable, "-m", "qsgm.cli", *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


def assert_refused(outcome: Outcome, code: int, *said: str) -> None:
    """One line that says what is wrong, and nothing else anywhere."""
    assert outcome.code == code, outcome.err
    assert outcome.out == ""
    assert outcome.err.count("\n") == 1, outcome.err
    assert "Traceback" not in outcome.err
    for text in said:
        assert text in outcome.err


def environment(**changes: str | None) -> dict[str, str]:
    values = {**os.environ, **changes}
    return {name: value for name, value in values.items() if value is not None}


def predict_into(taught: Path, frame: Path, redirection: str, **changes: str | None) -> Outcome:
    """`predict` in a shell, its streams as the shell's words have them."""
    command = [sys.executable, "-m", "qsgm.cli", "predict", "--object", str(taught), str(frame)]
    done = subprocess.run(
        ["bash", "-c", f'"$@" {redirection}', "bash", *command],
        env=environment(**changes),
        capture_output=True,
        text=True,
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)
