"""From a heatmap to few judged candidates: the best first, none twice."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from toys import bump, lay, plain, table, toy

from qsgm.grasp import judge as judging
from qsgm.grasp.angles import full_degrees
from qsgm.grasp.candidates import candidate_cells
from qsgm.grasp.correlation import Fit, coarse_fits, middle_fit, pyramid_of
from qsgm.grasp.evidence import NAMES
from qsgm.grasp.finding import Sighting, confidence_of
from qsgm.grasp.judge import (
    PROPOSED,
    QUICK,
    THOROUGH,
    Appearance,
    Effort,
    _opposite,
    cell_center,
    judge,
)
from qsgm.grasp.patch import Patch, cut_patch
from qsgm.grasp.shown import View
from qsgm.grasp.tuned import _around, _as_detection

CENTER = (320.0, 240.0)
APPEARANCE = Appearance.of(cut_patch(lay(toy(), table(), CENTER), CENTER))


def test_candidates_are_local_maxima_best_first() -> None:
    quality = np.zeros((6, 8), np.float32)
    quality[1, 1], quality[1, 2], quality[4, 6], quality[5, 7] = 0.9, 0.8, 0.95, 0.94
    assert candidate_cells(quality, 2) == [(4, 6), (1, 1)]
    cells = candidate_cells(quality, 100)
    assert len(set(cells)) == len(cells)
    for i, (row, col) in enumerate(cells):
        assert all(max(abs(row - r), abs(col - c)) > 1 for r, c in cells[:i])
    assert candidate_cells(np.zeros((1, 1), np.float32), 5) == [(0, 0)]


def test_only_a_cell_next_to_a_candidate_is_none_itself() -> None:
    quality = np.zeros((7, 7), np.float32)
    quality[3, 3] = 0.9
    around = [(1, 3), (5, 3), (3, 1), (3, 5), (2, 2), (4, 4)]  # two cells away, and one
    for cell, value in zip(around, (0.8, 0.7, 0.6, 0.5, 0.85, 0.85), strict=True):
        quality[cell] = value
    assert candidate_cells(quality, 5) == [(3, 3), *around[:4]]


@pytest.mark.parametrize("cell", [(0, 0), (0, 5), (5, 0), (5, 5), (2, 3)])
def test_around_a_cell_its_neighbours_keep_their_quality(cell: tuple[int, int]) -> None:
    alone = _around(np.ones((3, 6, 6), np.float32), cell)
    rows, cols = np.indices((6, 6))
    near = np.maximum(np.abs(rows - cell[0]), np.abs(cols - cell[1])) <= 1
    np.testing.assert_array_equal(alone[0], near)
    assert (alone[1:] == 1).all()


def test_as_many_places_are_judged_as_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """A view of many instances asks the network for twice as many cells."""
    asked, cells_of = list[int](), judging.candidate_cells

    def counted(quality: NDArray[np.float32], count: int) -> list[tuple[int, int]]:
        asked.append(count)
        return cells_of(quality, count)

    monkeypatch.setattr(judging, "candidate_cells", counted)
    places = [(100.0 + 110 * i, 100.0 + 110 * j) for i in range(5) for j in range(3)]
    many = judge(APPEARANCE, table(1), bump(places), Effort.for_places(len(places)))
    few = judge(APPEARANCE, table(1), bump(places), Effort.for_places(2))
    assert asked == [2 * len(places), PROPOSED]
    assert len(few) <= 2 < len(many) <= len(places)


def test_a_cell_looks_at_the_middle_of_its_window() -> None:
    assert cell_center((0, 0)) == (64, 64)
    assert cell_center((2, 5)) == (64 + 16 * 5, 64 + 16 * 2)


def test_the_object_is_judged_first_though_the_network_likes_others_better() -> None:
    place, turn = (200.0, 180.0), 50.0
    scene = lay(toy(), table(2), place, turn)
    heatmap = bump([(450.0, 300.0), (500.0, 120.0)], angle_rad=math.radians(turn))
    heatmap[0] = np.maximum(heatmap[0], 0.3 * bump([place])[0])
    found = judge(APPEARANCE, scene, heatmap)
    assert 1 < len(found) <= QUICK.judged
    best = found[0]
    assert math.dist(best.center_px, place) < 0.5
    assert math.dist(best.cell_px, place) < 12
    facts = dict(zip(NAMES, best.evidence.tolist(), strict=True))
    assert facts["correlation"] > 0.95
    assert facts["quality_logit"] == pytest.approx(
        math.log(best.quality / (1 - best.quality)), abs=1e-4
    )
    for i, one in enumerate(found):
        assert all(math.dist(one.fit.center_px, other.fit.center_px) > 12 for other in found[:i])


PLAIN = Appearance.of(cut_patch(lay(plain(), table(), CENTER), CENTER))


def off_and_turned(scene: np.ndarray, place: tuple[float, float], turn: float) -> tuple[float, ...]:
    best = judge(PLAIN, scene, bump([place]))[0]
    turned = (math.degrees(best.fit.turn_rad) - turn + 180) % 360 - 180
    return math.dist(best.center_px, place), abs(turned)


@pytest.mark.parametrize("seed", [2, 3, 4, 8, 9])
def test_a_plain_object_on_another_table_is_judged_where_its_edges_are(seed: int) -> None:
    """Without them it would be off by 2 to 3 px."""
    rng = np.random.default_rng(seed)
    place = float(rng.uniform(150, 480)), float(rng.uniform(130, 350))
    turn = float(rng.uniform(-180, 180))
    off, turned = off_and_turned(lay(plain(), table(seed + 1, grey=60), place, turn), place, turn)
    assert off < 1.5
    assert turned < 1


@pytest.mark.parametrize("seed", [11, 14, 20, 22, 32])
def test_edges_tell_the_way_round_of_a_plain_object_that_is_partly_hidden(seed: int) -> None:
    """By the score of its pixels alone it would lie the other way round."""
    rng, place = np.random.default_rng(100 + seed), (300.0, 220.0)
    turn = float(rng.uniform(-180, 180))
    scene = lay(plain(), table(seed + 1, grey=float(rng.choice([60, 100, 150]))), place, turn)
    right, up = 38 * math.cos(math.radians(turn)), 38 * math.sin(math.radians(turn))
    x, y = round(place[0] - right), round(place[1] + up)
    scene[y - 24 : y + 24, x - 24 : x + 24] = rng.integers(0, 255, 3)
    off, turned = off_and_turned(scene, place, turn)
    assert off < 2
    assert turned < 2


def laid_right(seed: int, effort: Effort) -> bool:
    """Whether a toy under two blocks of any colour is judged as it lies, the network 12 px off."""
    rng = np.random.default_rng(seed)
    place = float(rng.uniform(150, 480)), float(rng.uniform(130, 350))
    turn = float(rng.uniform(-180, 180))
    scene = lay(toy(), table(seed + 1, grey=float(rng.choice([60, 100, 150]))), place, turn)
    right, up = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    for _ in range(2):
        along, half = rng.uniform(-30, 30), int(rng.integers(14, 22))
        x, y = round(place[0] + along * right), round(place[1] - along * up)
        scene[y - half : y + half, x - half : x + half] = rng.integers(0, 255, 3)
    seen = place[0] + float(rng.uniform(-12, 12)), place[1] + float(rng.uniform(-12, 12))
    return any(
        math.dist(one.center_px, place) < 6
        and math.cos(one.fit.turn_rad - math.radians(turn)) > math.cos(math.radians(8))
        for one in judge(APPEARANCE, scene, bump([seen]), effort)
    )


def test_a_thorough_look_lays_right_what_a_quick_one_lays_wrong() -> None:
    """Of 20 scenes of a half hidden object quick looks lay 12 right, thorough ones 18."""
    quick, thorough = (
        np.array([laid_right(seed, effort) for seed in range(20)]) for effort in (QUICK, THOROUGH)
    )
    assert thorough.sum() >= quick.sum() + 4
    assert (quick & ~thorough).sum() <= 1


def test_judging_again_gives_the_same_numbers() -> None:
    heatmap = bump([(200.0, 180.0), (450.0, 300.0)])
    scenes = [lay(toy(), table(seed), (200.0, 180.0), 50) for seed in (2, 3)]
    first = judge(APPEARANCE, scenes[0], heatmap)
    judge(APPEARANCE, scenes[1], heatmap)
    again = judge(APPEARANCE, scenes[0], heatmap)
    for one, other in zip(first, again, strict=True):
        assert one.fit == other.fit
        np.testing.assert_array_equal(one.evidence, other.evidence)


def test_a_frame_of_one_window_has_one_candidate() -> None:
    scene = lay(toy(), table(2, (128, 128)), (64.0, 64.0), 20)
    (only,) = judge(APPEARANCE, scene, bump([(64.0, 64.0)], (128, 128)))
    assert math.dist(only.center_px, (64, 64)) < 0.5


def test_without_a_lead_both_ways_round_are_as_likely_and_more_of_it_is_surer() -> None:
    assert confidence_of(0.0) == 0.5
    assert 0.5 < confidence_of(0.05) < confidence_of(0.2) < confidence_of(1.5) <= 1


@pytest.mark.parametrize(
    ("turn", "degrees"), [(0, 0), (180, 180), (-180, 180), (181, -179), (540, 180), (-359, 1)]
)
def test_a_full_turn_is_in_half_open_degrees(turn: float, degrees: float) -> None:
    assert full_degrees(math.radians(turn)) == pytest.approx(degrees, abs=1e-9)


@pytest.mark.parametrize("pixel", [(0, 0), (159, 159), (80, 80), None])
@pytest.mark.parametrize("grey", [0, 255, None])
def test_any_patch_and_frame_give_finite_evidence(
    pixel: tuple[int, int] | None, grey: int | None
) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 256, (160, 160, 3)).astype(np.uint8)
    image = noise if grey is None else np.full_like(noise, grey)
    mask = np.full((160, 160), 255 if pixel is None else 0, np.uint8)
    if pixel is not None:
        mask[pixel] = 255
    appearance = Appearance.of(Patch(image, mask))
    heatmap = rng.uniform(0, 1, (3, 10, 12)).astype(np.float32)
    for frame in (np.zeros((300, 330, 3), np.uint8), np.tile(noise, (2, 3, 1))[:300, :330]):
        for one in judge(appearance, frame, heatmap):
            assert np.isfinite(one.evidence).all()
            assert np.isfinite([*one.center_px, one.lead, one.fit.score]).all()


def test_a_sighting_is_found_from_a_quality_of_a_half_on_where_the_patch_lies_or_the_cell() -> None:
    view = View(cut_patch(lay(toy(), table(), CENTER), CENTER), 0.0, whole=True)
    for score, center in ((0.9, (1.0, 2.0)), (0.1, (30.0, 40.0))):
        fit = Fit(score, 0.3, 1.0, (1.0, 2.0))
        for quality, found in ((0.5, True), (0.49, False)):
            seen = _as_detection(Sighting(view, fit, 0.5, (1.0, 2.0), quality, (30.0, 40.0)))
            assert (seen.found, seen.quality, seen.center_px) == (found, quality, center)


def test_what_is_alike_both_ways_round_lies_as_well_the_other_way_wherever_it_was_shown() -> None:
    shown = lay(toy(front=False), table(), (320.0, 255.0))  # not in the middle of its patch
    appearance = Appearance.of(cut_patch(shown, CENTER))
    scene = pyramid_of(lay(toy(front=False), table(1), (300.0, 200.0), 40.0))
    (fits,) = coarse_fits(appearance.template, scene, [(300.0, 200.0)])
    fit = middle_fit(appearance.template, scene, max(fits, key=lambda one: one.score))
    other = _opposite(appearance, scene, fit)
    assert math.cos(other.turn_rad - fit.turn_rad) < -0.95
    assert other.score == pytest.approx(fit.score, abs=0.05)
