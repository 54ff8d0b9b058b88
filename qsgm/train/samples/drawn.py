"""A task of samples as pretraining and calibration take it."""

import hashlib
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from qsgm.errors import QsgmError
from qsgm.network import Network
from qsgm.samples.lesson import SampleLesson, Samples, checked_samples
from qsgm.samples.task import SampleTask
from qsgm.task import Array, Heads, Inputs, Scores
from qsgm.train.pretraining.backbone import BackboneConfig
from qsgm.train.pretraining.maml import MamlConfig
from qsgm.train.pretraining.map_sgms import MapConfig
from qsgm.train.pretraining.matching import MatchingConfig
from qsgm.train.pretraining.own_runs import OwnRunsConfig
from qsgm.train.pretraining.pretrain import PretrainConfig
from qsgm.train.pretraining.rates import RatesConfig

CALIBRATION_LESSONS = 8
HIDDEN = (32, 32)
MOST_LATE = 3  # layers that are meta-trained


@dataclass(frozen=True)
class DrawnSamples:
    """Lessons of a task's drawn samples, all of which are learnt from."""

    task: SampleTask
    source: str = ""  # digest of what defines it, so that no unfinished pretraining mixes two

    @property
    def name(self) -> str:
        return self.task.name

    @property
    def network(self) -> Network:
        return self.task.network

    @property
    def heads(self) -> Heads:
        return self.task.heads

    def to_json(self) -> dict[str, Any]:
        return self.task.to_json()

    def scores(self, outputs: Array, labels: Array) -> Scores:
        return self.task.scores(outputs, labels)

    def example(self, rng: np.random.Generator, count: int) -> tuple[Inputs, Array]:
        return _whole(self.task, self.task.example(rng, count), "example", count)

    def lesson(self, rng: np.random.Generator, count: int) -> SampleLesson:
        inputs, labels = _whole(self.task, self.task.draw(rng, count), "draw", count)
        return SampleLesson(self.task, inputs, labels, taught=count)


@dataclass(frozen=True)
class DrawnLessons:
    """Lessons to calibrate on, drawn as they are needed."""

    drawn: DrawnSamples
    count: int = CALIBRATION_LESSONS

    def __len__(self) -> int:
        return self.count

    @property
    def sha256(self) -> str:
        """Digest of some samples of each lesson."""
        digest = hashlib.sha256()
        for i in range(self.count):
            digest.update(self.samples(i, np.random.default_rng(i), 8).tobytes())
        return digest.hexdigest()

    def lesson(self, i: int, rng: np.random.Generator, count: int) -> SampleLesson:  # noqa: ARG002
        return self.drawn.lesson(rng, count)

    def samples(self, i: int, rng: np.random.Generator, count: int) -> Inputs:  # noqa: ARG002
        return self.drawn.lesson(rng, count).inputs


def usual_config(task: SampleTask, hidden: tuple[int, ...] = HIDDEN) -> PretrainConfig:
    """Sizes for a network of some ten thousand weights: minutes on one core."""
    return PretrainConfig(
        hidden=hidden,
        first_rates=min(task.tuned, MOST_LATE),
        grouped=True,
        by_length=True,
        tasks=64,
        crops_per_task=200,
        backbone=BackboneConfig(steps=600, loader_processes=0),
        matching=MatchingConfig(epochs=4, fit_steps=600, fit_batch=512),
        own_runs=OwnRunsConfig(rounds=3),
        maml=MamlConfig(outer_steps=300, tasks_per_step=4, unroll=10, run_lengths=(5, 15, 50, 100)),
        early=MapConfig(tasks=12, crops_per_task=80, epochs=8, looks=(1, 4, 8), steps=150),
        rates=RatesConfig(
            tasks=16,
            crops_per_task=200,
            epochs=20,
            short_epochs=4,
            early_tasks=4,
            early_crops_per_task=120,
            early_epochs=10,
        ),
    )


def quicker(config: PretrainConfig, share: float) -> PretrainConfig:
    """The same with a share of all steps and tasks: for trials, and for tests."""

    def part(count: int, least: int) -> int:
        return max(least, round(share * count))

    own = config.own_runs.fit
    stages = {
        "backbone": replace(config.backbone, steps=part(config.backbone.steps, 100)),
        "matching": replace(config.matching, fit_steps=part(config.matching.fit_steps, 50)),
        "own_runs": replace(
            config.own_runs,
            tasks=part(config.own_runs.tasks, 8),
            fit=replace(own, fit_steps=part(own.fit_steps, 50)),
        ),
        "maml": replace(config.maml, outer_steps=part(config.maml.outer_steps, 10)),
        "early": replace(config.early, steps=part(config.early.steps, 20)),
        "rates": replace(config.rates, tasks=part(config.rates.tasks, 3)),
    }
    changed: Any = stages
    return replace(config, tasks=part(config.tasks, 8), **changed)


def _whole(task: SampleTask, found: Samples, method: str, count: int) -> tuple[Inputs, Array]:
    """Labelled samples, as many as were asked for. Raises QsgmError."""
    where = f"`{method}` of the task {task.name!r}"
    samples = checked_samples(found, task.network, task.heads, where)
    if samples.labels is None or len(samples) != count:
        has = "no labels" if samples.labels is None else f"{len(samples)} samples"
        raise QsgmError(f"{where} gives {has}, expected {count} labelled ones")
    return samples.inputs, samples.labels
