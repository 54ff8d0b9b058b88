"""What is fine-tuned: each system of the paper's tables and of its text, from where and by what."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass

import torch

from qsgm.grasp.network import GRASPNET
from qsgm.schedule import MOMENTUM
from qsgm.train.model.fold import folded_start
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm
from qsgm.train.paper.baselines.backpropagation import Backpropagation
from qsgm.train.paper.baselines.direct_feedback import DirectFeedbackAlignment
from qsgm.train.paper.baselines.feedback_alignment import FeedbackAlignment, random_feedback
from qsgm.train.paper.baselines.interface import Baseline
from qsgm.train.paper.baselines.online_sgms import OnlineSgms
from qsgm.train.paper.baselines.projections import random_projections
from qsgm.train.paper.baselines.static_sgms import StaticSgms
from qsgm.train.paper.baselines.target_projection import TargetProjection
from qsgm.train.paper.baselines.tuning import Recipe, adam, constant_rate, run_baseline, sgd
from qsgm.train.paper.driven import Driver, FixedSgms, FollowingSgms, tune_with_batchnorm
from qsgm.train.paper.objects import PAPER_TASK, ObjectCrops
from qsgm.train.paper.pretraining import ADAM_RATE, Pretrained, Sgms
from qsgm.train.pretraining.evaluate import Score
from qsgm.train.pretraining.tasks import TaskSet, features_of

ADAM = "Adam 0.001"
BATCHNORM = "BN, SGD 0.1"
BATCHNORM_MOMENTUM = "BN, momentum"
# Variants of layers that keep their batchnorm, and their momentum; the paper's first.
WITH_BATCHNORM: Mapping[str, float] = {BATCHNORM: 0.0, BATCHNORM_MOMENTUM: MOMENTUM}
# Of SGD with momentum, constant; the paper's first.
RATES = (1e-1, 1e-2, 3e-3, 1e-3)


@dataclass(frozen=True)
class System:
    """A way to fine-tune: a start, and where gradients come from."""

    net: ConvNet
    tuned: int
    baseline: Callable[[], Baseline]  # a new one for every run
    # The same system for layers that keep their batchnorm; None: not run so.
    driver: Callable[[], Driver] | None = None
    with_adam: bool = False  # as the paper's backpropagation; else SGD at all RATES


def sgd_variant(rate: float) -> str:
    """What a run with SGD at this rate is called."""
    return f"SGD {rate:g}"


def all_systems(pretrained: Pretrained, seed: int) -> dict[str, System]:
    """Every system by name, in the tables' order; see :mod:`qsgm.train.paper.report`."""
    network, driven = pretrained.network, pretrained.driven
    torch.manual_seed(seed)
    random = {layer: Sgm(GRASPNET, layer) for layer in (4, 5)}
    feedback, projections = (
        random_feedback(GRASPNET, folded_start(network, 3), seed),
        random_projections(GRASPNET, seed),
    )
    return {
        **{_layers("BP", n): System(network, n, Backpropagation, with_adam=True) for n in (1, 2)},
        "SGM, 2 layers": _static(driven, 2, pretrained.sgms),
        "BP, 3 layers": System(network, 3, Backpropagation, with_adam=True),
        "SGM, 3 layers": _static(driven, 3, pretrained.sgms),
        "trained, updating": _updating(driven, 2, pretrained.sgms),
        "random, updating": _updating(driven, 2, random),
        "BP, 4 layers": System(network, 4, Backpropagation, with_adam=True),
        "SGM, 4 layers": _static(pretrained.four_layers, 4, pretrained.four_layer_sgms),
        "BP by SGD": System(network, 3, Backpropagation),
        "BP, SGMs' start": System(driven, 3, Backpropagation, with_adam=True),
        "SGM, random": _static(driven, 3, random),
        "SGM, no label": _static(driven, 3, pretrained.label_free_sgms),
        "SGM, trained by l1": _static(driven, 3, pretrained.l1_sgms),
        "feedback alignment": System(network, 3, lambda: FeedbackAlignment(feedback)),
        "direct feedback": System(network, 3, lambda: DirectFeedbackAlignment(projections)),
        "target projection": System(network, 3, lambda: TargetProjection(projections)),
    }


def tune_object(
    system: System, crops: ObjectCrops, epochs: int, rates: Sequence[float], seed: int
) -> dict[str, Score]:
    """Fine-tune on one object in every way that the system is run.

    Returns:
        By variant, the score on the query crops.
    """
    tasks = task_of(system.net, crops, system.tuned)
    start = folded_start(system.net, system.tuned)
    scores = {
        name: run_baseline(tasks, start, system.baseline(), recipe, PAPER_TASK, seed)[0]
        for name, recipe in _recipes(system, epochs, rates).items()
    }
    if system.driver is None:
        return scores
    for name, momentum in WITH_BATCHNORM.items():
        scores[name] = tune_with_batchnorm(
            system.net, system.tuned, system.driver(), tasks, epochs, PAPER_TASK, seed, momentum
        )
    return scores


def task_of(net: ConvNet, crops: ObjectCrops, tuned: int) -> TaskSet:
    """One object's crops as the last `tuned` layers of the untouched network see them."""
    features = features_of(net, crops.crops.numpy(), net.network.depth - tuned)
    return TaskSet(features[None].half(), crops.labels[None], crops.support)


def _recipes(system: System, epochs: int, rates: Sequence[float]) -> Mapping[str, Recipe]:
    """Constant rates, as the paper's are."""
    if system.with_adam:
        return {ADAM: Recipe(adam, (ADAM_RATE,) * system.tuned, epochs, constant_rate)}
    return {
        sgd_variant(rate): Recipe(sgd, (rate,) * system.tuned, epochs, constant_rate)
        for rate in rates
    }


def _static(net: ConvNet, tuned: int, sgms: Sgms) -> System:
    return System(net, tuned, lambda: StaticSgms(sgms), lambda: FixedSgms(sgms))


def _updating(net: ConvNet, tuned: int, sgms: Sgms) -> System:
    return System(
        net, tuned, lambda: OnlineSgms(sgms, 1), lambda: FollowingSgms(deepcopy(dict(sgms)))
    )


def _layers(method: str, count: int) -> str:
    return f"{method}, {count} layer{'s' if count > 1 else ''}"
