"""Fine-tuning runs on calibration lessons, as on the device, with SGMs that the caller runs.

Activations move while layers train, so whoever wants to know what an SGM sees has to go along. Of a
run only its current step is in memory.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from qsgm.blocks import single_layers
from qsgm.errors import QsgmError
from qsgm.network import ONE, Network, Pair
from qsgm.progress import Progress
from qsgm.schedule import BATCH, rate_factor
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm, float_product, float_trace
from qsgm.task import Lesson, label_span
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.heads import error
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.model.fold import fold_net, fold_sgm, run_folded_conv
from qsgm.train.model.local import LayerState, columns, layer_forward, local_step
from qsgm.train.model.net import maps_of, positions_of
from qsgm.train.pretraining.tasks import SeenLesson, see_lesson, start_states
from qsgm.train.processes import InTurn
from qsgm.train.quantization.lessons import Lessons
from qsgm.weights import to_step_layout

CROPS = 400
EPOCHS = 40  # as many steps as 20 epochs on the 800 crops of the device
# Where SGMs see whole maps a step takes about a hundred times as long: whole runs would take hours.
# A run of such layers is therefore a short one, its rates decaying as fast: their activations move
# little, and every sample has as many positions as its map.
MAP_CROPS = 96
MAP_EPOCHS = 10
# Steps between two measurements of fidelity; consecutive steps tell the same.
MEASURE_EVERY_STEPS = 13
MEASURE_MAPS_EVERY_STEPS = 15

Done = TypeVar("Done")
# (layer, what its SGM sees (B, P, Ci)) -> gradient (B, P, C)
SgmGradient = Callable[[int, FloatArray], FloatArray]


@dataclass(frozen=True)
class RunPlan:
    """A fine-tuning run: how many layers, on how many samples, for how many passes over them."""

    tuned: int
    crops: int
    epochs: int
    measured: range  # the layers of the SGMs that it is there for
    maps: bool = False  # whether there are SGMs in it that see maps; it is then there for those

    @property
    def measure_every(self) -> int:
        """Steps between two measurements."""
        return MEASURE_MAPS_EVERY_STEPS if self.maps else MEASURE_EVERY_STEPS


@dataclass(frozen=True)
class Trainee:
    """What is fine-tuned: a checkpoint, and what the device gets of it."""

    checkpoint: Checkpoint
    net: FoldedNet
    sgms: Mapping[int, FoldedSgm]  # by layer

    @property
    def network(self) -> Network:
        """The geometry of its network."""
        return self.net.network

    @property
    def label_span(self) -> tuple[FloatArray, FloatArray]:
        """Smallest and largest value of every label."""
        return label_span(self.checkpoint.task.heads)

    def float_trace(self, layer: int, seen: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """The SGM behind `layer` in float, as :func:`qsgm.sgm.float.float_trace`."""
        return float_trace(self.sgms[layer], seen, torch_product)

    def start(self, tuned: int) -> list[LayerState]:
        """The last `tuned` layers before the first step."""
        layers = self.net.layers[-tuned:]
        return start_states(
            [
                (torch.from_numpy(to_step_layout(layer.weight)).T, torch.from_numpy(layer.bias))
                for layer in layers
            ],
            tasks=1,
        )

    def seen(self, lesson: Lesson, tuned: int) -> SeenLesson:
        """A lesson as the first of the tuned layers sees it."""
        frozen = self.network.depth - tuned
        return see_lesson(self.checkpoint.net, lesson, frozen, self.checkpoint.task)


def torch_product(conv: FoldedConv, side: Pair, x: FloatArray) -> FloatArray:
    """:func:`qsgm.sgm.float.float_product` by torch, which takes maps five to ten times as fast."""
    if conv.weight.shape[2:] == ONE:
        return float_product(conv, side, x)
    maps: FloatArray = positions_of(
        run_folded_conv(conv, maps_of(torch.from_numpy(x), side))
    ).numpy()
    return maps


@dataclass(frozen=True)
class Moment:
    """One step of a run: the tuned layers before it, and the batch that they are about to see."""

    states: list[LayerState]
    rows: Tensor  # (B,), the batch among the lesson's samples
    features: Tensor  # (1, B, P, C)
    labels: Tensor  # (1, B, L)


@dataclass(frozen=True)
class Look:
    """All of a moment but what the lesson has: weights and biases, and the batch's rows."""

    weights: list[tuple[Tensor, Tensor]]
    rows: Tensor

    @staticmethod
    def at(moment: Moment) -> "Look":
        return Look([(state.weight, state.bias) for state in moment.states], moment.rows)

    def again(self, task: SeenLesson) -> Moment:
        """The moment, its momenta forgotten: nothing that is measured asks for them."""
        states = [LayerState.start(*one) for one in self.weights]
        return moment_of(states, task, self.rows)


# By lesson, of its run with maps. Those take nearly all of the time, and float SGMs drive them
# whatever is measured, so that one run does for all that is.
Looks = dict[int, list[Look]]


def moment_of(states: list[LayerState], task: SeenLesson, rows: Tensor) -> Moment:
    """A step on these samples of a lesson."""
    return Moment(states, rows, task.features[None, rows], task.labels[None, rows])


def prepare(checkpoint: Checkpoint) -> Trainee:
    """Fold a checkpoint. Raises QsgmError where batchnorm cannot be folded."""
    sgms = {layer: fold_sgm(sgm) for layer, sgm in sorted(checkpoint.sgms.items())}
    return Trainee(checkpoint, fold_net(checkpoint.net), sgms)


def one_position(network: Network) -> int:
    """The most layers that can be tuned with SGMs that all see one position."""
    flat = 1
    while flat < network.depth and network.positions_after(network.depth - flat) == 1:
        flat += 1
    return flat


def run_plans(network: Network, most_layers: int, epochs: int) -> list[RunPlan]:
    """Whole runs of SGMs that see one position, and a short one of all layers if there are more."""
    flat, depth = min(most_layers, one_position(network)), network.depth
    plans = [
        RunPlan(tuned, CROPS, epochs, range(depth + 1 - tuned, depth))
        for tuned in range(2, flat + 1)
    ]
    if most_layers > flat:
        measured = range(depth + 1 - most_layers, depth + 1 - flat)
        plans.append(RunPlan(most_layers, MAP_CROPS, min(epochs, MAP_EPOCHS), measured, maps=True))
    return plans


def measured_plans(trainee: Trainee, epochs: int) -> list[RunPlan]:
    """The runs that show all SGMs: those of two layers are part of those of three."""
    most = trainee.checkpoint.most_layers
    plans = run_plans(trainee.network, most, epochs)
    return [plan for plan in plans if plan.tuned >= min(most, one_position(trainee.network))]


def run(
    trainee: Trainee, lesson: Lesson, plan: RunPlan, seed: list[int], sgm_gradient: SgmGradient
) -> Iterator[Moment]:
    """Fine-tune the last layers on a lesson as the device does; yields before every step.

    Raises QsgmError when the run diverges.
    """
    task = trainee.seen(lesson, plan.tuned)
    states = trainee.start(plan.tuned)
    layers = trainee.network.last(plan.tuned)
    rates = torch.tensor(trainee.checkpoint.rates[str(single_layers(layers))])
    done, steps = 0, plan.epochs * -(-len(task.labels) // BATCH)
    generator = torch.Generator().manual_seed(int(np.random.default_rng(seed).integers(2**31)))
    for _ in range(plan.epochs):
        for rows in torch.randperm(len(task.labels), generator=generator).split(BATCH):
            moment = moment_of(states, task, rows)
            yield moment
            factor = rate_factor(done, steps)
            states = step(trainee, moment, list(factor * rates), sgm_gradient)
            refuse_unless_finite(states)
            done += 1


@dataclass(frozen=True)
class CalibrationRuns:
    """The same runs on every lesson of a calibration set, whoever goes along."""

    trainee: Trainee
    lessons: Lessons
    epochs: int = EPOCHS  # length of a whole run
    looks: Looks = field(default_factory=dict)  # that were kept, and are taken again
    seed: int = 0  # of crops and batches

    def lesson(self, i: int, plan: RunPlan) -> Lesson:
        """What a run on the i-th lesson learns from."""
        return self.lessons.lesson(i, np.random.default_rng([self.seed, i]), plan.crops)

    def run(self, i: int, plan: RunPlan, sgm_gradient: SgmGradient) -> Iterator[Moment]:
        """Every step of a run on the i-th lesson, see :func:`run`."""
        return run(self.trainee, self.lesson(i, plan), plan, [self.seed, i], sgm_gradient)

    def measured(
        self, i: int, gradient: Callable[[RunPlan, int, FloatArray], FloatArray]
    ) -> Iterator[tuple[RunPlan, Moment]]:
        """Every now and then a step of the runs that show all SGMs, as `gradient` drives them."""
        for plan in measured_plans(self.trainee, self.epochs):
            if plan.maps and i in self.looks:
                task = self.trainee.seen(self.lesson(i, plan), plan.tuned)
                yield from ((plan, look.again(task)) for look in self.looks[i])
            else:
                steps = self.run(i, plan, partial(gradient, plan))
                yield from ((plan, one) for one in islice(steps, 0, None, plan.measure_every))


def in_each(
    lessons: range, work: Callable[[int], Done], stage: str, watch: Progress, in_turn: InTurn
) -> Iterator[tuple[int, Done]]:
    """What comes of every lesson, by its number; `watch` is told about each."""
    watch(stage, 0, len(lessons))
    for done, found in enumerate(in_turn(work, lessons)):  # not zip, which keeps the one before
        yield lessons[done], found
        watch(stage, done + 1, len(lessons))


def step(
    trainee: Trainee, moment: Moment, rates: list[Tensor], sgm_gradient: SgmGradient
) -> list[LayerState]:
    """One feed-forward step."""
    network, heads = trainee.network, trainee.checkpoint.task.heads

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == network.depth:
            return error(heads, activation, labels[:, :, None])
        filled = labels[0, :, None].expand(-1, activation.shape[2], -1)
        seen = torch.cat([activation[0], filled], dim=2).numpy()
        return torch.from_numpy(sgm_gradient(layer, seen))[None]

    return local_step(
        network,
        moment.states,
        moment.features,
        moment.labels,
        rates,
        gradient_of,
        trainee.checkpoint.curvatures,
    )


def refuse_unless_finite(states: list[LayerState]) -> None:
    """Raise QsgmError for a run that has blown up."""
    if not all(torch.isfinite(state.weight).all() for state in states):
        raise QsgmError(
            f"fine-tuning {len(states)} layers on a calibration lesson diverged: the checkpoint's"
            " SGMs and rates do not work; pretrain again"
        )


def float_moment(trainee: Trainee, moment: Moment) -> dict[int, tuple[FloatArray, FloatArray]]:
    """What each SGM sees on one batch, and its float gradient; nothing moves."""
    found = {}

    def gradient(layer: int, seen: FloatArray) -> FloatArray:
        floating, _ = trainee.float_trace(layer, seen)
        found[layer] = seen, floating
        return floating

    still = [torch.zeros(())] * len(moment.states)
    step(trainee, moment, still, gradient)
    return found


def passes_of(network: Network, moment: Moment) -> dict[int, tuple[Tensor, Tensor]]:
    """By layer, the windows (1, B, P, K) it sees and its pre-activation (1, B, P, C)."""
    passes, x = {}, moment.features
    for layer, state in zip(network.last(len(moment.states)), moment.states, strict=True):
        windows = columns(network, layer, x)
        before, x = layer_forward(network, layer, state, windows)
        passes[layer] = windows, before
    return passes
