"""deploy/native next to Python: CPU seconds and peak memory of whole processes, in turns.

`python benchmarks/native.py PROGRAM BUNDLE FRAME SCENE`: the program that `make -C deploy/native`
builds, a slim bundle, two pictures.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2

REPEATS = 5
# The same work in Python: no patch, no probes, no verdict.
TEACH = """
import sys
from pathlib import Path
from qsgm import Settings, load_bundle, read_frame, resolve
from qsgm.grasp.teach import prepare_object, train_object
bundle = load_bundle(Path(sys.argv[1]))
plan = resolve(Settings(precision="int8"), bundle)
frame = read_frame(Path(sys.argv[2]))
network = train_object(prepare_object(frame, bundle, plan, span_px=90), plan).network()
"""


def cost(command: list[str]) -> tuple[float, float]:
    """CPU seconds and peak memory [MB] of a process."""
    with Path(os.devnull).open("w") as nowhere:
        process = subprocess.Popen(command, stdout=nowhere)
        _, status, used = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{command} failed")
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1000


def main(program: str, bundle: str, frame: str, scene: str) -> None:
    """Medians of each command, taken in turns."""
    with tempfile.TemporaryDirectory() as folder:
        pictures = []
        for one in (frame, scene):
            pictures.append(f"{folder}/{Path(one).stem}.ppm")
            cv2.imwrite(pictures[-1], cv2.imread(one))
        qsgm = [sys.executable, "-m", "qsgm.cli"]
        known = f"{folder}/known"
        cost([program, "finetune", "--int8", bundle, pictures[0], known])
        found = dict[str, list[tuple[float, float]]]()
        for number in range(REPEATS):
            new = f"{folder}/{number}"
            commands = {
                "teach, C": [program, "finetune", "--int8", bundle, pictures[0], new],
                "teach, Python": [sys.executable, "-c", TEACH, bundle, frame],
                "find, C": [program, "predict", known, pictures[1]],
                "find, Python": [*qsgm, "predict", "--json", "--object", known, scene],
            }
            for name, command in commands.items():
                found.setdefault(name, []).append(cost(command))
    for name, costs in found.items():
        seconds, memory = (statistics.median(one) for one in zip(*costs, strict=True))
        print(f"{name:14} {seconds:.2f} s of CPU, {memory:.0f} MB")
    print(f"the program: {Path(program).stat().st_size} bytes")


if __name__ == "__main__":
    main(*sys.argv[1:])
