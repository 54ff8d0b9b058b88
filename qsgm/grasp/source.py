"""The crops of one taught object, cut when they are asked for.

Kept are the frames, what was drawn at random, and the things to put on crops: never all crops.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.clutter import Addition, ClutterPlan, add_clutter, dimmed, joined, plan_clutter
from qsgm.grasp.crops import CROPS, CropPlan, plan_crops, widened, windows_of
from qsgm.grasp.distractors import Distractors
from qsgm.grasp.network import CROP_PX
from qsgm.grasp.pixels import arithmetic


@dataclass(frozen=True)
class Demonstration:
    """One frame that shows the object."""

    frame: NDArray[np.uint8]  # (H, W, 3) BGR
    center_px: tuple[float, float]  # of the object (x, y)


@dataclass(frozen=True)
class CropSource:
    """N planned crops of one or more demonstrations."""

    wide: tuple[NDArray[np.uint8], ...]  # the frames, widened
    shown: NDArray[np.uint8]  # (N,) which of the frames each crop is cut from
    plan: CropPlan
    clutter: ClutterPlan | None
    things: Distractors | None

    def __len__(self) -> int:
        return len(self.plan)

    @property
    def addition(self) -> NDArray[np.uint8]:
        """What is put on each crop (N,): of :class:`qsgm.grasp.clutter.Addition`."""
        if self.clutter is None:
            return np.full(len(self), Addition.NOTHING, np.uint8)
        return self.clutter.addition

    def cut(self, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Cut the crops `rows`: (B, 128, 128, 3) BGR."""
        crops = np.empty((len(rows), CROP_PX, CROP_PX, 3), dtype=np.uint8)
        recolor = arithmetic().recolor
        for number, wide in enumerate(self.wide):
            here = np.flatnonzero(self.shown[rows] == number)
            plan = self.plan[rows[here]]
            for at, window, color in zip(here, windows_of(wide, plan), plan.color, strict=True):
                if self.clutter is not None and self.things is not None:
                    add_clutter(window, self.clutter, int(rows[at]), self.things)
                recolor(window, color, crops[at])
        return crops


def crop_source(
    demonstrations: Sequence[Demonstration],
    things: Distractors | None,
    rng: np.random.Generator,
    count: int = CROPS,
) -> CropSource:
    """Plan `count` crops, spread evenly over the demonstrations.

    Args:
        demonstrations: at least one.
        things: to tell the object apart from; None: negatives are windows of the frames alone.
        rng: the only source of randomness.
        count: of crops.

    Raises:
        QsgmError: an object's window does not lie inside its frame, or a frame is too small.
    """
    shown = (np.arange(count) * len(demonstrations) // count).astype(np.uint8)
    plans = [
        plan_crops(one.frame.shape[:2], one.center_px, rng, int((shown == number).sum()))
        for number, one in enumerate(demonstrations)
    ]
    clutter = None
    if things is not None:
        plans = [dimmed(plan, rng) for plan in plans]
        clutter = joined([plan_clutter(plan, len(things), rng, things.named) for plan in plans])
    whole = CropPlan(
        *(
            np.concatenate([getattr(plan, name) for plan in plans])
            for name in ("center_px", "turn_rad", "color", "quality")
        )
    )
    wide = tuple(widened(one.frame) for one in demonstrations)
    source = CropSource(wide, shown, whole, clutter, things)
    return source if len(demonstrations) == 1 else _shuffled(source, rng)


def _shuffled(source: CropSource, rng: np.random.Generator) -> CropSource:
    """Crops in random order, so that held-out ones show every demonstration."""
    order = rng.permutation(len(source))
    clutter = None if source.clutter is None else source.clutter[order]
    return replace(source, shown=source.shown[order], plan=source.plan[order], clutter=clutter)
