"""How faithful gradients are: int8 against float, int8 against true, float against true.

A probe runs a batch through the tuned layers as they are at that moment and returns, for every
SGM, its int8 gradient, its float gradient and the true one by backpropagation, and what the weights
before it would make of each. A layer learns from a batch, so most metrics take the batch as one
vector; those of single samples tell what the larger gradients in it hide. Reports give means over a
run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
# What a probe says of each SGM, the layer's number behind the name.
PROBED = (
    *("int8", "float", "true", "clipped", "underflow"),
    *("update_int8", "update_float", "update_true"),
)


@dataclass(frozen=True)
class Gradients:
    """One gradient as the int8 SGM, the float SGM and backpropagation have it; shapes agree."""

    int8: Array
    floating: Array
    true: Array


@dataclass(frozen=True)
class LayerFidelity:
    """One SGM's gradients on one batch, or their mean over a run.

    Of the gradients on the activation, the batch one vector; `sample`: every sample's own, mean
    over the batch; `update`: of the gradient of the layer's weight and bias that results.
    """

    cos_int8_float: float  # cosine, in [-1, 1]
    cos_int8_true: float
    cos_float_true: float
    cos_sample_int8_float: float
    cos_sample_int8_true: float
    cos_update_int8_float: float
    cos_update_int8_true: float
    cos_update_float_true: float
    direction_deviation_deg: float  # angle between int8 and float [degrees], in [0, 180]
    weighted_error: float  # sum(|int8 - float| |float|) / sum(float^2)
    norm_ratio_int8_true: float  # |int8| / |true|
    sign_agreement_int8_float: float  # fraction of components whose signs agree
    sqnr_db: float  # float SGM's power over that of the quantization error [dB]
    clipped_fraction: float  # of the SGM's inputs outside the calibrated ranges
    underflow_fraction: float  # of its inputs other than 0 that int8 cannot tell from 0


def compare(
    activation: Gradients, update: Gradients, clipped: float, underflow: float
) -> LayerFidelity:
    """Compare what one batch gives.

    Args:
        activation: gradients on the SGM's layer's activation (B, P, C), each sample's own.
        update: gradients of the layer's weight and bias, in any shape, from those.
        clipped: fraction of the int8 SGM's inputs outside its ranges.
        underflow: fraction of those other than 0 that are rounded to 0.
    """
    int8, floating, true = activation.int8, activation.floating, activation.true
    return LayerFidelity(
        cos_int8_float=cosine(int8, floating),
        cos_int8_true=cosine(int8, true),
        cos_float_true=cosine(floating, true),
        cos_sample_int8_float=mean_cosine(int8, floating),
        cos_sample_int8_true=mean_cosine(int8, true),
        cos_update_int8_float=cosine(update.int8, update.floating),
        cos_update_int8_true=cosine(update.int8, update.true),
        cos_update_float_true=cosine(update.floating, update.true),
        direction_deviation_deg=angle_between_deg(int8, floating),
        weighted_error=weighted_error(int8, floating),
        norm_ratio_int8_true=_ratio(_norm(int8), _norm(true)),
        sign_agreement_int8_float=float(np.mean(np.sign(int8) == np.sign(floating))),
        sqnr_db=sqnr_db(int8, floating),
        clipped_fraction=clipped,
        underflow_fraction=underflow,
    )


def mean_over_run(probes: Sequence[LayerFidelity]) -> LayerFidelity:
    """The mean of every metric."""
    names = LayerFidelity.__dataclass_fields__
    return LayerFidelity(
        **{name: float(np.mean([getattr(p, name) for p in probes])) for name in names}
    )


def compare_probe(outputs: Mapping[str, Array], layers: Sequence[int]) -> dict[int, LayerFidelity]:
    """One probe's outputs, :data:`PROBED` with the layer's number behind, layer by layer."""

    def gradients(kind: str, k: int) -> Gradients:
        return Gradients(*(outputs[f"{kind}{name}{k}"] for name in ("int8", "float", "true")))

    return {
        k: compare(
            gradients("", k),
            gradients("update_", k),
            float(outputs[f"clipped{k}"]),
            float(outputs[f"underflow{k}"]),
        )
        for k in layers
    }


def cosine(a: Array, b: Array) -> float:
    """Cosine of two arrays taken as vectors; 0 if either vanishes."""
    x, y = a.ravel().astype(np.float64), b.ravel().astype(np.float64)
    return _ratio(float(x @ y), _norm(a) * _norm(b))


def mean_cosine(a: Array, reference: Array) -> float:
    """Mean over the samples (B, ...) of each one's own cosine to its reference.

    Samples whose reference vanishes have no direction to be compared with and are left out; 0 if
    none is left. A sample that vanishes itself counts as 0.
    """
    x, y = (some.reshape(len(some), -1).astype(np.float64) for some in (a, reference))
    lengths = np.linalg.norm(x, axis=1), np.linalg.norm(y, axis=1)
    there = lengths[1] > 0
    if not there.any():
        return 0.0
    products, sizes = np.sum(x * y, axis=1)[there], (lengths[0] * lengths[1])[there]
    return float(np.mean(np.divide(products, sizes, where=sizes > 0, out=np.zeros_like(sizes))))


def angle_between_deg(a: Array, b: Array) -> float:
    """Angle between two arrays taken as vectors [degrees], in [0, 180]; 90 if either vanishes.

    The arccosine of the cosine would lose everything below 1e-6 degrees to rounding; difference
    and sum of the unit vectors do not (Kahan, Computing cross-products and rotations, 2016).
    """
    if not (np.any(a) and np.any(b)):
        return 90.0
    u, v = a.astype(np.float64) / _norm(a), b.astype(np.float64) / _norm(b)
    return float(np.degrees(2 * np.arctan2(_norm(u - v), _norm(u + v))))


def weighted_error(quantized: Array, reference: Array) -> float:
    """sum(|quantized - reference| |reference|) / sum(reference^2); 0 if the reference vanishes.

    Relative errors of single components, weighted by their squares: an error of a tenth in every
    component is 0.1, and small components hardly count.
    """
    size = np.abs(reference.astype(np.float64))
    return _ratio(float(np.sum(np.abs(quantized - reference) * size)), float(np.sum(size**2)))


def sqnr_db(quantized: Array, reference: Array) -> float:
    """Power of the reference over that of its quantization error [dB]; capped at 200."""
    error = _norm(quantized.astype(np.float64) - reference)
    return min(200.0, 20 * float(np.log10(max(_norm(reference), 1e-30) / max(error, 1e-30))))


def _norm(a: NDArray[np.floating]) -> float:
    return float(np.linalg.norm(a.ravel().astype(np.float64)))


def _ratio(a: float, b: float) -> float:
    return a / b if b > 0 else 0.0
