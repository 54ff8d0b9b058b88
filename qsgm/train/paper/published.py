"""The figures that Neven et al. (2020) print: Table 1 ("fixed SGMs") and Table 2, by object a to f.

Table 1's averages and spreads are not those of the six columns it shows, but of seven objects: the
seventh follows from the averages, and with it the spreads come out as printed. Table 2 leaves out
Table 1's c: its c, d and e are d, e and f there, and its f is the seventh.
"""

from collections.abc import Mapping
from dataclasses import dataclass

Six = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Published:
    """One metric of one system: a value per object, average and spread as printed."""

    values: Six
    average: float
    spread: float


@dataclass(frozen=True)
class PublishedSystem:
    """One system: share of crops detected rightly, and mean absolute angle error [deg]."""

    detection: Published
    angle: Published


TABLE_1: Mapping[str, PublishedSystem] = {
    "BP, 1 layer": PublishedSystem(
        Published((0.92, 0.98, 0.98, 0.98, 0.99, 0.98), 0.97, 0.02),
        Published((37.19, 23.04, 33.72, 25.62, 35.49, 16.20), 28.71, 6.99),
    ),
    "BP, 2 layers": PublishedSystem(
        Published((0.97, 0.98, 0.99, 0.99, 0.99, 1.00), 0.99, 0.01),
        Published((18.19, 17.65, 13.55, 20.56, 20.76, 6.63), 16.44, 4.57),
    ),
    "SGM, 2 layers": PublishedSystem(
        Published((0.92, 0.97, 0.98, 0.99, 0.99, 0.99), 0.97, 0.02),
        Published((29.21, 21.34, 21.09, 24.37, 33.25, 17.48), 24.07, 5.01),
    ),
    "BP, 3 layers": PublishedSystem(
        Published((0.99, 0.99, 1.00, 0.99, 1.00, 1.00), 1.0, 0.0),
        Published((5.71, 2.44, 3.82, 2.73, 3.02, 3.04), 3.45, 1.01),
    ),
    "SGM, 3 layers": PublishedSystem(
        Published((0.97, 0.99, 1.00, 0.99, 0.99, 0.99), 0.99, 0.01),
        Published((16.82, 8.59, 15.32, 14.35, 9.99, 13.71), 12.65, 2.94),
    ),
}

TABLE_2: Mapping[str, PublishedSystem] = {
    "trained, static": PublishedSystem(
        Published((0.92, 0.97, 0.99, 0.99, 0.99, 0.96), 0.97, 0.03),
        Published((29.21, 21.34, 24.37, 33.25, 17.48, 21.77), 24.57, 5.25),
    ),
    "trained, updating": PublishedSystem(
        Published((0.96, 0.98, 0.98, 0.99, 0.99, 0.98), 0.98, 0.01),
        Published((26.20, 20.05, 25.54, 28.95, 8.30, 19.58), 21.44, 6.76),
    ),
    "random, updating": PublishedSystem(
        Published((0.97, 0.98, 0.98, 0.99, 0.99, 0.97), 0.98, 0.01),
        Published((23.32, 18.87, 26.53, 30.56, 13.27, 22.22), 22.46, 5.48),
    ),
}
