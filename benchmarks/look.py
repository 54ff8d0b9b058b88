"""What a look costs: CPU time of finding one object in one frame of 640x480.

    OPENBLAS_NUM_THREADS=1 python benchmarks/look.py [--objects N] [--repeats N] [--json FILE]

Drawn objects are taught and looked for in drawn scenes of all conditions, with the object and
without it. In turns with that the network alone looks, as it does for objects that have no patch;
that was all of a look before there were patches. Where nothing is found, `predict` looks again,
more closely and at other distances: what that comes to, first look included, is the third row.
Other work on the machine makes a look slower but never quicker: beside the median of all looks
stands the mean over scenes of each one's least. The commands set `OPENBLAS_NUM_THREADS` themselves:
threads of numpy's own would double the CPU time.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from qsgm.bench.composing import Composer
from qsgm.bench.frames import spread
from qsgm.bench.scenes import ScenePlan
from qsgm.bench.subjects import drawn_subjects
from qsgm.bundle import Bundle, load_bundle
from qsgm.grasp.heatmap import Detection
from qsgm.grasp.teach import prepare_object, train_object
from qsgm.grasp.tuned import TunedObject
from qsgm.tune.plan import resolve
from qsgm.tune.settings import Settings

EXPORT = Path(__file__).parents[1] / "export"
SEED = 3


@dataclass(frozen=True)
class Looks:
    """CPU [ms] of one way to look, at S scenes, R times each."""

    first: list[float]  # of each object
    later: NDArray[np.float64]  # (S, R)

    def figures(self) -> dict[str, float]:
        """Medians of first and later looks, the mean of each scene's least."""
        first = {"first_ms": statistics.median(self.first)} if self.first else {}
        return {
            **first,
            "median_ms": float(np.median(self.later)),
            "least_ms": float(self.later.min(axis=1).mean()),
        }


Look = Callable[[NDArray[np.uint8]], tuple[Detection, NDArray[np.float32]]]


def taught(frame: NDArray[np.uint8], bundle: Bundle, name: str) -> dict[str, Look]:
    """Ways to look for an object: itself, without what it looks like, and as `predict` does."""
    plan = resolve(Settings(precision="int8"), bundle)
    tuned = train_object(prepare_object(frame, bundle, plan), plan)
    whole = tuned.tuned_object(name)
    alone = replace(whole.description, views=(), decision=None)
    return {
        "look": whole.locate,
        "network_alone": TunedObject(alone, tuned.network(), 1).locate,
        "nothing_found": whole.locate_at_any_distance,
    }


def cpu_ms(look: Look, frame: NDArray[np.uint8]) -> tuple[float, bool]:
    """What one look takes, and whether the object is found."""
    began = time.process_time()
    detection, _ = look(frame)
    return 1000 * (time.process_time() - began), detection.found


def measured(
    objects: int, repeats: int, bundle: Bundle
) -> tuple[dict[str, Looks], list[list[bool]]]:
    """All ways to look, in turns, and what was found in scenes with the object, and without it."""
    subjects = drawn_subjects(SEED)
    plan = ScenePlan(tuple(subjects), tuple(spread(len(subjects), objects)), count=1, seed=SEED)
    composer = Composer(plan.subjects)
    names = ("look", "network_alone", "nothing_found")
    ways = {name: Looks([], np.zeros((0, repeats))) for name in names}
    found: list[list[bool]] = [[], []]
    for number in plan.taught:
        scenes = [scene for scene, _ in plan.scenes_of(composer, number)]
        tuned = taught(subjects[number].frame, bundle, subjects[number].name)
        for name in names[:2]:
            ways[name].first.append(cpu_ms(tuned[name], scenes[0].frame)[0])
        for scene in scenes:
            is_found = tuned["look"](scene.frame)[0].found
            asked = names[:2] if is_found else names
            each = [
                {name: cpu_ms(tuned[name], scene.frame) for name in asked} for _ in range(repeats)
            ]
            for name in asked:
                times = [[one[name][0] for one in each]]
                ways[name] = replace(ways[name], later=np.concatenate([ways[name].later, times]))
            found[scene.center_px is None].append(is_found)
    return ways, found


def main() -> None:
    """Measure and print."""
    cv2.setNumThreads(1)
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--objects", type=int, default=6)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    ways, found = measured(asked.objects, asked.repeats, load_bundle(EXPORT))
    figures = {name: way.figures() for name, way in ways.items()}
    network = figures["network_alone"]
    ratios = {key: value / network[key] for key, value in figures["look"].items()}
    table = Table("CPU of a look [ms]", "first", "later, median", "later, least")
    for name, values in figures.items():
        cells = (f"{values[key]:.1f}" if key in values else "-" for key in ratios)
        table.add_row(name.replace("_", " "), *cells)
    table.add_row("ratio", *(f"{value:.2f}" for value in ratios.values()))
    console = Console(width=80)
    console.print(table)
    with_it, without = (float(np.mean(some)) for some in found)
    console.print(
        f"{len(ways['look'].later)} scenes, {asked.repeats} times each; found in {with_it:.0%} of "
        f"those with the object, {without:.0%} without; load {os.getloadavg()[0]:.0f}"
    )
    if asked.json:
        answer = {"ms": figures, "ratio": ratios, "found": with_it, "false_alarms": without}
        asked.json.write_text(json.dumps(answer, indent=1) + "\n")


if __name__ == "__main__":
    main()
