"""A slim bundle: less of the whole one, and every number the same."""

import json
import shutil
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from rich.console import Console
from toys import by_correlation, with_decision

from qsgm import QsgmError, Settings, finetune, load_bundle
from qsgm.bench.speed import measure_speed
from qsgm.blocks import one_block, parse_blocks, single_layers
from qsgm.bundle import Bundle
from qsgm.grasp.task import distractors_of, task_of
from qsgm.manifest import probe_file, step_file
from qsgm.train.graphs.inspection import all_nodes
from qsgm.train.graphs.memory import step_memory
from qsgm.train.slim import slim_bundle
from qsgm.tune.prepare import in_step_layout

Frame = NDArray[np.uint8]


@pytest.fixture(scope="module")
def slim(bundle: Bundle, tmp_path_factory: pytest.TempPathFactory) -> Bundle:
    folder = tmp_path_factory.mktemp("slim") / "three"
    slim_bundle(bundle, parse_blocks("4,5,6"), folder)
    return load_bundle(folder)


@pytest.mark.parametrize(
    "settings",
    [
        Settings(precision="int8", epochs=1),
        Settings(epochs=1, precision="float"),
        Settings(epochs=1, method="bp"),
        Settings(precision="int8", epochs=1, recalibrate=True),
    ],
)
def test_tuning_with_it_gives_the_same_bits(
    frame: Frame, bundle: Bundle, slim: Bundle, settings: Settings
) -> None:
    own, whole = (finetune(frame, one, settings) for one in (slim, bundle))
    for name, weight in whole.weights.items():
        np.testing.assert_array_equal(own.weights[name], weight)
    assert (own.scores, own.losses, own.fidelity) == (
        whole.scores,
        whole.losses,
        whole.fidelity,
    )
    assert own.network() == whole.network()


def test_it_comes_out_of_a_bundle_whose_files_have_other_names_too(
    bundle: Bundle, slim: Bundle, tmp_path: Path
) -> None:
    linked = tmp_path / "linked"
    shutil.copytree(bundle.folder, linked)
    for path in list(linked.iterdir()):
        (tmp_path / path.name).hardlink_to(path)  # as uv links packages out of its cache
    slim_bundle(load_bundle(linked), parse_blocks("4,5,6"), tmp_path / "three")
    for path in slim.folder.iterdir():
        assert (tmp_path / "three" / path.name).read_bytes() == path.read_bytes()


def test_things_and_decision_stay(bundle: Bundle, slim: Bundle, tmp_path: Path) -> None:
    name = "distractors.png"
    assert (slim.folder / name).read_bytes() == (bundle.folder / name).read_bytes()
    deciding = with_decision(bundle, by_correlation())
    slim_bundle(deciding, parse_blocks("5,6"), tmp_path / "two")
    decision = task_of(load_bundle(tmp_path / "two")).decision
    assert decision is not None
    assert decision.to_json() == by_correlation().to_json()
    files = {k: v for k, v in bundle.manifest.files.items() if k != name}
    old = replace(bundle, manifest=replace(bundle.manifest, files=files))
    slim_bundle(old, parse_blocks("5,6"), tmp_path / "old")
    assert distractors_of(load_bundle(tmp_path / "old")) is None


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (Settings(layers=2), "was made to tune 3 layers, not 2; pass --layers 3 or another"),
        (Settings(layers=1, method="bp"), "was made to tune 3 layers, not 1"),
        (Settings(layers=6), "can tune 3 layers at most"),
        (Settings(blocks="4,5-6"), "has no step for the blocks 4,5-6; choose one of 4,5,6"),
        (Settings(optimizer="adam"), "has no rates for adam on the blocks 4,5,6"),
        (
            Settings(trunk="int8"),
            "was made without trunk_int8_3.onnx; pass another --bundle",
        ),
    ],
)
def test_what_it_was_made_without_is_refused(
    frame: Frame, slim: Bundle, settings: Settings, said: str
) -> None:
    with pytest.raises(QsgmError, match=said):
        finetune(frame, slim, settings)


def test_graphs_with_loops_keep_their_arithmetic(bundle: Bundle, tmp_path: Path) -> None:
    text = "1-4,5,6"
    pixels = np.random.default_rng(0).integers(0, 256, (3, 128 * 128, 3), np.uint8)
    slim_bundle(bundle, parse_blocks(text), tmp_path / "six")
    name, outputs = step_file("int8", "sgd", parse_blocks(text)), []
    for one in (bundle, load_bundle(tmp_path / "six")):
        session = one.session(name)
        feeds = {
            value.name: np.full([3 if isinstance(n, str) else n for n in value.shape], 0.1, "f")
            for value in session.get_inputs()
        }
        start = in_step_layout(one.start_weights(one.network.last(6)))
        feeds |= {"features": pixels, "rows": np.arange(3)}
        outputs.append(session.run(None, feeds | start))
    for own, whole in zip(*outputs, strict=True):
        np.testing.assert_array_equal(own, whole)
    graph = onnx.load(tmp_path / "six" / name).graph
    results = {value.name for value in graph.output}
    made = {value for node in all_nodes(graph) for value in node.output} - results
    assert max(map(len, made)) == 2
    names = [node.name for node in all_nodes(graph)]
    assert len(set(names)) == len(names)


def test_the_report_adds_up_and_fits_a_line(bundle: Bundle, tmp_path: Path) -> None:
    report = slim_bundle(bundle, parse_blocks("5,6"), tmp_path / "two")
    values = json.loads(json.dumps(report.to_json()))
    sizes = {path.name: path.stat().st_size for path in (tmp_path / "two").iterdir()}
    assert values["bundle_bytes"] == sum(
        size for name, size in sizes.items() if name in values["files"]
    )
    assert set(sizes) - set(values["files"]) == {"SHA256SUMS"}
    shown = StringIO()
    Console(file=shown, width=200).print(report)
    assert shown.getvalue().endswith(f"{values['bundle_bytes'] / 1000:.0f} KB\n")


@pytest.mark.parametrize("text", ["6", "4,5,6", "4,5-6", "1-4,5,6"])
def test_what_is_slim_already_stays_as_it_is(bundle: Bundle, tmp_path: Path, text: str) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    slim_bundle(bundle, parse_blocks(text), first)
    slim_bundle(load_bundle(first), parse_blocks(text), second)
    for path in first.iterdir():
        assert (second / path.name).read_bytes() == path.read_bytes(), path.name


def test_a_bundle_may_lack_the_probe_and_nothing_else(bundle: Bundle, tmp_path: Path) -> None:
    blocks = parse_blocks("5,6")
    files = bundle.manifest.files
    without = {name: one for name, one in files.items() if name != probe_file(2)}
    report = slim_bundle(
        replace(bundle, manifest=replace(bundle.manifest, files=without)), blocks, tmp_path / "two"
    )
    assert probe_file(2) not in report.bytes
    step = step_file("float", "sgd", blocks)
    without = {name: one for name, one in files.items() if name != step}
    with pytest.raises(QsgmError, match=f"was made without {step}"):
        slim_bundle(
            replace(bundle, manifest=replace(bundle.manifest, files=without)),
            blocks,
            tmp_path / "no",
        )


def test_memory_and_speed_of_a_slim_bundle_are_refused_before_any_work(
    slim: Bundle, frame_path: Path
) -> None:
    with pytest.raises(QsgmError, match=r"was made without step_float_sgd_4-6\.onnx"):
        measure_speed(frame_path, slim, Settings(), 1, pytest.fail)
    with pytest.raises(QsgmError, match=r"was made without step_float_sgd_4-6\.onnx"):
        step_memory(slim, "float", one_block(slim.network.last(3)), 2)
    assert step_memory(slim, "int8", single_layers(slim.network.last(3)), 2).peak > 0


def test_a_bundle_is_not_replaced_by_a_part_of_it(slim: Bundle) -> None:
    with pytest.raises(QsgmError, match="is the bundle itself"):
        slim_bundle(slim, parse_blocks("4,5,6"), slim.folder)
    assert load_bundle(slim.folder).manifest == slim.manifest


@pytest.mark.parametrize("text", ["4-6", "3,4-5,6"])
def test_blocks_without_sgms_in_the_bundle_are_refused(
    bundle: Bundle, tmp_path: Path, text: str
) -> None:
    with pytest.raises(QsgmError, match=f"has no SGMs for the blocks {text}; choose one of 6 or"):
        slim_bundle(bundle, parse_blocks(text), tmp_path / "new")
    assert not (tmp_path / "new").exists()


def test_a_folder_with_something_else_is_refused(bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(QsgmError, match="did not write"):
        slim_bundle(bundle, parse_blocks("5,6"), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
