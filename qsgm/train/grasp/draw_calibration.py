"""`qsgm draw-calibration`: demonstration frames for calibration, all drawn, none photographed."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from qsgm import defaults
from qsgm.files import new_folder, sha256
from qsgm.images import write_png
from qsgm.progress import Progress
from qsgm.train.grasp.draw_demo import draw_demo
from qsgm.train.grasp.objects import OBJECT_KINDS, TABLE_KINDS, DrawnFrame, draw_frame

MANIFEST = "manifest.json"
DEMO_OBJECT, DEMO_SCENE = "demo_object.png", "demo_scene.png"
# No other folder that qsgm writes holds a file of this name; `manifest.json` is in two kinds.
MARKER = DEMO_SCENE
# Sets these frames apart from those that pretraining draws with the same seed.
STREAM = 24001
JPEG_QUALITY = 92
CENTER_PX = (320, 240)


_README = """# The calibration set

{count} demonstration frames: an object on a table, seen from above, its centre at ({x}, {y}).
`qsgm fold-and-quantize` fine-tunes on each of them and takes the int8 ranges of the synthetic
gradient modules along these runs, from the first step to the last.

All frames are drawn from random numbers, none is a photograph, and none was used in pretraining.
Every kind of table and {kinds} kinds of objects occur. Made by

    {command}

which writes the same pictures again. `manifest.json` says for every frame what is on it, the seed
it was drawn from and its sha256. Frames of your own, with a manifest of the same form, make a
calibration set for your own tables: `qsgm fold-and-quantize sgm.pt --calib DIR`.

`demo_object.png` and `demo_scene.png` are for `make demo` and take no part in calibration: one
object, and the same object moved and turned in other light; `manifest.json` holds where and how
far.
"""


def draw_calibration_set(
    folder: Path,
    count: int = defaults.CALIBRATION_FRAMES,
    seed: int = 0,
    watch: Progress | None = None,
) -> None:
    """Draw `count` frames and the two demo pictures into a new folder.

    Args:
        folder: absent, empty, or an earlier calibration set made by this command.
        count: number of frames; kinds of tables and of objects are taken in turn.
        seed: of everything drawn at random.
        watch: told about progress.

    Raises:
        QsgmError: the folder holds something else or cannot be written.
    """
    command = f"qsgm draw-calibration --count {count} --seed {seed} -o calib"
    object_kinds = np.random.default_rng([STREAM, seed]).permutation(OBJECT_KINDS).tolist()
    with new_folder(folder, MARKER) as new:
        frames = []
        for i in range(count):
            own_seed = [STREAM, seed, i]
            drawn = draw_frame(
                np.random.default_rng(own_seed),
                object_kind=object_kinds[i % len(object_kinds)],
                table_kind=TABLE_KINDS[i % len(TABLE_KINDS)],
            )
            frames.append(_write_frame(new, f"frame_{i:02}.jpg", drawn, own_seed))
            if watch is not None:
                watch("draw", i + 1, count)
        manifest = {"command": command, "demo": _write_demo(new, seed), "frames": frames}
        (new / MANIFEST).write_text(json.dumps(manifest, indent=1) + "\n")
        kinds = len({frame["object_kind"] for frame in frames})
        x, y = CENTER_PX
        readme = _README.format(count=count, kinds=kinds, command=command, x=x, y=y)
        (new / "README.md").write_text(readme)


# Of the first few, the one whose object shows best.
_DEMO_SEED_OFFSET = 2


def _write_frame(folder: Path, name: str, drawn: DrawnFrame, seed: list[int]) -> dict[str, Any]:
    """Write a frame as JPEG; returns its entry in the manifest."""
    data = cv2.imencode(".jpg", drawn.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
    (folder / name).write_bytes(data)
    return {
        "file": name,
        "object_kind": drawn.object_kind,
        "table_kind": drawn.table_kind,
        "seed": seed,
        "sha256": sha256(data),
        "center_px": list(CENTER_PX),
    }


def _write_demo(folder: Path, seed: int) -> dict[str, Any]:
    """Write both demo pictures; returns their entry in the manifest."""
    demo = draw_demo(seed + _DEMO_SEED_OFFSET)
    write_png(folder / DEMO_OBJECT, demo.demonstration)
    write_png(folder / DEMO_SCENE, demo.scene)
    return {
        "object": DEMO_OBJECT,
        "scene": DEMO_SCENE,
        "scene_center_px": list(demo.center_px),
        "scene_angle_deg": demo.angle_deg,
    }
