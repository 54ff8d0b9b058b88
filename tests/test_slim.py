"""A slim bundle: less of the whole one, and every number the same."""

import json
from io import StringIO
from pathlib import Path

import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from rich.console import Console

from qsgm import QsgmError, Settings, finetune, load_bundle
from qsgm.bench.step_jobs import random_features, start_of
from qsgm.blocks import parse_blocks
from qsgm.bundle import Bundle, step_file
from qsgm.train.graphs.inspection import all_nodes
from qsgm.train.slim import slim_bundle

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
        Settings(precision="int8", epochs=1, method="bp"),
        Settings(precision="int8", epochs=1, recalibrate=True),
    ],
)
def test_tuning_with_it_gives_the_same_bits(
    frame: Frame, bundle: Bundle, slim: Bundle, settings: Settings
) -> None:
    own, whole = (finetune(frame, one, settings) for one in (slim, bundle))
    for name, weight in whole.weights.items():
        np.testing.assert_array_equal(own.weights[name], weight)
    assert (own.accuracy, own.losses, own.fidelity) == (
        whole.accuracy,
        whole.losses,
        whole.fidelity,
    )
    assert own.network() == whole.network()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        (
            Settings(precision="int8", layers=2),
            "has no step for the blocks 5,6; choose one of 4,5,6",
        ),
        (Settings(precision="int8", layers=6), "can tune 3 layers at most"),
        (Settings(precision="int8", optimizer="adam"), "has no rates for adam on the blocks 4,5,6"),
        (
            Settings(precision="int8", trunk="int8"),
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
    slim_bundle(bundle, parse_blocks(text), tmp_path / "six")
    name, outputs = step_file("int8", "sgd", parse_blocks(text)), []
    for one in (bundle, load_bundle(tmp_path / "six")):
        session = one.session(name)
        feeds = {
            value.name: np.full([3 if isinstance(n, str) else n for n in value.shape], 0.1, "f")
            for value in session.get_inputs()
        }
        feeds |= {"features": random_features(session, 3), "rows": np.arange(3)}
        outputs.append(session.run(None, feeds | start_of(one, 6)))
    for own, whole in zip(*outputs, strict=True):
        np.testing.assert_array_equal(own, whole)
    graph = onnx.load(tmp_path / "six" / name).graph
    results = {value.name for value in graph.output}
    made = {value for node in all_nodes(graph) for value in node.output} - results
    assert max(map(len, made)) == 2
    assert {node.name for node in all_nodes(graph)} == {""}


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


def test_a_folder_with_something_else_is_refused(bundle: Bundle, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(QsgmError, match="did not write"):
        slim_bundle(bundle, parse_blocks("5,6"), tmp_path)
    with pytest.raises(QsgmError, match="has no step for the blocks 3,4-5,6"):
        slim_bundle(bundle, parse_blocks("3,4-5,6"), tmp_path / "new")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]
