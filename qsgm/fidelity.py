"""How faithful gradients are: int8 against float, int8 against true, float against true.

A probe runs a batch through the tuned layers as they are at that moment and returns, for every
SGM, its int8 gradient, its float gradient and the true one by backpropagation. Metrics compare
whole batches, since a batch is what a layer learns from; reports give means over a run.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
# What a probe says of each SGM, the layer's number behind the name.
PROBED = ("int8", "float", "true", "clipped")


@dataclass(frozen=True)
class LayerFidelity:
    """One SGM's gradients on one batch, or their mean over a run."""

    cos_int8_float: float  # cosine, in [-1, 1]
    cos_int8_true: float
    cos_float_true: float
    norm_ratio_int8_true: float  # |int8| / |true|
    sign_agreement_int8_float: float  # fraction of components whose signs agree
    sqnr_db: float  # float SGM's power over that of the quantization error [dB]
    clipped_fraction: float  # of the SGM's inputs outside the calibrated ranges


def compare(int8: Array, floating: Array, true: Array, clipped: float) -> LayerFidelity:
    """Compare the gradients (B, P, C) of one batch."""
    return LayerFidelity(
        cos_int8_float=cosine(int8, floating),
        cos_int8_true=cosine(int8, true),
        cos_float_true=cosine(floating, true),
        norm_ratio_int8_true=_ratio(_norm(int8), _norm(true)),
        sign_agreement_int8_float=float(np.mean(np.sign(int8) == np.sign(floating))),
        sqnr_db=sqnr_db(int8, floating),
        clipped_fraction=clipped,
    )


def mean_over_run(probes: Sequence[LayerFidelity]) -> LayerFidelity:
    """The mean of every metric."""
    names = LayerFidelity.__dataclass_fields__
    return LayerFidelity(
        **{name: float(np.mean([getattr(p, name) for p in probes])) for name in names}
    )


def compare_probe(outputs: Mapping[str, Array], layers: Sequence[int]) -> dict[int, LayerFidelity]:
    """One probe's outputs (`int8{k}`, `float{k}`, `true{k}`, `clipped{k}`), layer by layer."""
    return {
        k: compare(
            outputs[f"int8{k}"],
            outputs[f"float{k}"],
            outputs[f"true{k}"],
            float(outputs[f"clipped{k}"]),
        )
        for k in layers
    }


def cosine(a: Array, b: Array) -> float:
    """Cosine of two arrays taken as vectors; 0 if either vanishes."""
    x, y = a.ravel().astype(np.float64), b.ravel().astype(np.float64)
    return _ratio(float(x @ y), _norm(a) * _norm(b))


def sqnr_db(quantized: Array, reference: Array) -> float:
    """Power of the reference over that of its quantization error [dB]; capped at 200."""
    error = _norm(quantized.astype(np.float64) - reference)
    return min(200.0, 20 * float(np.log10(max(_norm(reference), 1e-30) / max(error, 1e-30))))


def _norm(a: NDArray[np.floating]) -> float:
    return float(np.linalg.norm(a.ravel().astype(np.float64)))


def _ratio(a: float, b: float) -> float:
    return a / b if b > 0 else 0.0
