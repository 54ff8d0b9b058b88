"""Drawn objects, taught in torch as the device teaches them, and what is then judged in scenes."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from qsgm.grasp.comparer import Comparer
from qsgm.grasp.judge import Appearance, judge
from qsgm.grasp.patch import cut_patch
from qsgm.task import Heads
from qsgm.train.grasp.comparer_examples import Look
from qsgm.train.grasp.decision import JudgedScene, Weighed
from qsgm.train.grasp.drawing.scenes import DrawnScene
from qsgm.train.grasp.episodes import CENTER_PX, Episode, EpisodesConfig
from qsgm.train.grasp.task import DrawnGrasping, frame_lesson
from qsgm.train.heads import activate
from qsgm.train.model.local import LayerState
from qsgm.train.model.net import ConvNet, normalize
from qsgm.train.pretraining.evaluate import UpdateRule, fine_tune
from qsgm.train.pretraining.tasks import SeenLesson, TaskSet, see_lesson


@dataclass(frozen=True)
class DecisionScenesConfig(EpisodesConfig):
    """How many objects and scenes the decision is made on, and how each object is taught."""

    episodes: int = 480  # half as many leave the threshold uncertain by 0.36 of log odds
    crops: int = 1000
    support: int = 800
    epochs: int = 20
    tasks_at_once: int = 8


def judged_scenes(
    net: ConvNet,
    rule: UpdateRule,
    start: Sequence[tuple[Tensor, Tensor]],
    comparer: Comparer | None,
    config: DecisionScenesConfig,
    seed: int,
    after_episode: Callable[[], None],
) -> list[JudgedScene]:
    """Teach every episode's object, and judge the candidates of all its scenes.

    Args:
        net: in eval mode; its frozen layers are used.
        rule: by which the last layers learn.
        start: of these layers, batchnorm folded.
        comparer: whose answers are the last piece of evidence.
        config: sizes.
        seed: of the episodes.
        after_episode: told about each.
    """
    maker = config.maker(seed)
    judged: list[JudgedScene] = []
    for first in range(0, config.episodes, config.tasks_at_once):
        numbers = range(first, min(first + config.tasks_at_once, config.episodes))
        episodes = [maker.draw(number, config.scenes, without=True) for number in numbers]
        taught = _teach(net, rule, start, episodes, config, seed)
        for number, episode, states in zip(numbers, episodes, taught, strict=True):
            look = partial(heatmap_of, net, states, heads=rule.task.heads)
            judged += _judge_all(number, episode, look, comparer)
            after_episode()
    return judged


def _teach(
    net: ConvNet,
    rule: UpdateRule,
    start: Sequence[tuple[Tensor, Tensor]],
    episodes: Sequence[Episode],
    config: DecisionScenesConfig,
    seed: int,
) -> Iterator[list[LayerState]]:
    """The tuned layers of every episode."""
    tasks = [_task(net, episode, len(start), config, rule, seed) for episode in episodes]
    together = TaskSet(
        torch.stack([task.features for task in tasks]),
        torch.stack([task.labels for task in tasks]),
        config.support,
    )
    *_, states = fine_tune(rule, start, together, config.epochs, seed)
    for i in range(len(tasks)):
        yield [_of_task(state, i) for state in states]


def _task(
    net: ConvNet,
    episode: Episode,
    tuned: int,
    config: DecisionScenesConfig,
    rule: UpdateRule,
    seed: int,
) -> SeenLesson:
    rng, frame = np.random.default_rng(seed), episode.demonstration.image
    assert isinstance(rule.task, DrawnGrasping), "scenes are drawn of objects to grasp"
    lesson = frame_lesson(frame, rng, config.crops, rule.task)
    return see_lesson(net, lesson, net.network.depth - tuned, rule.task)


def _judge_all(
    number: int, episode: Episode, look: Look, comparer: Comparer | None
) -> Iterator[JudgedScene]:
    appearance = Appearance.of(cut_patch(episode.demonstration.image, CENTER_PX))
    cells = appearance.aligner.cells

    def judged(scene: DrawnScene, center_px: tuple[float, float] | None) -> JudgedScene:
        found = judge(appearance, scene.image, look(scene.image))
        evidence, seen = (
            np.stack([getattr(one, k) for one in found]) for k in ("evidence", "seen")
        )
        facts = evidence
        if comparer is not None:
            facts = np.column_stack([evidence, comparer.logits_all_ways(cells, seen)])
        weighed = (Weighed(some, one.center_px) for some, one in zip(facts, found, strict=True))
        return JudgedScene(number, center_px, tuple(weighed))

    for scene in episode.scenes:
        yield judged(scene, scene.center_px)
    for scene in episode.without:
        yield judged(scene, None)


@torch.no_grad()
def heatmap_of(
    net: ConvNet, states: Sequence[LayerState], frame: NDArray[np.uint8], *, heads: Heads
) -> NDArray[np.float32]:
    """Quality, sine and cosine (3, rows, cols) of a frame (H, W, 3) by one task's tuned layers."""
    numbers = net.network.last(len(states))
    pixels = normalize(torch.from_numpy(frame[None]).permute(0, 3, 1, 2))
    x = net.between(pixels, 1, numbers[0] - 1)
    for number, state in zip(numbers, states, strict=True):
        layer = net.network.layer(number)
        weight = state.weight[0].view(*layer.kernel, layer.into, layer.out).permute(3, 2, 0, 1)
        x = F.conv2d(x, weight, state.bias[0], layer.stride, padding=layer.padding)
        x = F.relu(x) if layer.relu else x
        x = F.avg_pool2d(x, layer.pool, layer.pool_stride)
    heatmap: NDArray[np.float32] = activate(heads, x[0].permute(1, 2, 0)).permute(2, 0, 1).numpy()
    return heatmap


def _of_task(state: LayerState, i: int) -> LayerState:
    one = slice(i, i + 1)
    return LayerState(
        state.weight[one], state.bias[one], state.weight_momentum[one], state.bias_momentum[one]
    )
