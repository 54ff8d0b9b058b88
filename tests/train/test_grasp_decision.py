"""Evidence becomes quality: kept as it was written, refused when it is damaged."""

import json
from typing import Any

import numpy as np
import pytest
from toys import by_correlation, lay, table, toy

from qsgm import QsgmError
from qsgm.grasp.correlation import Fit, pyramid_of
from qsgm.grasp.decision import Decision
from qsgm.grasp.evidence import NAMES, evidence
from qsgm.grasp.judge import Appearance
from qsgm.grasp.patch import cut_patch

CENTER = (320.0, 240.0)


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


def facts_of(scene: np.ndarray, turn_deg: float = 0.0) -> dict[str, float]:
    frame = lay(toy(), table(), CENTER)
    appearance = Appearance.of(cut_patch(frame, CENTER))
    fit = Fit(0.0, np.deg2rad(turn_deg), 1.0, (319.5, 239.5))
    look = appearance.aligner.look(pyramid_of(scene), fit)
    values = evidence(appearance.reference, look, fit.scale, 0.9, 0.3)
    return dict(zip(NAMES, values.tolist(), strict=True))


def test_everything_speaks_for_the_demonstration_itself() -> None:
    facts = facts_of(lay(toy(), table(), CENTER))
    for name in ("correlation", "agreement_middle", "edge_agreement", "inside", "palette"):
        assert facts[name] > 0.9, name
    for name in ("tint", "hue", "spread", "scale", "residual", "contrast_gain", "deviation"):
        assert abs(facts[name]) < 0.05, name
    assert facts["quality_logit"] == pytest.approx(np.log(9), abs=1e-4)
    assert facts["lead"] == pytest.approx(0.3)


def test_half_light_is_contrast_and_not_another_look() -> None:
    bright = facts_of(lay(toy(), table(3), CENTER))
    half = facts_of(lay(toy(), table(3), CENTER, light=0.5))
    assert half["contrast_gain"] == pytest.approx(np.log(0.5), abs=0.15)
    assert half["correlation"] > 0.9
    assert half["agreement_middle"] > bright["agreement_middle"] - 0.1


def test_another_table_changes_little_and_another_object_much() -> None:
    same = facts_of(lay(toy(), table(5, grey=60), CENTER))
    other = facts_of(lay(toy()[..., [1, 0, 2, 3]], table(5), CENTER))
    turned = facts_of(lay(toy(), table(5), CENTER, 90))
    assert same["correlation"] > 0.9
    assert same["palette"] > other["palette"] + 0.2
    assert other["hue"] > same["hue"] + 0.1
    assert turned["agreement_low"] < same["agreement_low"] - 0.3
    assert turned["outline"] < same["outline"]


def test_a_thing_of_the_same_colours_that_is_larger_has_no_edge_where_the_object_ends() -> None:
    plain = np.zeros_like(toy())
    plain[..., :3] = (60, 70, 200)
    plain[100:380, 20:460, 3] = 255
    taught, wide = facts_of(lay(toy(), table(5), CENTER)), facts_of(lay(plain, table(5), CENTER))
    assert taught["edge_low"] > np.log1p(20)
    assert wide["edge_middle"] < np.log1p(15)


def test_what_hides_a_part_leaves_the_other_cells_agreeing() -> None:
    scene = lay(toy(), table(5), CENTER)
    scene[200:280, 270:305] = (250, 250, 20)
    hidden, shown = facts_of(scene), facts_of(lay(toy(), table(5), CENTER))
    assert hidden["correlation"] > 0.9
    assert hidden["agreement_middle"] > 0.6 * shown["agreement_middle"]
    assert hidden["agreement_low"] < shown["agreement_low"] - 0.2
