"""Evidence becomes quality: kept as it was written, refused when it is damaged."""

import json
from typing import Any

import numpy as np
import pytest
from toys import by_correlation

from qsgm import QsgmError
from qsgm.grasp.decision import Decision
from qsgm.grasp.evidence import NAMES, evidence


def random_decision() -> Decision:
    rng = np.random.default_rng(0)
    facts, hidden = len(NAMES), 5
    shapes = ((facts,), (facts,), (hidden, facts), (hidden,), (hidden,))
    arrays = [rng.normal(0, 1, shape).astype(np.float32) for shape in shapes]
    arrays[1] = np.abs(arrays[1]) + np.float32(0.1)
    return Decision(*arrays, bias=0.3, threshold=0.7)


def test_quality_is_that_of_a_network_with_one_hidden_layer() -> None:
    decision, rng = random_decision(), np.random.default_rng(1)
    facts = rng.normal(0, 1, (4, len(NAMES))).astype(np.float32)
    for row in facts:
        total = decision.bias - decision.threshold
        for weights, bias, out in zip(
            decision.hidden, decision.hidden_bias, decision.output, strict=True
        ):
            before = bias + sum(
                w * (x - m) / d
                for w, x, m, d in zip(weights, row, decision.mean, decision.deviation, strict=True)
            )
            total += out * max(0.0, before)
        assert decision.quality(row) == pytest.approx(1 / (1 + np.exp(-total)), abs=1e-5)
    np.testing.assert_allclose(decision.quality(facts)[2], decision.quality(facts[2]))


def test_the_threshold_is_where_quality_is_a_half() -> None:
    decision = by_correlation(threshold=0.6)
    facts = np.zeros(len(NAMES), np.float32)
    facts[0] = 0.6
    assert decision.quality(facts) == pytest.approx(0.5, abs=1e-6)
    facts[0] = 1e6
    assert decision.quality(facts) == 1


def test_a_decision_reads_back_to_the_last_bit() -> None:
    decision = random_decision()
    again = Decision.from_json(json.loads(json.dumps(decision.to_json())), "here")
    for name, value in vars(decision).items():
        np.testing.assert_array_equal(vars(again)[name], value)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"evidence": ["correlation"]}, "weighs other evidence"),
        ({"evidence": None}, "weighs other evidence"),
        ({"mean": [0.0]}, "numbers do not fit"),
        ({"hidden": "many"}, "numbers do not fit"),
        ({"bias": None}, "numbers do not fit"),
        ({"threshold": 1e400}, "not finite or out of range"),
        ({"deviation": [0.0] * len(NAMES)}, "not finite or out of range"),
        ({"hidden": [], "hidden_bias": [], "output": []}, "not finite or out of range"),
    ],
)
def test_a_damaged_decision_is_refused_in_one_line(change: dict[str, Any], said: str) -> None:
    values = random_decision().to_json() | change
    with pytest.raises(QsgmError, match=f"here: the decision.* {said}"):
        Decision.from_json(values, "here")
    with pytest.raises(QsgmError, match="other evidence"):
        Decision.from_json([], "here")  # type: ignore[arg-type]


def test_evidence_is_what_its_names_say() -> None:
    values = evidence(0.7, 0.5, 0.9, -0.3)
    assert dict(zip(NAMES, values.tolist(), strict=True)) == pytest.approx(
        {"correlation": 0.7, "scale": np.log(2), "quality_logit": np.log(9), "lead": -0.3}
    )
    for quality, logit in ((0.0, -8), (1.0, 8)):
        assert evidence(0, 1, quality, 0).tolist() == [0, 0, logit, 0]
