"""The same object again in another scene: other table, other light, other things beside it.

An object is drawn once and keeps its shape, prints and finish. A scene puts it down anywhere,
turned, nearer or seen at a slant, among others. :func:`qsgm.train.grasp.objects.draw_frame` draws
single frames; here a demonstration and the scenes to find it in are drawn alike.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.train.grasp.drawing.camera import FRAME_HW, random_light, seen_by_camera
from qsgm.train.grasp.drawing.noise import Colour, Field, blur, cast_shadow, hsv, mean_colour
from qsgm.train.grasp.drawing.render import (
    LEAST_CONTRAST,
    SUPERSAMPLING,
    Light,
    Painted,
    lit,
    paint,
)
from qsgm.train.grasp.drawing.shapes import TRIES, chosen_object, random_length, random_shape
from qsgm.train.grasp.drawing.structures import draw_structure
from qsgm.train.grasp.drawing.tables import chosen_table, draw_table

# Kept at this size, an object takes a third of the memory and is lit in half the time.
KEPT_SUPERSAMPLING = 2

_SHADOW_MARGIN_PX = 48  # even; how far a shadow can fall
_PUSH_PX, _PULL_PX = 12.0, 2.0  # steps in which a thing is moved out of the way, and back
_TOUCHING_SHARE, _NEAR_SHARE = 0.35, 0.3  # of the other things; the rest lies anywhere
_NEAR_PX = 40.0
_DARKEST = 8.0  # levels; what is darker is repainted as if it were that

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class DrawnObject:
    """An object that can be put into any number of scenes."""

    kind: str
    size_px: tuple[float, float]
    """Long and short side of its minimum-area rectangle at scale 1."""
    middle_px: tuple[float, float]
    """Centre (x, y) of that rectangle, from the middle of the painted arrays, at scale 1."""
    painted: Painted
    """It, lying along x at KEPT_SUPERSAMPLING times its size, not yet lit."""

    @property
    def elongation(self) -> float:
        """Long over short side, at least 1."""
        return self.size_px[0] / self.size_px[1]


@dataclass(frozen=True)
class DrawnScene:
    """A camera frame and the truth about what lies in it."""

    image: Image
    """Shape (480, 640, 3), BGR."""
    center_px: tuple[float, float] | None
    """Where (x, y) the middle of the object's rectangle is; None where the object is absent."""
    turn_rad: float
    """How far the object is turned from how it was drawn, counter-clockwise as seen."""
    mask: Mask
    """Shape (480, 640), True on what can be seen of the object; nowhere where it is absent."""
    others: Mask
    """Shape (480, 640), True on what can be seen of the other things."""
    hidden_share: float
    """Share of the object that other things hide, 0 to 1."""


@dataclass(frozen=True)
class View:
    """How the camera sees the table: its distance and a mild slant."""

    scale: float = 1.0
    tilt_rad: float = 0.0
    """Between the camera's axis and the table's normal; lengths along `tilt_direction_rad` shrink
    by its cosine."""
    tilt_direction_rad: float = 0.0

    def linear(self, turn_rad: float) -> NDArray[np.float64]:
        """Map (2, 2) of an object's own axes, turned counter-clockwise as seen, to the image.

        Its rotation (of its polar decomposition) is the turn itself, so a slant does not bias it.
        """
        along = np.array([np.cos(self.tilt_direction_rad), -np.sin(self.tilt_direction_rad)])
        slant = np.eye(2) - (1 - np.cos(self.tilt_rad)) * np.outer(along, along)
        cos, sin = np.cos(turn_rad), np.sin(turn_rad)
        return np.asarray(self.scale * slant @ np.array([[cos, sin], [-sin, cos]]))


@dataclass(frozen=True)
class _Shade:
    """The shadows of one scene's light."""

    light: Light
    contact_px: float
    contact: float  # darkening, 0 to 1
    cast_px: float
    cast: float

    @classmethod
    def drawn(cls, rng: np.random.Generator, light: Light) -> "_Shade":
        contact, cast = rng.uniform(0.1, 0.6), rng.uniform(0, 0.75)
        return cls(light, rng.uniform(1.0, 3.0), contact, rng.uniform(0.8, 7.0), cast)


@dataclass(frozen=True)
class _Cutout:
    """A lit object as it will lie in the frame."""

    layer: Image  # (h, w, 4) BGR times opacity, opacity
    outline: Mask  # (h, w)
    corner: tuple[int, int]  # (x, y) in the frame of the arrays' first pixel; may be outside


def draw_object(
    rng: np.random.Generator,
    table_colour: Colour | None = None,
    *,
    kind: str | None = None,
    elongated: bool | None = None,
) -> DrawnObject:
    """Draws a new object, long side 55 to 115 px, that shows on a table of a mean colour (BGR).

    Left out, the kind is drawn at random: 85 % are elongated unless ``elongated`` says. Without a
    table colour any light grey to brown will do. Raises QsgmError for a kind that does not exist.
    """
    kind = chosen_object(rng, kind, elongated)
    if table_colour is None:
        table_colour = hsv(rng.uniform(0, 0.17), rng.uniform(0, 0.4), rng.uniform(0.4, 0.9))
    long_px = random_length(rng)
    for _ in range(TRIES):
        shape = random_shape(rng, kind, table_colour, long_px)
        painted = _kept(paint(shape, rng))
        if _shows(painted, table_colour):
            break
    return _measured(kind, painted)


def in_colours_of(thing: DrawnObject, model: DrawnObject) -> DrawnObject:
    """A thing repainted so that its mean colour is another one's: told apart by its shape alone."""
    wanted, own = (_mean_paint(one.painted) + _DARKEST for one in (model, thing))
    colour = np.clip(np.rint(thing.painted.colour * (wanted / own)), 0, 255).astype(np.uint8)
    return replace(thing, painted=replace(thing.painted, colour=colour))


def draw_scene(
    rng: np.random.Generator,
    drawn: DrawnObject | None,
    *,
    others: Sequence[DrawnObject] = (),
    table_kind: str | None = None,
    table: Image | None = None,
    structures: Sequence[str] = (),
    center_px: tuple[float, float] = (320.0, 240.0),
    turn_rad: float = 0.0,
    view: View | None = None,
    hidden_share: float = 0.0,
    taken_away: bool = False,
) -> DrawnScene:
    """Draws a scene with an object (or none) and other things, in new light.

    Args:
        rng: the only source of randomness; it is used alike with and without ``taken_away``.
        drawn: the object, or None.
        others: other things. They lie anywhere, a third of them touching the object, in any
            direction, and may hide one another, but not the object.
        table_kind: one of TABLE_KINDS; left out, any on which the object shows.
        table: a table (480, 640, 3) BGR drawn before, which saves half of the time. Not changed.
        structures: any of STRUCTURE_KINDS, drawn on the table in this order.
        center_px: where (x, y) the centre of the object's rectangle lies.
        turn_rad: how far it is turned, counter-clockwise as seen.
        view: of the camera; left out, straight from above at scale 1.
        hidden_share: share of the object, 0 to 1, that the first of the others may hide at most.
        taken_away: draw this very scene without the object.

    Raises:
        QsgmError: a kind of table or structure does not exist.
    """
    view = view or View()
    ground = _ground(rng, drawn, table_kind) if table is None else table.copy()
    for kind in structures:
        draw_structure(rng, ground, kind, center_px)
    shade = _Shade.drawn(rng, random_light(rng))
    target = None
    if drawn is not None:
        target = _cutout(drawn, view, turn_rad, center_px, shade.light)
    things = list(_placed(rng, others, target, view, center_px, hidden_share, shade.light))
    shown = None if taken_away else target
    owner, whole = _put_all(rng, ground, shown, things, shade)
    seen = int(np.count_nonzero(owner == 1))
    return DrawnScene(
        image=seen_by_camera(rng, ground, shade.light),
        center_px=None if shown is None else center_px,
        turn_rad=turn_rad,
        mask=owner == 1,
        others=owner == 2,
        hidden_share=1 - seen / whole if whole else 0.0,
    )


def draw_alone(drawn: DrawnObject, light: Light, side_px: int) -> Image:
    """The object as it lies along x, without a table.

    Returns (side, side, 4): BGR times opacity, and opacity; the centre of its rectangle is the
    middle of the picture. Raises ValueError where it does not fit.
    """
    middle = (side_px - 1) / 2
    lying = _cutout(drawn, View(), 0.0, (middle, middle), _single(light))
    layer = lying.layer
    rows, columns = (np.flatnonzero(layer[..., 3].any(axis=axis)) for axis in (1, 0))
    x, y = lying.corner
    left, top, right, bottom = columns[0], rows[0], columns[-1] + 1, rows[-1] + 1
    if min(x + left, y + top) < 0 or max(x + right, y + bottom) > side_px:
        raise ValueError(f"a {drawn.kind} of {drawn.size_px} px does not fit {side_px} px")
    result = np.zeros((side_px, side_px, 4), np.uint8)
    result[y + top : y + bottom, x + left : x + right] = layer[top:bottom, left:right]
    return result


def _put_all(
    rng: np.random.Generator,
    image: Image,
    target: _Cutout | None,
    things: Sequence[_Cutout],
    shade: _Shade,
) -> tuple[Image, int]:
    """Lays down the object, then the others.

    Returns whose each pixel (480, 640) is, 1 the object's and 2 another's, and how many the
    object would have if nothing hid it.
    """
    owner = np.zeros(FRAME_HW, np.uint8)
    heights = rng.uniform(1, 12, 1 + len(things))  # px; above the table
    whole = 0
    if target is not None:
        _put(image, target, shade, heights[0])
        whole = _mark(owner, target, 1)
    for thing, height in zip(things, heights[1:], strict=True):
        _put(image, thing, shade, height)
        _mark(owner, thing, 2)
    return owner, whole


def _mean_paint(painted: Painted) -> NDArray[np.float64]:
    """Mean colour (3,) inside the outline."""
    return np.asarray(painted.colour[painted.coverage > 127].mean(axis=0))


def _kept(painted: Painted) -> Painted:
    """A painted object shrunk from SUPERSAMPLING to KEPT_SUPERSAMPLING."""
    factor = KEPT_SUPERSAMPLING / SUPERSAMPLING
    size = tuple(round(side * factor) for side in painted.coverage.shape[::-1])
    layers = {
        name: cv2.resize(getattr(painted, name), size, interpolation=cv2.INTER_AREA)
        for name in ("colour", "coverage", "opacity", "relief", "gloss", "tone")
    }
    layers["relief"] = layers["relief"] * np.float32(factor)
    return replace(painted, **layers)


def _measured(kind: str, painted: Painted) -> DrawnObject:
    """The object with its rectangle, of pixels as a camera would see it, not of outlines."""
    points = cv2.findNonZero((painted.coverage > 127).astype(np.uint8))
    middle, size, _ = cv2.minAreaRect(points)
    middle = (np.array(middle) + 0.5 - np.array(painted.coverage.shape[::-1]) / 2).tolist()
    long_side, short_side = ((side + 1) / KEPT_SUPERSAMPLING for side in (max(size), min(size)))
    x, y = (value / KEPT_SUPERSAMPLING for value in middle)
    return DrawnObject(kind, (long_side, short_side), (x, y), painted)


def _shows(painted: Painted, table: Colour) -> bool:
    """Whether an object differs enough from a table's mean colour."""
    on = painted.coverage > 127
    difference = np.abs(painted.colour[on] - np.array(table, np.float32)).max(axis=-1)
    return float(np.mean(difference * painted.opacity[on] / 255)) > LEAST_CONTRAST


def _ground(rng: np.random.Generator, drawn: DrawnObject | None, kind: str | None) -> Image:
    """A table on which the object shows, unless none of a few does."""
    for _ in range(TRIES):
        table = draw_table(rng, chosen_table(rng, kind), FRAME_HW)
        if drawn is None or _shows(drawn.painted, mean_colour(table)):
            break
    return table


def _cutout(
    drawn: DrawnObject,
    view: View,
    turn_rad: float,
    center_px: tuple[float, float],
    light: Light,
) -> _Cutout:
    """The object lit and mapped into the frame, its rectangle's centre on ``center_px`` (x, y)."""
    painted = drawn.painted
    linear = view.linear(turn_rad)
    half = np.array(painted.coverage.shape[::-1]) / 2
    reach = np.ceil(np.abs(linear) @ half / KEPT_SUPERSAMPLING).astype(int) + 1
    spot = np.array(center_px) - linear @ np.array(drawn.middle_px)
    corner = np.floor(spot).astype(int) - reach
    # Drawn at twice the size and shrunk, so that edges come out smooth.
    size = 2 * (2 * reach + 2)
    linear = linear * (2 / KEPT_SUPERSAMPLING)
    middle = 2 * (spot - corner) + 0.5
    matrix = np.concatenate([linear, (middle - linear @ (half - 0.5))[:, None]], axis=1)
    colour = lit(painted, _single(light.turned(turn_rad)))
    layer = np.asarray(cv2.merge([*cv2.split(colour), painted.opacity]), np.uint8)
    layer = _mapped(layer, matrix, size)
    solid = np.array_equal(painted.opacity, painted.coverage)
    coverage = layer[..., 3] if solid else _mapped(painted.coverage, matrix, size)
    return _Cutout(layer, coverage > 127, (int(corner[0]), int(corner[1])))


def _single(light: Light) -> Light:
    """Light in Python's numbers: NumPy's own would make the shading double precision."""
    return Light(float(light.x), float(light.y), float(light.z))


def _mapped(layer: Image, matrix: NDArray[np.float64], size: NDArray[np.int64]) -> Image:
    grown = cv2.warpAffine(layer, matrix, (int(size[0]), int(size[1])), flags=cv2.INTER_LINEAR)
    half = (int(size[0]) // 2, int(size[1]) // 2)
    return np.asarray(cv2.resize(grown, half, interpolation=cv2.INTER_AREA), np.uint8)


def _placed(
    rng: np.random.Generator,
    others: Sequence[DrawnObject],
    target: _Cutout | None,
    view: View,
    center_px: tuple[float, float],
    hidden_share: float,
    light: Light,
) -> Iterator[_Cutout]:
    """The other things, each in its place."""
    for index, other in enumerate(others):
        thing = _cutout(other, view, rng.uniform(0, 2 * np.pi), (0.0, 0.0), light)
        draw, direction = rng.random(), rng.uniform(0, 2 * np.pi)
        gap = rng.uniform(0, _NEAR_PX)
        spot = rng.uniform(0, 1, 2) * FRAME_HW[::-1]
        allowed = hidden_share if index == 0 else 0.0
        ahead = np.array([np.cos(direction), np.sin(direction)])
        if draw < _TOUCHING_SHARE + _NEAR_SHARE or allowed > 0:
            spot = np.array(center_px)
        elif np.any(spot != center_px):
            ahead = (spot - center_px) / np.linalg.norm(spot - center_px)
        spot = _freed(thing, spot, ahead, target, allowed)
        if _TOUCHING_SHARE <= draw < _TOUCHING_SHARE + _NEAR_SHARE and not allowed:
            spot = spot + gap * ahead
        yield replace(thing, corner=_moved(thing, spot))


def _freed(
    thing: _Cutout,
    spot: NDArray[np.float64],
    ahead: NDArray[np.float64],
    target: _Cutout | None,
    allowed: float,
) -> NDArray[np.float64]:
    """Where a thing meant for a spot (x, y) goes so that it hides no more than is allowed."""
    if target is None:
        return spot
    most = allowed * np.count_nonzero(target.outline)
    if _overlap(thing, target, spot) <= most:
        return spot
    while _overlap(thing, target, spot) > most:
        spot = spot + _PUSH_PX * ahead
    while _overlap(thing, target, spot - _PULL_PX * ahead) <= most:
        spot = spot - _PULL_PX * ahead
    return spot


def _moved(thing: _Cutout, spot: NDArray[np.float64]) -> tuple[int, int]:
    """The corner of a thing that was mapped around (0, 0) and goes to a spot (x, y)."""
    return round(spot[0]) + thing.corner[0], round(spot[1]) + thing.corner[1]


def _overlap(thing: _Cutout, target: _Cutout, spot: NDArray[np.float64]) -> int:
    """Number of pixels of the target that a thing put on a spot (x, y) hides."""
    height, width = thing.outline.shape
    x, y = _moved(thing, spot)
    x, y = x - target.corner[0], y - target.corner[1]
    under = target.outline[max(y, 0) : max(y + height, 0), max(x, 0) : max(x + width, 0)]
    top, left = max(-y, 0), max(-x, 0)
    over = thing.outline[top : top + under.shape[0], left : left + under.shape[1]]
    return int(np.count_nonzero(under & over)) if under.size else 0


def _window(
    corner: tuple[int, int], shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """What of an array at a corner (x, y) lies in the frame: slices of the frame, of the array."""
    inside, own = [], []
    for start, length, limit in zip(corner[::-1], shape[:2], FRAME_HW, strict=True):
        low, high = max(start, 0), min(start + length, limit)
        high = max(high, low)
        inside.append(slice(low, high))
        own.append(slice(low - start, high - start))
    return (inside[0], inside[1]), (own[0], own[1])


def _mark(owner: Image, thing: _Cutout, label: int) -> int:
    """Gives the thing's pixels a label; returns how many there are in the frame."""
    inside, own = _window(thing.corner, thing.outline.shape)
    outline = thing.outline[own]
    owner[inside][outline] = label
    return int(np.count_nonzero(outline))


def _put(image: Image, thing: _Cutout, shade: _Shade, height: float) -> None:
    """Lays a thing with its shadow on what is there."""
    shadow = _shadow(thing.layer[..., 3], shade, height)
    margin = _SHADOW_MARGIN_PX
    corner = (thing.corner[0] - margin, thing.corner[1] - margin)
    inside, own = _window(corner, shadow.shape)
    if image[inside].size == 0:
        return
    left = cv2.merge([shadow[own]] * 3)
    image[inside] = cv2.multiply(image[inside], left, scale=1 / 255)
    inside, own = _window(thing.corner, thing.layer.shape)
    if image[inside].size == 0:
        return
    colour, opacity = thing.layer[own][..., :3], thing.layer[own][..., 3]
    rest = cv2.merge([255 - opacity] * 3)
    image[inside] = cv2.add(cv2.multiply(image[inside], rest, scale=1 / 255), colour)


def _shadow(opacity: Image, shade: _Shade, height: float) -> Image:
    """How much light (0 to 255) is left around a thing: a contact shadow and a cast one.

    Shadows are soft, so they are made at half the size.
    """
    margin = _SHADOW_MARGIN_PX
    padded = np.pad(opacity, margin)
    size = padded.shape[1::-1]
    small = (size[0] // 2, size[1] // 2)
    covered = cv2.resize(padded, small, interpolation=cv2.INTER_AREA).astype(np.float32)
    covered *= np.float32(1 / 255)
    contact = blur(covered, shade.contact_px / 2) * np.float32(shade.contact)
    away = -height / 2 / shade.light.z * np.array([shade.light.x, shade.light.y])
    cast = np.maximum(covered, cast_shadow(covered, away))
    cast = blur(cast, shade.cast_px / 2) * np.float32(shade.cast)
    left: Field = (1 - contact) * (1 - cast) * np.float32(255)
    return np.asarray(cv2.resize(left.astype(np.uint8), size), np.uint8)
