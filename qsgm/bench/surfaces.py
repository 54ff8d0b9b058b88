"""Tables with something beside the object: an edge with floor behind, a dark gap, a sheet.

Every border is a straight line that keeps clear of the object, on any side of it.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

# A border line runs this far beside the object.
CLEARANCE_PX = (5.0, 70.0)
GAP_PX = (8.0, 40.0)
SHEET_PX = (50.0, 220.0)


@dataclass(frozen=True)
class Line:
    """A directed line; the object lies where the distance is negative."""

    normal: tuple[float, float]  # (x, y)
    offset_px: float

    def distance(self, shape_hw: tuple[int, ...]) -> Floats:
        """Signed distance (H, W) of every pixel."""
        y, x = np.mgrid[: shape_hw[0], : shape_hw[1]]
        return np.asarray(
            x * self.normal[0] + y * self.normal[1] - self.offset_px, dtype=np.float32
        )


def with_surface(table: Floats, other: Floats, covered: Mask, rng: np.random.Generator) -> Floats:
    """The table (H, W, 3) with an edge, a gap or a sheet in view.

    Args:
        table: what the object lies on.
        other: another table, of the same size; floor and sheets look like it, or plain.
        covered: the object's pixels, which no border line crosses.
        rng: decides.
    """
    kinds = (_edge, _gap, _sheet)
    surface = other if rng.random() < 0.6 else _plain(table.shape, rng)
    return kinds[int(rng.integers(len(kinds)))](table, surface, covered, rng)


def _edge(table: Floats, floor: Floats, covered: Mask, rng: np.random.Generator) -> Floats:
    """The table ends; behind its front lies a darker floor."""
    beyond = _line_beside(covered, rng).distance(table.shape)
    front = rng.uniform(0.0, 22.0)
    depth = beyond - front
    shadow = 1 - rng.uniform(0.2, 0.6) * np.exp(-np.maximum(depth, 0) / rng.uniform(10.0, 50.0))
    below = np.asarray(floor * rng.uniform(0.35, 1.0) * shadow[:, :, None], dtype=np.float32)
    edged = _mixed(table, table * rng.uniform(0.35, 0.8), beyond)
    return _mixed(edged, below, depth)


def _gap(table: Floats, _: Floats, covered: Mask, rng: np.random.Generator) -> Floats:
    """A dark band, as between two boards or above a drawer."""
    near = _line_beside(covered, rng).distance(table.shape)
    inside = np.minimum(near, rng.uniform(*GAP_PX) - near)
    return _mixed(table, table * rng.uniform(0.05, 0.35), inside, rng.uniform(0.5, 2.0))


def _sheet(table: Floats, sheet: Floats, covered: Mask, rng: np.random.Generator) -> Floats:
    """A sheet or board that crosses the view; the object lies beside it or on it."""
    line = _line_beside(covered, rng)
    inside = line.distance(table.shape)
    if rng.random() < 0.4:
        inside = -inside
    elif rng.random() < 0.6:
        inside = np.minimum(inside, rng.uniform(*SHEET_PX) - inside)
    if rng.random() < 0.5:  # a corner of it
        side = 1 if rng.random() < 0.5 else -1
        along = (-side * line.normal[1], side * line.normal[0])
        inside = np.minimum(inside, -_beside(covered, along, rng).distance(table.shape))
    width = rng.uniform(2.0, 9.0)
    shadow = 1 - rng.uniform(0.0, 0.4) * np.exp(-np.maximum(-inside, 0) / width)
    shaded = np.asarray(table * shadow[:, :, None], dtype=np.float32)
    return _mixed(shaded, sheet, inside)


def _line_beside(covered: Mask, rng: np.random.Generator) -> Line:
    direction = rng.uniform(-np.pi, np.pi)
    return _beside(covered, (float(np.cos(direction)), float(np.sin(direction))), rng)


def _beside(covered: Mask, normal: tuple[float, float], rng: np.random.Generator) -> Line:
    """A line with this normal beyond all of the object."""
    y, x = np.nonzero(covered)
    furthest = (x * normal[0] + y * normal[1]).max() if len(x) else 0.0
    return Line(normal, float(furthest + rng.uniform(*CLEARANCE_PX)))


def _plain(shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    """A surface of one colour with a little grain."""
    coarse = rng.normal(0.0, rng.uniform(1.0, 8.0), (shape[0] // 4 + 1, shape[1] // 4 + 1))
    grain = cv2.resize(coarse.astype(np.float32), (shape[1], shape[0]))
    gray = rng.uniform(25, 235)
    color = np.clip(gray + rng.normal(0.0, 28.0, 3), 5, 250)
    return np.asarray(color + grain[:, :, None], dtype=np.float32)


def _mixed(outside: Floats, inside: Floats, depth: Floats, soft_px: float = 0.6) -> Floats:
    """`inside` where the depth (H, W) is positive, with a border this soft."""
    share = np.clip(depth / (2 * soft_px) + 0.5, 0, 1)[:, :, None]
    return np.asarray(outside * (1 - share) + inside * share, dtype=np.float32)
