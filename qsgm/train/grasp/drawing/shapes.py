"""The families of objects that can be drawn, by kind.

A builder turns random numbers and a Brush into a shape: a list of parts in painting order.
"""

import numpy as np

from qsgm.errors import QsgmError
from qsgm.train.grasp.drawing.goods import COMPACT_GOODS, ELONGATED_GOODS
from qsgm.train.grasp.drawing.noise import Colour, chance, drawn_from
from qsgm.train.grasp.drawing.parts import Brush, Builder, Shape
from qsgm.train.grasp.drawing.render import fitted
from qsgm.train.grasp.drawing.tools import TOOLS

ELONGATED: dict[str, Builder] = ELONGATED_GOODS | TOOLS
COMPACT: dict[str, Builder] = COMPACT_GOODS
OBJECT_KINDS: tuple[str, ...] = (*ELONGATED, *COMPACT)

TRIES = 4  # at an object that shows on its table

_ELONGATED_SHARE = 0.85
_LEAST_ELONGATION = 1.42  # of the drawn outline; leaves room for the pixels' rounding to 1.35
_LEAST_PX = 6.5
_OBJECT_WEIGHTS = {
    "bottle": 3.0,
    "can": 2.0,
    "carton": 2.2,
    "bag": 2.2,
    "bent": 1.3,
    "tapered": 1.3,
    "composite": 1.8,
    "handle_tool": 1.6,
    "ring": 0.4,
}


def chosen_object(rng: np.random.Generator, kind: str | None, elongated: bool | None) -> str:
    """The kind asked for, or one at random: 85 % are elongated unless `elongated` says.

    Raises QsgmError for a kind that is not in OBJECT_KINDS.
    """
    if kind is None:
        if elongated is None:
            elongated = chance(rng, _ELONGATED_SHARE)
        return drawn_from(rng, tuple(ELONGATED if elongated else COMPACT), _OBJECT_WEIGHTS)
    if kind not in OBJECT_KINDS:
        raise QsgmError(f"unknown object kind {kind!r}: expected one of {', '.join(OBJECT_KINDS)}")
    return kind


def random_length(rng: np.random.Generator) -> float:
    """Long side of an object [px], 55 to 115."""
    return float(rng.uniform(70, 105) if chance(rng, 0.8) else rng.uniform(55, 115))


def random_shape(rng: np.random.Generator, kind: str, table: Colour, long_px: float) -> Shape:
    """A new object of a kind, fitted to ``long_px``; ``table`` is the mean colour it lies on."""
    builder, least = (ELONGATED, _LEAST_ELONGATION) if kind in ELONGATED else (COMPACT, 1.0)
    return fitted(builder[kind](rng, Brush(rng, table)), long_px, least, _LEAST_PX)
