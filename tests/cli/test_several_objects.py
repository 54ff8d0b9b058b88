"""`qsgm predict --object a --object b`: which thing is where."""

import math
from pathlib import Path

import cv2
import pytest
from command_line import Run, assert_refused
from toy_objects import HOOK_AT, TOY_AT, TURN_DEG, both_on_a_table, hook, teach
from toys import lay, table, toy

from qsgm import paths
from qsgm.images import write_png

ALWAYS = {
    "object", "found", "quality", "center_px", "displacement_px", "angle_deg", "full_angle_deg",
    "full_angle_confidence", "refined_by", "scale", "candidates",
}  # fmt: skip


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A scene of two objects, both taught."""
    for name, picture in (("toy", toy()), ("hook", hook())):
        teach(paths.folder_named(name), name, picture)
    write_png(tmp_path / "scene.png", both_on_a_table())
    return tmp_path / "scene.png"


BOTH = ("--object", "toy", "--object", "hook")


def test_each_object_is_where_it_was_laid(qsgm: Run, scene: Path) -> None:
    values = qsgm("predict", "--json", *BOTH, scene).json
    first, second = values["objects"]
    assert set(first) == set(second) == ALWAYS
    assert [first["object"], second["object"]] == ["toy", "hook"]
    for one, center, turn in ((first, TOY_AT, TURN_DEG), (second, HOOK_AT, -TURN_DEG)):
        assert one["found"]
        assert math.dist(one["center_px"], center) < 2
        assert one["full_angle_deg"] == pytest.approx(turn, abs=1)
        assert one["candidates"][0]["center_px"] == one["center_px"]


def test_several_objects_are_found_as_each_is_alone(qsgm: Run, scene: Path) -> None:
    for entry in qsgm("predict", "--json", *BOTH, scene).json["objects"]:
        alone = qsgm("predict", "--json", "--object", entry["object"], scene).json
        assert "objects" not in alone
        assert {key: alone[key] for key in entry} == entry


def test_the_top_level_describes_the_surest_object_whatever_the_order(
    qsgm: Run, scene: Path
) -> None:
    write_png(scene, lay(hook(), table(3), HOOK_AT))
    orders = BOTH, (*BOTH[2:], *BOTH[:2])
    values = [qsgm("predict", "--json", *order, scene).json for order in orders]
    assert [one["object"] for one in values] == ["hook", "hook"]
    assert [one["found"] for one in values[0]["objects"]] == [False, True]
    without = [{k: v for k, v in one.items() if k != "objects"} for one in values]
    assert without[0] == without[1]


def test_all_instances_of_several_objects_have_their_names(qsgm: Run, scene: Path) -> None:
    two = lay(toy(), both_on_a_table(), (480.0, 120.0))
    write_png(scene, two)
    values = qsgm("predict", "--json", "--all", *BOTH, scene).json
    toys = [one["center_px"] for one in values["objects"] if one["object"] == "toy"]
    assert {one["object"] for one in values["objects"]} == {"toy", "hook"}
    for center in (TOY_AT, (480.0, 120.0)):
        assert min(math.dist(center, one) for one in toys) < 2
    write_png(scene, lay(toy(), table(3), TOY_AT))
    values = qsgm("predict", "--json", "--all", *BOTH, scene).json
    found = {(one["object"], one["found"]) for one in values["objects"]}
    assert found == {("toy", True), ("hook", False)}


def test_a_table_and_a_picture_show_what_is_where_and_what_is_not(
    qsgm: Run, scene: Path, tmp_path: Path
) -> None:
    write_png(scene, lay(toy(), table(3), TOY_AT))
    outcome = qsgm("predict", *BOTH, "-o", tmp_path / "seen.png", scene)
    rows = [line.split() for line in outcome.out.splitlines()]
    assert next(row for row in rows if row[:1] == ["toy"])[2] == f"{TOY_AT[0]:.1f},"
    assert next(row for row in rows if row[:1] == ["hook"])[2:4] == ["not", "found"]
    seen = cv2.imread(str(tmp_path / "seen.png"))
    assert seen is not None
    assert seen.shape == (960, 1280, 3)
    plain = cv2.resize(cv2.imread(str(scene)), (1280, 960), interpolation=cv2.INTER_CUBIC)
    drawn = (cv2.absdiff(seen, plain).max(axis=2) > 60).nonzero()
    assert set((drawn[0] // 480).tolist()) == {0, 1}  # the toy above, the hook's name below


def test_a_place_that_look_alikes_claim_is_the_surer_ones(qsgm: Run, scene: Path) -> None:
    """The twin is the toy with a spot: alone it takes the toy for itself."""
    twin = toy()
    cv2.circle(twin, (270, 240), 28, (20, 30, 60, 255), cv2.FILLED)
    teach(paths.folder_named("twin"), "twin", twin)
    write_png(scene, both_on_a_table())
    alone = qsgm("predict", "--json", "--object", "twin", scene).json
    assert alone["found"]
    assert math.dist(alone["center_px"], TOY_AT) < 3
    for order in (("toy", "twin"), ("twin", "toy")):
        options = [text for name in order for text in ("--object", name)]
        values = qsgm("predict", "--json", *options, scene).json
        entries = {one["object"]: one for one in values["objects"]}
        assert (values["object"], values["found"]) == ("toy", True)
        assert set(entries["twin"]) == set(entries["toy"]) == ALWAYS
        assert [entries[name]["found"] for name in ("toy", "twin")] == [True, False]
        assert math.dist(entries["twin"]["center_px"], TOY_AT) > 24
    write_png(scene, lay(twin, lay(toy(), table(3), TOY_AT, TURN_DEG), HOOK_AT))
    for options in ((), ("--all",)):
        both = ("--object", "twin", "--object", "toy")
        objects = qsgm("predict", "--json", *options, *both, scene).json["objects"]
        assert [(one["object"], one["found"]) for one in objects] == [("twin", True), ("toy", True)]
        assert math.dist(objects[0]["center_px"], HOOK_AT) < 3
        assert math.dist(objects[1]["center_px"], TOY_AT) < 3


def test_two_objects_of_one_name_are_refused(qsgm: Run, scene: Path, tmp_path: Path) -> None:
    teach(tmp_path / "other", "toy", hook())
    for other in (tmp_path / "other", "toy"):
        outcome = qsgm("predict", "--object", "toy", "--object", other, scene)
        assert_refused(outcome, 1, "two of the objects are called 'toy'", "objects rename")
