"""The drift watch: whether int8 SGMs still do what float ones would, on this object.

An object outside the calibration set need not suffer from it, so the warning goes by the harm: the
cosine of int8 to float gradients, which every run measures. What is clipped or underflows says why.
"""

from collections.abc import Mapping

from qsgm.fidelity import LayerFidelity

# Mean over a run. In `qsgm bench calibration` most runs below it end worse than with float SGMs, of
# those above it one in a hundred.
LEAST_COSINE = 0.85
# Above these shares, ranges are named as the reason.
NOTABLE_CLIPPING = 0.01
NOTABLE_UNDERFLOW = 0.25


def drift_warnings(fidelity: Mapping[int, LayerFidelity], advice: str) -> tuple[str, ...]:
    """One line for every SGM that its ranges make unfaithful; `advice` ends it."""
    return tuple(
        f"layer {k}: int8 gradients are at a cosine of {layer.cos_int8_float:.2f} to the float "
        f"ones{reason(layer)}: what is learnt from is unlike the calibration set; {advice}"
        for k, layer in fidelity.items()
        if layer.cos_int8_float < LEAST_COSINE
    )


def reason(layer: LayerFidelity) -> str:
    """What its ranges do to what an SGM sees; empty if nothing much."""
    if layer.clipped_fraction > NOTABLE_CLIPPING:
        share = f"{100 * layer.clipped_fraction:.1f} %"
        return f", {share} of what the SGM saw lies outside the calibrated ranges"
    if layer.underflow_fraction > NOTABLE_UNDERFLOW:
        share = f"{100 * layer.underflow_fraction:.0f} %"
        return f", {share} of what the SGM saw is too small for the calibrated ranges"
    return ""
