"""A tuned object on disk: written whole, read back as it was, refused when it is not."""

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
from toys import bump, by_correlation, lay, table, toy

from qsgm import QsgmError, load_object, tuned_folder
from qsgm.bundle import Bundle
from qsgm.grasp import tuned as tuned_module
from qsgm.grasp.decision import Decision
from qsgm.grasp.finding import Finder, Sighting
from qsgm.grasp.heatmap import Detection, locate, refine
from qsgm.grasp.judge import QUICK, THOROUGH, Effort
from qsgm.grasp.patch import cut_patch
from qsgm.grasp.shown import View
from qsgm.grasp.tuned import (
    MARGIN_PX,
    MOST_VIEWS,
    OTHER_SIZES,
    ObjectDescription,
    TunedObject,
    save_object,
)
from qsgm.manifest import NETWORK
from qsgm.tuned_folder import DESCRIPTION, REPORT

Point = tuple[float, float]
Frame = NDArray[np.uint8]
Heatmap = NDArray[np.float32]
MUG = ObjectDescription("mug", "double", 0.25)


@pytest.fixture
def saved(bundle: Bundle, tmp_path: Path) -> Path:
    save_object(tmp_path / "mug", MUG, bundle.network_with({}), {"seed": 3})
    return tmp_path / "mug"


def refusal(folder: Path) -> str:
    with pytest.raises(QsgmError) as raised:
        load_object(folder)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_an_object_reads_back_as_it_was_written(saved: Path) -> None:
    assert load_object(saved).description == MUG
    assert json.loads((saved / REPORT).read_text()) == {"seed": 3}


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


def test_an_object_is_replaced_by_the_next_one(saved: Path, bundle: Bundle) -> None:
    save_object(saved, ObjectDescription("cup", "double", 0.0), bundle.network_with({}), {})
    assert load_object(saved).description.name == "cup"


def test_a_folder_with_something_else_in_it_is_left_alone(bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(QsgmError, match=r"did not write 'notes.txt'"):
        save_object(tmp_path, MUG, bundle.network_with({}), {})
    assert [path.name for path in tmp_path.iterdir() if path.name != "data"] == ["notes.txt"]


def test_a_missing_or_altered_network_is_refused(saved: Path) -> None:
    (saved / NETWORK).write_bytes((saved / NETWORK).read_bytes()[:-1] + b"x")
    assert "network.onnx is altered: its sha256 differs; tune the object again" in refusal(saved)
    (saved / NETWORK).unlink()
    assert "network.onnx does not exist" in refusal(saved)


@pytest.mark.parametrize("content", ["", "nonsense", "{}", '{"format": "qsgm-bundle"}'])
def test_another_description_is_refused(saved: Path, content: str) -> None:
    (saved / DESCRIPTION).write_text(content)
    assert "qsgm finetune" in refusal(saved)


def test_a_folder_that_is_no_object_is_refused(tmp_path: Path) -> None:
    assert "object.json does not exist: expected an object" in refusal(tmp_path)


@pytest.mark.parametrize("key", ["name", "encoding", "offset_rad", "sha256"])
def test_a_description_without_one_of_its_keys_is_refused_by_that_key(
    saved: Path, key: str
) -> None:
    path = saved / "object.json"
    description = json.loads(path.read_text())
    path.write_text(json.dumps({k: v for k, v in description.items() if k != key}))
    with pytest.raises(QsgmError, match=f"'{key}' holds nothing"):
        load_object(saved)


@pytest.mark.parametrize(
    ("key", "value"), [("encoding", "triple"), ("offset_rad", float("nan")), ("offset_rad", 1e999)]
)
def test_a_description_that_says_nonsense_is_refused(saved: Path, key: str, value: object) -> None:
    path = saved / "object.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    assert "expected encoding double or paper and a finite offset_rad" in refusal(saved)


def test_a_float_may_be_written_as_a_whole_number(saved: Path) -> None:
    """As JavaScript writes 1.0; not as a truth value, and not beyond what a float holds."""
    path, taught = saved / "object.json", load_object(saved).description
    whole = json.loads(path.read_text()) | {"offset_rad": 1, "scale": 1}
    path.write_text(json.dumps(whole))
    about = load_object(saved).description
    assert (about.offset_rad, about.scale) == (1.0, 1.0)
    assert isinstance(about.offset_rad, float)
    assert about.name == taught.name
    for wrong in (True, 10**400):
        path.write_text(json.dumps(whole | {"scale": wrong}))
        assert "'scale' holds" in refusal(saved)


def test_a_network_that_is_another_graph_is_refused(bundle: Bundle, tmp_path: Path) -> None:
    save_object(tmp_path / "mug", MUG, (bundle.folder / "trunk_float_6.onnx").read_bytes(), {})
    text = refusal(tmp_path / "mug")
    assert "takes {'samples': ('tensor(uint8)', " in text
    assert "expected {'frame': ('tensor(uint8)', (None, None, 3))}; tune the object again" in text


def test_a_frame_that_does_not_fit_the_network_is_refused(saved: Path) -> None:
    with pytest.raises(QsgmError, match=r"the frame is an array of uint8 .*: expected"):
        load_object(saved).heatmap(np.zeros((128, 128, 5), np.uint8))


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


def described(
    picture: NDArray[np.float32] | None = None, decision: Decision | None = None, scale: float = 1.0
) -> ObjectDescription:
    """A toy as it is kept, by default with a decision by correlation alone."""
    frame = lay(toy() if picture is None else picture, table(), CENTER)
    view = View(cut_patch(frame, CENTER), 0.0, whole=True)
    chosen = by_correlation() if decision is None else decision
    return ObjectDescription("toy", "double", 0.0, scale, (view,), chosen, {"seed": 4})


def named(name: str) -> ObjectDescription:
    return replace(described(), name=name)


def other_network(bundle: Bundle) -> bytes:
    """The bundle's with one weight changed."""
    weights = bundle.start_weights(bundle.network.last(1))
    weights["bias6"] = weights["bias6"] + 1
    return bundle.network_with(weights)


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


@pytest.mark.parametrize(("sure", "is_found"), [(0.69, False), (0.71, True)])
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


def test_looks_decision_and_provenance_read_back_as_they_were(
    bundle: Bundle, tmp_path: Path
) -> None:
    about = described(scale=0.5)
    about = replace(about, views=(*about.views, replace(about.views[0], turn_rad=0.5, whole=False)))
    save_object(tmp_path / "toy", about, bundle.network_with({}), {})
    again = load_object(tmp_path / "toy").description
    assert (again.scale, again.made) == (0.5, {"seed": 4})
    for got, kept in zip(again.views, about.views, strict=True):
        assert (got.turn_rad, got.whole) == (kept.turn_rad, kept.whole)
        assert (got.patch.center_px, got.patch.cut_out) == (kept.patch.center_px, True)
        np.testing.assert_array_equal(got.patch.image, kept.patch.image)
        np.testing.assert_array_equal(got.patch.mask, kept.patch.mask)
    assert again.decision is not None
    assert again.decision.to_json() == by_correlation().to_json()
    values = json.loads((tmp_path / "toy" / DESCRIPTION).read_text())
    assert values["threshold"] == {"quality": 0.5, "false_alarm_rate": 0.01}
    assert {path.name for path in (tmp_path / "toy").iterdir()} == {
        "SHA256SUMS",
        "network.onnx",
        "object.json",
        "report.json",
        "patch.png",
        "patch_2.png",
    }


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


def test_a_missing_or_altered_patch_is_refused(bundle: Bundle, tmp_path: Path) -> None:
    save_object(tmp_path / "toy", described(), bundle.network_with({}), {})
    path = tmp_path / "toy" / "patch.png"
    path.write_bytes(path.read_bytes()[:-1] + b"x")
    assert "patch.png is altered: its sha256 differs; tune the object again" in refusal(
        tmp_path / "toy"
    )
    path.unlink()
    assert "patch.png does not exist" in refusal(tmp_path / "toy")


@pytest.mark.parametrize(
    "change",
    [
        {"scale": 0.0},
        {"scale": 1e9},
        {"scale": float("nan")},
        {"views": [1]},
        {"views": [{}]},
        {"views": [{"file": "../network.onnx", "sha256": "0"}]},
        {"decision": {"evidence": []}},
    ],
)
def test_a_description_of_version_2_that_says_nonsense_is_refused(
    bundle: Bundle, tmp_path: Path, change: dict[str, object]
) -> None:
    save_object(tmp_path / "toy", described(), bundle.network_with({}), {})
    path = tmp_path / "toy" / DESCRIPTION
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert "again" in refusal(tmp_path / "toy")


def test_of_a_description_with_too_many_views_no_more_are_read_than_shows_that(
    bundle: Bundle, tmp_path: Path
) -> None:
    save_object(tmp_path / "toy", described(), bundle.network_with({}), {})
    path = tmp_path / "toy" / DESCRIPTION
    values = json.loads(path.read_text())
    (view,) = values["views"]
    values["views"] = [view] * (MOST_VIEWS + 1) + [view | {"file": "missing.png"}]
    path.write_text(json.dumps(values))
    assert "'views' or 'scale' is damaged" in refusal(tmp_path / "toy")
    values["views"] = [view] * MOST_VIEWS
    path.write_text(json.dumps(values))
    assert len(load_object(tmp_path / "toy").description.views) == MOST_VIEWS


@pytest.mark.parametrize("key", ["scale", "views", "made"])
def test_a_description_of_version_2_lacks_none_of_its_keys(saved: Path, key: str) -> None:
    path = saved / DESCRIPTION
    values = json.loads(path.read_text())
    path.write_text(json.dumps({k: v for k, v in values.items() if k != key}))
    assert f"'{key}' holds nothing" in refusal(saved)


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


def test_an_object_whose_network_keeps_numbers_elsewhere_is_refused(
    bundle: Bundle, tmp_path: Path
) -> None:
    graph = (bundle.folder / "trunk_float_3.onnx").read_bytes()
    save_object(tmp_path / "mug", MUG, graph, {})
    (tmp_path / "mug" / "weights.bin").write_bytes((bundle.folder / "weights.bin").read_bytes())
    assert "keeps numbers in the file 'weights.bin'" in refusal(tmp_path / "mug")


@pytest.mark.parametrize("name", ["../network.onnx", "/etc/hostname", "", ".", "a\nb", 3, None])
def test_a_file_of_an_object_is_one_in_its_folder(
    bundle: Bundle, tmp_path: Path, name: object
) -> None:
    save_object(tmp_path / "toy", described(), bundle.network_with({}), {})
    path = tmp_path / "toy" / DESCRIPTION
    values = json.loads(path.read_text())
    values["views"][0]["file"] = name
    path.write_text(json.dumps(values))
    assert "no plain name" in refusal(tmp_path / "toy")


def test_an_object_that_is_replaced_while_it_is_read_is_the_old_or_the_new(
    bundle: Bundle, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, networks = tmp_path / "toy", [bundle.network_with({}), other_network(bundle)]
    read, reads = tuned_module.read_file, 0

    def replacing(path: Path, *arguments: Any) -> bytes:
        nonlocal reads
        data = read(path, *arguments)
        reads += 1
        if reads == moment:
            save_object(folder, named("new"), networks[1], {})
        return data

    for module in (tuned_module, tuned_folder):
        monkeypatch.setattr(module, "read_file", replacing)
    for moment in range(1, 4):
        save_object(folder, named("old"), networks[0], {})
        reads = 0
        tuned = load_object(folder)
        assert reads >= moment
        expected = networks[tuned.description.name == "new"]
        assert tuned._remade_from[1] == expected


def test_a_name_that_cannot_be_shown_is_loaded_as_one_that_can(saved: Path) -> None:
    path = saved / DESCRIPTION
    name = "mug\x1b[31m\n\udcff" + "x" * 10**6
    path.write_text(json.dumps(json.loads(path.read_text()) | {"name": name}))
    loaded = load_object(saved).description.name
    assert loaded.startswith("mug\\x1b[31m\\n\\udcff")
    assert loaded.isprintable()
    assert len(loaded) < 300
    loaded.encode()
