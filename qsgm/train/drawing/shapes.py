"""The families of objects that can be drawn, by kind.

A builder turns random numbers and a Brush into a shape: a list of parts in painting order.
"""

from qsgm.train.drawing.goods import COMPACT_GOODS, ELONGATED_GOODS
from qsgm.train.drawing.parts import Builder
from qsgm.train.drawing.tools import TOOLS

ELONGATED: dict[str, Builder] = ELONGATED_GOODS | TOOLS
COMPACT: dict[str, Builder] = COMPACT_GOODS
