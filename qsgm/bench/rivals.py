"""Other methods on the same scenes: processes that are given a folder and leave their answers.

A folder holds `demonstration.png`, `mask.png` (white on the object), the scenes as PNG, and
`scenes.json`: {"demonstration", "mask", "center_px", "scenes": [file, ...]}. A rival is called as
`COMMAND FOLDER ANSWERS.json` and writes {"answers": [{"file", "score", "center_px", "turn_deg",
"seconds"}, ...]}: the turn counter-clockwise over the full circle, null for a centre where it has
no guess.
"""

import json
import math
import shlex
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qsgm.bench.composing import Composer, Subject
from qsgm.bench.cutouts import Frame
from qsgm.bench.judging import Answer
from qsgm.bench.scenes import ScenePlan
from qsgm.errors import QsgmError
from qsgm.files import write_text_atomic
from qsgm.images import write_png
from qsgm.progress import Progress
from qsgm.tables import to_json

DEMONSTRATION = "demonstration.png"
MASK = "mask.png"
LISTING = "scenes.json"
TRUTH = "truth.json"


@dataclass(frozen=True)
class Rival:
    """A method in a process of its own, started once per demonstration."""

    name: str
    command: tuple[str, ...]

    def answers(self, subject: Subject, scenes: Sequence[Frame]) -> list[Answer]:
        """What the process answers.

        Raises:
            QsgmError: it cannot be started, fails, or does not answer every scene.
        """
        with tempfile.TemporaryDirectory(prefix="qsgm-scenes-") as name:
            folder = Path(name)
            files = write_subject(folder, subject, scenes)
            written = folder / "answers.json"
            self._run([*self.command, str(folder), str(written)])
            return self._read(written, files)

    def _run(self, command: list[str]) -> None:
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            raise QsgmError(
                f"rival {self.name}: cannot start {command[0]}: {error.strerror}; check the command"
            ) from error
        if done.returncode:
            said = (done.stderr.strip() or done.stdout.strip() or "nothing").splitlines()[-1]
            raise QsgmError(f"rival {self.name} ended with {done.returncode}, saying: {said}")

    def _read(self, path: Path, files: Sequence[str]) -> list[Answer]:
        try:
            listed = {item["file"]: item for item in json.loads(path.read_text())["answers"]}
            return [_answer(listed[file]) for file in files]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise QsgmError(
                f"rival {self.name} left no usable answers: expected one to each of {len(files)} "
                f"scenes, as qsgm/bench/rivals.py says"
            ) from error


def parse_rival(text: str) -> Rival:
    """A name and a command, such as `ncc=python benchmarks/rivals/ncc.py`.

    Raises:
        QsgmError: there is no name or no command.
    """
    name, _, command = text.partition("=")
    try:
        words = tuple(shlex.split(command))
    except ValueError:
        words = ()
    if not name.strip() or not words:
        raise QsgmError(f"{text!r} is no rival: expected NAME=COMMAND, such as ncc=python ncc.py")
    return Rival(name.strip(), words)


def write_subject(folder: Path, subject: Subject, scenes: Sequence[Frame]) -> list[str]:
    """Write a demonstration and scenes into a folder; the scenes' file names."""
    files = [f"scene_{k:03}.png" for k in range(len(scenes))]
    write_png(folder / DEMONSTRATION, subject.frame)
    write_png(folder / MASK, 255 * subject.mask.astype(np.uint8))
    for file, scene in zip(files, scenes, strict=True):
        write_png(folder / file, scene)
    listing = {
        "demonstration": DEMONSTRATION,
        "mask": MASK,
        "center_px": list(subject.center_px),
        "scenes": files,
    }
    write_text_atomic(folder / LISTING, to_json(listing) + "\n")
    return files


def keep_scenes(plan: ScenePlan, folder: Path, watch: Progress) -> None:
    """Write every scene of a plan, a folder per subject, and `truth.json` beside them."""
    composer = Composer(plan.subjects)
    for done, number in enumerate(plan.taught, start=1):
        subject = plan.subjects[number]
        staged = list(plan.scenes_of(composer, number))
        files = write_subject(folder / subject.name, subject, [scene.frame for scene, _ in staged])
        truths = [
            {"file": file} | asdict(truth) for file, (_, truth) in zip(files, staged, strict=True)
        ]
        write_text_atomic(folder / subject.name / TRUTH, to_json({"scenes": truths}) + "\n")
        watch("scenes", done, len(plan.taught))


def _answer(item: dict[str, Any]) -> Answer:
    seconds = item.get("seconds")
    if item["center_px"] is None:
        return Answer(False, -math.inf, (math.nan, math.nan), 0.0, None, seconds)
    x, y = item["center_px"]
    turn = float(item["turn_deg"])
    return Answer(False, float(item["score"]), (float(x), float(y)), turn, turn, seconds)
