"""What is said of a find and of a run, in words and as JSON: every value is there, as it is."""

import json
import math
from dataclasses import asdict, replace
from io import StringIO
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console, RenderableType

from qsgm.blocks import parse_blocks
from qsgm.fidelity import LayerFidelity
from qsgm.grasp.heatmap import Detection
from qsgm.grasp.report import detection_table, instances_table, turn_text
from qsgm.grasp.taught import shown_json
from qsgm.tune.probe import Probe
from qsgm.tune.report import (
    detail_table,
    fidelity_json,
    fidelity_over_run_json,
    fidelity_table,
    run_title,
)
from qsgm.tune.settings import Settings

FOUND = Detection(True, 0.934, (207.66, 300.72), (-112.34, 60.72), -60.24)
LAYER = LayerFidelity(*(0.5 + k / 100 + 1e-9 for k in range(15)))


def rows(shown: RenderableType) -> list[list[str]]:
    text = StringIO()
    Console(file=text, width=200).print(shown)
    return [line.split() for line in text.getvalue().splitlines() if line.split()]


def test_a_find_is_told_by_name_quality_centre_way_and_turn() -> None:
    assert rows(detection_table(FOUND, "mug")) == [
        ["mug", "found"],
        ["quality", "0.93"],
        ["centre", "207.7,", "300.7", "px"],
        ["move", "-112.3", "px", "right,", "+60.7", "px", "down"],
        ["turn", "-60.2°", "counter-clockwise,", "or", "the", "opposite"],
    ]
    assert detection_table(FOUND, "mug").columns[0].style == "bold"
    known = detection_table(replace(FOUND, full_angle_deg=119.76), "mug")
    assert rows(known)[-1] == ["turn", "+119.8°", "counter-clockwise"]


def test_what_was_not_found_is_told_with_the_best_guess() -> None:
    missed = replace(FOUND, found=False, quality=0.234)
    assert rows(detection_table(missed, "mug")) == [
        ["mug", "not", "found"],
        ["quality", "0.23", "(found", "from", "0.50)"],
        ["best", "guess", "208,", "301", "px"],
    ]


def test_every_instance_is_a_row() -> None:
    both = (FOUND, replace(FOUND, quality=0.6, full_angle_deg=-179.98))
    *_, first, second = rows(instances_table(both, "mug"))
    same = ["207.7,", "300.7", "px", "-112.3,", "+60.7", "px"]
    assert first == ["0.93", *same, "-60.2°", "yes"]
    assert second == ["0.60", *same, "+180.0°", "no"]


@pytest.mark.parametrize(
    ("angle", "full", "said"),
    [
        (-0.01, None, "+0.0°"),
        (89.96, None, "+90.0°"),
        (30, 179.97, "+180.0°"),
        (30, -30.04, "-30.0°"),
    ],
)
def test_turns_are_rounded_within_their_half_open_circles(
    angle: float, full: float | None, said: str
) -> None:
    assert turn_text(replace(FOUND, angle_deg=angle, full_angle_deg=full)) == said


def test_what_was_shown_is_told_as_json() -> None:
    def told(span_px: float | None, turns: tuple[float | None, ...]) -> dict[str, Any]:
        shown = SimpleNamespace(scale=0.1234567, span_px=span_px, turns_rad=turns)
        prepared = SimpleNamespace(shown=shown, others_sha256=("a", "b"))
        values: dict[str, Any] = shown_json(SimpleNamespace(prepared=prepared))  # type: ignore[arg-type]
        return json.loads(json.dumps(values))  # type: ignore[no-any-return]

    assert told(88.88, (0.0, None, math.radians(30))) == {
        "scale": 0.12346,
        "span_px": 88.9,
        "demonstrations": [{"turn_deg": 0.0}, {"turn_deg": None}, {"turn_deg": 30.0}],
        "others": 2,
    }
    assert told(None, (0.0,))["span_px"] is None


@pytest.mark.parametrize(
    ("settings", "blocks", "said"),
    [
        (Settings(epochs=3), "4,5,6", "mug: last 3 layers, sgm float, 3 epochs"),
        (Settings(precision="int8", epochs=20), "4,5,6", "mug: last 3 layers, sgm int8, 20 epochs"),
        (Settings(method="bp", layers=2, epochs=1), "5-6", "mug: last 2 layers, bp, 1 epochs"),
        (Settings(blocks="4,5-6", epochs=1), "4,5-6", "mug: blocks 4,5-6, sgm float, 1 epochs"),
    ],
)
def test_a_runs_title_says_what_was_tuned_and_how(
    settings: Settings, blocks: str, said: str
) -> None:
    plan = SimpleNamespace(settings=settings)
    result: Any = SimpleNamespace(plan=plan, blocks=parse_blocks(blocks, 6))
    assert run_title(result, "mug") == said


def test_fidelity_is_told_metric_by_metric() -> None:
    expected = {name: round(value, 2) for name, value in asdict(LAYER).items()}
    assert fidelity_json(LAYER, 5) == expected
    result: Any = SimpleNamespace(probes=(Probe(25, 1.0000001, {4: LAYER}),))
    (entry,) = fidelity_over_run_json(result)
    assert {"step": 25, "epoch": 1.0}.items() <= entry.items()
    assert entry["4"] == pytest.approx(expected)
    names = ("direction_deviation_deg", "weighted_error", "cos_sample_int8_float")
    names += ("cos_sample_int8_true", "cos_update_int8_float", "cos_update_int8_true")
    assert numbers(detail_table({4: LAYER})) == pytest.approx(
        [expected[name] for name in (*names, "cos_update_float_true")], abs=5e-3
    )
    names = ("cos_int8_float", "cos_int8_true", "cos_float_true", "norm_ratio_int8_true")
    names += ("sign_agreement_int8_float", "sqnr_db", "clipped_fraction")
    assert numbers(fidelity_table({4: LAYER})) == pytest.approx(
        [expected[name] for name in names], abs=5e-2
    )


def numbers(table: RenderableType) -> list[float]:
    """Of the row of layer 4."""
    (row,) = (row for row in rows(table) if row[0] == "4")
    return [float(value) for value in row[1:]]
