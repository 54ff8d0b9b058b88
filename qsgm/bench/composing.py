"""Scenes composed from the cut-outs of demonstrations, in pairs: with the object and without it.

A pair shares everything else: table, other things, light, noise. In half of the pairs another
thing lies where the object was, since an empty table asks little. Things beside, over or in the
place of an object are never of its kind.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from qsgm.bench.cutouts import CutOut, Frame, Mask, Point, Pose, cut_out, footprint, lay, pose_of
from qsgm.bench.lighting import Camera, blurred_camera, dim_camera, mild_camera, photograph
from qsgm.bench.surfaces import with_surface
from qsgm.bench.things import TRIES, LaidThing, LooseThing, Target, cover
from qsgm.errors import QsgmError
from qsgm.grasp.crops import HALF_CROP_PX

Condition = Literal[
    "same_table",
    "another_table",
    "beside",
    "edges",
    "scale",
    "tilt",
    "half_light",
    "blur",
    "hidden",
]
CONDITIONS: tuple[Condition, ...] = get_args(Condition)

# A centre keeps this much beyond its window from the border.
BORDER_PX = HALF_CROP_PX + 8
OBJECT_SCALE = (0.8, 1.25)
TILT_RAD = float(np.radians(25))
MOST_THINGS = 4
SOMEWHERE_SHARE = 0.4  # of other things lie anywhere, the rest touch the object or nearly so


@dataclass(frozen=True)
class Subject:
    """An object in its demonstration."""

    name: str
    kind: str
    frame: Frame
    mask: Mask
    elongated: bool | None = None  # None: nobody said
    unique: bool | None = None  # whether it shows which way round it lies

    @property
    def center_px(self) -> Point:
        """The frame's middle, where a demonstration shows its object."""
        return self.frame.shape[1] / 2, self.frame.shape[0] / 2


@dataclass(frozen=True)
class Scene:
    """A frame and what is true of it."""

    frame: Frame
    center_px: Point | None  # of the demonstration's centre pixel; None: the object is not there
    turn_rad: float = 0.0  # since the demonstration, counter-clockwise
    scale: float = 1.0
    condition: Condition = "same_table"
    others: Mask = field(default_factory=lambda: np.zeros((0, 0), dtype=np.bool_))  # (H, W)
    thing_instead: bool = False  # another thing lies where the object would be


@dataclass(frozen=True)
class ScenePair:
    """The same scene with the object and without it."""

    present: Scene
    absent: Scene

    @property
    def absent_thing(self) -> bool:
        """Whether another thing lies where the object was."""
        return self.absent.thing_instead


@dataclass(frozen=True)
class _Place:
    """Where the object lies, and how."""

    center_px: Point
    turn_rad: float
    scale: float = 1.0
    tilt_rad: float = 0.0
    tilt_axis_rad: float = 0.0

    def pose(self, cut: CutOut) -> Pose:
        how = self.turn_rad, self.scale, self.tilt_rad, self.tilt_axis_rad
        return pose_of(cut.center_px, self.center_px, *how)


@dataclass(frozen=True)
class _Layout:
    """A scene before it is painted; the things lie over the object."""

    table: NDArray[np.float32]
    place: _Place
    camera: Camera
    things: tuple[LaidThing, ...] = ()


class Composer:
    """Composes scenes of any subject among others.

    Raises:
        QsgmError: frames of several sizes or too small ones, a mask that cannot be used.
    """

    def __init__(self, subjects: Sequence[Subject]) -> None:
        if not subjects:
            raise QsgmError("scenes need frames with masks: expected at least one, got none")
        self.subjects = tuple(subjects)
        self._frame_hw = _common_size(self.subjects)
        self._cuts: dict[int, CutOut] = {}

    def pair(self, number: int, condition: Condition, rng: np.random.Generator) -> ScenePair:
        """A scene of subject `number`, with it and without it.

        Raises:
            QsgmError: there is no subject of another kind to be the other thing.
        """
        layout = _LAYOUTS[condition](self, number, rng)
        stand_in = self.cut(self._stranger(number, rng)) if rng.random() < 0.5 else None
        painted = [self._painted(layout, cut) for cut in (self.cut(number), stand_in)]
        taken, empty = photograph(painted, layout.camera)
        place = layout.place
        present = Scene(
            frame=taken,
            center_px=place.center_px,
            turn_rad=place.turn_rad,
            scale=place.scale,
            condition=condition,
            others=self._things_mask(layout, None),
        )
        absent = replace(
            present,
            frame=empty,
            center_px=None,
            others=self._things_mask(layout, stand_in),
            thing_instead=stand_in is not None,
        )
        return ScenePair(present, absent)

    def cut(self, number: int) -> CutOut:
        """Subject `number` off its table; made once."""
        if number not in self._cuts:
            subject = self.subjects[number]
            self._cuts[number] = cut_out(subject.frame, subject.mask, subject.center_px)
        return self._cuts[number]

    def _painted(self, layout: _Layout, cut: CutOut | None) -> NDArray[np.float32]:
        """The layout (H, W, 3) with this cut-out in the object's place."""
        canvas = layout.table
        if cut is not None:
            canvas = lay(canvas, cut, layout.place.pose(cut))
        for thing, pose in layout.things:
            canvas = lay(canvas, thing, pose)
        return canvas

    def _things_mask(self, layout: _Layout, stand_in: CutOut | None) -> Mask:
        """Pixels of all things that are not the object."""
        things = list(layout.things)
        if stand_in is not None:
            things.append((stand_in, layout.place.pose(stand_in)))
        covered = np.zeros(self._frame_hw, dtype=np.bool_)
        for thing, pose in things:
            covered |= footprint(thing, pose, self._frame_hw)
        return covered

    def _covered(self, cut: CutOut, layout: _Layout) -> Mask:
        """Pixels of a cut-out in the object's place."""
        return footprint(cut, layout.place.pose(cut), self._frame_hw)

    def _table(self, number: int) -> NDArray[np.float32]:
        return self.cut(number).table.astype(np.float32)

    def _place(self, rng: np.random.Generator) -> _Place:
        height, width = self._frame_hw
        x, y = rng.uniform(BORDER_PX, width - BORDER_PX), rng.uniform(BORDER_PX, height - BORDER_PX)
        return _Place((float(x), float(y)), float(rng.uniform(-np.pi, np.pi)))

    def _another(self, number: int, rng: np.random.Generator) -> int:
        """Any other subject; this one where it is alone."""
        rest = [i for i in range(len(self.subjects)) if i != number]
        return rest[int(rng.integers(len(rest)))] if rest else number

    def _stranger(self, number: int, rng: np.random.Generator) -> int:
        """A subject of another kind."""
        kind = self.subjects[number].kind
        others = [i for i, subject in enumerate(self.subjects) if subject.kind != kind]
        if not others:
            raise QsgmError(
                f"all frames show the kind {kind!r}: scenes need other things beside it, expected "
                f"frames of at least two kinds"
            )
        return others[int(rng.integers(len(others)))]

    def same_table(self, number: int, rng: np.random.Generator) -> _Layout:
        """The object moved and turned on its own table."""
        return _Layout(self._table(number), self._place(rng), mild_camera(rng))

    def another_table(self, number: int, rng: np.random.Generator) -> _Layout:
        """The object on the table of another subject."""
        table = self._table(self._another(number, rng))
        return _Layout(table, self._place(rng), mild_camera(rng))

    def beside(self, number: int, rng: np.random.Generator) -> _Layout:
        """One to four other things around it, some touching, on its own or another table."""
        plain = self.same_table if rng.random() < 0.5 else self.another_table
        layout = plain(number, rng)
        cut = self.cut(number)
        target = Target.of(self._covered(cut, layout), layout.place.center_px)
        things = []
        for _ in range(int(rng.integers(1, MOST_THINGS + 1))):
            thing = LooseThing.of(self.cut(self._stranger(number, rng)), rng)
            somewhere = rng.random() < SOMEWHERE_SHARE
            center = thing.clear_of(target, rng) if somewhere else None
            if center is None:
                center = thing.touching(target, rng)
            things.append(thing.at(center))
        return replace(layout, things=tuple(things))

    def edges(self, number: int, rng: np.random.Generator) -> _Layout:
        """A table's edge, a gap or a sheet near the object."""
        layout = self.same_table(number, rng)
        cut = self.cut(number)
        covered = self._covered(cut, layout)
        other = self._table(self._another(number, rng))
        return replace(layout, table=with_surface(layout.table, other, covered, rng))

    def scale(self, number: int, rng: np.random.Generator) -> _Layout:
        """The object smaller or larger, the table as it is."""
        layout = self.same_table(number, rng)
        scale = float(np.exp(rng.uniform(*np.log(OBJECT_SCALE))))
        return replace(layout, place=replace(layout.place, scale=scale))

    def tilt(self, number: int, rng: np.random.Generator) -> _Layout:
        """The object leaning away in any direction."""
        layout = self.same_table(number, rng)
        axis = float(rng.uniform(-np.pi, np.pi))
        return replace(layout, place=replace(layout.place, tilt_rad=TILT_RAD, tilt_axis_rad=axis))

    def half_light(self, number: int, rng: np.random.Generator) -> _Layout:
        """Half the light."""
        return replace(self.same_table(number, rng), camera=dim_camera(rng))

    def blur(self, number: int, rng: np.random.Generator) -> _Layout:
        """Out of focus, or moving."""
        return replace(self.same_table(number, rng), camera=blurred_camera(rng))

    def hidden(self, number: int, rng: np.random.Generator) -> _Layout:
        """Another thing over 30 % of the object."""
        layout = self.same_table(number, rng)
        cut = self.cut(number)
        target = Target.of(self._covered(cut, layout), layout.place.center_px)
        tries = ((self.cut(self._stranger(number, rng)), rng) for _ in range(TRIES))
        things = (LooseThing.of(*drawn, larger=1 + k / 10) for k, drawn in enumerate(tries))
        return replace(layout, things=(cover(target, things, rng),))


_LAYOUTS: dict[Condition, Callable[[Composer, int, np.random.Generator], _Layout]] = {
    condition: getattr(Composer, condition) for condition in CONDITIONS
}


def kind_of(text: str) -> str:
    """What an object's name calls it: `beer bottle (green)` and `Bottles` are both `bottle`."""
    plain = re.sub(r"\(.*?\)|,.*", " ", text.lower())
    words = re.findall(r"[^\W\d_]+", plain)
    return re.sub(r"(?<=[^\Ws])s$", "", words[-1]) if words else text.strip().lower()


def _common_size(subjects: Sequence[Subject]) -> tuple[int, int]:
    """Height and width of all frames."""
    height, width = subjects[0].frame.shape[:2]
    for subject in subjects:
        h, w = subject.frame.shape[:2]
        if (h, w) != (height, width):
            raise QsgmError(
                f"{subject.name} is {w}x{h} px, {subjects[0].name} {width}x{height} px: scenes "
                f"need frames of one size"
            )
    if min(height, width) <= 2 * BORDER_PX:
        raise QsgmError(
            f"{subjects[0].name} is {width}x{height} px: scenes need more than {2 * BORDER_PX} px "
            f"on either side"
        )
    return height, width
