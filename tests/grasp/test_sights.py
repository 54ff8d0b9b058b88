"""Several objects' sights of one frame: who has a place, and what the others are left with."""

from dataclasses import replace

import numpy as np

from qsgm.grasp.heatmap import Detection
from qsgm.grasp.sights import Sight, shared_out

HEATMAP = np.zeros((3, 4, 4), np.float32)
HERE, THERE = (100.0, 100.0), (300.0, 200.0)


def place(center: tuple[float, float], quality: float, found: bool = True) -> Detection:
    return Detection(found, quality, center, (0.0, 0.0), 10.0, 10.0, 0.9, "patch")


def sight(name: str, *places: Detection) -> Sight:
    return Sight(name, replace(places[0], candidates=places), HEATMAP)


def test_a_sight_alone_is_left_as_it_is() -> None:
    alone = sight("mug", place(HERE, 0.9), place(THERE, 0.7))
    (same,) = shared_out([alone])
    assert same is alone
    everything = replace(alone, instances=(place(HERE, 0.9),))
    assert shared_out([everything])[0].detection.candidates == alone.detection.candidates


def test_who_loses_a_place_has_the_next_one_as_it_was_seen() -> None:
    second = replace(place(THERE, 0.6), refined_by="network", full_angle_confidence=0.8)
    loser = sight("mug", place(HERE, 0.9), second)
    first, other = shared_out([loser, sight("cup", place(HERE, 0.99))])
    assert replace(first.detection, candidates=()) == second
    assert first.detection.candidates == loser.detection.candidates
    assert other.detection.center_px == HERE


def test_a_next_place_that_was_not_sure_enough_where_it_was_seen_is_none() -> None:
    """At another distance a quality of 0.6 is no find."""
    loser = sight("mug", place(HERE, 0.95), place(THERE, 0.6, found=False))
    first, _ = shared_out([loser, sight("cup", place(HERE, 0.99))])
    assert not first.detection.found
    assert first.detection.center_px == THERE
