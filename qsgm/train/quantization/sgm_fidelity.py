"""How faithful int8 SGMs are along whole fine-tuning runs on the calibration set."""

from collections.abc import Mapping
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
    CalibrationRuns,
    Moment,
    RunPlan,
    Trainee,
    float_moment,
    in_each,
    passes_of,
)


def measure(
    runs: CalibrationRuns,
    int8_sgms: Mapping[int, QuantizedSgm],
    watch: Progress,
    in_turn: InTurn = map,
) -> dict[int, LayerFidelity]:
    """Fidelity of each int8 SGM, mean over runs on every frame.

    Behind layers 4 and 5 it is taken along whole runs of the last three layers, and the int8 SGMs
    drive them, as on the device: what they see is what they have led to. Behind layers 1 to 3 it is
    taken along the short runs of all layers, which the float SGMs drive: they are quicker here, and
    looks that calibration kept of them can be taken again.
    """
    measured: dict[int, list[LayerFidelity]] = {layer: [] for layer in int8_sgms}
    work, lessons = partial(measure_lesson, runs, int8_sgms), range(len(runs.lessons))
    for _, found in in_each(lessons, work, "measure", watch, in_turn):
        for layer, fidelity in found:
            measured[layer].append(fidelity)
    return {layer: mean_over_run(values) for layer, values in measured.items()}


def measure_lesson(
    runs: CalibrationRuns, int8_sgms: Mapping[int, QuantizedSgm], i: int
) -> list[tuple[int, LayerFidelity]]:
    """Every now and then along the runs on one lesson, what each SGM is worth."""

    def gradient(plan: RunPlan, layer: int, seen: FloatArray) -> FloatArray:
        if plan.maps:
            return runs.trainee.float_trace(layer, seen)[0]
        return integer_forward(int8_sgms[layer], seen)[0]

    return [
        found
        for plan, moment in runs.measured(i, gradient)
        for found in compare_moment(runs.trainee, int8_sgms, moment, plan.measured).items()
    ]


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
