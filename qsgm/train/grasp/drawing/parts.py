"""What drawn objects are made of: parts with outlines, colours, finishes and prints.

Coordinates are in units of the object's length: x along its long side, y across it (pointing
down in the drawing). Colours come from a Brush.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from qsgm.train.grasp.drawing.noise import Colour, chance, hsv, mixed

Outline = NDArray[np.float64]


@dataclass(frozen=True)
class Part:
    """One piece of an object.

    ``roundness``: 0 flat with a slight bevel, 1 as round as a cylinder or ball, -1 hollow.
    ``gloss``: strength of the highlight, 0 to 1. ``opacity``: below 1 for glass.
    ``prints``: names of PRINT_KINDS to draw on it. ``decal``: painted on what is already there,
    so it changes neither the outline nor the height. ``lathed``: round about the x axis, with
    flat ends; other parts are domed by the distance from their edge.
    """

    outline: Outline
    colour: Colour
    roundness: float = 0.8
    gloss: float = 0.3
    opacity: float = 1.0
    prints: tuple[str, ...] = ()
    holes: tuple[Outline, ...] = field(default=())
    decal: bool = False
    lathed: bool = False


class Brush:
    """Picks the colours and finishes of one object."""

    def __init__(self, rng: np.random.Generator, table: Colour) -> None:
        """``table`` is the table's mean colour; now and then the object is close to it."""
        self.rng = rng
        self._table = table
        self._camouflage = rng.uniform(0.3, 0.7) if chance(rng, 0.12) else 0.0

    def any(self) -> Colour:
        """Any colour an object may have."""
        kinds = (self.vivid, self.dark, self.pale, self.metal, self.muted)
        return kinds[self.rng.choice(5, p=[0.5, 0.18, 0.12, 0.06, 0.14])]()

    def vivid(self) -> Colour:
        """A saturated colour, more often a warm one."""
        hue = self.rng.uniform(-0.06, 0.17) if chance(self.rng, 0.45) else self.rng.random()
        return self._near(hsv(hue, self.rng.uniform(0.6, 1), self.rng.uniform(0.35, 1)))

    def dark(self) -> Colour:
        """Black or dark grey, as most handles are."""
        value = self.rng.uniform(0.04, 0.28)
        return self._near(hsv(self.rng.random(), self.rng.uniform(0, 0.35), value))

    def pale(self) -> Colour:
        """White or nearly so."""
        value = self.rng.uniform(0.75, 1)
        return self._near(hsv(self.rng.random(), self.rng.uniform(0, 0.2), value))

    def metal(self) -> Colour:
        """Grey of any brightness with a slight tint."""
        value = self.rng.uniform(0.2, 0.9)
        return self._near(hsv(self.rng.uniform(0, 0.8), self.rng.uniform(0, 0.12), value))

    def muted(self) -> Colour:
        """A dull colour: wood, cardboard, olive, rust."""
        hue = self.rng.uniform(0.02, 0.2) if chance(self.rng, 0.6) else self.rng.random()
        return self._near(hsv(hue, self.rng.uniform(0.2, 0.6), self.rng.uniform(0.25, 0.8)))

    def prints(self, probability: float = 0.6) -> tuple[str, ...]:
        """None to three prints for a face."""
        if not chance(self.rng, probability):
            return ()
        return tuple(str(self.rng.choice(PRINT_KINDS)) for _ in range(self.rng.integers(1, 4)))

    def _near(self, colour: Colour) -> Colour:
        return mixed(colour, self._table, self._camouflage)


PRINT_KINDS: tuple[str, ...] = (
    "text",
    "rows",
    "blocks",
    "bands",
    "stripes",
    "checker",
    "logo",
    "speckle",
    "fade",
)

Shape = list[Part]


def box(x0: float, x1: float, y0: float, y1: float, corner: float = 0.0) -> Outline:
    """A rectangle with corners rounded by ``corner``."""
    corner = min(corner, (x1 - x0) / 2, (y1 - y0) / 2)
    if corner <= 0:
        return np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], np.float64)
    angle = np.linspace(0, np.pi / 2, 6)
    points = []
    centres = ((x1, y1, 1, 1), (x0, y1, -1, 1), (x0, y0, -1, -1), (x1, y0, 1, -1))
    for turn, (x, y, sign_x, sign_y) in enumerate(centres):
        at = angle + turn * np.pi / 2
        centre = np.array([x - sign_x * corner, y - sign_y * corner])
        points.append(centre + corner * np.stack([np.cos(at), np.sin(at)], -1))
    return np.concatenate(points)


def ellipse(x: float, y: float, radius_x: float, radius_y: float) -> Outline:
    """An ellipse with its axes along x and y."""
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    return np.stack([x + radius_x * np.cos(angle), y + radius_y * np.sin(angle)], -1)


def profile(stations: Sequence[tuple[float, float]], smooth: bool = True) -> Outline:
    """A shape symmetric about the x axis from (x, half width) stations in order of x."""
    at, half = np.array(stations, np.float64).T
    x = np.linspace(at[0], at[-1], 60)
    x = np.union1d(x, at)
    y = np.interp(x, at, half)
    if smooth:
        padded = np.pad(y, 2, mode="edge")
        y = np.convolve(padded, np.array([1, 2, 3, 2, 1]) / 9, mode="valid")
    return np.concatenate([np.stack([x, y], -1), np.stack([x, -y], -1)[::-1]])


def sweep(spine: Outline, half_width: NDArray[np.float64]) -> Outline:
    """A band of varying half width along a line of points."""
    along = np.gradient(spine, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True) + 1e-9
    across = np.stack([-along[:, 1], along[:, 0]], -1) * half_width[:, None]
    return np.concatenate([spine + across, (spine - across)[::-1]])


def moved(outline: Outline, angle: float, x: float = 0.0, y: float = 0.0) -> Outline:
    """The outline turned about the origin [rad] and then shifted."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.asarray(outline @ np.array([[cos, sin], [-sin, cos]]) + (x, y), np.float64)


def ring_part(
    x: float, y: float, radius: float, thick: float, colour: Colour, stretch: float = 1.0
) -> Part:
    """A hoop around (x, y), ``thick`` wide and ``stretch`` times as long as high."""
    outer = ellipse(x, y, radius * stretch, radius)
    inner = ellipse(x, y, radius * stretch - thick, radius - thick)
    return Part(outer, colour, 0.8, 0.4, holes=(inner,))


Builder = Callable[[np.random.Generator, Brush], Shape]
