"""A tuned object's network: what it is shown, what it answers, and what is made of that."""

import json
import math
import pickle
from collections.abc import Callable
from copy import copy, deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from toy_objects import MUG, described

from qsgm import QsgmError, load_object
from qsgm.bundle import Bundle
from qsgm.grasp.heatmap import locate, refine
from qsgm.grasp.tuned import (
    ObjectDescription,
    TunedObject,
    save_object,
)
from qsgm.tuned_folder import DESCRIPTION


def test_a_whole_frame_gives_a_heatmap_of_a_cell_every_16_px(
    saved: Path, frame: NDArray[np.uint8]
) -> None:
    tuned = load_object(saved)
    assert tuned.heatmap(frame).shape == (3, 23, 33)
    assert tuned.heatmap(frame[:128, :144]).shape == (3, 1, 2)


def test_the_turn_is_relative_to_the_demonstration(
    bundle: Bundle, tmp_path: Path, frame: NDArray[np.uint8]
) -> None:
    angles = []
    for name, offset in (("a", 0.0), ("b", 0.25)):
        description = ObjectDescription(name, "double", offset)
        save_object(tmp_path / name, description, bundle.network_with({}), {})
        angles.append(load_object(tmp_path / name).locate(frame)[0].angle_deg)
    difference = (angles[0] - angles[1] - np.degrees(0.25)) % 180
    assert min(difference, 180 - difference) == pytest.approx(0, abs=1e-6)


def test_a_frame_that_does_not_fit_the_network_is_refused(saved: Path) -> None:
    with pytest.raises(QsgmError, match=r"the frame is an array of uint8 .*: expected"):
        load_object(saved).heatmap(np.zeros((128, 128, 5), np.uint8))


def test_an_object_of_the_first_version_is_read_and_found_as_ever(
    saved: Path, frame: NDArray[np.uint8]
) -> None:
    path = saved / DESCRIPTION
    new = json.loads(path.read_text())
    old = {key: new[key] for key in ("format", "sha256", "name", "encoding", "offset_rad")}
    path.write_text(json.dumps(old | {"version": 1}))
    tuned = load_object(saved)
    assert tuned.description == MUG
    heatmap = tuned.heatmap(frame)
    expected = locate(heatmap, (480, 640), 0.25)
    if expected.found:
        expected = refine(expected, frame, tuned.heatmap, 0.25)
    found, _ = tuned.locate(frame)
    assert replace(found, candidates=()) == expected
    assert all(one.found for one in tuned.locate_all(frame))
    with pytest.raises(QsgmError, match=r"kept no picture of it; tune the object again .* a frame"):
        tuned.as_other()


class Answering:
    """A session that answers what a test says."""

    def __init__(self, *answer: float, shape: tuple[int, ...] = (3, 23, 33)) -> None:
        self.heatmap = np.full(shape, 0.5, np.float32)
        self.heatmap.flat[: len(answer)] = answer

    def run(self, *_: object) -> list[NDArray[np.float32]]:
        return [self.heatmap]


@pytest.mark.parametrize(
    ("session", "expected"),
    [
        (Answering(7.5), "qualities of 0.5 to 7.5"),
        (Answering(1e38), "qualities of 0.5 to 1e"),
        (Answering(-3), "qualities of -3 to 0.5"),
        (Answering(math.nan), "NaN"),
        (Answering(*[0.5] * 800, math.inf), "infinity"),
        (
            Answering(shape=(3, 60, 80)),
            r"\(3, 60, 80\) numbers, expected 3 for every window in a frame of 640x480 px",
        ),
        (Answering(shape=(2, 23, 33)), "numbers, expected"),
        (Answering(shape=(3,)), "numbers, expected"),
    ],
)
def test_an_answer_that_is_no_heatmap_of_the_frame_is_refused_in_one_line(
    saved: Path, session: Answering, expected: str, frame: NDArray[np.uint8]
) -> None:
    tuned = load_object(saved)
    tuned._session = session
    with pytest.raises(QsgmError, match=expected + ".*; tune the object again") as raised:
        tuned.heatmap(frame)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("frame", [None, np.zeros((480, 640), np.uint8), np.zeros((9, 9, 3))])
def test_what_is_no_frame_is_refused_and_the_object_is_not_blamed(
    bundle: Bundle, frame: Any
) -> None:
    tuned = TunedObject(described(), bundle.network_with({}), 1)
    for look in (tuned.locate, tuned.locate_all, tuned.locate_at_any_distance, tuned.heatmap):
        with pytest.raises(QsgmError, match="the frame is") as raised:
            look(frame)
        assert "tune the object" not in str(raised.value)


@pytest.mark.parametrize("again", [copy, deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
def test_an_object_can_be_copied_and_pickled(
    bundle: Bundle, frame: NDArray[np.uint8], again: Callable[[TunedObject], TunedObject]
) -> None:
    tuned = TunedObject(described(), bundle.network_with({}), 1)
    found, heatmap = tuned.locate(frame)
    found_again, heatmap_again = again(tuned).locate(frame)
    assert found_again == found
    np.testing.assert_array_equal(heatmap_again, heatmap)
