"""Tools, cutlery, keys and pens: long thin things with a grip and a working end."""

import numpy as np

from qsgm.train.grasp.drawing.noise import chance
from qsgm.train.grasp.drawing.parts import (
    Brush,
    Builder,
    Part,
    Shape,
    box,
    ellipse,
    moved,
    profile,
    ring_part,
    sweep,
)


def _handle(rng: np.random.Generator, brush: Brush, end: float, half: float) -> Shape:
    """A grip from x = 0 to ``end``, often with a second colour or grooves."""
    waist = half * rng.uniform(0.65, 1.1)
    outline = profile(
        [
            (0, half * 0.6),
            (0.04, half),
            (end * 0.5, waist),
            (end * 0.9, half * 0.9),
            (end, half * 0.6),
        ]
    )
    if chance(rng, 0.3):
        outline = box(0, end, -half, half, rng.uniform(0, half))
    colour = (brush.dark, brush.vivid, brush.muted, brush.any)[rng.integers(4)]()
    parts = [Part(outline, colour, 0.9, rng.uniform(0, 0.7), lathed=True)]
    draw = rng.random()
    if draw < 0.3:
        low, high = sorted(rng.uniform(0, end, 2))
        parts.append(Part(box(low, high, -half, half), brush.any(), decal=True))
    elif draw < 0.5:
        inlay = box(0.05, end * 0.9, -half * 0.4, half * 0.4, half * 0.4)
        parts.append(Part(inlay, brush.any(), decal=True))
    elif draw < 0.65:
        parts.append(Part(ellipse(0.04, 0, 0.015, 0.015), brush.dark(), decal=True))
    return parts


def _head(rng: np.random.Generator, brush: Brush, at: float) -> Shape:
    """The working end of a tool, from about x = ``at`` to 1."""
    size = rng.uniform(0.06, 0.2)
    colour = brush.metal() if chance(rng, 0.7) else brush.any()
    style = rng.integers(5)
    if style == 0:  # hammer
        bar = box(1 - size * 0.7, 1, -size * 1.1, size * rng.uniform(0.8, 1.6), 0.02)
        return [Part(bar, colour, 0.8, 0.6)]
    if style == 1:  # axe or cleaver
        blade = np.array([(0.8, 0), (0.98, 0), (1.0, 0.28), (0.72, 0.22)]) * (1, 0.6 + 3 * size)
        return [Part(blade, colour, 0.2, 0.5), Part(box(0.8, 1, -0.05, 0.03), colour, 0.3, 0.3)]
    if style == 2:  # spatula or trowel
        return [Part(box(1 - 2 * size, 1, -size, size, rng.uniform(0, 0.06)), colour, 0.15, 0.4)]
    if style == 3:  # brush
        bristles = box(1 - 2 * size, 1, 0, size * 0.9)
        back = box(1 - 2.2 * size, 1.02, -size * 0.3, size * 0.1, 0.02)
        hair = Part(bristles, brush.any(), 0.1, 0.0, prints=("stripes",))
        return [hair, Part(back, colour, 0.6, 0.4)]
    tip = profile([(at, size * 0.4), (1 - size, size), (1, size * rng.uniform(0, 0.9))], False)
    return [Part(tip, colour, 0.6, 0.5)]


def _handle_tool(rng: np.random.Generator, brush: Brush) -> Shape:
    end = rng.uniform(0.3, 0.75)
    half = rng.uniform(0.03, 0.085)
    shaft = box(end - 0.05, 0.97, -half * 0.5, half * rng.uniform(0.3, 0.8))
    parts = [Part(shaft, brush.metal() if chance(rng, 0.7) else brush.any(), 1.0, 0.6)]
    return parts + _head(rng, brush, end) + _handle(rng, brush, end, half)


def _screwdriver(rng: np.random.Generator, brush: Brush) -> Shape:
    end = rng.uniform(0.35, 0.6)
    half = rng.uniform(0.015, 0.03)
    tip = [(end - 0.05, half), (0.92, half), (0.97, half * rng.uniform(1, 1.8)), (1, half * 0.5)]
    shaft = Part(profile(tip, False), brush.metal(), 1.0, 0.8, lathed=True)
    return [shaft, *_handle(rng, brush, end, rng.uniform(0.05, 0.11))]


def _wrench(rng: np.random.Generator, brush: Brush) -> Shape:
    colour = brush.metal() if chance(rng, 0.8) else brush.any()
    half, radius = rng.uniform(0.025, 0.06), rng.uniform(0.08, 0.15)
    parts = [Part(box(0.05, 0.9, -half, half, half), colour, 0.5, 0.7, prints=brush.prints(0.3))]
    ends = [(1 - radius, rng.uniform(-0.4, 0.4))]
    if chance(rng, 0.5):
        ends.append((radius * 0.8, np.pi + rng.uniform(-0.4, 0.4)))
    for x, turn in ends:
        jaw = radius * rng.uniform(0.35, 0.6)
        depth = rng.uniform(-0.3, 0.3) * radius
        opening = np.arcsin(min(jaw / radius, 0.95))
        arc = np.linspace(opening, 2 * np.pi - opening, 30)
        rim = radius * np.stack([np.cos(arc), np.sin(arc)], -1)
        outline = np.concatenate([rim, np.array([(depth, -jaw), (depth, jaw)])])
        parts.append(Part(moved(outline, turn, x, 0), colour, 0.4, 0.7))
    if len(ends) == 1 and chance(rng, 0.5):
        hole = ellipse(0.04, 0, half * 0.5, half * 0.5)
        parts.append(
            Part(ellipse(0.04, 0, half * 1.2, half * 1.2), colour, 0.4, 0.5, holes=(hole,))
        )
    return parts


def _cutlery(rng: np.random.Generator, brush: Brush) -> Shape:
    colour = brush.metal() if chance(rng, 0.7) else brush.any()
    half = rng.uniform(0.021, 0.04)
    end = rng.uniform(0.45, 0.7)
    stem = profile([(0.0, half * rng.uniform(0.8, 1.6)), (end, half * 0.75), (0.75, half * 0.75)])
    parts = [Part(stem, colour, 0.7, 0.8)]
    style = rng.integers(3)
    bowl = rng.uniform(0.05, 0.12)
    if style == 0:  # spoon
        length = max(bowl * rng.uniform(1.3, 1.8), 0.14)  # reaches the stem
        parts.append(Part(ellipse(1 - length, 0, length, bowl), colour, -0.7, 0.9))
    elif style == 1:  # fork
        parts.append(
            Part(profile([(0.68, half * 0.75), (0.78, bowl), (0.86, bowl)]), colour, 0.3, 0.7)
        )
        tines = int(rng.integers(3, 5))
        parts += [
            Part(box(0.84, 1, y - bowl * 0.17, y + bowl * 0.17), colour, 0.8, 0.7)
            for y in np.linspace(-bowl * 0.85, bowl * 0.85, tines)
        ]
    else:  # knife
        wide = rng.uniform(0.03, 0.07)
        x = np.linspace(0.4, 1, 20)
        edge = wide * np.sqrt(np.clip(1 - ((x - 0.4) / 0.6) ** 4, 0, 1))
        back = np.full(20, -half)
        blade = np.concatenate([np.stack([x, edge], -1), np.stack([x, back], -1)[::-1]])
        parts.append(Part(blade, colour, 0.1, 0.6))
    return parts + (_handle(rng, brush, end, half * 1.7) if chance(rng, 0.5) else [])


def _crossed(rng: np.random.Generator, brush: Brush) -> Shape:
    """Scissors, pliers and clamps: two mirrored levers that cross at a pivot."""
    spread = rng.uniform(0.08, 0.35)
    pivot = rng.uniform(0.35, 0.7)
    metal, grip = brush.metal(), brush.any()
    grip = brush.dark() if chance(rng, 0.3) else grip
    rings = chance(rng, 0.55)
    radius, thick = rng.uniform(0.09, 0.14), rng.uniform(0.025, 0.05)
    thick_blade = rng.uniform(0.02, 0.06)
    parts: Shape = []
    for side in (-1, 1):
        angle = side * spread
        blade = profile([(-0.05, thick_blade), (0.1, thick_blade), (1 - pivot, 0.004)], False)
        parts.append(Part(moved(blade, angle * rng.uniform(0.3, 1), pivot, 0), metal, 0.3, 0.8))
        lever_end = pivot - (radius if rings else 0)
        x = np.linspace(0, lever_end, 16)
        y = side * (spread * x + rng.uniform(0, 0.08) * np.sin(np.pi * x / lever_end))
        lever = sweep(np.stack([pivot - x, y], -1), np.linspace(0.6, 1, 16) * thick_blade * 1.1)
        parts.append(Part(lever, grip, 0.9, 0.4))
        if rings:
            at = side * max(spread * lever_end, radius * 0.95)
            stretch = rng.uniform(1.0, 1.4)
            parts.append(ring_part(radius * 0.9, at, radius, thick, grip, stretch))
    parts.append(Part(ellipse(pivot, 0, 0.025, 0.025), brush.any(), 1.0, 0.6))
    return parts


def _key(rng: np.random.Generator, brush: Brush) -> Shape:
    colour = brush.metal() if chance(rng, 0.5) else brush.any()
    radius, half = rng.uniform(0.12, 0.22), rng.uniform(0.025, 0.05)
    bow = Part(
        ellipse(radius, 0, radius, radius * rng.uniform(0.8, 1.2)),
        colour,
        0.3,
        0.6,
        holes=(ellipse(radius * 0.6, 0, radius * 0.35, radius * 0.35),),
    )
    x = np.linspace(1.8 * radius, 1, 18)
    teeth = half + np.where(x > 0.5, rng.uniform(0, 0.05, 18), 0)
    shank = np.concatenate([np.stack([x, teeth], -1), np.stack([x, np.full(18, -half)], -1)[::-1]])
    return [Part(shank, colour, 0.3, 0.7), bow]


def _pen(rng: np.random.Generator, brush: Brush) -> Shape:
    half = rng.uniform(0.035, 0.09)
    split = rng.uniform(0.3, 0.75)
    tip = rng.uniform(0.02, 0.16)
    first = profile([(0, half * rng.uniform(0.6, 1)), (0.04, half), (split, half)], False)
    second = profile(
        [(split, half), (1 - tip, half * rng.uniform(0.8, 1.1)), (1, half * 0.3)], False
    )
    gloss = rng.uniform(0.1, 1)
    parts = [
        Part(first, brush.any(), 1.0, gloss, prints=brush.prints(0.4), lathed=True),
        Part(second, brush.any(), 1.0, gloss, prints=brush.prints(0.2), lathed=True),
    ]
    if chance(rng, 0.6):
        parts.append(Part(box(1 - tip, 1, -half, half), brush.any(), decal=True))
    if chance(rng, 0.4):
        clip = box(0.02, split * 0.8, half * 0.2, half * 0.7)
        parts.append(Part(clip, brush.any(), decal=True))
    return parts


def _loop(rng: np.random.Generator, brush: Brush) -> Shape:
    """Magnifier, racket, pan: a disc or hoop at the end of a handle."""
    radius = rng.uniform(0.15, 0.28)
    thick = rng.uniform(0.02, 0.07)
    rim, x = brush.any(), 1 - radius
    parts = _handle(rng, brush, 1 - 1.9 * radius, rng.uniform(0.025, 0.07))
    if chance(rng, 0.75):
        glass = rng.uniform(0.25, 1.0)
        lens = ellipse(x, 0, radius * 0.95, radius * 0.95)
        parts.append(Part(lens, brush.any(), rng.uniform(-0.6, 0.6), 0.6, glass))
    return [*parts, ring_part(x, 0, radius, thick, rim)]


TOOLS: dict[str, Builder] = {
    "handle_tool": _handle_tool,
    "screwdriver": _screwdriver,
    "wrench": _wrench,
    "cutlery": _cutlery,
    "crossed": _crossed,
    "key": _key,
    "pen": _pen,
    "loop": _loop,
}
