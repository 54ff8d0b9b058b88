"""Fit the decision: which evidence speaks for the taught object, and from when on it is found.

Objects drawn anew are taught, then looked for in scenes with them and without them. A small network
learns to tell the judged candidates that are the object from those that are not; its threshold is
what 1 % of the scenes without the object reach.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import dist

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn import functional as F

from qsgm.grasp.comparer import Comparer
from qsgm.grasp.decision import FALSE_ALARM_RATE, Decision
from qsgm.train.grasp.comparer_examples import OFF_OBJECT_PX, ON_OBJECT_PX

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Weighed:
    """A candidate as the decision sees it."""

    evidence: Floats  # (F,)
    center_px: tuple[float, float]


@dataclass(frozen=True)
class JudgedScene:
    """What was judged in one scene, and where the object is."""

    episode: int
    center_px: tuple[float, float] | None  # None: it is not there
    candidates: tuple[Weighed, ...]


@dataclass(frozen=True)
class DecisionConfig:
    """Sizes and rates of the fit."""

    hidden: int = 32
    steps: int = 1500
    peak_rate: float = 1e-2
    weight_decay: float = 1.0
    folds: int = 4  # the threshold is set on scenes whose episodes had no say in the weights


def fit_decision(
    scenes: Sequence[JudgedScene],
    config: DecisionConfig,
    seed: int,
    comparer: Comparer | None = None,
) -> Decision:
    """Fit weights to all scenes, and the threshold to the ones without the object.

    What the comparer says, where there is one, is the last piece of their evidence. Where the
    threshold lies is found by cross-validation: each fold's scenes are scored by weights fitted to
    the other folds' episodes.
    """
    empty_scores: list[float] = []
    for own, others in _folds(scenes, config.folds):
        judge = _fitted(others, config, seed)
        empty_scores += [best_score(judge, scene) for scene in own if scene.center_px is None]
    threshold = float(np.quantile(empty_scores, 1 - FALSE_ALARM_RATE))
    whole = _fitted(scenes, config, seed)
    return replace(whole, threshold=threshold, comparer=comparer)


def best_score(decision: Decision, scene: JudgedScene) -> float:
    """The highest score of a scene's candidates; minus infinity where there is none."""
    scores = [float(decision.score(one.evidence)) for one in scene.candidates]
    return max(scores, default=-np.inf)


def _folds(
    scenes: Sequence[JudgedScene], count: int
) -> list[tuple[list[JudgedScene], list[JudgedScene]]]:
    """Scenes of every count-th episode, and all others."""
    return [
        (
            [scene for scene in scenes if scene.episode % count == number],
            [scene for scene in scenes if scene.episode % count != number],
        )
        for number in range(count)
    ]


def _examples(scenes: Sequence[JudgedScene]) -> tuple[Floats, Floats]:
    """Evidence (N, F) and whether it is the object (N,)."""
    facts, mine = [], []
    for scene in scenes:
        for one in scene.candidates:
            off = np.inf if scene.center_px is None else dist(one.center_px, scene.center_px)
            if not ON_OBJECT_PX < off < OFF_OBJECT_PX:
                facts.append(one.evidence)
                mine.append(off <= ON_OBJECT_PX)
    return np.stack(facts), np.array(mine, np.float32)


def _fitted(scenes: Sequence[JudgedScene], config: DecisionConfig, seed: int) -> Decision:
    facts, mine = _examples(scenes)
    mean, deviation = facts.mean(axis=0), facts.std(axis=0) + 1e-3
    x, y = torch.from_numpy((facts - mean) / deviation), torch.from_numpy(mine)
    torch.manual_seed(seed)
    first, last = nn.Linear(x.shape[1], config.hidden), nn.Linear(config.hidden, 1)
    net = nn.Sequential(first, nn.ReLU(), last)
    optimizer = torch.optim.AdamW(
        net.parameters(), config.peak_rate, weight_decay=config.weight_decay
    )
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, config.peak_rate, total_steps=config.steps
    )
    for _ in range(config.steps):
        loss = F.binary_cross_entropy_with_logits(net(x)[:, 0], y)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    hidden, hidden_bias, output = (
        p.detach().numpy().copy() for p in (first.weight, first.bias, last.weight[0])
    )
    bias = float(last.bias.item())
    return Decision(mean, deviation, hidden, hidden_bias, output, bias, threshold=0.0)
