"""All of it: for every object pretrain on the others, then fine-tune on it by every system."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from qsgm.progress import NO_FIGURES, Progress, counted
from qsgm.train.paper.objects import OBJECTS, ObjectCrops, cut_object
from qsgm.train.paper.pretraining import PretrainingSizes, pretrain_without
from qsgm.train.paper.systems import RATES, all_systems, tune_object
from qsgm.train.pretraining.evaluate import Score
from qsgm.train.processes import one_thread

Scores = tuple[float, float, float]  # objective, detection accuracy, angle error [deg]


@dataclass(frozen=True)
class PaperConfig:
    """Sizes; the defaults take the paper's 1000 crops of each of six objects."""

    objects: int = 6
    crops: int = 1000
    epochs: int = 30
    rates: tuple[float, ...] = RATES
    pretraining: PretrainingSizes = field(default_factory=PretrainingSizes)


# Seconds instead of minutes: shows that all of it runs, its figures mean nothing.
QUICK = PaperConfig(2, 60, 1, RATES[::2], PretrainingSizes(3, 3, 2, 4))


@dataclass(frozen=True)
class PaperResults:
    """Scores on each object's validation crops, by its letter, system and variant."""

    config: PaperConfig
    seed: int
    scores: Mapping[str, Mapping[str, Mapping[str, Scores]]]

    @property
    def letters(self) -> tuple[str, ...]:
        return tuple(self.scores)


def measure_paper(config: PaperConfig, seed: int, watch: Progress) -> PaperResults:
    """Run everything on one thread; `watch` is told about progress."""
    letters = list(OBJECTS)[: config.objects]
    with one_thread():
        objects = {
            letter: cut_object(OBJECTS[letter].draw(), config.crops, seed + i)
            for i, letter in enumerate(letters)
        }
        scores = {
            letter: _measure_object(letter, objects, config, seed, _later(watch, i, len(letters)))
            for i, letter in enumerate(letters)
        }
    return PaperResults(config, seed, scores)


def _later(watch: Progress, i: int, of: int) -> Progress:
    """Tells of the i-th of `of` equal parts as of the whole."""

    def later(
        stage: str, done: int, total: int, figures: Mapping[str, float] = NO_FIGURES, /
    ) -> None:
        watch(stage, i * total + done, of * total, figures)

    return later


def _measure_object(
    held_out: str,
    objects: Mapping[str, ObjectCrops],
    config: PaperConfig,
    seed: int,
    watch: Progress,
) -> dict[str, dict[str, Scores]]:
    sizes = config.pretraining
    steps = sizes.network_steps + sizes.sgm_steps + sizes.four_layer_steps
    after_step = counted(watch, "pretrain", steps)
    pretrained = pretrain_without(held_out, objects, sizes, seed, after_step)
    systems = all_systems(pretrained, seed)
    scores = {}
    for i, (name, system) in enumerate(systems.items(), start=1):
        found = tune_object(system, objects[held_out], config.epochs, config.rates, seed)
        scores[name] = {variant: _three(score) for variant, score in found.items()}
        watch("tune", i, len(systems))
    return scores


def _three(score: Score) -> Scores:
    figures = score.scores
    return score.objective, figures["detection_accuracy"], figures["angle_mae_deg"]
