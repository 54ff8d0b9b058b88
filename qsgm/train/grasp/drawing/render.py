"""Turns the parts of a shape into a small shaded picture with coverage.

Everything is painted lying along x at SUPERSAMPLING times the size, then turned and shrunk once,
so edges come out smooth. Heights above the table give the shading: each part is domed by its
distance from its own edge.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from qsgm.train.grasp.drawing.noise import (
    Colour,
    Field,
    blur,
    chance,
    hsv,
    smooth_noise,
    white_noise,
)
from qsgm.train.grasp.drawing.parts import Outline, Part, Shape

SUPERSAMPLING = 3
LEAST_CONTRAST = 14.0  # levels of 255, before the exposure; below it nobody could tell
_MARGIN_PX = 3
_WORDS = ("COLA", "Fresh", "NUTRI", "soap", "MAX", "Juice 40", "Best", "OIL", "tea", "POWER", "ml")


@dataclass(frozen=True)
class Light:
    """Where the light comes from: unit vector in image axes, x right, y down, z to the camera."""

    x: float
    y: float
    z: float

    def turned(self, angle: float) -> "Light":
        """The light seen after a turn by ``angle`` [rad] clockwise as seen in the image."""
        cos, sin = np.cos(angle), np.sin(angle)
        return Light(self.x * cos - self.y * sin, self.y * cos + self.x * sin, self.z)


@dataclass(frozen=True)
class Sprite:
    """A rendered object on a square, side (n, n).

    ``colour`` is BGR float32 already multiplied by ``opacity`` (0 to 1); ``coverage`` (0 to 1)
    is the outline without regard to transparency.
    """

    colour: NDArray[np.float32]
    opacity: Field
    coverage: Field


@dataclass(frozen=True)
class Painted:
    """An object lying along x, painted SUPERSAMPLING times as large, not yet lit.

    Its centre is the middle of the arrays.
    """

    colour: NDArray[np.uint8]
    """(h, w, 3) BGR, prints included."""
    coverage: NDArray[np.uint8]
    """(h, w), 255 inside the outline."""
    opacity: NDArray[np.uint8]
    """(h, w), below 255 where it is glass; 0 outside the outline."""
    relief: Field
    """(h, w) height above the table [pixels of this array]."""
    gloss: Field
    """(h, w) strength of the highlight, 0 to 1."""
    tone: Field
    """(h, w) brightness of the finish, about 1."""
    ambient: np.float32
    """Share of the light that comes from everywhere, 0 to 1."""
    sharpness: np.float32
    """Exponent of the highlight."""
    brilliance: np.float32
    """Brightness of the highlight [levels]."""


def _each_outline(shape: Shape, change: Callable[[Outline], Outline]) -> Shape:
    return [
        replace(part, outline=change(part.outline), holes=tuple(change(h) for h in part.holes))
        for part in shape
    ]


def _extent(shape: Shape) -> Outline:
    """All points that count for the outline: those of the parts that are no decals."""
    return np.concatenate([part.outline for part in shape if not part.decal])


def fitted(shape: Shape, long_px: float, least_elongation: float, least_px: float) -> Shape:
    """The shape scaled to ``long_px`` pixels and centred on the origin, its long side along x.

    A shape less elongated than ``least_elongation`` is squeezed and one thinner than
    ``least_px`` is widened. Long side and centre are those of the minimum-area rectangle.
    """
    _, size, degrees = cv2.minAreaRect(_extent(shape).astype(np.float32))
    turn = np.deg2rad(degrees + (0.0 if size[0] >= size[1] else 90.0))
    # The nearest equivalent turn keeps x as the long side without swapping a shape's ends.
    turn -= np.pi * np.round(turn / np.pi)
    cos, sin = np.cos(turn), np.sin(turn)
    spin = np.array([[cos, -sin], [sin, cos]])
    points = _extent(shape) @ spin
    low, high = points.min(axis=0), points.max(axis=0)
    width, height = high - low
    scale = long_px / width
    tall = float(np.clip(height * scale, least_px, long_px / least_elongation))
    factor = np.array([scale, tall / max(height, 1e-6)])
    centre = (low + high) / 2
    return _each_outline(shape, lambda outline: (outline @ spin - centre) * factor)


def render(shape: Shape, angle: float, light: Light, rng: np.random.Generator) -> Sprite:
    """Paints a fitted shape [px] turned by ``angle`` [rad] clockwise as seen in the image."""
    painted = paint(shape, rng)
    points = _extent(shape)
    side = 2 * (int(np.ceil(np.hypot(*np.abs(points).max(axis=0)))) + _MARGIN_PX)
    layers = [
        _turned(layer, angle, side)
        for layer in (lit(painted, light.turned(-angle)), painted.opacity, painted.coverage)
    ]
    return Sprite(
        layers[0].astype(np.float32),
        layers[1].astype(np.float32) * np.float32(1 / 255),
        layers[2].astype(np.float32) * np.float32(1 / 255),
    )


def paint(shape: Shape, rng: np.random.Generator) -> Painted:
    """Paints a fitted shape [px] lying along x, with everything random about it but the light."""
    half = np.ceil(np.abs(_extent(shape)).max(axis=0)).astype(int) + _MARGIN_PX
    canvas = _Canvas(2 * half[0] * SUPERSAMPLING, 2 * half[1] * SUPERSAMPLING)
    for part in shape:
        canvas.add(part, rng)
    return canvas.finished(rng)


def lit(painted: Painted, light: Light) -> NDArray[np.uint8]:
    """A painted object's colours (h, w, 3) lit from ``light``, times its opacity."""
    slope_x = np.asarray(cv2.Sobel(painted.relief, cv2.CV_32F, 1, 0, scale=1 / 8))
    slope_y = np.asarray(cv2.Sobel(painted.relief, cv2.CV_32F, 0, 1, scale=1 / 8))
    length = np.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
    facing = (light.z - light.x * slope_x - light.y * slope_y) / length
    ambient = painted.ambient
    shade = ambient + (1 - ambient) * np.clip(facing / np.float32(light.z), 0, 1.5)
    shade *= painted.tone
    norm = np.sqrt(2 + 2 * light.z)
    half = (light.z + 1 - light.x * slope_x - light.y * slope_y) / (length * np.float32(norm))
    spark = np.clip(half, 0, 1) ** painted.sharpness * painted.gloss
    spark *= painted.brilliance
    opaque = painted.opacity.astype(np.float32) * np.float32(1 / 255)
    matt = painted.colour * (shade * opaque)[..., None]
    glossy = matt + (spark * (painted.coverage > 0))[..., None]
    return np.clip(glossy, 0, 255).astype(np.uint8)


def contrast(sprite: Sprite, table: Colour) -> float:
    """Mean difference [levels] between the object and the table it hides."""
    hidden = sprite.opacity[..., None] * np.array(table, np.float32)
    area = np.maximum(sprite.coverage.sum(), 1.0)
    return float(np.abs(sprite.colour - hidden).max(axis=-1).sum() / area)


def rectangle(sprite: Sprite) -> tuple[tuple[float, float], tuple[float, float]]:
    """Centre (x, y) and side lengths [px] of a sprite's minimum-area rectangle."""
    points = cv2.findNonZero((sprite.coverage >= 0.5).astype(np.uint8))
    centre, size, _ = cv2.minAreaRect(points)
    return (float(centre[0]), float(centre[1])), (float(size[0]), float(size[1]))


def _turned(layer: NDArray[np.uint8], angle: float, side: int) -> NDArray[np.uint8]:
    """A supersampled layer turned about its centre and shrunk to ``side`` pixels square."""
    grown = side * SUPERSAMPLING
    height, width = layer.shape[:2]
    cos, sin = np.cos(angle), np.sin(angle)
    linear = np.array([[cos, -sin], [sin, cos]])
    old = np.array([(width - 1) / 2, (height - 1) / 2])
    shift = np.array([(grown - 1) / 2] * 2) - linear @ old
    matrix = np.concatenate([linear, shift[:, None]], axis=1)
    turned = cv2.warpAffine(layer, matrix, (grown, grown), flags=cv2.INTER_LINEAR)
    return np.asarray(cv2.resize(turned, (side, side), interpolation=cv2.INTER_AREA), np.uint8)


class _Canvas:
    """Colour, coverage, opacity, height and gloss of an object lying along x, supersampled."""

    def __init__(self, width: int, height: int) -> None:
        self.colour = np.zeros((height, width, 3), np.uint8)
        self.coverage = np.zeros((height, width), np.uint8)
        self.opacity = np.zeros((height, width), np.uint8)
        self.gloss = np.zeros((height, width), np.float32)
        self.relief = np.zeros((height, width), np.float32)

    def add(self, part: Part, rng: np.random.Generator) -> None:
        """Paints one part over what is there."""
        middle = np.array([self.coverage.shape[1], self.coverage.shape[0]]) / 2
        contours = [
            np.rint(outline * SUPERSAMPLING + middle - 0.5).astype(np.int32)
            for outline in (part.outline, *part.holes)
        ]
        low = np.clip(contours[0].min(axis=0), 0, None)
        high = np.minimum(contours[0].max(axis=0) + 1, self.coverage.shape[::-1])
        if np.any(high - low < 2):
            return
        area = (slice(low[1], high[1]), slice(low[0], high[0]))
        # One more pixel all round, so that the distance to the edge is known at the box's sides.
        mask = np.zeros((high[1] - low[1] + 2, high[0] - low[0] + 2), np.uint8)
        cv2.fillPoly(mask, [contour - (low - 1).astype(np.int32) for contour in contours], 255)
        inner = mask[1:-1, 1:-1]
        if part.decal:
            inner = np.minimum(inner, self.coverage[area])
        on = inner > 0
        self.colour[area][on] = _printed(part, on.shape, rng)[on]
        if not part.decal:
            self._raise(area, on, mask, part)

    def _raise(
        self, area: tuple[slice, slice], on: NDArray[np.bool_], mask: NDArray[np.uint8], part: Part
    ) -> None:
        self.coverage[area][on] = 255
        self.opacity[area][on] = round(255 * part.opacity)
        self.gloss[area][on] = part.gloss
        self.relief[area][on] = _relief(mask, part)[1:-1, 1:-1][on]

    def finished(self, rng: np.random.Generator) -> Painted:
        """What was painted, with a finish drawn at random."""
        relief = blur(self.relief, rng.uniform(1.0, 2.5))
        ambient = np.float32(rng.uniform(0.3, 0.8))
        unevenness = np.float32(rng.uniform(0, 0.10))
        return Painted(
            colour=self.colour,
            coverage=self.coverage,
            opacity=self.opacity * (self.coverage > 0),
            relief=relief,
            gloss=self.gloss,
            tone=1 + unevenness * smooth_noise(rng, self.coverage.shape, 30),
            ambient=ambient,
            sharpness=np.float32(rng.uniform(12, 90)),
            brilliance=np.float32(rng.uniform(60, 230)),
        )


def _relief(mask: NDArray[np.uint8], part: Part) -> Field:
    """Height [supersampled px] of a part, highest in its middle; negative when hollow."""
    return _lathed(mask, part.roundness) if part.lathed else _domed(mask, part.roundness)


def _lathed(mask: NDArray[np.uint8], roundness: float) -> Field:
    """Each column an arc over its own width, as on a bottle or a can."""
    on = (mask > 0).astype(np.float32)
    half = np.maximum(on.sum(axis=0) / 2, 1)
    rows = np.arange(len(on), dtype=np.float32)[:, None]
    middle = (rows * on).sum(axis=0) / (2 * half)
    across = (rows - middle) / half
    arc = half * np.sqrt(np.clip(1 - across * across, 0, 1))
    return np.asarray(roundness * arc, dtype=np.float32)


def _domed(mask: NDArray[np.uint8], roundness: float) -> Field:
    """The height rises with the distance from the edge."""
    distance = np.asarray(cv2.distanceTransform(mask, cv2.DIST_L2, 3))
    strength = abs(roundness)
    radius = max(float(distance.max()) * (0.12 + 0.88 * strength), 1.0)
    inward = 1 - np.minimum(distance / np.float32(radius), 1)
    dome = radius * (0.25 + 0.75 * strength) * np.sqrt(np.clip(1 - inward * inward, 0, 1))
    dome = blur(np.asarray(dome, np.float32), 0.5 + 0.12 * radius)  # no crease along the ridge
    return np.asarray(np.sign(roundness) * dome, dtype=np.float32)


def _printed(part: Part, shape: tuple[int, int], rng: np.random.Generator) -> NDArray[np.uint8]:
    """The part's bounding box filled with its colour and its prints."""
    face = np.empty((*shape, 3), np.uint8)
    face[:] = np.clip(part.colour, 0, 255)
    for name in part.prints:
        ink = _ink(part.colour, rng)
        rows = np.sort(rng.integers(0, shape[0] + 1, 2))
        columns = np.sort(rng.integers(0, shape[1] + 1, 2))
        if rows[1] - rows[0] < 4 or columns[1] - columns[0] < 4:
            rows, columns = np.array([0, shape[0]]), np.array([0, shape[1]])
        _PRINTERS[name](face[rows[0] : rows[1], columns[0] : columns[1]], ink, rng)
    return face


def _ink(ground: Colour, rng: np.random.Generator) -> Colour:
    """A colour to print with: black or white where that shows, or any bright colour."""
    draw = rng.random()
    if draw < 0.5:
        bright = 240.0 * (sum(ground) < 380)
        return bright + 10, bright + 8, bright + 5
    return hsv(rng.random(), rng.uniform(0.4, 1), rng.uniform(0.3, 1))


Face = NDArray[np.uint8]


def _text(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    word = _WORDS[rng.integers(len(_WORDS))]
    upright = chance(rng, 0.3)
    height, width = (face.shape[1], face.shape[0]) if upright else (face.shape[0], face.shape[1])
    canvas = np.zeros((height, width), np.uint8)
    font = int(rng.choice([cv2.FONT_HERSHEY_SIMPLEX, cv2.FONT_HERSHEY_DUPLEX]))
    scale = min(width / (len(word) * 19), height / 26)
    start = (round(0.03 * width), round(height / 2 + 10 * scale))
    cv2.putText(canvas, word, start, font, scale, 255, max(1, round(3.5 * scale)))
    drawn = (canvas.T if upright else canvas) > 0
    face[drawn] = np.clip(ink, 0, 255)


def _rows(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    """Small print: rows of dashes."""
    pitch = int(rng.integers(5, 16))
    for top in range(2, face.shape[0] - pitch // 2, pitch):
        left = 2
        while left < face.shape[1]:
            right = left + int(rng.integers(4, 40))
            face[top : top + pitch // 2, left:right] = ink
            left = right + pitch // 2


def _blocks(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    for _ in range(rng.integers(1, 5)):
        top, left = rng.integers(face.shape[0]), rng.integers(face.shape[1])
        tall, wide = (1 + rng.random(2) * face.shape[:2] * 0.6).astype(int)
        face[top : top + tall, left : left + wide] = ink


def _bands(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    for _ in range(rng.integers(1, 4)):
        left = int(rng.integers(face.shape[1]))
        face[:, left : left + int(rng.integers(3, 4 + face.shape[1] // 3))] = ink


def _stripes(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    pitch = int(rng.integers(3, 15))
    y, x = np.mgrid[: face.shape[0], : face.shape[1]]
    along = (x, x + y, y)[rng.integers(3)]
    face[along // pitch % 2 == 0] = ink


def _checker(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    pitch = int(rng.integers(8, 48))
    y, x = np.ogrid[: face.shape[0], : face.shape[1]]
    face[(x // pitch + y // pitch) % 2 == 0] = ink


def _logo(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    size = np.array(face.shape[1::-1])
    centre = (rng.uniform(0.3, 0.7, 2) * size).astype(int)
    radius = np.maximum(rng.uniform(0.1, 0.45, 2) * size, 1).astype(int)
    layer = np.zeros(face.shape[:2], np.uint8)
    if chance(rng, 0.6):
        cv2.ellipse(layer, centre.tolist(), radius.tolist(), 0, 0, 360, 255, -1)
    else:
        angle = np.sort(rng.uniform(0, 2 * np.pi, 6))
        corners = centre + radius * np.stack([np.cos(angle), np.sin(angle)], -1)
        cv2.fillPoly(layer, [corners.astype(np.int32)], 255)
    face[layer > 0] = ink


def _speckle(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    cell = rng.uniform(3, 14)
    face[smooth_noise(rng, face.shape[:2], cell) > rng.uniform(0.5, 1.3)] = ink


def _fade(face: Face, ink: Colour, rng: np.random.Generator) -> None:
    """The colour drifts to the ink along the part, with a little grain."""
    share = np.linspace(0, rng.uniform(0.3, 1), face.shape[1], dtype=np.float32)
    share = share[:: int(rng.choice([-1, 1]))][None, :, None]
    faded = face + share * (np.array(ink, np.float32) - face)
    face[:] = np.clip(faded + 2 * white_noise(rng, face.shape), 0, 255).astype(np.uint8)


_PRINTERS: dict[str, Callable[[Face, Colour, np.random.Generator], None]] = {
    "text": _text,
    "rows": _rows,
    "blocks": _blocks,
    "bands": _bands,
    "stripes": _stripes,
    "checker": _checker,
    "logo": _logo,
    "speckle": _speckle,
    "fade": _fade,
}
