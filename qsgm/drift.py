"""The drift watch: whether an object lies outside what the int8 SGMs were calibrated on.

Clipping and underflow say that an SGM sees other numbers than in calibration; whether they cost
anything is said by its cosine to the float SGM, which every run measures as well.
"""

from collections.abc import Mapping

from qsgm.fidelity import LayerFidelity

# Means over a run. Beyond these, what int8 SGMs tune may be worse than what float ones would.
NOTABLE_CLIPPING = 0.01
NOTABLE_UNDERFLOW = 0.25
LEAST_COSINE = 0.98


def drift_warnings(fidelity: Mapping[int, LayerFidelity]) -> tuple[str, ...]:
    """One line for every SGM whose ranges do not fit the object."""
    return tuple(
        f"layer {k}: {why}: this object is unlike the calibration set; tune it with --recalibrate"
        for k, layer in fidelity.items()
        if (why := drift_of(layer))
    )


def drift_of(layer: LayerFidelity) -> str:
    """What is wrong with one SGM's ranges; empty if nothing is."""
    if layer.clipped_fraction > NOTABLE_CLIPPING:
        share = f"{100 * layer.clipped_fraction:.1f} %"
        return f"{share} of what its int8 SGM saw lies outside the calibrated ranges"
    if layer.underflow_fraction > NOTABLE_UNDERFLOW:
        share = f"{100 * layer.underflow_fraction:.0f} %"
        return f"{share} of what its int8 SGM saw is too small for the calibrated ranges"
    if layer.cos_int8_float < LEAST_COSINE:
        return f"int8 gradients are at a cosine of {layer.cos_int8_float:.2f} to the float ones"
    return ""
