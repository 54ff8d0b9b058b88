"""Lessons as training data: a stream of labelled examples, and tasks for meta-training.

A task is one lesson, as the device will meet it: features of the frozen layers, and labels that
may depend on the untouched network's answers.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from qsgm.schedule import BATCH
from qsgm.task import Described, Inputs, Lesson
from qsgm.train.heads import activate
from qsgm.train.model.local import LayerState
from qsgm.train.model.net import ConvNet, as_seen, maps_of, positions_of
from qsgm.train.task import DrawnTask

SUPPORT_SHARE = 0.8  # of a task's samples are learnt from


class ExampleStream(Dataset[tuple[Tensor, Tensor]]):
    """Item i: inputs (n, H, W, C) of the i-th drawn example and its labels (n, L)."""

    def __init__(self, task: DrawnTask, seed: int, count: int, samples: int) -> None:
        self.task, self.seed, self.count, self.samples = task, seed, count, samples

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> tuple[Tensor, Tensor]:
        inputs, labels = self.task.example(np.random.default_rng((self.seed, i)), self.samples)
        return torch.from_numpy(inputs), torch.from_numpy(labels)


@dataclass(frozen=True)
class SeenLesson:
    """A lesson as the tuned layers see it: features (N, P, C), and labels (N, L)."""

    features: Tensor
    labels: Tensor


@torch.no_grad()
def features_of(net: ConvNet, inputs: Inputs, last_frozen: int, chunk: int = 100) -> Tensor:
    """Inputs (N, H, W, C) to features (N, P, C) behind layer `last_frozen`."""
    parts = []
    for start in range(0, len(inputs), chunk):
        x = as_seen(net.network, torch.from_numpy(inputs[start : start + chunk]))
        parts.append(positions_of(net.between(x, 1, last_frozen)))
    return torch.cat(parts)


@torch.no_grad()
def see_lesson(net: ConvNet, lesson: Lesson, last_frozen: int, task: Described) -> SeenLesson:
    """Features and labels of all samples of a lesson, by the untouched network."""
    features = features_of(net, lesson.cut(np.arange(len(lesson))), last_frozen)
    network = net.network
    maps = maps_of(features, network.before(last_frozen + 1))
    raw = net.between(maps, last_frozen + 1, network.depth)[:, :, 0, 0]
    labels = lesson.labelled(activate(task.heads, raw).numpy()).labels
    return SeenLesson(features, torch.from_numpy(labels))


@dataclass(frozen=True)
class TaskSet:
    """T tasks of N samples each; the first `support` are for learning, the rest is query."""

    features: Tensor  # (T, N, P, C), half precision
    labels: Tensor  # (T, N, L)
    support: int

    def __len__(self) -> int:
        return len(self.labels)

    def chunks(self, size: int) -> Iterator["TaskSet"]:
        """Tasks in groups of at most `size`."""
        for start in range(0, len(self), size):
            rows = slice(start, start + size)
            yield TaskSet(self.features[rows], self.labels[rows], self.support)


def task_set(lessons: Sequence[SeenLesson], support: int) -> TaskSet:
    """Lessons of as many samples side by side."""
    features = torch.stack([lesson.features.half() for lesson in lessons])
    return TaskSet(features, torch.stack([lesson.labels for lesson in lessons]), support)


def shuffled_batches(count: int, epochs: int, seed: int) -> Iterator[Tensor]:
    """Rows of every batch of `epochs` passes over `count` samples."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(epochs):
        yield from torch.randperm(count, generator=generator).split(BATCH)


def draw_tasks(
    net: ConvNet,
    task: DrawnTask,
    count: int,
    samples: int,
    seed: int,
    after_task: Callable[[], None],
    last_frozen: int,
) -> TaskSet:
    """Draw `count` lessons and featurize `samples` of each; four fifths of them are support."""
    lessons = []
    for i in range(count):
        lesson = task.lesson(np.random.default_rng((seed, i)), samples)
        lessons.append(see_lesson(net, lesson, last_frozen, task))
        after_task()
    return task_set(lessons, int(samples * SUPPORT_SHARE))


def start_states(start: Sequence[tuple[Tensor, Tensor]], tasks: int) -> list[LayerState]:
    """States of every tuned layer that start alike, (K, Co) and (Co,), for each task."""
    return [
        LayerState.start(weight.expand(tasks, -1, -1), bias.expand(tasks, -1))
        for weight, bias in start
    ]
