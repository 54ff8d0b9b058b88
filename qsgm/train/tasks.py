"""Drawn objects as training data: a stream of episodes, and tasks for meta-training.

A task is one object, as the device will meet it: a demonstration frame, crops of it with other
things among them, features of the frozen layers, and labels aligned with the network's own idea of
the object's axis. What counts is how it does on crops of other scenes with the same object.
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

from qsgm.angles import AngleEncoding, decode_angle, encode_angle, mean_direction, wrap_half_turn
from qsgm.crops import CropPlan, label_crops
from qsgm.distractors import Distractors, load_distractors
from qsgm.grasp.clutter import Addition
from qsgm.grasp.source import CropSource, Demonstration, crop_source
from qsgm.train.draw_distractors import SHEET_SEED, distractor_file
from qsgm.train.episodes import CENTER_PX, FRAME_HW, episode_maker, scene_crops
from qsgm.train.graspnet import LAYERS, GraspNet, Loss, normalize
from qsgm.train.local import LayerState
from qsgm.tuning import BATCH

__all__ = ["CENTER_PX", "FRAME_HW"]

# Rounder than this, a drawn object has no axis worth learning: both angle labels are 0.
LEAST_ELONGATION = 1.25
# Of a task's crops: from its demonstration to learn from, from there to judge, from other scenes.
SUPPORT_SHARE, HELD_OUT_SHARE = 0.8, 0.1
SCENES_PER_TASK = 3


@lru_cache(maxsize=1)
def shipped_things() -> Distractors:
    """The things that come with every bundle."""
    return load_distractors(distractor_file(SHEET_SEED))


@dataclass(frozen=True)
class Example:
    """Crops of one episode: the first half of its demonstration, the others of another scene."""

    crops: Tensor  # (n, 128, 128, 3) uint8
    labels: Tensor  # (n, 3): whether anything is at the middle, and how it lies
    weights: Tensor  # (n,): 0 where that is not known
    mine: Tensor  # (n,): 1 where it is this object

    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return self.crops, self.labels, self.weights, self.mine


class EpisodeStream(Dataset[tuple[Tensor, Tensor, Tensor, Tensor]]):
    """Item i: the parts of an :class:`Example` of the i-th drawn object."""

    def __init__(self, seed: int, episodes: int, crops: int, encoding: AngleEncoding) -> None:
        self.seed, self.episodes, self.crops, self.encoding = seed, episodes, crops, encoding

    def __len__(self) -> int:
        return self.episodes

    def __getitem__(self, i: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        cv2.setNumThreads(1)  # one loader process a core
        rng = np.random.default_rng((self.seed, i))
        episode = episode_maker(self.seed).draw(i, 1)
        half = self.crops // 2
        demonstration = Demonstration(episode.demonstration.image, CENTER_PX)
        source = crop_source([demonstration], shipped_things(), rng, half)
        crops, seen = scene_crops(episode.scenes[0], episode.demonstration, rng, self.crops - half)
        turn, elongated = episode.demonstration.turn_rad, episode.drawn.elongation
        known = elongated >= LEAST_ELONGATION
        taught = _anything_labels(source, turn, known, self.encoding)
        other = _labels(seen, turn, known, self.encoding)
        mine = np.concatenate([source.plan.quality, seen.quality])
        # What lies elsewhere in a scene may well be at a window's middle: that is not known.
        weights = np.concatenate([np.ones(half), seen.quality])
        return Example(
            torch.from_numpy(np.concatenate([source.cut(np.arange(half)), crops])),
            torch.from_numpy(np.concatenate([taught, other])),
            torch.from_numpy(weights.astype(np.float32)),
            torch.from_numpy(mine),
        ).parts()


def _labels(
    plan: CropPlan, turn: float, known: bool, encoding: AngleEncoding
) -> NDArray[np.float32]:
    labels = label_crops(plan, turn, encoding)
    if not known:
        labels[:, 1:] = 0.0
    return labels


def _anything_labels(
    source: CropSource, turn: float, known: bool, encoding: AngleEncoding
) -> NDArray[np.float32]:
    """Labels (N, 3) by which a thing at the middle is as good as the object."""
    labels = _labels(source.plan, turn, known, encoding)
    if source.clutter is None:
        return labels
    thing = (source.clutter.addition == Addition.THING) & (source.plan.quality == 0)
    reach = shipped_things().reach_px[source.clutter.things.sprite]
    lies = (reach[:, 0] >= LEAST_ELONGATION * reach[:, 1])[:, None]
    angle = encode_angle(source.clutter.things.turn_rad, encoding) * lies
    labels[thing] = np.concatenate([np.ones((len(angle), 1)), angle], axis=1)[thing]
    return labels


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
    for start in range(0, max(len(crops), 1), chunk):
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
) -> Task:
    """Cut, label and featurize the crops of one demonstration with the untouched network."""
    source = crop_source([Demonstration(frame, center_px)], shipped_things(), rng, count)
    features = features_of(net, source.cut(np.arange(count)), last_frozen)
    offset = axis_offset(_raw(net, features, last_frozen), source.plan, loss)
    labels = torch.from_numpy(label_crops(source.plan, offset, loss.encoding))
    return Task(features, labels, offset)


def _raw(net: GraspNet, features: Tensor, last_frozen: int) -> Tensor:
    """Raw outputs (N, 3) of the layers behind the frozen ones."""
    side = int(features.shape[1] ** 0.5)
    maps = features.transpose(1, 2).unflatten(2, (side, side))
    return net.between(maps, last_frozen + 1, LAYERS)[:, :, 0, 0]


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
    """Draw `count` objects and featurize `crops` of each.

    Four fifths of the crops are of the demonstration and support; of the query, half are of the
    demonstration, too, and half of other scenes with the same object.
    """
    tasks = []
    for number in range(count):
        tasks.append(_drawn_task(net, number, crops, seed, loss, last_frozen))
        after_task()
    return TaskSet(
        torch.stack([task.features.half() for task in tasks]),
        torch.stack([task.labels for task in tasks]),
        support=round(crops * SUPPORT_SHARE),
    )


@torch.no_grad()
def _drawn_task(
    net: GraspNet, number: int, crops: int, seed: int, loss: Loss, last_frozen: int
) -> Task:
    rng = np.random.default_rng((seed, number))
    episode = episode_maker(seed).draw(number, SCENES_PER_TASK)
    taught = round(crops * (SUPPORT_SHARE + HELD_OUT_SHARE))
    demonstration = episode.demonstration
    task = make_task(
        net, demonstration.image, rng, last_frozen=last_frozen, count=taught, loss=loss
    )
    features, labels = [task.features], [task.labels]
    for scene, count in zip(episode.scenes, _spread(crops - taught, SCENES_PER_TASK), strict=True):
        seen, plan = scene_crops(scene, demonstration, rng, count)
        features.append(features_of(net, seen, last_frozen))
        labels.append(torch.from_numpy(label_crops(plan, task.offset_rad, loss.encoding)))
    return Task(torch.cat(features), torch.cat(labels), task.offset_rad)


def _spread(count: int, parts: int) -> list[int]:
    """A number as a sum of nearly equal ones, the larger ones first."""
    return [len(part) for part in np.array_split(np.arange(count), parts)]


def start_states(start: Sequence[tuple[Tensor, Tensor]], tasks: int) -> list[LayerState]:
    """The same start (weight (K, Co), bias (Co,)) of every tuned layer for each task."""
    return [
        LayerState.start(weight.expand(tasks, -1, -1), bias.expand(tasks, -1))
        for weight, bias in start
    ]
