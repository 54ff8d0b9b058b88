"""A tuned object on disk: written whole, read back as it was, refused when it is not."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from qsgm import QsgmError, load_object
from qsgm.bundle import NETWORK, Bundle
from qsgm.tuned import DESCRIPTION, REPORT, ObjectDescription, save_object

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
    assert "missing or altered; tune the object again" in refusal(saved)
    (saved / NETWORK).unlink()
    assert "missing or altered" in refusal(saved)


@pytest.mark.parametrize("content", ["", "nonsense", "{}", '{"format": "qsgm-bundle"}'])
def test_another_description_is_refused(saved: Path, content: str) -> None:
    (saved / DESCRIPTION).write_text(content)
    assert "qsgm finetune" in refusal(saved)


def test_a_folder_that_is_no_object_is_refused(tmp_path: Path) -> None:
    assert "holds no object.json" in refusal(tmp_path)


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


def test_a_network_that_is_another_graph_is_refused(bundle: Bundle, tmp_path: Path) -> None:
    save_object(tmp_path / "mug", MUG, (bundle.folder / "trunk_float_6.onnx").read_bytes(), {})
    text = refusal(tmp_path / "mug")
    assert "takes ['crops'] and gives ['features'], expected a frame and its heatmap" in text


def test_a_frame_that_does_not_fit_the_network_is_refused(saved: Path) -> None:
    with pytest.raises(QsgmError, match=r"does not fit .*; tune the object again"):
        load_object(saved).heatmap(np.zeros((128, 128, 5), np.uint8))
