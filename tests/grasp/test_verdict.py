"""The verdict: good only where everything speaks for it, and every reason says what to do."""

import re
from dataclasses import replace

import numpy as np
import pytest
from toys import SIDE, lay, table, toy

from qsgm.grasp.likeness import Likeness, likeness_of
from qsgm.grasp.patch import Patch, cut_patch
from qsgm.grasp.verdict import Verdict, verdict_on
from qsgm.task import Scores


def scores(*values: float) -> dict[str, float | None]:
    """On all crops, on those with nothing put on them, and of other things."""
    names = ("detection_accuracy", "angle_mae_deg")
    plain = tuple(f"{name}_plain" for name in names)
    return dict(zip((*names, *plain, "told_apart"), values, strict=True))


GOOD = scores(0.99, 1.5, 0.995, 1.4, 0.97)
UNTOUCHED = scores(0.8, 5.0, 0.95, 3.0, 0.6)
CLEAR = Likeness(cut_out=True, featureless=False, round=False, same_both_ways=False)


def on(tuned: Scores = GOOD, like: Likeness = CLEAR, strength: float = 0.9) -> Verdict:
    return verdict_on(tuned, UNTOUCHED, strength, like)


def test_where_all_is_well_nothing_is_said() -> None:
    verdict = on()
    assert verdict.good
    assert verdict.headline == "will be found and told apart"
    assert verdict.to_json() == {"good": True, "reasons": [], "notes": []}


@pytest.mark.parametrize(
    ("tuned", "like", "said"),
    [
        (GOOD | {"detection_accuracy": 0.85}, CLEAR, r"only 85 % .* told right: tune longer"),
        (GOOD | {"told_apart": 0.7}, CLEAR, r"30 % of other things .* name those .* --not"),
        (GOOD | {"angle_mae_deg": 20.0}, CLEAR, r"off by 20 degrees .* --epochs"),
        (GOOD, replace(CLEAR, cut_out=False), r"not be told from its table.* another colour"),
    ],
)
def test_what_speaks_against_it_is_said_with_what_to_do(
    tuned: Scores, like: Likeness, said: str
) -> None:
    verdict = on(tuned, like)
    assert not verdict.good
    assert verdict.headline == "may be missed or confused"
    (reason,) = verdict.reasons
    assert re.search(said, reason)


def test_tuning_that_made_nothing_better_is_a_reason_unless_all_was_well_before() -> None:
    tuned = scores(0.94, 2.0, 0.95, 2.0, 0.95)
    (reason,) = verdict_on(tuned, tuned | {"detection_accuracy": 0.95}, 0.9, CLEAR).reasons
    assert "no better than untouched (detection 0.940, before 0.950)" in reason
    assert verdict_on(GOOD, GOOD | {"detection_accuracy": 0.995}, 0.9, CLEAR).good
    assert verdict_on(tuned, tuned, 0.9, CLEAR, trained=False).good


def test_an_object_without_an_angle_is_not_blamed_for_it() -> None:
    tuned = GOOD | {"angle_mae_deg": 45.0}
    assert on(tuned, replace(CLEAR, round=True)).good
    assert on(tuned, strength=0.2).good
    assert not on(tuned).good


@pytest.mark.parametrize(
    ("like", "note"),
    [
        (replace(CLEAR, featureless=True), "hardly any markings"),
        (replace(CLEAR, round=True, same_both_ways=True), "the same at every turn"),
        (replace(CLEAR, same_both_ways=True), "modulo 180 degrees"),
    ],
)
def test_what_else_there_is_to_know_is_a_note(like: Likeness, note: str) -> None:
    verdict = on(like=like)
    assert verdict.good
    assert len(verdict.notes) == 1
    assert note in verdict.notes[0]
    assert "no other things" in on(GOOD | {"told_apart": None}).notes[0]


def patch_of(picture: np.ndarray) -> Patch:
    return cut_patch(lay(picture, table(), (320.0, 240.0), 30), (320.0, 240.0))


def test_an_object_with_a_front_is_like_itself_in_one_turn_only() -> None:
    assert likeness_of(patch_of(toy())) == CLEAR
    assert likeness_of(patch_of(toy(front=False))) == replace(CLEAR, same_both_ways=True)


def test_a_target_is_round_and_a_plain_disk_has_no_markings_either() -> None:
    y, x = np.mgrid[:SIDE, :SIDE] - SIDE / 2
    radius = np.hypot(x, y)
    target = np.zeros((SIDE, SIDE, 4), np.float32)
    target[radius < 160] = (200, 60, 40, 255)
    plain = likeness_of(patch_of(target))
    assert (plain.featureless, plain.round) == (True, True)
    target[radius < 80] = (40, 220, 230, 255)
    ringed = likeness_of(patch_of(target))
    assert (ringed.featureless, ringed.round, ringed.same_both_ways) == (False, True, True)


def test_a_failed_cut_is_reported() -> None:
    assert not likeness_of(cut_patch(table(), (320.0, 240.0))).cut_out
