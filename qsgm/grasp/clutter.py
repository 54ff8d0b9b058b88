"""What lies on the crops beside the object: other things, edges, and other light.

Taught with negatives of its own frame alone, a network finds *an* object: whatever is at the middle
of a window. So negatives show other things at their middle, or the edge of another surface, on the
demonstration's own background; and positives show things beside the object, now and then over it.
All of them are seen in dimmer light, too.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.crops import HALF_CROP_PX, CropPlan
from qsgm.grasp.distractors import (
    Distractors,
    EdgePlan,
    PastePlan,
    paint_planned,
    paste_planned,
    plan_edges,
    plan_pastes,
)

# Of the negatives. What is left are plain windows of the frame, near misses among them.
THING_SHARE = 0.4
EDGE_SHARE = 0.12
# Of the positives. A thing is that far from the object: partly over it, touching, or apart.
BESIDE_SHARE = 0.3
BESIDE_PX = (42.0, 84.0)
# Of the things, where the user named some: one among all the drawn ones would hardly be seen.
NAMED_SHARE = 0.5
DIM_SHARE = 0.4
DIMMEST = 0.45


class Addition(IntEnum):
    """What was put on a crop."""

    NOTHING = 0
    THING = 1
    EDGE = 2


# Looked up for every crop: an enumeration takes longer to say what they are.
_THING, _EDGE = int(Addition.THING), int(Addition.EDGE)


@dataclass(frozen=True)
class ClutterPlan:
    """What is put on each of N crops; rows that get nothing are planned all the same."""

    addition: NDArray[np.uint8]  # (N,) of Addition
    things: PastePlan
    edges: EdgePlan

    def __len__(self) -> int:
        return len(self.addition)

    def __getitem__(self, rows: slice | NDArray[np.int64]) -> "ClutterPlan":
        return ClutterPlan(self.addition[rows], self.things[rows], self.edges[rows])


def plan_clutter(
    plan: CropPlan, sprites: int, rng: np.random.Generator, named: int = 0
) -> ClutterPlan:
    """Draw what is put on planned crops.

    Args:
        plan: of the crops; its `quality` says which ones are negatives.
        sprites: how many things there are to choose from.
        rng: the only source of randomness.
        named: how many of them, the last ones, the user named.
    """
    count = len(plan)
    negative, draw = plan.quality == 0, rng.random(count)
    thing = np.where(negative, draw < THING_SHARE, draw < BESIDE_SHARE)
    edge = negative & ~thing & (draw < THING_SHARE + EDGE_SHARE)
    pastes = plan_pastes(rng, count, sprites)
    beside = HALF_CROP_PX + _ring(rng, count)
    centers = np.where(negative[:, None], pastes.center_px, beside).astype(np.float32)
    edges = plan_edges(rng, count)
    # Last, so that all else is the same whatever is named.
    sprite = _often_named(rng, count, sprites, named) if 0 < named < sprites else pastes.sprite
    return ClutterPlan(
        addition=np.select([thing, edge], [Addition.THING, Addition.EDGE]).astype(np.uint8),
        things=replace(pastes, center_px=centers, sprite=sprite),
        edges=edges,
    )


def _often_named(
    rng: np.random.Generator, count: int, sprites: int, named: int
) -> NDArray[np.int32]:
    """Sprites (N,), a share of them among the last `named` ones."""
    drawn = rng.integers(0, sprites - named, count)
    last = rng.integers(sprites - named, sprites, count)
    return np.where(rng.random(count) < NAMED_SHARE, last, drawn).astype(np.int32)


def dimmed(plan: CropPlan, rng: np.random.Generator) -> CropPlan:
    """A plan in which some of the crops have less light."""
    count = len(plan)
    dim = np.where(rng.random(count) < DIM_SHARE, rng.uniform(DIMMEST, 1.0, count), 1.0)
    return replace(plan, color=(plan.color * dim[:, None, None]).astype(np.float32))


def add_clutter(crop: NDArray[np.uint8], plan: ClutterPlan, row: int, things: Distractors) -> None:
    """Put what is planned for one row on a crop (128, 128, 3), in place."""
    addition = int(plan.addition[row])
    if addition == _THING:
        paste_planned(crop, things, plan.things, row)
    elif addition == _EDGE:
        paint_planned(crop, plan.edges, row)


def joined(plans: Sequence[ClutterPlan]) -> ClutterPlan:
    """Plans of several frames' crops, one after the other."""

    def together(parts: Sequence[PastePlan] | Sequence[EdgePlan]) -> dict[str, NDArray[Any]]:
        return {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])
        }

    return ClutterPlan(
        np.concatenate([plan.addition for plan in plans]),
        PastePlan(**together([plan.things for plan in plans])),
        EdgePlan(**together([plan.edges for plan in plans])),
    )


def _ring(rng: np.random.Generator, count: int) -> NDArray[np.float64]:
    """Points (N, 2) [px] around the middle, as far from it as things beside an object are."""
    direction = rng.uniform(-np.pi, np.pi, count)
    radius = rng.uniform(*BESIDE_PX, count)
    return np.asarray(radius[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1))
