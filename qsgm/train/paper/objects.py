"""Six drawn household objects, a to f, each once in front of the camera, and crops of them.

An angle is measured against the demonstration as it lies (paper section 3.1, "The Model": "the
rotation angle with respect to the demonstration image"), so each object has a zero of its own.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from qsgm.grasp.crops import cut_crops, label_crops, plan_crops
from qsgm.grasp.task import GraspTask
from qsgm.train.grasp.drawing.camera import CENTER_PX, FRAME_HW
from qsgm.train.grasp.objects import DrawnFrame, draw_frame

# The paper's label: sine and cosine of an angle in (-90, 90] degrees, not smoothed.
PAPER_TASK = GraspTask(encoding="paper", label_smoothing=0.0)
_SHEET_WINDOW = np.s_[130:350, 190:450]
_RED = (0, 0, 220)


@dataclass(frozen=True)
class PaperObject:
    """What is drawn: a kind that `draw_frame` knows, and a seed."""

    name: str
    kind: str
    seed: int

    def draw(self) -> DrawnFrame:
        return draw_frame(np.random.default_rng([self.seed, 77]), object_kind=self.kind)


OBJECTS: Mapping[str, PaperObject] = {
    "a": PaperObject("spanner", "wrench", 2),
    "b": PaperObject("scissors", "crossed", 5),
    "c": PaperObject("banana", "bent", 1),
    "d": PaperObject("spoon", "cutlery", 3),
    "e": PaperObject("bottle", "bottle", 4),
    "f": PaperObject("hammer", "handle_tool", 4),
}


@dataclass(frozen=True)
class ObjectCrops:
    """Crops (N, 128, 128, 3) uint8 BGR of one object and their labels (N, 3)."""

    crops: Tensor
    labels: Tensor

    @property
    def support(self) -> int:
        """How many are for learning: the first four fifths, 800 of the paper's 1000."""
        return len(self.labels) * 4 // 5


def cut_object(drawn: DrawnFrame, count: int, seed: int) -> ObjectCrops:
    """Plan, cut and label `count` crops of one demonstration."""
    plan = plan_crops(FRAME_HW, CENTER_PX, np.random.default_rng(seed), count)
    labels = label_crops(plan, encoding=PAPER_TASK.encoding)
    return ObjectCrops(torch.from_numpy(cut_crops(drawn.image, plan)), torch.from_numpy(labels))


def contact_sheet(letters: tuple[str, ...]) -> NDArray[np.uint8]:
    """The middles of the demonstrations side by side, three a row, with letter and name."""
    tiles = [_tile(letter) for letter in letters]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % 3)
    rows = [np.hstack(tiles[i : i + 3]) for i in range(0, len(tiles), 3)]
    return np.vstack(rows)


def _tile(letter: str) -> NDArray[np.uint8]:
    tile = OBJECTS[letter].draw().image[_SHEET_WINDOW].copy()
    text = f"{letter}: {OBJECTS[letter].name}"
    cv2.putText(tile, text, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _RED, 2, cv2.LINE_AA)
    return tile
