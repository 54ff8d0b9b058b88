"""Episodes: one drawn object as it is taught, and the scenes in which it is looked for then.

Judged by windows of its own demonstration, an object is told apart from what that one frame shows.
Here everything else changes: the table, the light, the distance, a slant, and what lies beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.crops import HALF_CROP_PX
from qsgm.train.grasp.drawing.camera import CENTER_PX, FRAME_HW
from qsgm.train.grasp.drawing.noise import mean_colour
from qsgm.train.grasp.drawing.scenes import (
    DrawnObject,
    DrawnScene,
    View,
    draw_object,
    draw_scene,
    in_colours_of,
)
from qsgm.train.grasp.drawing.structures import STRUCTURE_KINDS
from qsgm.train.grasp.drawing.tables import chosen_table, draw_table

__all__ = ["CENTER_PX", "Episode", "EpisodeMaker", "EpisodesConfig"]

# An object keeps this much beyond its window from the border.
_BORDER_PX = HALF_CROP_PX + 16
_LARGEST_TILT_RAD = np.deg2rad(25)

# How often what is wrong with a scene: mostly one thing at a time.
_CROWDS = (0, 0, 0, 0, 1, 1, 2, 2, 3, 4)  # other things, one of these numbers of them
_STRUCTURES = (0.7, 0.25, 0.05)  # of no edge, gap or sheet, one, two
_OTHER_DISTANCE, _TILTED, _HIDDEN = 0.15, 0.15, 0.4
_DIM, _BLURRED = 0.12, 0.1
_ALIKE = 0.3  # that another thing has the taught one's colours

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Episode:
    """An object taught in one scene, and others."""

    drawn: DrawnObject
    demonstration: DrawnScene  # with the object alone, in the middle
    scenes: tuple[DrawnScene, ...]  # with the object
    without: tuple[DrawnScene, ...]  # the same ones without it, or with another thing in its place


@dataclass(frozen=True)
class EpisodesConfig:
    """How many objects are drawn, and how many scenes of each."""

    episodes: int
    scenes: int = 8  # with the object, and as many without it
    tables: int = 48  # one takes half of a scene's time: each is used again and again
    others: int = 96  # that lie there

    def maker(self, seed: int) -> "EpisodeMaker":
        """What draws them."""
        return EpisodeMaker(seed, self.tables, self.others)


class EpisodeMaker:
    """Draws episodes from one seed; tables and other things are drawn once and used again."""

    def __init__(self, seed: int, tables: int, others: int) -> None:
        self.seed = seed
        self._tables = [_table((seed, 1, i)) for i in range(tables)]
        self._others = [draw_object(np.random.default_rng((seed, 2, i))) for i in range(others)]

    def draw(self, number: int, scenes: int, *, without: bool = False) -> Episode:
        """Draw the episode of a number: an object, its demonstration and so many scenes."""
        rng = np.random.default_rng((self.seed, 3, number))
        table = self._table(rng)
        drawn = draw_object(rng, mean_colour(table))
        turn = float(rng.uniform(-np.pi, np.pi))
        demonstration = draw_scene(rng, drawn, table=table, turn_rad=turn)
        with_object, absent = [], []
        for _ in range(scenes):
            seed = int(rng.integers(2**31))
            with_object.append(self._scene(seed, drawn, drawn, taken_away=False))
            if without:
                other = self._another(rng, drawn) if rng.random() < 0.5 else None
                absent.append(self._scene(seed, drawn, other or drawn, taken_away=other is None))
        return Episode(drawn, demonstration, tuple(with_object), tuple(absent))

    def _scene(
        self, seed: int, taught: DrawnObject, shown: DrawnObject, *, taken_away: bool
    ) -> DrawnScene:
        rng = np.random.default_rng(seed)
        center = tuple(float(rng.uniform(_BORDER_PX, side - _BORDER_PX)) for side in FRAME_HW[::-1])
        crowd = _CROWDS[rng.integers(len(_CROWDS))]
        others = [self._another(rng, taught) for _ in range(crowd)]
        structures = [str(rng.choice(STRUCTURE_KINDS)) for _ in range(rng.choice(3, p=_STRUCTURES))]
        far = rng.random() < _OTHER_DISTANCE
        tilt = rng.uniform(0, _LARGEST_TILT_RAD) if rng.random() < _TILTED else 0.0
        view = View(
            float(rng.uniform(0.8, 1.25) if far else rng.uniform(0.95, 1.05)),
            float(tilt),
            float(rng.uniform(0, np.pi)),
        )
        scene = draw_scene(
            rng,
            shown,
            table=self._table(rng),
            others=others,
            structures=structures,
            center_px=(center[0], center[1]),
            turn_rad=float(rng.uniform(-np.pi, np.pi)),
            view=view,
            hidden_share=0.33 if rng.random() < _HIDDEN else 0.05,
            taken_away=taken_away,
        )
        return _as_photographed(scene, rng)

    def _table(self, rng: np.random.Generator) -> Image:
        """One of the tables, in one of its eight mirrored and turned ways, in other colours."""
        table = self._tables[rng.integers(len(self._tables))]
        flips = rng.integers(4)
        table = table[:: -1 if flips & 1 else 1, :: -1 if flips & 2 else 1]
        tint = np.clip(table * rng.uniform(0.7, 1.15) * rng.uniform(0.85, 1.15, 3), 0, 255)
        return np.ascontiguousarray(tint, dtype=np.uint8)

    def _another(self, rng: np.random.Generator, taught: DrawnObject) -> DrawnObject:
        """A thing of another kind."""
        while True:
            other = self._others[rng.integers(len(self._others))]
            if other.kind != taught.kind:
                alike = rng.random() < _ALIKE
                return in_colours_of(other, taught) if alike else other


def _as_photographed(scene: DrawnScene, rng: np.random.Generator) -> DrawnScene:
    """The scene in half light now and then, or out of focus."""
    image = scene.image
    if rng.random() < _DIM:
        light = rng.uniform(0.4, 0.75) * rng.uniform(0.93, 1.07, 3)
        image = np.clip(image * light, 0, 255).astype(np.uint8)
    if rng.random() < _BLURRED:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.8, 2.0)), dtype=np.uint8)
    return replace(scene, image=image)


def _table(seed: Sequence[int]) -> Image:
    rng = np.random.default_rng(seed)
    return draw_table(rng, chosen_table(rng, None), FRAME_HW)
