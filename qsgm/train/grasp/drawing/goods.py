"""Packages, food and tableware: bottles, cans, boxes, bags, fruit, mugs and nameless toys."""

import numpy as np

from qsgm.train.grasp.drawing.noise import chance, hsv, mixed, scaled
from qsgm.train.grasp.drawing.parts import (
    Brush,
    Builder,
    Outline,
    Part,
    Shape,
    box,
    ellipse,
    moved,
    profile,
    ring_part,
    sweep,
)


def _bottle(rng: np.random.Generator, brush: Brush) -> Shape:
    half = rng.uniform(0.12, 0.29)
    neck = half * rng.uniform(0.25, 0.7)
    shoulder, neck_start = sorted(rng.uniform(0.5, 0.85, 2))
    base = half * rng.uniform(0.8, 1.0)
    waist = half * rng.uniform(0.85, 1.0)
    body = profile(
        [
            (0, base),
            (0.05, half),
            (0.3, waist),
            (shoulder, half),
            (neck_start + 0.05, neck),
            (1, neck),
        ]
    )
    glass = rng.uniform(0.45, 0.9) if chance(rng, 0.4) else 1.0
    colour = brush.any()
    parts = [Part(body, colour, 1.0, rng.uniform(0.2, 1.0), glass, brush.prints(0.25), lathed=True)]
    if chance(rng, 0.75):
        low, high = 0.04 + rng.uniform(0, 0.2), shoulder - rng.uniform(0, 0.15)
        label = box(low, max(high, low + 0.15), -half * 1.1, half * 1.1)
        parts.append(Part(label, brush.any(), prints=brush.prints(0.9), decal=True))
    if chance(rng, 0.75):
        wide = neck * rng.uniform(1.0, 1.35)
        cap = box(1 - rng.uniform(0.02, 0.1), 1 + rng.uniform(0.0, 0.06), -wide, wide, 0.015)
        bands = ("bands",) if chance(rng, 0.3) else ()
        parts.append(Part(cap, brush.any(), 1.0, 0.4, prints=bands, lathed=True))
    return parts


def _can(rng: np.random.Generator, brush: Brush) -> Shape:
    half = rng.uniform(0.22, 0.36)
    taper = rng.uniform(0, 0.05)
    body = profile(
        [(0, half - taper), (taper + 0.01, half), (0.95, half), (1, half - taper)], False
    )
    gloss = rng.uniform(0.2, 1)
    parts = [Part(body, brush.any(), 1.0, gloss, prints=brush.prints(0.9), lathed=True)]
    rim = brush.metal() if chance(rng, 0.7) else brush.any()
    if chance(rng, 0.8):
        deep = rng.uniform(0.02, 0.12)
        parts.append(Part(box(-0.01, deep, -1, 1), rim, decal=True))
        parts.append(Part(box(1 - deep * rng.uniform(0.5, 2), 1.01, -1, 1), rim, decal=True))
    if chance(rng, 0.3):
        lid = ellipse(1, 0, rng.uniform(0.03, 0.12), half - taper)
        parts.append(Part(lid, brush.metal(), 0.0, 0.8))
    return parts


def _tube(rng: np.random.Generator, brush: Brush) -> Shape:
    wide, narrow = rng.uniform(0.1, 0.2), rng.uniform(0.05, 0.12)
    body = profile([(0, wide), (0.06, wide), (0.8, narrow), (0.85, narrow * 0.7)], False)
    cap = profile([(0.83, narrow * 0.8), (1, narrow * rng.uniform(0.6, 0.9))], False)
    return [
        Part(body, brush.any(), 0.7, rng.uniform(0.1, 0.8), prints=brush.prints(0.8), lathed=True),
        Part(box(-0.01, 0.06, -wide, wide), brush.any(), decal=True, prints=("stripes",)),
        Part(cap, brush.any(), 1.0, 0.4, lathed=True),
    ]


def _carton(rng: np.random.Generator, brush: Brush, half: float | None = None) -> Shape:
    half = rng.uniform(0.12, 0.36) if half is None else half
    colour = brush.any()
    parts: Shape = []
    if chance(rng, 0.6):
        deep = rng.uniform(0.02, 0.12)
        side = scaled(colour, rng.uniform(0.35, 0.8))
        parts.append(Part(box(0, 1, half - 0.01, half + deep), side, 0.0, 0.0))
    corner = rng.uniform(0, 0.08) if chance(rng, 0.5) else 0.0
    face = Part(box(0, 1, -half, half, corner), colour, 0.05, 0.1, prints=brush.prints(0.9))
    parts.append(face)
    if chance(rng, 0.5):
        cut = rng.uniform(0.2, 0.8)
        parts.append(Part(box(0, cut, -half, half), brush.any(), decal=True, prints=brush.prints()))
    return parts


def _bag(rng: np.random.Generator, brush: Brush) -> Shape:
    half = rng.uniform(0.13, 0.32)
    x = np.linspace(0, 1, 28)
    edges = [
        half + rng.normal(0, 0.008, 28) + 0.03 * np.sin(x * rng.uniform(3, 9) + rng.uniform(0, 6))
        for _ in range(2)
    ]
    outline = np.concatenate([np.stack([x, edges[0]], -1), np.stack([x, -edges[1]], -1)[::-1]])
    colour, seal = brush.any(), brush.any()
    deep = rng.uniform(0.03, 0.1)
    ends = [(-0.01, deep), (1 - deep, 1.01)][: int(rng.integers(0, 3))]
    parts = [Part(outline, colour, 0.7, rng.uniform(0.2, 1), prints=brush.prints(0.95))]
    for low, high in ends:
        parts.append(Part(box(low, high, -1, 1), seal, prints=("stripes",), decal=True))
    for _ in range(rng.integers(0, 7)):  # creases of the foil
        start, turn = rng.uniform(0.05, 0.95), rng.uniform(0, np.pi)
        crease = moved(box(-0.15, 0.15, -0.008, 0.008), turn, start, rng.uniform(-half, half))
        shade = scaled(colour, 0.5) if chance(rng, 0.5) else mixed(colour, (255, 255, 255), 0.5)
        parts.append(Part(crease, shade, decal=True))
    return parts


def _bent(rng: np.random.Generator, brush: Brush) -> Shape:
    arc = np.linspace(-1, 1, 40) * rng.uniform(0.3, 1.1)
    spine = np.stack([np.sin(arc), 1 - np.cos(arc)], -1) / (2 * np.sin(arc[-1]))
    along = np.linspace(-1, 1, 40)
    blunt = rng.uniform(2, 8)
    half = rng.uniform(0.05, 0.14) * (1.03 - np.abs(along) ** blunt)
    gloss = rng.uniform(0, 0.8)
    colour = brush.any()
    banana = chance(rng, 0.5)
    if banana:
        colour = mixed(colour, hsv(rng.uniform(0.11, 0.18), 0.85, rng.uniform(0.6, 1)), 0.85)
    parts = [Part(sweep(spine, half), colour, 1.0, gloss)]
    if banana:
        for index in (slice(0, 5), slice(35, 40)):
            width = half[index] + 0.012
            parts.append(Part(sweep(spine[index], width), scaled(colour, 0.5)))
    elif chance(rng, 0.5):
        start = int(rng.integers(0, 30))
        ring = sweep(spine[start : start + 9], half[start : start + 9] * 1.05)
        parts.append(Part(ring, brush.any(), decal=True))
    return parts


def _tapered(rng: np.random.Generator, brush: Brush) -> Shape:
    wide, peak, blunt = rng.uniform(0.12, 0.36), rng.uniform(0.12, 0.4), rng.uniform(0.03, 0.2)
    stations = [(0, wide * 0.35), (peak * 0.4, wide * 0.85), (peak, wide)]
    stations += [(0.75, wide * (0.3 + blunt)), (0.95, wide * blunt * 1.6), (1, wide * blunt * 0.5)]
    body = Part(profile(stations), brush.any(), 1.0, rng.uniform(0, 0.6), prints=brush.prints(0.3))
    parts = [body]
    for _ in range(rng.integers(0, 4)):
        leaf = ellipse(0, 0, rng.uniform(0.06, 0.16), rng.uniform(0.02, 0.07))
        green = hsv(rng.uniform(0.2, 0.4), 0.7, rng.uniform(0.3, 0.8))
        spot = moved(leaf, rng.uniform(-0.9, 0.9), -0.03, rng.uniform(-0.06, 0.06))
        parts.append(Part(spot, green, 0.6, 0.2))
    return parts


def _ring(rng: np.random.Generator, brush: Brush) -> Shape:
    """An open band, stretched to an oval: a bracelet, a shackle, a roll of tape."""
    thick = rng.uniform(0.05, 0.14)
    band = ring_part(0.5, 0, rng.uniform(0.2, 0.36), thick, brush.any())
    outer = band.outline * (1, 1)
    outer[:, 0] = 0.5 + (outer[:, 0] - 0.5) * 0.5 / np.ptp(outer[:, 1]) * 2
    inner = band.holes[0] * (1, 1)
    scale = (1 - 2 * thick) / np.ptp(inner[:, 0])
    inner[:, 0] = 0.5 + (inner[:, 0] - 0.5) * scale
    return [Part(outer, band.colour, 0.8, rng.uniform(0, 1), holes=(inner,))]


def _composite(rng: np.random.Generator, brush: Brush) -> Shape:
    """Two to five random pieces that overlap: toys, drills, parts with no name."""
    main = box(0, 1, -0.1, 0.1) * (1, rng.uniform(0.4, 1.8))
    parts = [_piece(rng, brush, main)]
    for _ in range(rng.integers(1, 5)):
        length, half = rng.uniform(0.15, 0.6), rng.uniform(0.03, 0.18)
        piece = box(-length / 2, length / 2, -half, half, rng.uniform(0, half))
        if chance(rng, 0.3):
            piece = ellipse(0, 0, length / 2, half * 1.3)
        turn = rng.choice([0.0, np.pi / 2, rng.uniform(0, np.pi)])
        spot = (rng.uniform(0.05, 0.95), rng.uniform(-0.06, 0.06))
        parts.append(_piece(rng, brush, moved(piece, turn, *spot)))
    return parts


def _piece(rng: np.random.Generator, brush: Brush, outline: Outline) -> Part:
    return Part(
        outline, brush.any(), rng.uniform(0, 1), rng.uniform(0, 0.8), prints=brush.prints(0.3)
    )


def _fruit(rng: np.random.Generator, brush: Brush) -> Shape:
    angle = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    radius = 0.5 + sum(
        rng.normal(0, 0.03 / k) * np.cos(k * angle + rng.uniform(0, 6)) for k in (2, 3, 4)
    )
    outline = np.stack([radius * np.cos(angle), radius * np.sin(angle) * rng.uniform(0.82, 1)], -1)
    body = Part(outline, brush.vivid(), 1.0, rng.uniform(0, 0.7), prints=brush.prints(0.3))
    parts = [body]
    if chance(rng, 0.5):
        spot = moved(ellipse(0, 0, 0.07, 0.04), rng.uniform(0, 3), *rng.uniform(-0.3, 0.3, 2))
        parts.append(Part(spot, brush.dark(), decal=True))
    return parts


def _square_box(rng: np.random.Generator, brush: Brush) -> Shape:
    return _carton(rng, brush, rng.uniform(0.38, 0.46))


def _disc(rng: np.random.Generator, brush: Brush) -> Shape:
    """Lids, coins, rolls of tape and bowls."""
    outline = ellipse(0, 0, 0.5, 0.5 * rng.uniform(0.9, 1))
    roundness = rng.choice([-0.8, 0.1, 0.8])
    parts = [Part(outline, brush.any(), roundness, rng.uniform(0, 0.8), prints=brush.prints(0.4))]
    inner = rng.uniform(0.15, 0.42)
    if chance(rng, 0.7):
        parts.append(Part(ellipse(0, 0, inner, inner), brush.any(), -0.5, 0.4))
    return parts


def _mug(rng: np.random.Generator, brush: Brush) -> Shape:
    colour = brush.any()
    radius = rng.uniform(0.36, 0.41)
    reach = 1 - 2 * radius
    handle = box(-reach, 0.1, -0.06, 0.06, 0.04) * (1, rng.uniform(0.5, 1.3))
    rim = ellipse(radius, 0, radius, radius)
    inside = ellipse(radius, 0, radius * 0.88, radius * 0.88)
    inner = scaled(colour, 0.35) if chance(rng, 0.5) else brush.any()
    return [
        Part(handle, colour, 0.9, 0.4),
        Part(rim, colour, 0.4, 0.6),
        Part(inside, inner, -1.0, 0.4),
    ]


ELONGATED_GOODS: dict[str, Builder] = {
    "bottle": _bottle,
    "can": _can,
    "tube": _tube,
    "carton": _carton,
    "bag": _bag,
    "bent": _bent,
    "tapered": _tapered,
    "ring": _ring,
    "composite": _composite,
}
COMPACT_GOODS: dict[str, Builder] = {
    "fruit": _fruit,
    "square_box": _square_box,
    "disc": _disc,
    "mug": _mug,
}
