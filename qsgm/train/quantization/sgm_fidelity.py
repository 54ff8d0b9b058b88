"""How faithful int8 SGMs are along whole fine-tuning runs on the calibration set."""

from collections.abc import Iterator, Mapping
from functools import partial

import torch
from torch import Tensor

from qsgm.fidelity import Gradients, LayerFidelity, compare, mean_over_run
from qsgm.network import Network
from qsgm.progress import Progress
from qsgm.sgm.float import FloatArray
from qsgm.sgm.int8 import QuantizedSgm, integer_forward, underflow_fraction
from qsgm.train.model.local import through_activation, true_gradients, weight_gradients
from qsgm.train.processes import InTurn
from qsgm.train.quantization.calibration_runs import (
    EPOCHS,
    Looks,
    Moment,
    RunPlan,
    Trainee,
    float_moment,
    measured_moments,
    measured_plans,
    passes_of,
)
from qsgm.train.quantization.lessons import Lessons

NO_LOOKS: Looks = {}


def measure(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    lessons: Lessons,
    seed: int,
    watch: Progress,
    epochs: int = EPOCHS,
    looks: Looks = NO_LOOKS,
    in_turn: InTurn = map,
) -> dict[int, LayerFidelity]:
    """Fidelity of each int8 SGM, mean over runs on every frame.

    Behind layers 4 and 5 it is taken along whole runs of the last three layers, and the int8 SGMs
    drive them, as on the device: what they see is what they have led to. Behind layers 1 to 3 it is
    taken along the short runs of all layers, which the float SGMs drive: they are quicker here, and
    calibration's `looks` at them can be looked at again.
    """
    measured: dict[int, list[LayerFidelity]] = {layer: [] for layer in int8_sgms}
    watch("measure", 0, len(lessons))
    work = partial(measure_lesson, trainee, int8_sgms, lessons, seed, epochs, looks)
    for done, found in enumerate(in_turn(work, range(len(lessons))), start=1):
        for layer, fidelity in found:
            measured[layer].append(fidelity)
        watch("measure", done, len(lessons))
    return {layer: mean_over_run(values) for layer, values in measured.items()}


def measure_lesson(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    lessons: Lessons,
    seed: int,
    epochs: int,
    looks: Looks,
    i: int,
) -> list[tuple[int, LayerFidelity]]:
    """What each SGM is worth in the runs on one lesson."""
    return [
        found
        for plan in measured_plans(trainee, epochs)
        for found in measure_run(trainee, int8_sgms, lessons, i, plan, seed, looks)
    ]


def measure_run(
    trainee: Trainee,
    int8_sgms: Mapping[int, QuantizedSgm],
    lessons: Lessons,
    i: int,
    plan: RunPlan,
    seed: int,
    looks: Looks,
) -> Iterator[tuple[int, LayerFidelity]]:
    """Every now and then along one run, what the SGMs that it is there for are worth."""

    def driver(layer: int, seen: FloatArray) -> FloatArray:
        if plan.maps:
            return trainee.float_trace(layer, seen)[0]
        return integer_forward(int8_sgms[layer], seen)[0]

    for moment in measured_moments(trainee, lessons, i, plan, seed, driver, looks):
        yield from compare_moment(trainee, int8_sgms, moment, plan.measured).items()


def compare_moment(
    trainee: Trainee, int8_sgms: Mapping[int, QuantizedSgm], moment: Moment, layers: range
) -> dict[int, LayerFidelity]:
    """Int8, float and true gradients on one batch behind `layers`, as they are at that moment."""
    network, heads = trainee.network, trainee.checkpoint.task.heads
    true = true_gradients(network, moment.states, moment.features, moment.labels, heads)
    fidelity, passes = {}, passes_of(network, moment)
    for layer, (seen, floating) in float_moment(trainee, moment).items():
        if layer in layers:
            int8, clipped = integer_forward(int8_sgms[layer], seen)
            given = (int8, floating, true[layer][0].numpy())
            updates = (update_from(network, layer, *passes[layer], gradient) for gradient in given)
            fidelity[layer] = compare(
                Gradients(*given),
                Gradients(*updates),
                clipped,
                underflow_fraction(int8_sgms[layer], seen),
            )
    return fidelity


def update_from(
    network: Network, layer: int, windows: Tensor, before: Tensor, gradient: FloatArray
) -> FloatArray:
    """Gradients of a layer's weight and bias, one after the other, from one on its activation.

    Args:
        layer: its number.
        windows: of its input, (1, B, P, K).
        before: its pre-activation, (1, B, P, C).
        gradient: (B, P', C), each sample's own.
    """
    dz = through_activation(network, layer, before, torch.from_numpy(gradient)[None])
    parts = weight_gradients(windows, dz)
    return torch.cat([part.flatten() for part in parts]).numpy()
