"""The calibration set: drawn the same twice, what its manifest says, damage refused in one line."""

import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from qsgm import QsgmError
from qsgm.files import check_replaceable
from qsgm.images import read_frame, write_png
from qsgm.train.grasp.calibration_set import CalibrationSet
from qsgm.train.grasp.draw_calibration import draw_calibration_set
from qsgm.train.grasp.draw_demo import draw_demo
from qsgm.train.grasp.objects import TABLE_KINDS


def test_a_drawn_set_is_the_same_twice_and_replaces_itself(tmp_path: Path) -> None:
    folder, again = tmp_path / "once", tmp_path / "again"
    draw_calibration_set(folder, count=2, seed=3)
    draw_calibration_set(again, count=1, seed=4)
    draw_calibration_set(again, count=2, seed=3)
    names = sorted(path.name for path in folder.iterdir())
    assert names == sorted(path.name for path in again.iterdir())
    for name in names:
        assert (folder / name).read_bytes() == (again / name).read_bytes()


def test_the_shipped_set_shows_every_table_and_is_what_its_manifest_says() -> None:
    shipped = Path(__file__).parents[2] / "calib"
    manifest = json.loads((shipped / "manifest.json").read_text())
    frames = CalibrationSet(shipped)
    assert len(frames) == len(manifest["frames"]) >= 20
    assert {frame["table_kind"] for frame in manifest["frames"]} == set(TABLE_KINDS)
    for i in range(len(frames)):
        assert frames[i].frame.shape == (480, 640, 3)
    assert sum(path.stat().st_size for path in shipped.iterdir()) < 3e6
    check_replaceable(shipped, "manifest.json")
    demo = manifest["demo"]
    assert read_frame(shipped / demo["scene"]).shape == (480, 640, 3)


def test_the_demo_object_turns_and_moves_as_its_truth_says() -> None:
    # The bottle is darker than everything on this table.
    demo = draw_demo(0)
    gray = [cv2.cvtColor(p, cv2.COLOR_BGR2GRAY) for p in (demo.demonstration, demo.scene)]
    masks = [(picture < 90).astype(np.uint8) for picture in gray]
    centers, angles = [], []
    for mask in masks:
        (x, y), size, degrees = cv2.minAreaRect(cv2.findNonZero(cv2.medianBlur(mask, 5)))
        centers.append((x, y))
        angles.append(-(degrees if size[0] >= size[1] else degrees + 90))
    assert centers[0] == pytest.approx((320, 240), abs=4)
    assert centers[1] == pytest.approx(demo.center_px, abs=4)
    turn = (angles[1] - angles[0] - demo.angle_deg + 90) % 180 - 90
    assert turn == pytest.approx(0, abs=4)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "manifest.json does not exist: expected a calibration set"),
        ("[]", "is damaged"),
        ("{", "is damaged"),
        ('{"frames": [{"file": "a"}]}', "is damaged"),
        ('{"frames": []}', "lists no frames"),
        ("[" * 100_000, "is damaged"),
        ('{"format": "qsgm-bundle", "frames": []}', "is damaged"),
        ('{"version": 2, "frames": []}', "is damaged"),
        ('{"format": "qsgm-calibration", "version": 1, "frames": []}', "lists no frames"),
    ],
)
def test_a_folder_that_is_no_calibration_set_is_refused(
    tmp_path: Path, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(QsgmError, match=message):
        CalibrationSet(tmp_path)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("file", "../frame.png"),
        ("file", "/etc/passwd"),
        ("file", "sub/frame.png"),
        ("file", "sub\\frame.png"),
        ("file", ".."),
        ("file", ""),
        ("file", "frame\0.png"),
        ("file", "frame\n.png"),
        ("file", "frame\ud800.png"),
        ("file", 7),
        ("sha256", None),
        ("sha256", 7),
        ("center_px", [320]),
        ("center_px", [320, 240, 1]),
        ("center_px", ["320", "240"]),
        ("center_px", [320, float("nan")]),
        ("center_px", [float("inf"), 240]),
        ("center_px", [10**400, 240]),
        ("center_px", [-1, 240]),
        ("center_px", [True, 240]),
        ("center_px", None),
    ],
)
def test_an_entry_that_describes_no_frame_is_refused(
    tmp_path: Path, key: str, value: object
) -> None:
    entry = {"file": "frame.png", "sha256": "0" * 64, "center_px": [320, 240]}
    manifest = tmp_path / "manifest.json"
    manifest.write_text(json.dumps({"frames": [entry]}))
    assert len(CalibrationSet(tmp_path)) == 1
    manifest.write_text(json.dumps({"frames": [entry | {key: value}]}))
    with pytest.raises(QsgmError, match="is damaged") as caught:
        CalibrationSet(tmp_path)
    assert "\n" not in str(caught.value)


def write_set(folder: Path, picture: np.ndarray, center_px: tuple[float, float]) -> CalibrationSet:
    """A set of one frame."""
    write_png(folder / "frame.png", picture)
    digest = hashlib.sha256((folder / "frame.png").read_bytes()).hexdigest()
    entry = {"file": "frame.png", "sha256": digest, "center_px": center_px}
    (folder / "manifest.json").write_text(json.dumps({"frames": [entry]}))
    return CalibrationSet(folder)


@pytest.mark.parametrize("center_px", [(640, 240), (320, 480), (1e9, 1e9)])
def test_an_object_outside_its_frame_is_refused(
    tmp_path: Path, frame: np.ndarray, center_px: tuple[float, float]
) -> None:
    assert write_set(tmp_path, frame, (639, 479))[0].center_px == (639, 479)
    with pytest.raises(QsgmError, match=r"outside its frame of 640x480; correct its center_px"):
        write_set(tmp_path, frame, center_px)[0]


def test_a_frame_that_is_no_demonstration_is_refused(tmp_path: Path) -> None:
    flat = np.full((480, 640, 3), 90, np.uint8)
    with pytest.raises(QsgmError, match="one flat colour"):
        write_set(tmp_path, flat, (320, 240))[0]


def test_an_altered_frame_is_refused(tmp_path: Path) -> None:
    draw_calibration_set(tmp_path / "set", count=2, seed=3)
    frames = CalibrationSet(tmp_path / "set")
    (tmp_path / "set/frame_01.jpg").write_bytes((tmp_path / "set/frame_00.jpg").read_bytes())
    assert frames[0].center_px == (320, 240)
    with pytest.raises(QsgmError, match=r"frame_01\.jpg is not the frame the manifest describes"):
        frames[1]
