"""Teach on one demonstration, look for its object in composed scenes, with it and without it."""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from qsgm.bench.composing import CONDITIONS, Composer, Condition, Scene, Subject
from qsgm.bench.cutouts import Frame
from qsgm.bench.judging import Answer, Judged, Tally, Truth, judge, threshold_for, truth_of
from qsgm.bundle import Bundle
from qsgm.grasp.heatmap import Detection
from qsgm.grasp.teach import prepare_object, train_object
from qsgm.manifest import Recipe
from qsgm.progress import Progress
from qsgm.tune.plan import resolve
from qsgm.tune.settings import Settings

# Told about every scene as it is judged, while its picture is at hand.
Look = Callable[[Scene, Judged], None]


@dataclass(frozen=True)
class ScenePlan:
    """Which scenes are composed: the same for everyone who looks at them."""

    subjects: tuple[Subject, ...]  # all that may lie in a scene
    taught: tuple[int, ...]  # those that are looked for
    conditions: tuple[Condition, ...] = CONDITIONS
    count: int = 3  # pairs per condition and subject
    seed: int = 0

    def scenes_of(self, composer: Composer, number: int) -> Iterator[tuple[Scene, Truth]]:
        """All scenes of a subject: each with the object, then without it.

        Neither the other subjects taught nor the other conditions change a scene.
        """
        for condition in self.conditions:
            for k in range(self.count):
                key = [self.seed, number, CONDITIONS.index(condition), k]
                pair = composer.pair(number, condition, np.random.default_rng(key))
                for scene in (pair.present, pair.absent):
                    subject = self.subjects[number]
                    yield scene, truth_of(subject, scene, k, pair.absent_thing)


class Method(Protocol):
    """Something that is taught an object and looks for it."""

    @property
    def name(self) -> str: ...

    def answers(self, subject: Subject, scenes: Sequence[Frame]) -> list[Answer]:
        """Teach on the subject's demonstration and look for it in every scene."""
        ...


@dataclass(frozen=True)
class TunedMethod:
    """The bundle's network, tuned as the settings say."""

    name: str
    bundle: Bundle
    settings: Settings
    recipe: Recipe | None = None  # optimizer and rates; None: the bundle's

    def answers(self, subject: Subject, scenes: Sequence[Frame]) -> list[Answer]:
        """Tune on the subject's demonstration and look in every scene as `qsgm predict` does."""
        plan = resolve(self.settings, self.bundle, self.recipe)
        prepared = prepare_object(subject.frame, self.bundle, plan)
        tuned = train_object(prepared, plan).tuned_object(subject.name)
        answers = []
        for scene in scenes:
            began = time.perf_counter()
            detection, _ = tuned.locate_at_any_distance(scene)
            answers.append(_answer(detection, time.perf_counter() - began))
        return answers


@dataclass(frozen=True)
class MethodResults:
    """A method's judged answers to all scenes of a plan."""

    name: str
    results: tuple[Judged, ...]

    def of(self, condition: Condition | None) -> tuple[Judged, ...]:
        """The results of a condition; None: of all."""
        return tuple(r for r in self.results if condition in (None, r.truth.condition))

    @property
    def threshold(self) -> float:
        """The quality above which 2 % of all scenes without the object are."""
        return threshold_for(Tally.of(self.results).quality[:, 1])

    def at_false_alarm_rate(self) -> "MethodResults":
        """The same answers, found where their quality is above :attr:`threshold`."""
        threshold = self.threshold
        return MethodResults(
            self.name,
            tuple(
                replace(r, answer=replace(r.answer, found=r.answer.quality > threshold))
                for r in self.results
            ),
        )


def measure_scenes(
    plan: ScenePlan, methods: Sequence[Method], watch: Progress, look: Look | None = None
) -> list[MethodResults]:
    """Every method's answers to the same scenes.

    Args:
        plan: says which scenes.
        methods: at least one.
        watch: told about every subject.
        look: shown every scene with the first method's judged answer.
    """
    composer = Composer(plan.subjects)
    results: list[list[Judged]] = [[] for _ in methods]
    for done, number in enumerate(plan.taught, start=1):
        staged = list(plan.scenes_of(composer, number))
        frames = [scene.frame for scene, _ in staged]
        for i, method in enumerate(methods):
            answers = method.answers(plan.subjects[number], frames)
            for (scene, truth), answer in zip(staged, answers, strict=True):
                results[i].append(judge(truth, answer, scene.others))
                if look is not None and i == 0:
                    look(scene, results[i][-1])
        watch("frames", done, len(plan.taught))
    return [MethodResults(m.name, tuple(r)) for m, r in zip(methods, results, strict=True)]


def _answer(detection: Detection, seconds: float) -> Answer:
    return Answer(
        detection.found,
        detection.quality,
        detection.center_px,
        detection.angle_deg,
        detection.full_angle_deg,
        seconds,
        detection.refined_by == "patch",
    )
