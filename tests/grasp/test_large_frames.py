"""Photographs of 12 megapixels: answers as if looked at as a whole, and little memory."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from toy_objects import described
from toys import lay, table, toy

from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.grasp import pictures
from qsgm.grasp import tuned as tuned_module
from qsgm.grasp.heatmap import Detection
from qsgm.grasp.pictures import draw_detection
from qsgm.grasp.tuned import ObjectDescription, TunedObject, save_object

MOST_MB = 250
# Of that, what is used of the libraries' files. Around it the kernel maps as much as it likes of
# what it has cached of them: that is not the process's.
FILES_MB = 60
CENTER = (320.0, 240.0)


@given(
    height=st.integers(128, 420),
    width=st.integers(128, 420),
    strip_pixels=st.integers(1, 60_000),
    seed=st.integers(0, 2**32),
)
def test_strips_give_the_heatmap_of_the_whole_frame_bit_by_bit(
    bundle: Bundle, height: int, width: int, strip_pixels: int, seed: int
) -> None:
    tuned = TunedObject(ObjectDescription("mug", "double", 0.0), bundle.network_with({}), 1)
    frame = np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)
    whole = tuned._session.run(["heatmap"], {"frame": frame})[0]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuned_module, "_STRIP_PIXELS", strip_pixels)
        patch.setattr(tuned_module, "_KEPT_PIXELS", 0)
        assert len(list(tuned_module._strips(frame))) > 1 or height < 256 or strip_pixels > 50_000
        np.testing.assert_array_equal(tuned.heatmap(frame), whole)


def test_a_picture_drawn_strip_by_strip_is_the_one_drawn_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    quality = np.zeros((3, 25, 35), np.float32)
    quality[0, 3:22, 4:6], quality[0, 12, 20] = 0.9, 0.4
    found = Detection(True, 0.9, (200.0, 300.0), (0.0, 0.0), 30.0, scale=0.7)
    frame = np.random.default_rng(0).integers(0, 256, (400, 640, 3), dtype=np.uint8)
    strips = draw_detection(frame, quality, found, "toy")
    monkeypatch.setattr(pictures, "_STRIP_ROWS", 10_000)
    at_once = draw_detection(frame, quality, found, "toy")
    # The rows of a strip are counted anew, in float32.
    assert np.abs(strips.astype(int) - at_once).max() <= 1
    assert (strips != at_once).mean() < 1e-3


def test_frames_are_as_large_as_is_said_and_what_is_larger_at_the_objects_scale_is_refused(
    bundle: Bundle,
) -> None:
    frame = np.random.default_rng(0).integers(0, 256, (160, 4096, 3), dtype=np.uint8)
    _, heatmap = TunedObject(described(), bundle.network_with({}), 1).locate(frame)
    assert heatmap.shape == (3, 9, 255)
    enlarging = TunedObject(described(scale=1.5), bundle.network_with({}), 1)
    with pytest.raises(QsgmError, match="has 6144x240 at the scale of 'toy': expected 64 to 4096"):
        enlarging.locate(frame)


MEASURED = """
import re, sys
from pathlib import Path
from qsgm.cli import main
sys.argv[0] = "qsgm"
try:
    main()
finally:
    status = Path("/proc/self/status").read_text()
    kilobytes = (int(re.search(rf"{name}:\\s*(\\d+)", status)[1]) for name in ("VmHWM", "RssFile"))
    print(*(one // 1000 for one in kilobytes), file=sys.stderr)
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="there is no /proc")
@pytest.mark.parametrize("options", [["--any-distance"], ["--all"], ["-o", "seen.png"]])
def test_a_photograph_of_12_megapixels_is_searched_in_less_than_250_mb(
    bundle: Bundle, tmp_path: Path, options: list[str]
) -> None:
    save_object(tmp_path / "toy", described(), bundle.network_with({}), {})
    cv2.imwrite(str(tmp_path / "photo.jpg"), photograph())
    command = ["predict", "--json", "--object", "toy", *options, "photo.jpg"]
    done = subprocess.run(
        [sys.executable, "-c", MEASURED, *command],
        capture_output=True,
        text=True,
        check=True,
        cwd=tmp_path,
    )
    peak, files = map(int, done.stderr.split()[-2:])
    assert peak - files < MOST_MB - FILES_MB


def photograph() -> NDArray[np.uint8]:
    """A toy on a table, (3000, 4000, 3)."""
    part = lay(toy(), table(1), CENTER, 40)
    room = 1300, 3000 - 1300 - 480, 1700, 4000 - 1700 - 640
    return np.asarray(cv2.copyMakeBorder(part, *room, cv2.BORDER_REFLECT_101), np.uint8)
