"""All of it: for every object pretrain on the others, then fine-tune on it by every system."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from torch import Tensor

from qsgm.train.paper.objects import OBJECTS, ObjectCrops, cut_object
from qsgm.train.paper.pretraining import PretrainingSizes, pretrain_without
from qsgm.train.paper.systems import RATES, all_systems, tune_object
from qsgm.train.pretraining.pretrain import one_thread

# (stage, done, of how many)
Watch = Callable[[str, int, int], None]
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


def measure_paper(config: PaperConfig, seed: int, watch: Watch) -> PaperResults:
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


def _later(watch: Watch, i: int, of: int) -> Watch:
    """Tells of the i-th of `of` equal parts as of the whole."""
    return lambda stage, done, total: watch(stage, i * total + done, of * total)


def _measure_object(
    held_out: str, objects: Mapping[str, ObjectCrops], config: PaperConfig, seed: int, watch: Watch
) -> dict[str, dict[str, Scores]]:
    sizes, done = config.pretraining, 0
    steps = sizes.network_steps + sizes.sgm_steps + sizes.four_layer_steps

    def after_step() -> None:
        nonlocal done
        done += 1
        watch("pretrain", done, steps)

    pretrained = pretrain_without(held_out, objects, sizes, seed, after_step)
    systems = all_systems(pretrained, seed)
    scores = {}
    for i, (name, system) in enumerate(systems.items(), start=1):
        found = tune_object(system, objects[held_out], config.epochs, config.rates, seed)
        scores[name] = {variant: _three(values) for variant, values in found.items()}
        watch("tune", i, len(systems))
    return scores


def _three(values: Tensor) -> Scores:
    objective, detection, angle = values.tolist()
    return objective, detection, angle
