"""The drift watch: it names the SGM, what is wrong with its ranges, and the way out."""

from dataclasses import fields, replace

import pytest

from qsgm.drift import LEAST_COSINE, NOTABLE_CLIPPING, NOTABLE_UNDERFLOW, drift_warnings
from qsgm.fidelity import LayerFidelity

GOOD = LayerFidelity(
    **{one.name: 0.0 for one in fields(LayerFidelity) if not one.name.startswith("cos")},
    **{one.name: 1.0 for one in fields(LayerFidelity) if one.name.startswith("cos")},
)


def test_nothing_is_said_of_ranges_that_fit() -> None:
    edge = replace(
        GOOD,
        clipped_fraction=NOTABLE_CLIPPING,
        underflow_fraction=NOTABLE_UNDERFLOW,
        cos_int8_float=LEAST_COSINE,
    )
    assert drift_warnings({4: GOOD, 5: edge}) == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"clipped_fraction": 0.08}, "8.0 % of what its int8 SGM saw lies outside"),
        ({"underflow_fraction": 0.4}, "40 % of what its int8 SGM saw is too small"),
        ({"cos_int8_float": 0.7}, "int8 gradients are at a cosine of 0.70 to the float ones"),
    ],
)
def test_each_sign_of_drift_is_named_with_its_layer(change: dict[str, float], message: str) -> None:
    (line,) = drift_warnings({4: GOOD, 5: replace(GOOD, **change)})
    assert line.startswith(f"layer 5: {message}")
    assert line.endswith("tune it with --recalibrate")
