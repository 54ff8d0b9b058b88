"""New activation scales on the device, from a lesson's own samples: no onnx, no run.

What the int8 SGMs would see is known before the first step: activations of the untouched network,
and the labels. The float SGMs, which a bundle holds as plain arrays, give what hidden channels make
of those; SGMs are then quantized again, and their constants take the place of the graphs' own.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.sgm.float import FloatArray, FoldedSgm, float_trace
from qsgm.sgm.int8 import ActivationBits, SgmRanges, constants, quantize_sgm
from qsgm.task import label_span
from qsgm.tune.graphs import open_probe
from qsgm.tune.plan import Overrides, Plan
from qsgm.tune.prepare import Prepared
from qsgm.tune.probe import activations_of

# Activations grow while layers learn. 16 bits have their headroom for that.
GROWTH: dict[ActivationBits, float] = {8: 1.5, 16: 1.0}
# Positions whose windows are in memory at once.
POSITIONS = 4096
# Samples whose activations an int8 SGM is calibrated on anew, and how many at a time; of maps,
# which have thousands of positions a sample, the first slice has to do.
SAMPLES, SAMPLES_AT_ONCE = 400, 16
MOST_LABELS = 16  # that every activation is seen beside


def recalibrate(prepared: Prepared, plan: Plan) -> Plan:
    """A run's plan with int8 SGMs calibrated on the samples it is to learn from.

    Raises:
        QsgmError: the run has no int8 SGM, or the bundle no probe to see activations with.
    """
    if not (plan.precision == "int8" and plan.blocks.sgm_layers):
        raise QsgmError(
            "there is nothing to recalibrate: the run has no int8 SGM; leave --recalibrate out, or "
            "tune two layers or more with --method sgm and --int8"
        )
    found = activations_before(prepared, plan)
    labels = typical_labels(prepared.labels[: prepared.taught])
    return replace(plan, overrides=recalibrated(prepared.bundle, found, labels))


def activations_before(prepared: Prepared, plan: Plan) -> dict[int, FloatArray]:
    """What the layers in front of SGMs give on some samples before any step, (N, P, C).

    Of maps a few samples do, each has thousands of positions; in memory are a few at a time.
    """
    session = open_probe(prepared.bundle, plan)
    found: dict[int, list[FloatArray]] = {}
    for first in range(0, min(SAMPLES, prepared.taught), SAMPLES_AT_ONCE):
        rows = np.arange(first, min(first + SAMPLES_AT_ONCE, prepared.taught))
        for layer, activation in activations_of(
            session, prepared, plan, prepared.start, rows
        ).items():
            if first == 0 or activation.shape[1] == 1:
                found.setdefault(layer, []).append(activation)
    return {layer: np.concatenate(slices) for layer, slices in found.items()}


def typical_labels(labels: FloatArray) -> FloatArray:
    """Some of the labels (N, L) that differ, spread over all of them: (K, L), K at most 16."""
    different: FloatArray = np.unique(labels, axis=0)
    spread = np.unique(np.linspace(0, len(different) - 1, MOST_LABELS).astype(int))
    return np.asarray(different[spread])


def recalibrated(
    bundle: Bundle, activations: Mapping[int, FloatArray], labels: FloatArray
) -> Overrides:
    """Constants of the int8 SGMs behind some layers, for what these layers give on a lesson.

    Args:
        bundle: gives the float SGMs.
        activations: by layer, (N, P, C).
        labels: (K, L), that any of these may come with.
    """
    exchanged: dict[int, dict[str, NDArray[Any]]] = {}
    span = label_span(bundle.manifest.heads)
    for layer, activation in activations.items():
        sgm, bits = bundle.float_sgm(layer), bundle.activation_bits(layer)
        ranges = grown(ranges_of(sgm, activation, labels, span), GROWTH[bits], sgm.labels)
        exchanged[layer] = constants(quantize_sgm(sgm, ranges, bits))
    return exchanged


def ranges_of(
    sgm: FoldedSgm,
    activation: FloatArray,
    labels: FloatArray,
    span: tuple[FloatArray, FloatArray],
) -> SgmRanges:
    """What an SGM sees and holds if any of these activations comes with any of these labels.

    Args:
        sgm: in float.
        activation: (N, P, C).
        labels: (K, L).
        span: smallest and largest value of any label, (L,) each.
    """
    count, positions, channels = activation.shape
    at_once = max(1, POSITIONS // positions)
    highs = [np.zeros(len(conv.bias), np.float32) for conv in sgm.convs[:-1]]
    for label in labels:
        seen = np.empty((count, positions, channels + len(label)), np.float32)
        seen[..., :channels], seen[..., channels:] = activation, label
        for first in range(0, count, at_once):
            _, hidden = float_trace(sgm, seen[first : first + at_once])
            highs = [
                np.maximum(high, tensor.max(axis=(0, 1)))
                for high, tensor in zip(highs, hidden, strict=True)
            ]
    return SgmRanges(
        np.concatenate([activation.min(axis=(0, 1)), span[0]]),
        np.concatenate([activation.max(axis=(0, 1)), span[1]]),
        tuple(highs),
    )


def grown(ranges: SgmRanges, factor: float, labels: int) -> SgmRanges:
    """Ranges with the high ends of activations and hidden tensors so many times as high."""
    high = ranges.input_high.copy()
    high[:-labels] *= factor
    hidden = tuple(factor * tensor for tensor in ranges.hidden_high)
    return replace(ranges, input_high=high, hidden_high=hidden)
