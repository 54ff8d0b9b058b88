"""The grasping task on the host: drawn objects to learn from."""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.crops import cut_crops, label_crops, plan_crops
from qsgm.grasp.distractors import Distractors, load_distractors
from qsgm.grasp.lesson import GraspLesson
from qsgm.grasp.source import Demonstration, crop_source
from qsgm.grasp.task import GraspTask
from qsgm.task import Array
from qsgm.train.grasp.draw_distractors import SHEET_SEED, distractor_file
from qsgm.train.grasp.drawing.camera import CENTER_PX, FRAME_HW
from qsgm.train.grasp.objects import draw_frame

# Rounder than this, a drawn object has no axis worth learning: both angle labels are 0.
LEAST_ELONGATION = 1.25


@dataclass(frozen=True)
class DrawnGrasping(GraspTask):
    """Grasping drawn objects."""

    def example(self, rng: np.random.Generator, count: int) -> tuple[NDArray[np.uint8], Array]:
        """Crops (N, 128, 128, 3) of one drawn frame, and labels (N, 3) by the object's axis."""
        cv2.setNumThreads(1)  # one loader process a core
        drawn = draw_frame(rng)
        plan = plan_crops(FRAME_HW, CENTER_PX, rng, count)
        labels = label_crops(plan, drawn.axis_rad, self.encoding)
        if drawn.elongation < LEAST_ELONGATION:
            labels[:, 1:] = 0.0
        return cut_crops(drawn.image, plan), labels

    def lesson(self, rng: np.random.Generator, count: int) -> GraspLesson:
        """The crops of one drawn frame, with other things on them as the device has them."""
        return frame_lesson(draw_frame(rng).image, rng, count, self)


def frame_lesson(
    frame: NDArray[np.uint8],
    rng: np.random.Generator,
    count: int,
    task: GraspTask,
    center_px: tuple[float, float] = CENTER_PX,
) -> GraspLesson:
    """Crops of one demonstration (H, W, 3), with other things on them as the device has them.

    All of them say how it lies: none is held out.
    """
    crops = crop_source([Demonstration(frame, center_px)], shipped_things(), rng, count)
    return GraspLesson(crops, task.encoding, taught=count)


@lru_cache(maxsize=1)
def shipped_things() -> Distractors:
    """The things that come with every bundle."""
    return load_distractors(distractor_file(SHEET_SEED))
