"""A bundle is used as it was exported, or refused in one line."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import numpy_helper
from refusals import refusal_of
from toys import by_correlation

from qsgm import QsgmError, load_bundle
from qsgm.blocks import one_block, parse_blocks, single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.network import GRASPNET
from qsgm.grasp.task import distractors_of, task_of
from qsgm.grasp.teach import finetune
from qsgm.manifest import NETWORK, Recipe, head_file, probe_file, step_file, trunk_file
from qsgm.tune.settings import Settings

GROUPED = ("4,5-6", "3-4,5,6", "2-4,5,6", "1-4,5,6")
BLOCKS = ["6", "5,6", "4,5,6", "3,4,5,6", "2,3,4,5,6", "1,2,3,4,5,6", *GROUPED]
LAST_TWO, LAST_THREE = GRASPNET.last(2), GRASPNET.last(3)
STEP = step_file("float", "sgd", parse_blocks("4,5,6"))


def test_a_whole_bundle_loads(bundle: Bundle) -> None:
    task = task_of(bundle)
    assert task.encoding == "double"
    assert 0 <= task.label_smoothing < 1
    assert bundle.network == GRASPNET
    assert bundle.manifest.heads == task.heads
    assert bundle.manifest.most_layers == 6
    singles = ("6", "5,6", "4,5,6", "3,4,5,6", "2,3,4,5,6", "1,2,3,4,5,6")
    assert bundle.manifest.blocks == (*singles, *GROUPED)


def test_the_things_that_come_with_a_bundle_are_read_and_checked(
    bundle: Bundle, own_bundle: Path
) -> None:
    things = distractors_of(bundle)
    assert things is not None
    assert len(things) == 2
    path = own_bundle / "distractors.png"
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(QsgmError, match=r"distractors\.png is not the file the manifest describes"):
        load_bundle(own_bundle)


def test_a_bundle_of_before_has_neither_things_nor_a_decision(own_bundle: Path) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["files"]["distractors.png"]
    path.write_text(json.dumps(manifest))
    (own_bundle / "distractors.png").unlink()
    old = load_bundle(own_bundle)
    assert distractors_of(old) is None
    assert task_of(old).decision is None


def test_a_bundles_decision_is_read_or_refused_before_any_work(
    own_bundle: Path, frame: NDArray[np.uint8]
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    good = by_correlation().to_json()
    set_in(manifest, "task", "decision", good)
    path.write_text(json.dumps(manifest))
    decision = task_of(load_bundle(own_bundle)).decision
    assert decision is not None
    assert decision.to_json() == by_correlation().to_json()
    assert load_bundle(own_bundle).sha256() == hashlib.sha256(path.read_bytes()).hexdigest()
    set_in(manifest, "task", "decision", good | {"bias": "x"})
    path.write_text(json.dumps(manifest))
    with pytest.raises(QsgmError, match=r"manifest\.json: the decision's numbers do not fit"):
        finetune(frame, load_bundle(own_bundle))


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"encoding": "triple"}, "'encoding' is damaged: expected double or paper"),
        ({"encoding": None}, "'encoding' is damaged"),
        ({"encoding": ["double"]}, "'encoding' is damaged"),
        ({"name": "sorting"}, "is of the task 'sorting', expected 'grasp'"),
        ({"decision": {}}, "the decision weighs other evidence"),
        ({"decision": [1]}, "the decision"),
    ],
)
def test_another_task_than_grasping_is_refused_where_an_object_is_taught(
    own_bundle: Path, frame: NDArray[np.uint8], changed: dict[str, Any], said: str
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["task"] |= changed
    path.write_text(json.dumps(manifest))
    with pytest.raises(QsgmError, match=said) as raised:
        finetune(frame, load_bundle(own_bundle))
    assert "\n" not in str(raised.value)


def test_names_of_steps() -> None:
    assert step_file("int8", "sgd", single_layers(range(4, 7))) == "step_int8_sgd_4,5,6.onnx"
    assert step_file("float", "adam", parse_blocks("1-4,5,6")) == "step_float_adam_1-4,5,6.onnx"
    # The last block has its gradient from the loss: a single one needs no SGM.
    assert step_file("int8", "sgd", one_block(range(5, 7))) == "step_float_sgd_5-6.onnx"
    assert step_file("int8", "sgd", single_layers(range(6, 7))) == "step_float_sgd_6.onnx"


def test_blocks_that_the_bundle_lacks_are_refused_with_those_it_has(bundle: Bundle) -> None:
    for text in (*bundle.manifest.blocks, "4-6"):
        bundle.check_blocks(parse_blocks(text))
    with pytest.raises(QsgmError, match="no step for the blocks 4-5,6; choose one of 6 or 5,6 or"):
        bundle.check_blocks(parse_blocks("4-5,6"))
    small = replace(bundle, manifest=replace(bundle.manifest, most_layers=3))
    with pytest.raises(QsgmError, match="3 layers at most, not 6; pass --layers 3"):
        small.check_blocks(parse_blocks("1-4,5,6"))


def test_a_recipe_has_a_rate_per_layer_and_its_own_optimizer(bundle: Bundle) -> None:
    last = bundle.network.last
    assert bundle.recipe("sgm", last(3), None).optimizer == "sgd"
    assert bundle.recipe("bp", last(3), None).optimizer == "adam"
    assert bundle.recipe("bp", last(2), "sgd").optimizer == "sgd"
    for tuned in range(1, 7):
        assert len(bundle.recipe("sgm", last(tuned), None).rates) == tuned
    assert len(bundle.recipe("sgm", last(6), None, parse_blocks("1-4,5,6")).rates) == 6


def test_start_weights_are_those_in_the_network(bundle: Bundle) -> None:
    model = onnx.load(bundle.folder / NETWORK)
    inside = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    start = bundle.start_weights(bundle.network.last(3))
    assert set(start) == {"weight4", "bias4", "weight5", "bias5", "weight6", "bias6"}
    for name, value in start.items():
        np.testing.assert_array_equal(value, inside[name])


def test_exchanged_weights_arrive_in_the_network_and_nothing_else_changes(bundle: Bundle) -> None:
    start = bundle.start_weights(bundle.network.last(3))
    new = {name: np.asarray(value + 1, dtype=np.float32) for name, value in start.items()}
    model = onnx.load_from_string(bundle.network_with(new))
    inside = {tensor.name: numpy_helper.to_array(tensor) for tensor in model.graph.initializer}
    for name, value in new.items():
        np.testing.assert_array_equal(inside[name], value)
    assert bundle.network_with(start) == (bundle.folder / NETWORK).read_bytes()
    with pytest.raises(ValueError, match="`bias6` must be"):
        bundle.network_with({"bias6": np.zeros(4, np.float32)})


def refusal(folder: Path) -> str:
    return refusal_of(load_bundle, folder)


def test_a_missing_graph_is_named(own_bundle: Path) -> None:
    (own_bundle / trunk_file("float", LAST_TWO)).unlink()
    assert "trunk_float_2.onnx does not exist: expected a file that `qsgm fold-and-q" in refusal(
        own_bundle
    )


def test_a_graph_altered_by_one_bit_is_named(own_bundle: Path) -> None:
    path = own_bundle / NETWORK
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    assert f"{path} is not the file the manifest describes" in refusal(own_bundle)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "is not JSON"),
        ("{", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("[]", "is of format None"),
        ('{"format": "qsgm-object", "version": 1}', "is of format ('qsgm-object', 1)"),
        ('{"format": "qsgm-bundle", "version": 99}', "is of format ('qsgm-bundle', 99)"),
    ],
)
def test_a_manifest_of_something_else_is_refused(
    own_bundle: Path, content: str, expected: str
) -> None:
    (own_bundle / "manifest.json").write_text(content)
    assert expected in refusal(own_bundle)


def test_a_folder_without_manifest_is_refused(tmp_path: Path) -> None:
    assert "manifest.json does not exist: expected a bundle" in refusal(tmp_path)


def test_a_graph_that_the_runtime_cannot_load_is_refused(own_bundle: Path) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    (own_bundle / trunk_file("float", LAST_THREE)).write_bytes(b"not a graph")
    sha256 = hashlib.sha256(b"not a graph").hexdigest()
    manifest["files"][trunk_file("float", LAST_THREE)] = {"sha256": sha256}
    path.write_text(json.dumps(manifest))
    with pytest.raises(QsgmError, match=r"cannot load .*trunk_float_3\.onnx"):
        load_bundle(own_bundle).session(trunk_file("float", LAST_THREE))


@pytest.mark.parametrize(
    "key",
    [
        *("task", "network", "heads", "trunk", "blocks", "files", "initializers", "recipes"),
        *("most_layers", "sgms"),
    ],
)
def test_a_manifest_without_one_of_its_keys_is_refused_by_that_key(
    own_bundle: Path, key: str
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    for broken in ({k: v for k, v in manifest.items() if k != key}, manifest | {key: None}):
        path.write_text(json.dumps(broken))
        got = "'None'" if key in broken else "nothing"
        said = f"'{key}' is damaged: expected .*, got {got}; run `qsgm fold-and-quantize`"
        with pytest.raises(QsgmError, match=said):
            load_bundle(own_bundle)


def test_a_file_entry_of_another_shape_is_refused(own_bundle: Path) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    for entry in ("fine", {"sha256": None}, {"sha256": "fine", "peak_activation_bytes": "much"}):
        manifest["files"]["network.onnx"] = entry
        path.write_text(json.dumps(manifest))
        assert "'files' is damaged: expected a sha256 for every file" in refusal(own_bundle)
    manifest["files"]["network.onnx"] = {"sha256": "fine"}
    path.write_text(json.dumps(manifest))
    assert "its sha256 differs" in refusal(own_bundle)


def test_a_manifest_that_is_not_utf_8_is_refused(own_bundle: Path) -> None:
    (own_bundle / "manifest.json").write_bytes(b'{"format": "\xff"}')
    assert "is not JSON" in refusal(own_bundle)


def set_in(manifest: dict[str, Any], *keys_and_value: Any) -> None:
    *way, last, value = keys_and_value
    for key in way:
        manifest = manifest[key]
    manifest[last] = value


@pytest.mark.parametrize(
    ("way", "value", "said"),
    [
        (("task", "name"), 5, "'task' is damaged: expected a name"),
        (("heads", 0, "smoothing"), 1.0, "'heads' is damaged: expected what the network gives"),
        (("heads", 0, "smoothing"), float("nan"), "'heads' is damaged"),
        (("most_layers",), 0, "'most_layers' is damaged: expected 1 to 6"),
        (("most_layers",), 7, "'most_layers' is damaged"),
        (("trunk",), "int4", "'trunk' is damaged: expected int8 or float"),
        (("blocks",), [], "'blocks' is damaged"),
        (("blocks",), [*BLOCKS, "4,5,6"], "'blocks' is damaged"),
        (("blocks",), [*BLOCKS, "4,5"], "'blocks' is damaged"),
        (("blocks",), [*BLOCKS, "4-6"], "'blocks' is damaged"),
        (("blocks",), [*BLOCKS, "4,5-6,"], "'blocks' is damaged"),
        (("blocks",), [*BLOCKS, 6], "'blocks' is damaged"),
        (("blocks",), [*BLOCKS, []], "'blocks' is damaged"),
        (("blocks",), BLOCKS[:3], "'blocks' is damaged"),  # of fewer layers than `most_layers`
        (("blocks",), [*BLOCKS, "4-5,6"], "'recipes' is damaged"),
        (("recipes",), {}, "'recipes' is damaged"),
        (("recipes", "bp"), [], "'recipes' is damaged"),
        (("recipes", "sgm", "short_gains", "6"), 0.5, "'recipes' is damaged"),
        (("recipes", "sgm", "optimizer"), "lion", "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "sgd", "4,5,6"), [0.1], "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "adam", "6"), [0.0], "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "adam", "6"), [10**400], "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "adam", "6"), ["0.1"], "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "adam", "6"), [True], "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "adam", "6"), [float("nan")], "'recipes' is damaged"),
        (("recipes", "sgm", "short_gains", "6"), "1.5", "'recipes' is damaged"),
        (("recipes", "sgm", "short_gains", "6"), 10**400, "'recipes' is damaged"),
        (("recipes", "sgm", "rates", "adam", "6"), ["fast"], "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"adam": {"6": []}}, "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"adam": {"6": [[5, 0.0]]}}, "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"adam": {"6": [[5.0, 1.0]]}}, "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"adam": {"6": [[0, 1.0]]}}, "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"adam": {"6": [[9, 2], [9, 1]]}}, "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"adam": {"5-6": [[9, 1]]}}, "'recipes' is damaged"),
        (("recipes", "sgm", "gains"), {"lion": {"6": [[9, 1]]}}, "'recipes' is damaged"),
        (("recipes", "sgm", "optimizers"), {"6": "lion"}, "'recipes' is damaged"),
        (("recipes", "sgm", "optimizers"), {"4,5-6": "adam"}, "'recipes' is damaged"),
        (("recipes", "bp", "rates", "adam", "5-6"), [1e-3, float("inf")], "'recipes' is damaged"),
        (("initializers", "bias6"), None, "'initializers' is damaged"),
        (("initializers", "bias6", "shape"), [3, 1], "'initializers' is damaged"),
        (("initializers", "bias6", "shape"), ["3"], "'initializers' is damaged"),
        (("initializers", "weight4", "offset"), 10**9, "'initializers' is damaged"),
        (("initializers", "weight4", "offset"), -1, "'initializers' is damaged"),
        (("initializers", "weight1"), None, "'initializers' is damaged"),
        (("sgms", "5"), None, "'sgms' is damaged"),
        (("sgms", "5", "bits"), 7, "'sgms' is damaged"),
        (("sgms", "5", "convolutions"), [], "'sgms' is damaged"),
        (("sgms", "4", "convolutions", 0, "weight", "offset"), 10**9, "'sgms' is damaged"),
        (("sgms", "4", "convolutions", 0, "weight", "shape"), [1, 1, 19, 12], "'sgms' is damaged"),
        (("sgms", "4", "convolutions", 0, "bias", "shape"), [3], "'sgms' is damaged"),
        (("sgms", "4", "convolutions", 1, "weight", "shape"), [12, 16, 1, 1], "'sgms' is damaged"),
    ],
)
def test_a_manifest_that_says_nonsense_is_refused_by_its_key(
    own_bundle: Path, way: tuple[str, ...], value: object, said: str
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    set_in(manifest, *way, value)
    path.write_text(json.dumps(manifest))
    assert said in refusal(own_bundle)


@pytest.mark.parametrize(
    "name",
    [
        NETWORK,
        head_file(1),
        trunk_file("float", GRASPNET.last(6)),
        step_file("float", "sgd", parse_blocks("1-4,5,6")),
    ],
)
def test_a_manifest_that_does_not_list_a_graph_is_refused_by_its_name(
    own_bundle: Path, name: str
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    del manifest["files"][name]
    path.write_text(json.dumps(manifest))
    assert f"'files' does not list {name}" in refusal(own_bundle)


@pytest.mark.parametrize(
    ("name", "other"),
    [
        (trunk_file("float", LAST_THREE), trunk_file("float", GRASPNET.last(1))),
        (trunk_file("float", LAST_THREE), head_file(3)),
        (head_file(3), head_file(1)),
        (STEP, step_file("float", "sgd", parse_blocks("5,6"))),
        (STEP, trunk_file("float", LAST_THREE)),
        (probe_file(3), head_file(3)),
    ],
)
def test_another_graph_under_the_name_of_one_is_refused_when_it_runs(
    own_bundle: Path, frame: NDArray[np.uint8], name: str, other: str
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    (own_bundle / name).write_bytes((own_bundle / other).read_bytes())
    manifest["files"][name] = manifest["files"][other]
    path.write_text(json.dumps(manifest))
    with pytest.raises(
        QsgmError, match=r"(takes|gives) .*expected .*export it again with"
    ) as raised:
        finetune(frame, load_bundle(own_bundle), Settings(epochs=1))
    assert "\n" not in str(raised.value)


def test_one_layer_is_tuned_with_the_rates_of_the_method_asked_for(own_bundle: Path) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["recipes"]["sgm"]["rates"]["sgd"]["6"] = [0.123]
    path.write_text(json.dumps(manifest))
    found = load_bundle(own_bundle)
    last = found.network.last(1)
    assert found.recipe("sgm", last, None) == Recipe("sgd", (0.123,))
    assert found.recipe("bp", last, None).optimizer == "adam"


def test_short_runs_of_sgms_start_at_higher_rates_and_those_of_others_do_not(
    own_bundle: Path,
) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["recipes"]["sgm"]["short_gains"]["5,6"] = 4.0
    path.write_text(json.dumps(manifest))
    found = load_bundle(own_bundle)
    recipe = found.recipe("sgm", LAST_TWO, None)
    for steps, factor in ((25, 4), (75, 4), (194, 2), (500, 1), (5000, 1)):
        expected = [factor * rate for rate in recipe.rates]
        assert recipe.rates_over(steps) == pytest.approx(expected, rel=1e-2)
    for other in (found.recipe("sgm", LAST_TWO, "adam"), found.recipe("bp", LAST_TWO, "sgd")):
        assert other.rates_over(25) == other.rates


def test_gains_by_length_take_the_place_of_those_of_short_runs(own_bundle: Path) -> None:
    path = own_bundle / "manifest.json"
    manifest = json.loads(path.read_text())
    recipes = manifest["recipes"]["sgm"]
    recipes["short_gains"]["5,6"] = 4.0
    recipes["gains"] = {"adam": {"5,6": [[5, 8.0], [20, 2.0], [80, 0.5]]}}
    recipes["optimizers"] = {"5,6": "adam"}
    path.write_text(json.dumps(manifest))
    found = load_bundle(own_bundle)
    recipe = found.recipe("sgm", LAST_TWO, None)
    assert recipe.optimizer == "adam"
    # Geometric between known lengths, as far as those go: 10 lies half way from 5 to 20.
    for steps, factor in ((1, 8), (5, 8), (10, 4), (20, 2), (40, 1), (80, 0.5), (9000, 0.5)):
        expected = [factor * rate for rate in recipe.rates]
        assert recipe.rates_over(steps) == pytest.approx(expected, rel=1e-6)
    plain = found.recipe("sgm", LAST_TWO, "sgd")
    assert plain.rates_over(5) == pytest.approx([4 * rate for rate in plain.rates])
    assert found.recipe("sgm", found.network.last(1), None).optimizer == "sgd"
    assert found.manifest.to_json()["recipes"]["sgm"]["gains"] == recipes["gains"]
