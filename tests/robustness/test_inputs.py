"""Whatever is in a file, it is read, or refused in one line: no traceback, no crash, no bomb."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from toys import by_correlation

from qsgm.bundle import Bundle
from qsgm.grasp.tuned import ObjectDescription, save_object
from robustness import saves
from robustness.conftest import Campaign

TOP = Path(__file__).parents[2]
# How many inputs CI tries, by what one of them takes.
READERS = {
    "frame": 400,
    "object_files": 60,
    "object_description": 60,
    "bundle": 30,
    "on_the_host": 90,
}


@pytest.fixture(scope="session")
def material(bundle: Bundle, frames_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What is broken: everything that qsgm reads, whole."""
    folder = tmp_path_factory.mktemp("material")
    (folder / "bundle").symlink_to(bundle.folder)
    (folder / "sgm.pt").write_bytes((TOP / "sgm.pt").read_bytes())
    about = ObjectDescription(
        "mug", "double", 0.25, 1.0, saves.VIEWS, by_correlation(), {"seed": 0}
    )
    save_object(folder / "object", about, bundle.network_with({}), {})
    frame = cv2.resize(cv2.imread(str(frames_folder / "bar.png")), (200, 150))
    for name, flags in (("frame.png", []), ("frame.jpg", []), ("frame.progressive", [2, 1])):
        ending = ".png" if name.endswith("png") else ".jpg"
        (folder / name).write_bytes(bytes(cv2.imencode(ending, frame, flags)[1]))
    wide = cv2.imencode(".png", frame.astype(np.uint16) << 4)[1]
    (folder / "frame.16").write_bytes(bytes(wide))
    entry = {"file": "a.png", "sha256": "0" * 64, "center_px": [320, 240]}
    (folder / "frames.json").write_text(json.dumps({"frames": [entry]}))
    return folder


@pytest.mark.parametrize("reader", READERS)
def test_a_broken_file_is_read_or_refused_in_one_line(
    campaign: Campaign, material: Path, tmp_path: Path, reader: str
) -> None:
    if reader == "on_the_host":
        pytest.importorskip("torch")
    counts = campaign("inputs", reader, tmp_path / "in", material, rounds=READERS[reader])
    assert counts["refused"]
    assert counts["accepted"]
    assert counts["inputs"] == counts["refused"] + counts["accepted"]
