"""The drift watch: it goes by the harm, and names the SGM, the reason and the way out."""

from dataclasses import fields, replace

import pytest

from qsgm.fidelity import LayerFidelity
from qsgm.tune.drift import LEAST_COSINE, NOTABLE_CLIPPING, NOTABLE_UNDERFLOW, drift_warnings

GOOD = LayerFidelity(
    **{one.name: 0.0 for one in fields(LayerFidelity) if not one.name.startswith("cos")},
    **{one.name: 1.0 for one in fields(LayerFidelity) if one.name.startswith("cos")},
)


def test_nothing_is_said_of_gradients_that_are_faithful_whatever_clips() -> None:
    clipping = replace(GOOD, clipped_fraction=0.3, underflow_fraction=0.9)
    edge = replace(GOOD, cos_int8_float=LEAST_COSINE)
    assert drift_warnings({4: clipping, 5: edge}, "mend it") == ()


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"clipped_fraction": 0.08, "underflow_fraction": 0.4}, ", 8.0 % of what the SGM saw lies"),
        ({"underflow_fraction": 0.4}, ", 40 % of what the SGM saw is too small"),
        (
            {"clipped_fraction": NOTABLE_CLIPPING, "underflow_fraction": NOTABLE_UNDERFLOW},
            ": what is learnt from",
        ),
    ],
)
def test_an_unfaithful_sgm_is_named_with_what_its_ranges_do(
    change: dict[str, float], reason: str
) -> None:
    (line,) = drift_warnings({4: GOOD, 5: replace(GOOD, cos_int8_float=0.7, **change)}, "mend it")
    start = "layer 5: int8 gradients are at a cosine of 0.70 to the float ones"
    assert line.startswith(start + reason)
    assert line.endswith("; mend it")
