"""`corrmatch` from PyPI: rotated grey-level templates in a pyramid, written in Rust.

Called as `corrmatch_rival.py FOLDER ANSWERS.json`; qsgm/bench/rivals.py says what lies in the
folder. It knows no masks: the template is the rectangle around the object, table included. Needs
numpy, cv2 and corrmatch, so it is started with a Python that has them:

    --rival "corrmatch=/path/to/python benchmarks/rivals/corrmatch_rival.py"
"""

import json
import sys
import time
from pathlib import Path

import corrmatch
import cv2
import numpy as np

RIM_PX = 2


def matcher_of(template: np.ndarray) -> corrmatch.Matcher:
    """A matcher with as many pyramid levels as the template's contrast allows."""
    how = corrmatch.MatchConfig(rotation="enabled", metric="zncc", parallel=False)
    for levels in range(6, 1, -1):
        try:
            config = corrmatch.CompileConfig(max_levels=levels)
            return corrmatch.Template(template).compile(config).matcher(how)
        except RuntimeError:
            continue
    return corrmatch.Template(template).compile(corrmatch.CompileConfig(max_levels=1)).matcher(how)


def main(folder: Path, output: Path) -> None:
    """Teach on the folder's demonstration, look for the object in its scenes."""
    cv2.setNumThreads(1)
    listing = json.loads((folder / "scenes.json").read_text())
    frame = cv2.imread(str(folder / listing["demonstration"]), cv2.IMREAD_GRAYSCALE)
    mask = cv2.imread(str(folder / listing["mask"]), cv2.IMREAD_GRAYSCALE) > 127
    rows, cols = np.nonzero(mask)
    top, left = max(rows.min() - RIM_PX, 0), max(cols.min() - RIM_PX, 0)
    part = frame[top : rows.max() + RIM_PX + 1, left : cols.max() + RIM_PX + 1]
    matcher = matcher_of(np.ascontiguousarray(part))
    middle = np.array([(part.shape[1] - 1) / 2, (part.shape[0] - 1) / 2])
    offset = np.array(listing["center_px"]) - (left, top) - middle
    answers = []
    for file in listing["scenes"]:
        scene = cv2.imread(str(folder / file), cv2.IMREAD_GRAYSCALE)
        began = time.perf_counter()
        match = matcher.match_image(scene)
        seconds = time.perf_counter() - began
        turn = -match.angle_deg  # its angles are clockwise
        cos, sin = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        x, y = np.array([match.x, match.y]) + middle + np.array([[cos, sin], [-sin, cos]]) @ offset
        answers.append(
            {
                "file": file,
                "score": match.score,
                "center_px": [float(x), float(y)],
                "turn_deg": (turn + 180) % 360 - 180,
                "seconds": seconds,
            }
        )
    output.write_text(json.dumps({"answers": answers}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
