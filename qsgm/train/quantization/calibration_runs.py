"""Fine-tuning runs on calibration frames, as on the device, with SGMs that the caller runs.

Activations move while layers train, so whoever wants to know what an SGM sees has to go along. Of a
run only its current step is in memory.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from qsgm.blocks import single_layers, tuned_layers
from qsgm.errors import QsgmError
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm, float_product, float_trace
from qsgm.train.checkpoint import Checkpoint
from qsgm.train.model.fold import FoldedNet, fold_net, fold_sgm, run_folded_conv
from qsgm.train.model.graspnet import LAYERS
from qsgm.train.model.local import LayerState, columns, layer_forward, local_step, loss_gradient
from qsgm.train.pretraining.maml import MOMENTUM
from qsgm.train.pretraining.tasks import Task, make_task, start_states
from qsgm.train.quantization.calibration_set import Demonstration
from qsgm.tune.loop import BATCH, rate_factor
from qsgm.weights import to_step_layout

CROPS = 400
EPOCHS = 40  # as many steps as 20 epochs on the 800 crops of the device
# The most layers whose SGMs all see one position per crop. Those further ahead see whole maps, so
# that a step takes about a hundred times as long: whole runs of them would take hours.
ONE_POSITION = 3
# A run of all layers is therefore a short one, its rates decaying as fast, on the same frames. The
# activations of those layers move little, and every crop gives as many samples as its map is large.
MAP_CROPS = 96
MAP_EPOCHS = 10
# Steps between two measurements of fidelity; consecutive steps tell the same.
MEASURE_EVERY_STEPS = 13
MEASURE_MAPS_EVERY_STEPS = 15

# (layer, what its SGM sees (B, P, Ci)) -> gradient (B, P, C)
SgmGradient = Callable[[int, FloatArray], FloatArray]


@dataclass(frozen=True)
class RunPlan:
    """A fine-tuning run: how many layers, on how many crops, for how many passes over them."""

    tuned: int
    crops: int
    epochs: int

    @property
    def maps(self) -> bool:
        """Whether there are SGMs in it that see whole maps; it is then there for those alone."""
        return self.tuned > ONE_POSITION

    @property
    def measured(self) -> range:
        """The layers of the SGMs that it is there for."""
        return range(LAYERS + 1 - self.tuned, LAYERS + 1 - ONE_POSITION if self.maps else LAYERS)

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

    def float_trace(self, layer: int, seen: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
        """The SGM behind `layer` in float, as :func:`qsgm.sgm.float.float_trace`."""
        return float_trace(self.sgms[layer], seen, torch_product)

    def start(self, tuned: int) -> list[LayerState]:
        """The last `tuned` layers before the first step."""
        layers = self.net.layers[LAYERS - tuned :]
        return start_states(
            [
                (torch.from_numpy(to_step_layout(layer.weight)).T, torch.from_numpy(layer.bias))
                for layer in layers
            ],
            tasks=1,
        )

    def task(self, demonstration: Demonstration, plan: RunPlan, seed: list[int]) -> Task:
        """The crops of one frame, as the first of the tuned layers sees them."""
        return make_task(
            self.checkpoint.net,
            demonstration.image,
            np.random.default_rng(seed),
            last_frozen=LAYERS - plan.tuned,
            count=plan.crops,
            loss=self.checkpoint.loss,
            center_px=demonstration.center_px,
        )


def torch_product(conv: FoldedConv, x: FloatArray) -> FloatArray:
    """:func:`qsgm.sgm.float.float_product` by torch, which takes maps five to ten times as fast."""
    if conv.weight.shape[2] == 1:
        return float_product(conv, x)
    side = round(x.shape[1] ** 0.5)
    maps = torch.from_numpy(x).transpose(1, 2).unflatten(2, (side, side))
    return run_folded_conv(conv, maps).flatten(2).transpose(1, 2).contiguous().numpy()


@dataclass(frozen=True)
class Moment:
    """One step of a run: the tuned layers before it, and the batch that they are about to see."""

    states: list[LayerState]
    features: Tensor  # (1, B, P, C)
    labels: Tensor  # (1, B, 3)


def prepare(checkpoint: Checkpoint) -> Trainee:
    """Fold a checkpoint. Raises QsgmError where batchnorm cannot be folded."""
    sgms = {layer: fold_sgm(sgm) for layer, sgm in sorted(checkpoint.sgms.items())}
    return Trainee(checkpoint, fold_net(checkpoint.net), sgms)


def run_plans(most_layers: int, epochs: int) -> list[RunPlan]:
    """Whole runs of two and of three layers, and a short one of all layers if there are more."""
    whole = range(2, min(most_layers, ONE_POSITION) + 1)
    plans = [RunPlan(tuned, CROPS, epochs) for tuned in whole]
    if most_layers > ONE_POSITION:
        plans.append(RunPlan(most_layers, MAP_CROPS, min(epochs, MAP_EPOCHS)))
    return plans


def measured_plans(trainee: Trainee, epochs: int) -> list[RunPlan]:
    """The runs that show all SGMs: those of two layers are part of those of three."""
    most = trainee.checkpoint.most_layers
    return [plan for plan in run_plans(most, epochs) if plan.tuned >= min(most, ONE_POSITION)]


def run(
    trainee: Trainee,
    demonstration: Demonstration,
    plan: RunPlan,
    seed: list[int],
    sgm_gradient: SgmGradient,
) -> Iterator[Moment]:
    """Fine-tune the last layers on one frame as the device does; yields before every step.

    Raises QsgmError when the run diverges.
    """
    task = trainee.task(demonstration, plan, seed)
    states = trainee.start(plan.tuned)
    rates = torch.tensor(trainee.checkpoint.rates[str(single_layers(plan.tuned))])
    done, steps = 0, plan.epochs * -(-len(task.labels) // BATCH)
    generator = torch.Generator().manual_seed(int(np.random.default_rng(seed).integers(2**31)))
    for _ in range(plan.epochs):
        for rows in torch.randperm(len(task.labels), generator=generator).split(BATCH):
            moment = Moment(states, task.features[None, rows], task.labels[None, rows])
            yield moment
            factor = rate_factor(done, steps)
            states = step(trainee, moment, list(factor * rates), sgm_gradient)
            refuse_unless_finite(states)
            done += 1


def step(
    trainee: Trainee, moment: Moment, rates: list[Tensor], sgm_gradient: SgmGradient
) -> list[LayerState]:
    """One feed-forward step."""
    loss = trainee.checkpoint.loss

    def gradient_of(layer: int, activation: Tensor, labels: Tensor) -> Tensor:
        if layer == LAYERS:
            return loss_gradient(loss, activation, labels[:, :, None])
        filled = labels[0, :, None].expand(-1, activation.shape[2], -1)
        seen = torch.cat([activation[0], filled], dim=2).numpy()
        return torch.from_numpy(sgm_gradient(layer, seen))[None]

    return local_step(
        moment.states,
        moment.features,
        moment.labels,
        rates,
        gradient_of,
        MOMENTUM,
        trainee.checkpoint.curvatures,
    )


def refuse_unless_finite(states: list[LayerState]) -> None:
    """Raise QsgmError for a run that has blown up."""
    if not all(torch.isfinite(state.weight).all() for state in states):
        raise QsgmError(
            f"fine-tuning {len(states)} layers on a calibration frame diverged: the checkpoint's"
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


def passes_of(moment: Moment) -> dict[int, tuple[Tensor, Tensor]]:
    """By layer, the windows (1, B, P, K) it sees and its pre-activation (1, B, P, C)."""
    passes, x = {}, moment.features
    for layer, state in zip(tuned_layers(len(moment.states)), moment.states, strict=True):
        windows = columns(layer, x)
        before, x = layer_forward(layer, state, windows)
        passes[layer] = windows, before
    return passes
