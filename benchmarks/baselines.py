"""Other systems on the same crops: online SGMs, feedback alignment, target projection.

    python benchmarks/baselines.py sgm.pt --frames DIR [--limit 4] [--layers 3] [--epochs 20]
        [--json FILE]

All in float and in torch, from the checkpoint's start, with rates that decay, each at the best of a
few optimizers and rates on these very frames, one rate for all layers. The checkpoint's static SGMs
also run as shipped: at their own rates, with their curvature.
"""

import argparse
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.progress import track

from qsgm.bench.frames import BenchFrame, list_frames
from qsgm.blocks import single_layers
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.source import crop_source
from qsgm.grasp.task import GraspTask, grasp_task
from qsgm.grasp.teach import as_demonstrations
from qsgm.schedule import gain_over, short_run, steps_per_epoch
from qsgm.tables import number, table
from qsgm.train.checkpoint import Checkpoint, load_checkpoint
from qsgm.train.model.fold import folded_start
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.backpropagation import Backpropagation
from qsgm.train.paper.baselines.direct_feedback import DirectFeedbackAlignment
from qsgm.train.paper.baselines.feedback_alignment import FeedbackAlignment, random_feedback
from qsgm.train.paper.baselines.interface import Baseline
from qsgm.train.paper.baselines.online_sgms import OnlineSgms, bootstrapped_target
from qsgm.train.paper.baselines.projections import random_projections
from qsgm.train.paper.baselines.static_sgms import StaticSgms
from qsgm.train.paper.baselines.target_projection import TargetProjection
from qsgm.train.paper.baselines.tuning import MakeOptimizer, Recipe, adam, run_baseline, sgd
from qsgm.train.pretraining.evaluate import Score, UpdateRule, mean_score, run_sgms, score
from qsgm.train.pretraining.tasks import TaskSet, see_lesson, start_states, task_set

GRID: Mapping[str, tuple[MakeOptimizer, tuple[float, ...]]] = {
    "sgd": (sgd, (0.003, 0.01, 0.03)),
    "adam": (adam, (0.001, 0.003)),
}
CHUNK = 8  # frames that are tuned side by side


def tasks_of(checkpoint: Checkpoint, frames: Sequence[BenchFrame], tuned: int) -> TaskSet:
    """The frames' crops as the last `tuned` layers see them, 800 to learn from and 200 to judge."""
    task, frozen = grasping(checkpoint), checkpoint.net.network.depth - tuned
    crops = (
        crop_source(as_demonstrations(frame.read()), None, np.random.default_rng(0))
        for frame in frames
    )
    lessons = (GraspLesson(one, task.encoding) for one in crops)
    return task_set([see_lesson(checkpoint.net, one, frozen, task) for one in lessons], TRAIN_CROPS)


def grasping(checkpoint: Checkpoint) -> GraspTask:
    """The checkpoint's task."""
    return grasp_task(checkpoint.task, "the checkpoint")


def all_systems(checkpoint: Checkpoint, tuned: int) -> dict[str, Callable[[int], Baseline]]:
    """By name, what makes a new one for a number of tasks."""
    start, network = folded_start(checkpoint.net, tuned), checkpoint.net.network
    trained = {k: sgm for k, sgm in checkpoint.sgms.items() if k in network.last(tuned)}
    torch.manual_seed(0)
    random = {layer: Sgm(network, layer, sgm.hidden).eval() for layer, sgm in trained.items()}
    feedback, projections = random_feedback(network, start, 0), random_projections(network, 0)
    return {
        "backpropagation": lambda _: Backpropagation(),
        "static SGMs": lambda _: StaticSgms(trained),
        "static SGMs, random": lambda _: StaticSgms(random),
        "online SGMs, trained": lambda tasks: OnlineSgms(trained, tasks, bootstrapped_target),
        "online SGMs, random": lambda tasks: OnlineSgms(random, tasks, bootstrapped_target),
        "feedback alignment": lambda _: FeedbackAlignment(feedback),
        "direct feedback": lambda _: DirectFeedbackAlignment(projections),
        "target projection": lambda _: TargetProjection(projections),
    }


def recipes(tuned: int, epochs: int) -> Iterator[tuple[str, Recipe]]:
    """The grid that each system is given the best of."""
    for name, (optimizer, rates) in GRID.items():
        for rate in rates:
            yield f"{name} {rate:g}", Recipe(optimizer, (rate,) * tuned, epochs)


def compare(checkpoint: Checkpoint, tasks: TaskSet, tuned: int, epochs: int) -> dict[str, Any]:
    """Fine-tune all tasks by all systems: recipe, detection and angle error of each."""
    start, task = folded_start(checkpoint.net, tuned), grasping(checkpoint)
    untouched = mean_score(score(start_states(start, len(tasks)), tasks, task))
    found = {
        "untouched": figures("", untouched),
        "static SGMs, as shipped": figures("own", as_shipped(checkpoint, tasks, tuned, epochs)),
    }
    systems = all_systems(checkpoint, tuned)
    for name in track(systems, console=Console(stderr=True)):
        runs = {}
        for recipe, how in recipes(tuned, epochs):
            scores = []
            for chunk in tasks.chunks(CHUNK):
                scores += run_baseline(chunk, start, systems[name](len(chunk)), how, task, 0)
            runs[recipe] = mean_score(scores)
        # One that diverged is never the best.
        best = min(runs, key=lambda recipe: np.nan_to_num(runs[recipe].objective, nan=inf))
        found[name] = figures(best, runs[best])
    return found


def as_shipped(checkpoint: Checkpoint, tasks: TaskSet, tuned: int, epochs: int) -> Score:
    """The checkpoint's rule with all it has learnt."""
    gains = short_run(checkpoint.short_gain)
    factor = gain_over(gains, epochs * steps_per_epoch(TRAIN_CROPS))
    layers = checkpoint.net.network.last(tuned)
    rates = tuple(factor * rate for rate in checkpoint.rates[str(single_layers(layers))])
    rule = UpdateRule(checkpoint.sgms, checkpoint.curvatures, rates, grasping(checkpoint))
    return run_sgms(rule, folded_start(checkpoint.net, tuned), tasks, epochs, CHUNK)


def figures(recipe: str, found: Score) -> dict[str, Any]:
    """One system's, as JSON has them."""
    return {"recipe": recipe} | {name: number(value, 4) for name, value in found.scores.items()}


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("checkpoint", type=Path)
    parser.add_argument("--frames", type=Path, default=Path("calib"))
    parser.add_argument("--limit", type=int)
    parser.add_argument("--layers", type=int, choices=(2, 3, 4), default=3)
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    checkpoint, frames = load_checkpoint(asked.checkpoint), list_frames(asked.frames, asked.limit)
    tasks = tasks_of(checkpoint, frames, asked.layers)
    found = compare(checkpoint, tasks, asked.layers, asked.epochs)
    title = f"{len(frames)} frames, each system at the best of a few rates"
    columns = ("system", "rate", ("detection", "{:.3f}"), ("angle error", "{:.2f}°"))
    rows = [[name, *row.values()] for name, row in found.items()]
    Console().print(table(title, columns, rows, left=(0, 1)))
    if asked.json is not None:
        values = {"frames": len(frames), "epochs": asked.epochs, "systems": found}
        asked.json.write_text(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
