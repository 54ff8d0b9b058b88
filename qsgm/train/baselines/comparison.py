"""Every system on a folder of frames: the same start, the same crops, rates that decay.

Each is given the best of a few rates on these very frames, one for all layers. The static SGMs of
the checkpoint also run as they are shipped: at their own rates, with their curvature.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
import torch
from rich.console import RenderableType
from torch import Tensor

from qsgm.bench.frames import BenchFrame
from qsgm.blocks import single_layers
from qsgm.grasp.crops import TRAIN_CROPS, VALIDATION_CROPS
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.model.graspnet import LAYERS
from qsgm.train.model.sgm import Sgm
from qsgm.train.model.start import folded_start
from qsgm.train.paper.baselines.backpropagation import Backpropagation
from qsgm.train.paper.baselines.direct_feedback import DirectFeedbackAlignment
from qsgm.train.paper.baselines.feedback_alignment import FeedbackAlignment, random_feedback
from qsgm.train.paper.baselines.interface import Baseline
from qsgm.train.paper.baselines.online_sgms import OnlineSgms, bootstrapped_target
from qsgm.train.paper.baselines.projections import random_projections
from qsgm.train.paper.baselines.static_sgms import StaticSgms
from qsgm.train.paper.baselines.target_projection import TargetProjection
from qsgm.train.paper.baselines.tuning import MakeOptimizer, Recipe, adam, run_baseline, sgd
from qsgm.train.pretraining.evaluate import UpdateRule, fine_tune, score
from qsgm.train.pretraining.tasks import CENTER_PX, TaskSet, make_task, start_states
from qsgm.tune.loop import BATCH, short_run_factor
from qsgm.tune.report import number, plain_table

GRID: Mapping[str, tuple[MakeOptimizer, tuple[float, ...]]] = {
    "sgd": (sgd, (0.003, 0.01, 0.03)),
    "adam": (adam, (0.001, 0.003)),
}
CHUNK = 8  # frames that are tuned side by side

# (stage, done, of how many)
Watch = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Row:
    """One system at its best."""

    system: str
    recipe: str
    detection_accuracy: float
    angle_mae_deg: float


def tasks_of(
    checkpoint: Checkpoint, frames: Sequence[BenchFrame], tuned: int, seed: int, watch: Watch
) -> TaskSet:
    """The frames' crops as the last `tuned` layers see them, 800 to learn from and 200 to judge."""
    tasks = []
    for done, frame in enumerate(frames, start=1):
        tasks.append(
            make_task(
                checkpoint.net,
                frame.read(),
                np.random.default_rng(seed),
                last_frozen=LAYERS - tuned,
                count=TRAIN_CROPS + VALIDATION_CROPS,
                loss=checkpoint.loss,
                center_px=CENTER_PX,
            )
        )
        watch("crops", done, len(frames))
    features = torch.stack([task.features.half() for task in tasks])
    return TaskSet(features, torch.stack([task.labels for task in tasks]), TRAIN_CROPS)


def all_systems(
    checkpoint: Checkpoint, tuned: int, seed: int
) -> dict[str, Callable[[int], Baseline]]:
    """By name, what makes a new one for a number of tasks."""
    start = folded_start(checkpoint.net, tuned)
    trained = {k: sgm for k, sgm in checkpoint.sgms.items() if k > LAYERS - tuned}
    torch.manual_seed(seed)
    random = {layer: Sgm(layer, sgm.hidden).eval() for layer, sgm in trained.items()}
    feedback, projections = random_feedback(start, seed), random_projections(seed)
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


def compare(
    checkpoint: Checkpoint, tasks: TaskSet, tuned: int, epochs: int, seed: int, watch: Watch
) -> list[Row]:
    """Fine-tune all tasks by all systems.

    Args:
        checkpoint: start, static SGMs and loss.
        tasks: as :func:`tasks_of` makes them.
        tuned: how many of the last layers are trained.
        epochs: passes over the crops.
        seed: of random matrices, random SGMs and the order of crops.
        watch: told about every run.
    """
    start, loss = folded_start(checkpoint.net, tuned), checkpoint.loss
    systems = all_systems(checkpoint, tuned, seed)
    rows = [_row("untouched", "", score(start_states(start, len(tasks)), tasks, loss))]
    rows.append(
        _row("static SGMs, as shipped", "own", _as_shipped(checkpoint, tasks, tuned, epochs))
    )
    for done, (name, make) in enumerate(systems.items(), start=1):
        runs = {
            recipe: torch.cat(
                [
                    run_baseline(some, start, make(len(some)), how, loss, seed)
                    for some in tasks.chunks(CHUNK)
                ]
            )
            for recipe, how in _recipes(tuned, epochs)
        }
        best = min(runs, key=lambda recipe: _objective(runs[recipe]))
        rows.append(_row(name, best, runs[best]))
        watch("systems", done, len(systems))
    return rows


def to_json(rows: Sequence[Row], frames: int, epochs: int) -> dict[str, Any]:
    """Means over the frames, by system."""
    return {
        "frames": frames,
        "epochs": epochs,
        "systems": {
            row.system: {
                "recipe": row.recipe,
                "detection_accuracy": number(row.detection_accuracy, 4),
                "angle_mae_deg": number(row.angle_mae_deg, 4),
            }
            for row in rows
        },
    }


def render(rows: Sequence[Row], frames: int) -> RenderableType:
    """A row per system."""
    table = plain_table(f"{frames} frames, each system at the best of a few rates")
    table.add_column("system")
    table.add_column("rate")
    table.add_column("detection", justify="right")
    table.add_column("angle [deg]", justify="right")
    for row in rows:
        figures = f"{row.detection_accuracy:.3f}", f"{row.angle_mae_deg:.2f}"
        table.add_row(row.system, row.recipe, *figures)
    return table


def _recipes(tuned: int, epochs: int) -> Iterator[tuple[str, Recipe]]:
    for name, (optimizer, rates) in GRID.items():
        for rate in rates:
            yield f"{name} {rate:g}", Recipe(optimizer, (rate,) * tuned, epochs)


def _as_shipped(checkpoint: Checkpoint, tasks: TaskSet, tuned: int, epochs: int) -> Tensor:
    """The checkpoint's rule with all it has learnt: (T, 3)."""
    factor = short_run_factor(checkpoint.short_gain, epochs * -(-TRAIN_CROPS // BATCH))
    rates = tuple(factor * rate for rate in checkpoint.rates[str(single_layers(tuned))])
    rule = UpdateRule(checkpoint.sgms, checkpoint.curvatures, rates, checkpoint.loss)
    start, scores = folded_start(checkpoint.net, tuned), []
    for some in tasks.chunks(CHUNK):
        *_, states = fine_tune(rule, start, some, epochs)
        scores.append(score(states, some, checkpoint.loss))
    return torch.cat(scores)


def _objective(scores: Tensor) -> float:
    mean = float(scores[:, 0].mean())
    return mean if isfinite(mean) else float("inf")


def _row(system: str, recipe: str, scores: Tensor) -> Row:
    _, detection, angle = scores.mean(dim=0).tolist()
    return Row(system, recipe, detection, angle)
