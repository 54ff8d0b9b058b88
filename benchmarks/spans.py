"""How often an object's size is measured rightly, from a tenth of its frame to nearly all of it.

    python benchmarks/spans.py [DIR] [--objects 60] [--json FILE]

Drawn demonstrations are enlarged until the object spans a share of the frame's shorter side, and
shown a little off their middle. DIR holds photographs and a manifest as for `photographs.py`. Right
is a span within a third of the true one.
"""

import argparse
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console
from rich.table import Table

from qsgm.grasp.measuring import Frame, Point, measured_span
from qsgm.images import read_frame
from qsgm.train.grasp.decision_scenes import DecisionScenesConfig

FRAME_HW = (600, 800)
SHARES = (0.1, 0.2, 0.35, 0.5, 0.7, 0.85)
SEED = 101
OFF_MIDDLE, NOISE = 0.04, 2.5  # deviations: of the span, and in levels
LEAST, MOST = 0.75, 1.34


def drawn(objects: int) -> Iterator[tuple[str, Frame, Point, float]]:
    """Share, frame, where the object is shown, and what it spans."""
    maker, rng = DecisionScenesConfig().maker(SEED), np.random.default_rng(5)
    height, width = FRAME_HW
    for number in range(objects):
        shown = maker.draw(number, 0).demonstration
        pixels = np.argwhere(shown.mask)[:, ::-1].astype(np.float32)
        middle, size, _ = cv2.minAreaRect(pixels)
        for share in SHARES:
            times = share * height / max(size)
            x, y = middle + rng.normal(0, OFF_MIDDLE, 2) * max(size)
            shift = width / 2 - times * x, height / 2 - times * y
            motion = np.array([[times, 0, shift[0]], [0, times, shift[1]]])
            large = cv2.warpAffine(
                shown.image,
                motion,
                (width, height),
                flags=cv2.INTER_CUBIC,
                borderMode=cv2.BORDER_REFLECT_101,
            )
            grainy = np.clip(large + rng.normal(0, NOISE, large.shape), 0, 255).astype(np.uint8)
            yield f"drawn, {share:.0%}", grainy, (width / 2, height / 2), share * height


def photographed(folder: Path) -> Iterator[tuple[str, Frame, Point, float]]:
    """The same of photographs."""
    for one in json.loads((folder / "manifest.json").read_text()):
        for photo in one["photos"]:
            x, y = map(float, photo["center_px"])
            yield "photographs", read_frame(folder / photo["file"]), (x, y), photo["long_side_px"]


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--objects", type=int, default=60)
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    right = defaultdict[str, list[bool]](list)
    sources = [drawn(asked.objects)] + ([photographed(asked.folder)] if asked.folder else [])
    for source in sources:
        for name, frame, center, span in source:
            measured = measured_span(frame, center)
            right[name].append(measured is not None and LEAST <= measured / span <= MOST)
    table = Table("", "right", "of")
    for name, some in right.items():
        table.add_row(name, str(sum(some)), str(len(some)))
    Console().print(table)
    if asked.json:
        found = {name: [sum(some), len(some)] for name, some in right.items()}
        asked.json.write_text(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
