"""The layers' convolutions on a crop, from which costs are counted."""

from dataclasses import dataclass
from math import isqrt

import numpy as np

from qsgm.blocks import LAYERS, Blocks
from qsgm.bundle import FLOAT_BYTES, Bundle, head_file
from qsgm.tune.loop import BATCH

STRIDES = (2, 2, 2, 2, 1, 1)
POOLED = 4  # of a crop, the pool behind it leaves one position

# What each layer leaves per crop: convolution and ReLU, and the pool's one position.
OUTPUTS_PER_CROP = {
    1: 8 * 2 * 62**2,
    2: 8 * 2 * 29**2,
    3: 16 * 2 * 13**2,
    4: 16 * (2 * 5**2 + 1),
    5: 16 * 2,
    6: 3,
}


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


def output_bytes(blocks: Blocks, batch: int = BATCH) -> dict[str, int]:
    """Bytes of layer outputs that have to be alive at once while these layers are trained.

    Counted in float32: a layer's convolution, ReLU and pool (its batchnorm is folded here), which
    is how the paper's Table 3 counts layers 4 and 5; of layers 1 to 3 it counts one tensor.
    Backpropagation keeps those of all layers for the way back. With SGMs a block is done before
    the next one runs, so it is the largest block's. Windows, weights and features are not counted,
    nor is what SGMs and gradients take on the way.
    """
    outputs = [
        sum(FLOAT_BYTES * batch * OUTPUTS_PER_CROP[k] for k in block) for block in blocks.groups
    ]
    return {"sgm": max(outputs), "backprop": sum(outputs)}
