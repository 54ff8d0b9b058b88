"""What was shown of an object: its demonstrations at the network's scale, and how they belong.

The first demonstration says what angle 0 is. Where the object looks alike in another one, the patch
says how far it is turned there; where it does not, as from its other side, that demonstration has a
patch of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from qsgm.errors import QsgmError
from qsgm.files import sha256
from qsgm.grasp.judge import Appearance, best_fit
from qsgm.grasp.measuring import (
    LARGEST_SPAN_PX,
    LEAST_SPAN_PX,
    measured_span,
    moved_point,
    scale_for,
    scaled_frame,
)
from qsgm.grasp.patch import Patch, cut_patch
from qsgm.grasp.source import Demonstration
from qsgm.grasp.surroundings import with_room

# From this score on, two demonstrations show the object alike: on drawn scenes three quarters of
# such fits lie within 4 px.
ALIKE = 0.7


@dataclass(frozen=True)
class View:
    """What the object looks like from one side."""

    patch: Patch
    turn_rad: float  # of that demonstration's object since the first one, counter-clockwise
    whole: bool  # whether that is known over the full circle, else modulo half a turn


@dataclass(frozen=True)
class Shown:
    """An object as it was shown, ready to be learnt."""

    demonstrations: tuple[Demonstration, ...]  # at the network's scale, with room around
    patches: tuple[Patch, ...]  # of each
    turns_rad: tuple[float | None, ...]  # of each since the first one, where the patch says it
    span_px: float | None  # of the object in the first frame as it came; None: not to be measured
    scale: float  # what that frame was scaled by, and scenes are
    sha256: tuple[str, ...]  # of each frame's pixels as they came

    def views(self, offsets_rad: Sequence[float]) -> tuple[View, ...]:
        """The first demonstration's look and those that differ from it.

        Args:
            offsets_rad: how each demonstration lies as the network sees it.
        """
        first = View(self.patches[0], 0.0, whole=True)
        others = [
            View(patch, offset - offsets_rad[0], whole=False)
            for patch, turn, offset in zip(self.patches, self.turns_rad, offsets_rad, strict=True)
            if turn is None
        ]
        return (first, *others)


def shown(demonstrations: Sequence[Demonstration], span_px: float | None = None) -> Shown:
    """Measure, scale and compare the demonstrations of one object.

    Args:
        demonstrations: at least one, as they came.
        span_px: the object's long side in the first frame; None: it is measured.

    Raises:
        QsgmError: the object fills its frame, or its centre is not in it.
    """
    for one in demonstrations:
        _check_inside(one)
    first, *others = demonstrations
    measured = measured_span(first.frame, first.center_px) if span_px is None else span_px
    scale = scale_for(measured, first.frame.shape[:2])
    scales = (scale, *(_own_scale(one, scale) for one in others))
    ready = [with_room(_scaled(*both)) for both in zip(demonstrations, scales, strict=True)]
    patches = [cut_patch(one.frame, one.center_px) for one in ready]
    turns = (0.0, *_turns_since(patches[0], ready[1:]))
    sums = tuple(sha256(one.frame.tobytes()) for one in demonstrations)
    return Shown(tuple(ready), tuple(patches), turns, measured, scale, sums)


def _check_inside(one: Demonstration) -> None:
    height, width = one.frame.shape[:2]
    x, y = one.center_px
    if not (0 <= x <= width and 0 <= y <= height):
        raise QsgmError(
            f"the object's centre ({x:g}, {y:g}) is outside of the {width}x{height} frame; "
            "pass another --center"
        )


def _own_scale(one: Demonstration, scale: float) -> float:
    """The first demonstration's scale, unless the object would be too large or small at it."""
    span = measured_span(one.frame, one.center_px)
    if span is None or LEAST_SPAN_PX <= scale * span <= LARGEST_SPAN_PX:
        return scale
    return scale_for(span, one.frame.shape[:2])


def _scaled(one: Demonstration, scale: float) -> Demonstration:
    if scale == 1.0:
        return one
    frame = scaled_frame(one.frame, scale)
    return Demonstration(frame, moved_point(one.center_px, one.frame.shape[:2], frame.shape[:2]))


def _turns_since(patch: Patch, others: Sequence[Demonstration]) -> list[float | None]:
    """How far the object is turned in other demonstrations, None where it does not look alike."""
    if not others:
        return []
    appearance = Appearance.of(patch)
    fits = [best_fit(appearance, one.frame, one.center_px)[0] for one in others]
    return [fit.turn_rad if fit.score >= ALIKE else None for fit in fits]
