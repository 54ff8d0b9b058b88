"""One or several objects in one frame: which thing is where.

Each object looks by itself. What those of one bundle share, the frozen layers, is the smaller part
of a look; the rest is the comparison with the object's own patch.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import RenderableType

from qsgm.grasp.heatmap import Detection
from qsgm.grasp.pictures import Picture, draw_detection, draw_objects
from qsgm.grasp.report import (
    detection_table,
    instances_table,
    object_json,
    place_json,
    place_texts,
    predict_json,
)
from qsgm.grasp.tuned import TunedObject
from qsgm.tables import number, table

# Two things as large as objects are at the scale of either have centres further apart.
_ONE_THING_PX = 24.0


@dataclass(frozen=True)
class Sight:
    """What one object's look at a frame gave."""

    name: str  # of the object
    detection: Detection  # its best place
    heatmap: NDArray[np.float32]
    instances: tuple[Detection, ...] | None = None  # all that were found, where asked for

    @property
    def places(self) -> tuple[Detection, ...]:
        """Every instance if there are any, else the best place."""
        return self.instances or (self.detection,)

    def to_json(self) -> list[dict[str, Any]]:
        """An entry for each place, with the object's name."""
        return [
            {
                "object": self.name,
                "found": place.found,
                **object_json(place),
                "scale": number(place.scale, 5),
                "candidates": [place_json(one) for one in place.candidates],
            }
            for place in self.places
        ]


def look_for(
    tuned: TunedObject,
    frame: NDArray[np.uint8],
    *,
    everything: bool = False,
    any_distance: bool = False,
) -> Sight:
    """Look for an object in a frame (H, W, 3).

    Args:
        tuned: the object.
        frame: where to look.
        everything: list every instance.
        any_distance: where it is not found, look more closely and at half to twice the
            distance, too.
    """
    look = tuned.locate_at_any_distance if any_distance else tuned.locate
    detection, heatmap = look(frame)
    instances = tuple(tuned.locate_all(frame)) if everything else None
    return Sight(tuned.description.name, detection, heatmap, instances)


def look_for_each(
    objects: Sequence[TunedObject],
    frame: NDArray[np.uint8],
    *,
    everything: bool = False,
    any_distance: bool = False,
) -> tuple[Sight, ...]:
    """Look for several objects, see :func:`look_for`; of two at one place it is the surer one's."""
    return shared_out(
        [look_for(one, frame, everything=everything, any_distance=any_distance) for one in objects]
    )


def shared_out(sights: Sequence[Sight]) -> tuple[Sight, ...]:
    """Sights in which no two objects are found in one place.

    The surest claim comes first. Whoever loses a place takes its next candidate, and where none is
    left that is sure enough, it is not found.
    """
    if len(sights) < 2:
        return tuple(sights)
    claims = [
        (place, owner)
        for owner, sight in enumerate(sights)
        for place in (_guesses(sight) if sight.instances is None else sight.instances)
        if place.found
    ]
    kept: list[tuple[Detection, int]] = []
    for place, owner in sorted(claims, key=lambda claim: -claim[0].quality):
        done = sights[owner].instances is None and any(owner == other for _, other in kept)
        if not done and not _taken(place, owner, kept):
            kept.append((place, owner))
    return tuple(_left_with(sight, owner, kept) for owner, sight in enumerate(sights))


def _left_with(sight: Sight, owner: int, kept: Sequence[tuple[Detection, int]]) -> Sight:
    """What a sight's object is left with: the places it kept, or its best guess elsewhere."""
    own = tuple(place for place, other in kept if other == owner)
    free = (one for one in _guesses(sight) if not _taken(one, owner, kept))
    best = own[0] if own else replace(next(free, sight.detection), found=False)
    best = replace(best, candidates=sight.detection.candidates)
    return replace(sight, detection=best, instances=None if sight.instances is None else own)


def _guesses(sight: Sight) -> list[Detection]:
    """The best place, then the other candidates."""
    return [sight.detection, *sight.detection.candidates[1:]]


def _taken(place: Detection, owner: int, kept: Sequence[tuple[Detection, int]]) -> bool:
    """Whether another object was found there."""
    return any(
        other != owner
        and math.dist(place.center_px, one.center_px) < _ONE_THING_PX / max(place.scale, one.scale)
        for one, other in kept
    )


def surest(sights: Sequence[Sight]) -> Sight:
    """The one that is found, or nearest to it."""
    return max(sights, key=lambda one: (one.detection.found, one.detection.quality))


def sights_json(sights: Sequence[Sight], output: Path | None) -> dict[str, Any]:
    """What `qsgm predict` prints: of several objects the surest one, and all under `objects`."""
    best = surest(sights)
    values = predict_json(best.detection, best.heatmap.shape, best.name, output, best.instances)
    if len(sights) == 1:
        return values
    return values | {"objects": [entry for one in sights for entry in one.to_json()]}


def sights_table(sights: Sequence[Sight]) -> RenderableType:
    """What was found, for people."""
    first = sights[0]
    if len(sights) == 1:
        if first.instances is None:
            return detection_table(first.detection, first.name)
        return instances_table(first.instances, first.name)
    columns = ("object", "quality", "centre", "move right, down", "turn")
    return table(None, columns, [row for one in sights for row in _rows(one)])


def sights_picture(frame: Picture, sights: Sequence[Sight]) -> Picture:
    """A frame with what was found in it."""
    first = sights[0]
    if len(sights) == 1:
        instances = first.instances or ()
        return draw_detection(frame, first.heatmap, first.detection, first.name, instances)
    return draw_objects(frame, named_places(sights))


def named_places(sights: Sequence[Sight]) -> list[tuple[str, Detection]]:
    """All places with their object's name."""
    return [(one.name, place) for one in sights for place in one.places]


def _rows(sight: Sight) -> list[tuple[object, ...]]:
    rows: list[tuple[object, ...]] = []
    for one in sight.places:
        quality = f"{one.quality:.2f}"
        if not one.found:
            rows.append((sight.name, quality, "not found", None, None))
            continue
        *where, turn = place_texts(one)
        opposite = "" if one.full_angle_deg is not None else " or opposite"
        rows.append((sight.name, quality, *where, turn + opposite))
    return rows
