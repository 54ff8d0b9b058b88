"""Drawn frames as training data: a stream of labelled crops, and tasks for meta-training.

A task is one object, as the device will meet it: a demonstration frame, crops of it, features of
the frozen layers, and labels aligned with the network's own idea of the object's axis.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import Dataset

from qsgm.grasp.angles import AngleEncoding, decode_angle, mean_direction, wrap_half_turn
from qsgm.grasp.crops import CropPlan, cut_crops, label_crops, plan_crops
from qsgm.grasp.distractors import Distractors, load_distractors
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.train.grasp.draw_distractors import SHEET_SEED, distractor_file
from qsgm.train.grasp.objects import draw_frame
from qsgm.train.model.graspnet import LAYERS, GraspNet, Loss, normalize
from qsgm.train.model.local import LayerState
from qsgm.tune.loop import BATCH

CENTER_PX = (320.0, 240.0)
FRAME_HW = (480, 640)
# Rounder than this, a drawn object has no axis worth learning: both angle labels are 0.
LEAST_ELONGATION = 1.25


class CropStream(Dataset[tuple[Tensor, Tensor]]):
    """Item i: crops (n, 128, 128, 3) uint8 of the i-th drawn frame and labels (n, 3)."""

    def __init__(
        self, seed: int, frames: int, crops_per_frame: int, encoding: AngleEncoding
    ) -> None:
        self.seed, self.frames, self.crops_per_frame = seed, frames, crops_per_frame
        self.encoding = encoding

    def __len__(self) -> int:
        return self.frames

    def __getitem__(self, i: int) -> tuple[Tensor, Tensor]:
        cv2.setNumThreads(1)  # one loader process a core
        rng = np.random.default_rng((self.seed, i))
        drawn = draw_frame(rng)
        plan = plan_crops(FRAME_HW, CENTER_PX, rng, self.crops_per_frame)
        labels = label_crops(plan, drawn.axis_rad, self.encoding)
        if drawn.elongation < LEAST_ELONGATION:
            labels[:, 1:] = 0.0
        return torch.from_numpy(cut_crops(drawn.image, plan)), torch.from_numpy(labels)


@lru_cache(maxsize=1)
def shipped_things() -> Distractors:
    """The things that come with every bundle."""
    return load_distractors(distractor_file(SHEET_SEED))


@dataclass(frozen=True)
class Task:
    """One object: features (N, P, C) of the frozen layers, position-major, and labels (N, 3)."""

    features: Tensor
    labels: Tensor
    offset_rad: float


@torch.no_grad()
def features_of(
    net: GraspNet, crops: NDArray[np.uint8], last_frozen: int, chunk: int = 100
) -> Tensor:
    """Crops (N, 128, 128, 3) to features (N, P, C) behind layer `last_frozen`."""
    parts = []
    for start in range(0, len(crops), chunk):
        x = normalize(torch.from_numpy(crops[start : start + chunk]))
        parts.append(net.between(x, 1, last_frozen).flatten(2).transpose(1, 2).contiguous())
    return torch.cat(parts)


@torch.no_grad()
def axis_offset(raw: Tensor, plan: CropPlan, loss: Loss) -> float:
    """The demonstration's own orientation [rad] as the untouched network sees it.

    Args:
        raw: (N, 3) raw outputs for all crops of the plan.
    """
    positive = plan.quality > 0
    seen = loss.activate(raw)[torch.from_numpy(positive)].numpy()
    predicted = decode_angle(seen[:, 1], seen[:, 2], loss.encoding)
    return mean_direction(wrap_half_turn(predicted - plan.turn_rad[positive]))[0]


@torch.no_grad()
def make_task(
    net: GraspNet,
    frame: NDArray[np.uint8],
    rng: np.random.Generator,
    *,
    last_frozen: int,
    count: int,
    loss: Loss,
    center_px: tuple[float, float] = CENTER_PX,
    things: Distractors | None = None,
) -> Task:
    """Cut, label and featurize the crops of one demonstration with the untouched network.

    `things` are put on crops as the device does it; None: the frame is all there is.
    """
    source = crop_source([Demonstration(frame, center_px)], things, rng, count)
    plan, features = source.plan, features_of(net, source.cut(np.arange(count)), last_frozen)
    side = int(features.shape[1] ** 0.5)
    maps = features.transpose(1, 2).unflatten(2, (side, side))
    raw = net.between(maps, last_frozen + 1, LAYERS)[:, :, 0, 0]
    offset = axis_offset(raw, plan, loss)
    return Task(features, torch.from_numpy(label_crops(plan, offset, loss.encoding)), offset)


@dataclass(frozen=True)
class TaskSet:
    """T tasks of N crops each; the first `support` crops are for learning, the rest is query."""

    features: Tensor  # (T, N, P, C), half precision
    labels: Tensor  # (T, N, 3)
    support: int

    def __len__(self) -> int:
        return len(self.labels)

    def chunks(self, size: int) -> Iterator["TaskSet"]:
        """The same tasks in groups of at most `size`."""
        for start in range(0, len(self), size):
            rows = slice(start, start + size)
            yield TaskSet(self.features[rows], self.labels[rows], self.support)


def shuffled_batches(count: int, epochs: int, seed: int) -> Iterator[Tensor]:
    """Rows of every batch of `epochs` passes over `count` crops."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(epochs):
        yield from torch.randperm(count, generator=generator).split(BATCH)


def draw_tasks(
    net: GraspNet,
    count: int,
    crops: int,
    seed: int,
    loss: Loss,
    after_task: Callable[[], None],
    last_frozen: int = 3,
) -> TaskSet:
    """Draw `count` objects and featurize `crops` of each; four fifths of them are support."""
    tasks = []
    for i in range(count):
        rng = np.random.default_rng((seed, i))
        frame = draw_frame(rng).image
        tasks.append(make_task(net, frame, rng, last_frozen=last_frozen, count=crops, loss=loss))
        after_task()
    return TaskSet(
        torch.stack([task.features.half() for task in tasks]),
        torch.stack([task.labels for task in tasks]),
        support=crops * 4 // 5,
    )


def start_states(start: Sequence[tuple[Tensor, Tensor]], tasks: int) -> list[LayerState]:
    """The same start (weight (K, Co), bias (Co,)) of every tuned layer for each task."""
    return [
        LayerState.start(weight.expand(tasks, -1, -1), bias.expand(tasks, -1))
        for weight, bias in start
    ]
