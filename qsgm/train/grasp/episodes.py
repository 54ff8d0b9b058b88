"""Episodes: one drawn object as it is taught, and the scenes in which it is looked for then.

Judged by windows of its own demonstration, an object is told apart from what that one frame shows.
Here everything else changes: the table, the light, the distance, a slant, and what lies beside it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.grasp.crops import HALF_CROP_PX
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

CENTER_PX = (320.0, 240.0)
FRAME_HW = (480, 640)
# A table takes half of a scene's time: each is used again and again.
TABLES = 48
OTHERS = 96
# An object keeps this much beyond its window from the border.
_BORDER_PX = HALF_CROP_PX + 16
_LARGEST_TILT_RAD = np.deg2rad(25)

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Difficulty:
    """How often what is wrong with a scene; probabilities, but for the crowds."""

    crowds: tuple[int, ...]  # how many other things there are, one of these numbers
    structures: tuple[float, float, float]  # of no edge, gap or sheet, one, two
    other_distance: float  # 0.8 to 1.25 times as large
    tilt: float  # up to 25 degrees
    hidden: float  # up to a third
    dim: float
    blurred: float
    alike: float  # that another thing has the taught one's colours


# As scenes come: mostly one thing at a time.
USUAL = Difficulty(
    (0, 0, 0, 0, 1, 1, 2, 2, 3, 4), (0.7, 0.25, 0.05), 0.15, 0.15, 0.4, 0.12, 0.1, 0.3
)


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
    tables: int = TABLES
    others: int = OTHERS  # that lie there

    def maker(self, seed: int) -> "EpisodeMaker":
        """What draws them."""
        return EpisodeMaker(seed, USUAL, self.tables, self.others)


class EpisodeMaker:
    """Draws episodes from one seed; tables and other things are drawn once and used again."""

    def __init__(
        self, seed: int, difficulty: Difficulty = USUAL, tables: int = TABLES, others: int = OTHERS
    ) -> None:
        self.seed, self.difficulty = seed, difficulty
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
        rng, how = np.random.default_rng(seed), self.difficulty
        center = tuple(float(rng.uniform(_BORDER_PX, side - _BORDER_PX)) for side in FRAME_HW[::-1])
        crowd = how.crowds[rng.integers(len(how.crowds))]
        others = [self._another(rng, taught) for _ in range(crowd)]
        structures = [
            str(rng.choice(STRUCTURE_KINDS)) for _ in range(rng.choice(3, p=how.structures))
        ]
        far = rng.random() < how.other_distance
        tilt = rng.uniform(0, _LARGEST_TILT_RAD) if rng.random() < how.tilt else 0.0
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
            hidden_share=0.33 if rng.random() < how.hidden else 0.05,
            taken_away=taken_away,
        )
        return _as_photographed(scene, rng, how)

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
                alike = rng.random() < self.difficulty.alike
                return in_colours_of(other, taught) if alike else other


def _as_photographed(scene: DrawnScene, rng: np.random.Generator, how: Difficulty) -> DrawnScene:
    """The scene in half light now and then, or out of focus."""
    image = scene.image
    if rng.random() < how.dim:
        light = rng.uniform(0.4, 0.75) * rng.uniform(0.93, 1.07, 3)
        image = np.clip(image * light, 0, 255).astype(np.uint8)
    if rng.random() < how.blurred:
        image = np.asarray(cv2.GaussianBlur(image, (0, 0), rng.uniform(0.8, 2.0)), dtype=np.uint8)
    values = vars(scene) | {"image": image}
    return DrawnScene(**values)


def _table(seed: Sequence[int]) -> Image:
    rng = np.random.default_rng(seed)
    return draw_table(rng, chosen_table(rng, None), FRAME_HW)
