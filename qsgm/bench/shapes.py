"""The layers' convolutions on a crop, from which costs are counted."""

from dataclasses import dataclass
from math import isqrt

import numpy as np

from qsgm.blocks import LAYERS
from qsgm.bundle import Bundle, head_file

STRIDES = (2, 2, 2, 2, 1, 1)
POOLED = 4  # of a crop, the pool behind it leaves one position


@dataclass(frozen=True)
class Shape:
    """A layer's convolution on a crop."""

    number: int
    weight: tuple[int, ...]  # (Co, Ci, kh, kw)
    side: int  # of its input map

    @property
    def channels(self) -> int:
        return self.weight[0]

    @property
    def products(self) -> int:
        """Multiply-adds at one position: as many as weights."""
        return int(np.prod(self.weight))

    @property
    def positions(self) -> int:
        """Of the map that the convolution makes."""
        return ((self.side - self.weight[2]) // STRIDES[self.number - 1] + 1) ** 2

    @property
    def positions_behind(self) -> int:
        """Of the layer's output, which its SGM sees."""
        return 1 if self.number == POOLED else self.positions


def layer_shapes(bundle: Bundle) -> tuple[Shape, ...]:
    """Of all layers that the bundle can tune."""
    shapes = []
    for tuned in range(bundle.most_layers, 0, -1):
        layer = LAYERS + 1 - tuned
        weight = tuple(bundle.manifest["initializers"][f"weight{layer}"]["shape"])
        (features,) = (
            value.shape
            for value in bundle.session(head_file(tuned)).get_inputs()
            if value.name == "features"
        )
        shapes.append(Shape(layer, weight, isqrt(features[1])))
    return tuple(shapes)
