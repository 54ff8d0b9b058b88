"""Ranges for the int8 SGMs, from what they see along whole fine-tuning runs.

Activations move while layers train, so ranges are taken from the first step to the last, on every
calibration frame, channel by channel. Values are looked at and dropped: one frame is in memory at
a time, and of each run only its current step.

Which calibrator suits a layer is not known beforehand. The default tries them all on some of the
frames, with ranges from the others, and takes for each layer the one whose int8 gradients point
most nearly where the float ones do.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from qsgm.errors import QsgmError
from qsgm.fidelity import cosine
from qsgm.progress import Progress
from qsgm.sgm.float import FloatArray
from qsgm.sgm.int8 import ActivationBits, QuantizedSgm, SgmRanges, integer_forward, quantize_sgm
from qsgm.sgm.ranges import CALIBRATORS, SgmObservers
from qsgm.train.processes import InTurn
from qsgm.train.quantization.calibration_runs import (
    CalibrationRuns,
    Look,
    Looks,
    RunPlan,
    Trainee,
    float_moment,
    in_each,
    run_plans,
)

# Not a calibrator: for each layer the best of them.
AUTO = "auto"
HELD_OUT_EVERY = 4
EQUAL_COSINE = 1e-5

# layer: calibrator: the SGM
Candidates = Mapping[int, Mapping[str, QuantizedSgm]]


@dataclass(frozen=True)
class Calibration:
    """Every SGM's ranges, whose they are, and why; all by layer."""

    ranges: dict[int, SgmRanges]
    chosen: dict[int, str]  # calibrator
    # calibrator: mean cosine of int8 to float gradients; empty where none was to be chosen
    cosines: dict[int, dict[str, float]]
    # Frames that the cosines were measured on and the ranges then compared were not taken from;
    # 0: both were all frames.
    held_out: int
    looks: Looks = field(default_factory=dict)  # that it had on the way


def calibrate(
    runs: CalibrationRuns,
    watch: Progress,
    calibrator: str = AUTO,
    activation_bits: ActivationBits = 16,
    in_turn: InTurn = map,
) -> Calibration:
    """Fine-tune on every frame with the float SGMs and take each SGM's ranges on the way.

    Layers are tuned by twos and by threes: the SGM behind layer 5 serves both. Where SGMs stand
    behind layers 1 to 3 all layers are tuned as well, in short runs, see
    :data:`qsgm.train.quantization.calibration_runs.MAP_EPOCHS`.

    Args:
        runs: of what is fine-tuned, on the calibration set.
        watch: told about progress.
        calibrator: one of :data:`qsgm.sgm.ranges.CALIBRATORS`, or :data:`AUTO`: for each layer
            the one that does best on frames held out.
        activation_bits: of the int8 SGMs.
        in_turn: goes through the frames.

    Raises:
        QsgmError: there is no such calibrator, a run diverged, or a frame cannot be used.
    """
    refuse_unknown(calibrator)
    trainee, every = runs.trainee, range(len(runs.lessons))
    held_out = held_out_frames(len(every)) if calibrator == AUTO else range(0)
    everything, compared, looks = observe(runs, watch, held_out, in_turn)
    if calibrator == AUTO:
        candidates = quantize_all(trainee, compared, activation_bits)
        judges = held_out or every
        cosines = judge(replace(runs, looks=looks), candidates, judges, watch, in_turn)
        chosen = {layer: best_calibrator(cosines[layer]) for layer in trainee.sgms}
    else:
        cosines = {layer: {} for layer in trainee.sgms}
        chosen = dict.fromkeys(trainee.sgms, calibrator)
    ranges = {
        layer: everything[layer].ranges(chosen[layer], 2**activation_bits, trainee.label_span)
        for layer in trainee.sgms
    }
    return Calibration(ranges, chosen, cosines, len(held_out), looks)


def refuse_unknown(calibrator: str) -> None:
    """Raise QsgmError for a name that is no calibrator's."""
    if calibrator not in (AUTO, *CALIBRATORS):
        raise QsgmError(
            f"there is no calibrator {calibrator!r}; take one of {', '.join((AUTO, *CALIBRATORS))}"
        )


def held_out_frames(count: int) -> range:
    """Every fourth; of fewer frames than that, none can be spared."""
    return range(HELD_OUT_EVERY - 1, count, HELD_OUT_EVERY)


def observe(
    runs: CalibrationRuns, watch: Progress, held_out: range, in_turn: InTurn
) -> tuple[dict[int, SgmObservers], dict[int, SgmObservers], Looks]:
    """What each SGM sees in the runs on all frames, and on those that are not held out; looks."""
    everything, compared = (
        {layer: SgmObservers(sgm) for layer, sgm in runs.trainee.sgms.items()} for _ in range(2)
    )
    work, looks = partial(observe_lesson, runs), Looks()
    for i, (observers, kept) in in_each(
        range(len(runs.lessons)), work, "calibrate", watch, in_turn
    ):
        for layer, seen in observers.items():
            everything[layer].merge(seen)
            if i not in held_out:
                compared[layer].merge(seen)
        if kept:
            looks[i] = kept
    return everything, compared, looks


def observe_lesson(runs: CalibrationRuns, i: int) -> tuple[dict[int, SgmObservers], list[Look]]:
    """What each SGM sees in the runs on one lesson, and looks at the run with maps."""
    kept, trainee = list[Look](), runs.trainee
    observers = {layer: SgmObservers(sgm) for layer, sgm in trainee.sgms.items()}
    for plan in run_plans(trainee.network, trainee.checkpoint.most_layers, runs.epochs):

        def gradient(layer: int, seen: FloatArray, plan: RunPlan = plan) -> FloatArray:
            result, hidden = trainee.float_trace(layer, seen)
            if layer in plan.measured:
                observers[layer].update(seen, hidden)
            return result

        for done, moment in enumerate(runs.run(i, plan, gradient)):
            if plan.maps and done % plan.measure_every == 0:
                kept.append(Look.at(moment))
    return observers, kept


def quantize_all(
    trainee: Trainee, seen: Mapping[int, SgmObservers], activation_bits: ActivationBits
) -> Candidates:
    """The int8 SGMs by every calibrator's ranges."""
    levels = 2**activation_bits
    return {
        layer: {
            name: quantize_sgm(
                sgm, seen[layer].ranges(name, levels, trainee.label_span), activation_bits
            )
            for name in CALIBRATORS
        }
        for layer, sgm in trainee.sgms.items()
    }


def judge(
    runs: CalibrationRuns, candidates: Candidates, judges: range, watch: Progress, in_turn: InTurn
) -> dict[int, dict[str, float]]:
    """Each calibrator's mean cosine of int8 to float gradients on some frames, by layer."""
    cosines: dict[int, dict[str, list[float]]] = {
        layer: {name: [] for name in CALIBRATORS} for layer in candidates
    }
    work = partial(judge_lesson, runs, candidates)
    for _, found in in_each(judges, work, "choose", watch, in_turn):
        for layer, name, value in found:
            cosines[layer][name].append(value)
    return {
        layer: {name: float(np.mean(values)) for name, values in by_name.items()}
        for layer, by_name in cosines.items()
    }


def judge_lesson(
    runs: CalibrationRuns, candidates: Candidates, i: int
) -> list[tuple[int, str, float]]:
    """Every now and then along the runs on one lesson, each calibrator's cosine at each SGM.

    The float SGMs drive the runs, so that all calibrators are asked the same.
    """

    def gradient(_: RunPlan, layer: int, seen: FloatArray) -> FloatArray:
        return runs.trainee.float_trace(layer, seen)[0]

    return [
        (layer, name, cosine(integer_forward(sgm, seen)[0], floating))
        for plan, moment in runs.measured(i, gradient)
        for layer, (seen, floating) in float_moment(runs.trainee, moment).items()
        if layer in plan.measured
        for name, sgm in candidates[layer].items()
    ]


def best_calibrator(cosines: Mapping[str, float]) -> str:
    """The one with the highest cosine; of equals the first."""
    best = max(cosines.values())
    return next(name for name, value in cosines.items() if value >= best - EQUAL_COSINE)
