"""A manifest is read as it was written, or refused in one line that names its key."""

import json
import math
import re
from dataclasses import FrozenInstanceError, replace
from pathlib import Path
from typing import Any

import pytest
from damage import damaged
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from qsgm import QsgmError
from qsgm.bundle import Bundle, load_bundle
from qsgm.manifest import (
    MANIFEST,
    Manifest,
    Place,
    Recipe,
    Recipes,
    SgmEntry,
    manifest_from,
)
from qsgm.network import Network

REFUSED = re.compile(
    r"(.*): '(\w+)' (is damaged: expected|does not list) .*; run `[\w -]+`( again)?"
)
KEYS = ["task", "network", "heads", "most_layers", "trunk", "blocks", "recipes", "initializers"]
KEYS += ["sgms", "files"]


@pytest.fixture(scope="module")
def written(bundle_folder: Path) -> dict[str, Any]:
    """A good manifest as it lies on the disk."""
    values: dict[str, Any] = json.loads((bundle_folder / MANIFEST).read_text())
    return values


def without_null_peaks(values: dict[str, Any]) -> dict[str, Any]:
    """A file whose steps take nobody knows how much may say so or leave it out."""
    files = {
        name: {
            key: value
            for key, value in one.items()
            if (key, value) != ("peak_activation_bytes", None)
        }
        for name, one in values["files"].items()
    }
    return values | {"files": files}


def read_or_refusal(values: dict[str, Any], path: Path) -> Manifest | str:
    """A manifest, or what is said against it."""
    try:
        return manifest_from(values, path)
    except QsgmError as error:
        return str(error)


def test_usual_blocks_are_some_of_those_that_can_be_tuned(
    bundle_folder: Path, written: dict[str, Any]
) -> None:
    path = bundle_folder / MANIFEST
    some = written | {"usual_blocks": {"3": "4,5-6"}}
    assert manifest_from(some, path).usual_blocks == {3: "4,5-6"}
    assert manifest_from(some, path).to_json() == some
    for bad in ({"2": "4,5-6"}, {"3": "4-5,6-7"}, {"x": "4,5,6"}, {"3": 4}, [1], 7, None):
        with pytest.raises(QsgmError, match="'usual_blocks' is damaged"):
            manifest_from(written | {"usual_blocks": bad}, path)


def test_a_manifest_comes_back_from_what_it_writes(
    bundle_folder: Path, written: dict[str, Any]
) -> None:
    manifest = load_bundle(bundle_folder).manifest
    assert manifest.to_json() == written
    assert manifest.text() == (bundle_folder / MANIFEST).read_text()
    again = manifest_from(json.loads(manifest.text()), bundle_folder / MANIFEST)
    assert again == manifest


def test_every_key_is_read_into_its_type(bundle: Bundle) -> None:
    manifest = bundle.manifest
    assert {*KEYS, "format", "version"} == manifest.to_json().keys()
    assert all(isinstance(one, Place) for one in manifest.initializers.values())
    assert manifest.initializers["bias6"].shape == (3,)
    assert all(isinstance(one, SgmEntry) for one in manifest.sgms.values())
    assert list(manifest.sgms) == [1, 2, 3, 4, 5]
    assert all(isinstance(one, Recipes) for one in manifest.recipes.values())
    assert bundle.recipe("sgm", range(5, 7), None) == Recipe("sgd", (0.005, 0.02))


def test_what_was_read_cannot_be_changed(bundle: Bundle) -> None:
    manifest: Any = bundle.manifest
    with pytest.raises(FrozenInstanceError):
        manifest.trunk = "int8"
    for entry, key in (
        (manifest.files["network.onnx"], "sha256"),
        (manifest.sgms[5], "convolutions"),
        (manifest.initializers["bias6"], "offset"),
        (manifest.recipes["sgm"], "optimizer"),
    ):
        with pytest.raises(FrozenInstanceError):
            setattr(entry, key, None)
    for values in (manifest.files, manifest.sgms, manifest.recipes, manifest.task.settings):
        with pytest.raises(TypeError, match="does not support item assignment"):
            values["x"] = 1
    manifest.task.to_json()["encoding"] = "paper"
    assert manifest.task.to_json()["encoding"] == "double"


@settings(max_examples=400, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_a_damaged_manifest_is_refused_by_a_key_or_read_as_it_is(
    bundle_folder: Path, written: dict[str, Any], data: st.DataObject
) -> None:
    path = bundle_folder / MANIFEST
    kept = {key: written[key] for key in KEYS}
    # As it would come from the disk: NaN is NaN there, and numbers may be too large.
    values = json.loads(json.dumps(data.draw(damaged(kept))))
    manifest = read_or_refusal(values, path)
    if isinstance(manifest, str):
        said = REFUSED.fullmatch(manifest)
        assert said is not None, manifest
        assert (said[1], said[2] in KEYS) == (str(path), True)
    else:
        head = {"format": written["format"], "version": written["version"]}
        assert manifest.to_json() == head | without_null_peaks(values)
        assert manifest_from(manifest.to_json(), path) == manifest


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize(
    "junk", [None, True, -1, 10**400, math.nan, "", "x", [], [[]], {}, {"name": None}], ids=repr
)
def test_a_key_that_holds_something_else_is_refused_by_its_name(
    bundle_folder: Path, written: dict[str, Any], key: str, junk: object
) -> None:
    with pytest.raises(QsgmError) as raised:
        manifest_from(written | {key: junk}, bundle_folder / MANIFEST)
    assert f"manifest.json: {key!r} " in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(("name", "shape"), [("bias6", [1, 3]), ("weight6", [16, 3, 1, 1])])
def test_numbers_of_another_shape_than_their_layers_are_refused(
    bundle_folder: Path, written: dict[str, Any], name: str, shape: list[int]
) -> None:
    places = written["initializers"]
    other = places | {name: places[name] | {"shape": shape}}
    with pytest.raises(QsgmError, match="'initializers' is damaged"):
        manifest_from(written | {"initializers": other}, bundle_folder / MANIFEST)


@pytest.mark.parametrize(
    "name",
    [
        *("", ".", "..", "/", "/etc/passwd", "../network.onnx", "a/b", "a/", "./network.onnx"),
        *("a\\b", "a\nb", "a\0b", "\x1b[2J"),
    ],
)
def test_names_that_are_not_plain_are_refused(
    bundle_folder: Path, written: dict[str, Any], name: str
) -> None:
    files = written["files"] | {name: {"sha256": "0" * 64}}
    with pytest.raises(QsgmError, match=r"'files' is damaged: .* by its plain name") as raised:
        manifest_from(written | {"files": files}, bundle_folder / MANIFEST)
    assert "\n" not in str(raised.value)


def test_layers_that_do_not_fit_each_other_or_the_heads_are_refused(
    bundle_folder: Path, written: dict[str, Any]
) -> None:
    path, network, heads = bundle_folder / MANIFEST, written["network"], written["heads"]
    layers = network["layers"]
    wider = [*layers[:2], layers[2] | {"out": 17}, *layers[3:]]
    with pytest.raises(QsgmError, match="'network' is damaged: expected layers that fit"):
        manifest_from(written | {"network": network | {"layers": wider}}, path)
    more = [*layers[:-1], layers[-1] | {"out": 4}]
    with pytest.raises(QsgmError, match="'heads' is damaged: expected what the network gives"):
        manifest_from(written | {"network": network | {"layers": more}}, path)
    with pytest.raises(QsgmError, match="'heads' is damaged"):
        manifest_from(written | {"heads": heads[:1]}, path)


def test_another_networks_manifest_is_read_as_well(bundle: Bundle) -> None:
    """Nothing in it is about six layers: the last three alone, as a network of numbers."""
    whole = bundle.manifest
    network = Network((1, 1, 16), whole.network.layers[4:], "numbers")
    places = {
        f"{kind}{k}": whole.initializers[f"{kind}{k + 4}"]
        for k in (1, 2)
        for kind in ("weight", "bias")
    }
    names = ["network.onnx", "weights.bin", "head_1.onnx", "head_2.onnx", "trunk_float_1.onnx"]
    names += ["trunk_float_2.onnx", "step_float_sgd_2.onnx", "step_float_sgd_1,2.onnx"]
    manifest = replace(
        whole,
        task=replace(whole.task, network=network),
        most_layers=2,
        blocks=("2", "1,2"),
        recipes={
            "sgm": Recipes(
                "sgd", {"sgd": {"2": (0.1,), "1,2": (0.1, 0.2)}}, {"2": 1.0, "1,2": 2.0}
            ),
            "bp": Recipes("adam", {"adam": {"2": (0.1,), "1-2": (0.1, 0.1)}}),
        },
        initializers=places,
        sgms={1: whole.sgms[5]},
        files=dict.fromkeys(names, whole.files["network.onnx"]),
    )
    assert manifest_from(manifest.to_json(), bundle.folder / MANIFEST) == manifest
