"""Where a tuned object is: its places, its turn, nearer and further, and where nothing is found."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from toy_objects import described
from toys import bump, by_correlation, lay, table, toy

from qsgm import QsgmError, load_object
from qsgm.bundle import Bundle
from qsgm.grasp.decision import Decision
from qsgm.grasp.finding import Finder, Sighting
from qsgm.grasp.heatmap import Detection, refine
from qsgm.grasp.judge import QUICK, THOROUGH, Effort
from qsgm.grasp.patch import cut_patch
from qsgm.grasp.shown import View
from qsgm.grasp.tuned import (
    MARGIN_PX,
    OTHER_SIZES,
    ObjectDescription,
    TunedObject,
)

Point = tuple[float, float]
Frame = NDArray[np.uint8]
Heatmap = NDArray[np.float32]
CENTER = (320.0, 240.0)
DEMONSTRATION = lay(toy(), table(), CENTER)


class Told(TunedObject):
    """A tuned object whose network sees what a test says, in pixels of the scaled frame."""

    def __init__(self, bundle: Bundle, description: ObjectDescription, *seen: Point) -> None:
        super().__init__(description, bundle.network_with({}), 1)
        margin = MARGIN_PX if description.views else 0
        self.seen = [(x + margin, y + margin) for x, y in seen]
        self.angle_rad = 0.0

    def heatmap(self, frame: NDArray[np.uint8]) -> NDArray[np.float32]:
        return bump(self.seen, frame.shape[:2], self.angle_rad)


def turn_error(got: float | None, expected: float, circle: float = 360) -> float:
    assert got is not None
    return abs((got - expected + circle / 2) % circle - circle / 2)


def test_the_demonstration_is_found_at_its_centre_and_not_turned(bundle: Bundle) -> None:
    found, _ = Told(bundle, described(), (327.0, 232.0)).locate(DEMONSTRATION)
    assert found.found
    assert found.refined_by == "patch"
    assert math.dist(found.center_px, CENTER) < 0.3
    assert found.displacement_px == pytest.approx((0, 0), abs=0.3)
    assert abs(found.angle_deg) < 0.3
    assert turn_error(found.full_angle_deg, 0) < 0.3


@pytest.mark.parametrize("seed", range(8))
def test_a_moved_and_turned_object_is_found_to_half_a_pixel_and_half_a_degree(
    bundle: Bundle, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    center = (320 + rng.uniform(-200, 200), 240 + rng.uniform(-130, 130))
    turn = rng.uniform(-180, 180)
    scene = lay(toy(), table(seed + 1), center, turn, light=rng.uniform(0.7, 1.1))
    found, _ = Told(bundle, described(), center, (100.0, 100.0)).locate(scene)
    assert math.dist(found.center_px, center) < 0.5
    assert turn_error(found.full_angle_deg, turn) < 0.5
    assert turn_error(found.angle_deg, turn, 180) < 0.5
    assert -90 < found.angle_deg <= 90
    assert found.full_angle_confidence is not None
    assert found.full_angle_confidence > 0.9


def test_another_thing_where_the_network_is_surest_is_not_taken_for_the_object(
    bundle: Bundle,
) -> None:
    other = toy()[..., [1, 0, 2, 3]]
    other[200:280, 100:380, :3] = 255 - other[200:280, 100:380, :3]
    both = lay(other, lay(toy(), table(2), (200.0, 180.0), 20), (450.0, 300.0), 70)
    told = Told(bundle, described(), (450.0, 300.0), (208.0, 170.0))
    found, _ = told.locate(both)
    assert math.dist(found.center_px, (200, 180)) < 0.5
    alone, _ = told.locate(lay(other, table(2), (450.0, 300.0), 70))
    assert not alone.found
    assert alone.quality < 0.5
    assert alone.candidates[0].quality == alone.quality


def test_candidates_are_the_judged_places_best_first_this_one_among_them(bundle: Bundle) -> None:
    scene = lay(toy(), table(2), (200.0, 180.0), 20)
    found, _ = Told(bundle, described(), (200.0, 180.0), (450.0, 300.0)).locate(scene)
    first, *others = found.candidates
    assert replace(first, candidates=found.candidates) == found
    assert others
    assert [one.quality for one in found.candidates] == sorted(
        (one.quality for one in found.candidates), reverse=True
    )


def test_all_instances_are_listed_each_once(bundle: Bundle) -> None:
    places = {
        (150.0, 130.0): 20.0,
        (330.0, 250.0): -75.0,
        (376.0, 252.0): -75.0,
        (520.0, 380.0): 160.0,
    }
    scene = table(2)
    for center, turn in places.items():
        scene = lay(toy(), scene, center, turn)
    found = Told(bundle, described(), *places).locate_all(scene)
    assert len(found) == len(places)
    for center, turn in places.items():
        nearest = min(found, key=lambda one: math.dist(one.center_px, center))
        assert math.dist(nearest.center_px, center) < 1.5
        assert turn_error(nearest.full_angle_deg, turn) < 1.5
    assert [one.quality for one in found] == sorted((one.quality for one in found), reverse=True)
    assert Told(bundle, described(), (300.0, 200.0)).locate_all(table(3)) == []


def test_an_object_without_a_front_has_no_full_turn(bundle: Bundle) -> None:
    scene = lay(toy(front=False), table(2), (300.0, 200.0), 40)
    found, _ = Told(bundle, described(toy(front=False)), (300.0, 200.0)).locate(scene)
    assert turn_error(found.angle_deg, 40, 180) < 0.5
    assert found.full_angle_deg is None
    assert found.full_angle_confidence is not None
    assert 0.5 <= found.full_angle_confidence < 0.75


def test_where_the_patch_fits_weakly_the_network_says_centre_and_turn(bundle: Bundle) -> None:
    """A decision that finds whatever there is, and an object that looks like nothing taught."""
    scene = lay(toy()[..., [2, 0, 1, 3]][:, ::-1].copy(), table(2), (300.0, 200.0), light=0.15)
    told = Told(bundle, described(decision=by_correlation(-10)), (304.0, 196.0))
    told.angle_rad = math.radians(25)
    found, _ = told.locate(scene)
    assert found.found
    assert found.refined_by == "network"
    cell = Detection(True, found.quality, (304.0, 192.0), (0.0, 0.0), 0.0)
    expected = refine(cell, scene, told.heatmap, 0.0)
    assert found.center_px == pytest.approx(expected.center_px)
    assert found.angle_deg == pytest.approx(25, abs=0.01)
    assert (found.full_angle_deg, found.full_angle_confidence) == (None, None)


def test_without_a_decision_the_network_finds_and_a_strong_patch_refines(bundle: Bundle) -> None:
    about = replace(described(), decision=None)
    scene = lay(toy(), table(2), (300.3, 200.6), -100)
    found, _ = Told(bundle, about, (306.0, 207.0)).locate(scene)
    assert found.quality > 0.9
    assert found.refined_by == "patch"
    assert math.dist(found.center_px, (300.3, 200.6)) < 0.5
    assert turn_error(found.full_angle_deg, -100) < 0.5
    nothing, _ = Told(bundle, about, (306.0, 207.0)).locate(table(3))
    assert nothing.found
    assert nothing.refined_by == "network"
    both = Told(bundle, about, (306.0, 207.0), (500.0, 400.0)).locate_all(scene)
    assert [one.refined_by for one in both] == ["patch", "network"]


def test_scenes_are_scaled_and_answered_in_their_own_pixels(bundle: Bundle) -> None:
    center, scale = (900.0, 700.0), 0.25
    scene = lay(toy(), table(2, (1200, 1600)), center, 35, 4)
    seen = tuple((value + 0.5) * scale - 0.5 for value in center)
    told = Told(bundle, described(scale=scale), (seen[0], seen[1]))
    found, heatmap = told.locate(scene)
    assert heatmap.shape == (3, 17, 24)
    assert math.dist(found.center_px, center) < 2
    assert found.displacement_px == pytest.approx((100, 100), abs=2)
    assert turn_error(found.full_angle_deg, 35) < 0.5
    assert found.scale == scale
    assert found.candidates[0].center_px == found.center_px
    (only,) = told.locate_all(scene)
    assert only.center_px == found.center_px
    with pytest.raises(QsgmError, match=r"640x240 px has 160x60 at the scale of 'toy': expected"):
        told.locate(DEMONSTRATION[:240])


@pytest.mark.parametrize("center", [(30.0, 240.0), (320.0, 24.0), (600.0, 455.0)])
def test_an_object_at_the_border_of_a_frame_is_found(bundle: Bundle, center: Point) -> None:
    scene = lay(toy(), table(4), center, 65)
    found, _ = Told(bundle, described(), center).locate(scene)
    assert found.found
    assert math.dist(found.center_px, center) < 1
    assert found.margin_px == MARGIN_PX


@pytest.mark.parametrize("size", [0.5, 2.0])
def test_an_object_at_another_distance_is_found_where_that_is_asked_for(
    bundle: Bundle, size: float
) -> None:
    center = (310.0, 230.0)
    scene = lay(toy(), table(4), center, 40, size)
    x, y = ((value + 0.5) / size - 0.5 for value in center)
    told = Told(bundle, described(), (x, y))
    assert not told.locate(scene)[0].found
    found, heatmap = told.locate_at_any_distance(scene)
    assert found.found
    assert math.dist(found.center_px, center) < 2
    assert turn_error(found.full_angle_deg, 40) < 1
    assert found.scale == 1 / size
    assert heatmap.shape != told.locate(scene)[1].shape
    assert told.description.scale == 1


@pytest.mark.parametrize(("sure", "is_found"), [(0.59, False), (0.61, True)])
def test_what_a_quick_look_leaves_open_a_thorough_one_decides_but_has_to_be_surer(
    bundle: Bundle, monkeypatch: pytest.MonkeyPatch, sure: float, is_found: bool
) -> None:
    """The same heatmap is looked at again before the frame is, at other sizes."""
    efforts, find = list[Effort](), Finder.find

    def as_told(
        self: Finder, frame: Frame, heatmap: Heatmap, decision: Decision, effort: Effort = QUICK
    ) -> list[Sighting]:
        efforts.append(effort)
        found = find(self, frame, heatmap, decision, QUICK)
        return [replace(one, quality=sure if effort == THOROUGH else 0.4) for one in found]

    monkeypatch.setattr(Finder, "find", as_told)
    told = Told(bundle, described(), (300.0, 200.0))
    assert not told.locate(table(3))[0].found
    efforts.clear()
    found, _ = told.locate_at_any_distance(table(3))
    assert efforts == [QUICK, THOROUGH, *[QUICK] * len(OTHER_SIZES)]
    assert found.found is is_found
    assert found.quality == (sure if is_found else 0.4)
    assert found.scale == 1
    assert all(one.found is is_found for one in found.candidates)


def test_at_any_distance_what_is_not_there_is_not_found(bundle: Bundle) -> None:
    told = Told(bundle, described(), (300.0, 200.0))
    found, _ = told.locate_at_any_distance(table(3))
    assert not found.found
    assert found.scale == 1


def test_an_object_of_the_first_version_is_not_looked_for_where_a_window_does_not_fit(
    saved: Path, frame: NDArray[np.uint8]
) -> None:
    tuned = load_object(saved)
    assert not tuned.description.views
    tuned.heatmap = lambda _frame: np.zeros((3, 1, 1), np.float32)  # type: ignore[method-assign]
    found, _ = tuned.locate_at_any_distance(frame[:128, :128])
    assert (found.found, found.scale) == (False, 1)


def test_of_several_looks_the_one_that_fits_is_taken_and_its_turn_added(bundle: Bundle) -> None:
    back = toy()[..., [2, 1, 0, 3]]
    frame = lay(back, table(1), CENTER)
    other = View(cut_patch(frame, CENTER), math.radians(30), whole=False)
    about = described()
    about = replace(about, views=(*about.views, other))
    scene = lay(back, table(3), (250.0, 220.0), 50)
    found, _ = Told(bundle, about, (250.0, 220.0)).locate(scene)
    assert math.dist(found.center_px, (250, 220)) < 0.5
    assert turn_error(found.angle_deg, 80, 180) < 0.5
    assert found.full_angle_deg is None
    front, _ = Told(bundle, about, CENTER).locate(DEMONSTRATION)
    assert turn_error(front.full_angle_deg, 0) < 0.3
