"""A tuned object's folder: written, read back, replaced, and refused where it is damaged."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refusal_of
from toy_objects import MUG, described
from toys import by_correlation

from qsgm import QsgmError, load_object, tuned_folder
from qsgm.bundle import Bundle
from qsgm.grasp.tuned import (
    MOST_VIEWS,
    ObjectDescription,
    save_object,
)
from qsgm.manifest import NETWORK
from qsgm.tuned_folder import DESCRIPTION, REPORT


def refusal(folder: Path) -> str:
    return refusal_of(load_object, folder)


def test_an_object_reads_back_as_it_was_written(saved: Path) -> None:
    assert load_object(saved).description == MUG
    assert json.loads((saved / REPORT).read_text()) == {"seed": 3}


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


def named(name: str) -> ObjectDescription:
    return replace(described(), name=name)


def other_network(bundle: Bundle) -> bytes:
    """The bundle's with one weight changed."""
    weights = bundle.start_weights(bundle.network.last(1))
    weights["bias6"] = weights["bias6"] + 1
    return bundle.network_with(weights)


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
    read, reads = tuned_folder.read_file, 0

    def replacing(path: Path, *arguments: Any) -> bytes:
        nonlocal reads
        data = read(path, *arguments)
        reads += 1
        if reads == moment:
            save_object(folder, named("new"), networks[1], {})
        return data

    monkeypatch.setattr(tuned_folder, "read_file", replacing)
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
