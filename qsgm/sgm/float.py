"""A static SGM with its batchnorm folded: convolutions in float32, as plain arrays."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from qsgm.network import ONE, Pair
from qsgm.weights import to_step_layout

FloatArray = NDArray[np.float32]
Number = TypeVar("Number", np.uint8, np.float32)


@dataclass(frozen=True)
class FoldedConv:
    """A convolution of an SGM, padded to keep the size, or of a layer, with batchnorm in it."""

    weight: FloatArray  # (O, I, kh, kw)
    bias: FloatArray  # (O,)


@dataclass(frozen=True)
class FoldedSgm:
    """The SGM behind layer `layer`: convolutions with ReLU between."""

    layer: int
    side: Pair  # of the maps behind that layer
    convs: tuple[FoldedConv, ...]

    @property
    def kernel(self) -> Pair:
        """Sides of all its windows: 3 where maps are, else 1."""
        height, width = self.convs[0].weight.shape[2:]
        return height, width

    @property
    def labels(self) -> int:
        """Numbers of a label, which are the last inputs."""
        return int(self.convs[0].weight.shape[1]) - len(self.convs[-1].bias)


def padded_windows(
    x: NDArray[Number], side: Pair, kernel: Pair, frame: NDArray[Any]
) -> NDArray[Number]:
    """Every position's window (N, P, kh * kw * C) of maps (N, P, C) of this size.

    Around the maps every position holds `frame` (C,). For 1x1 they are returned as they are.
    """
    if kernel == ONE:
        return x
    count, positions, channels = x.shape
    (height, width), (up, left) = side, (kernel[0] // 2, kernel[1] // 2)
    framed = np.tile(frame.astype(x.dtype), (count, height + 2 * up, width + 2 * left, 1))
    framed[:, up : up + height, left : left + width] = x.reshape(count, height, width, channels)
    windows = np.lib.stride_tricks.sliding_window_view(framed, kernel, axis=(1, 2))
    return windows.transpose(0, 1, 2, 4, 5, 3).reshape(count, positions, -1)


def float_product(conv: FoldedConv, side: Pair, x: FloatArray) -> FloatArray:
    """A padded convolution of maps (B, P, I) of this size: (B, P, O)."""
    height, width = conv.weight.shape[2:]
    windows = padded_windows(x, side, (height, width), np.zeros(x.shape[2], np.float32))
    flat = windows.reshape(-1, windows.shape[2]) @ to_step_layout(conv.weight).T + conv.bias
    return flat.reshape(*x.shape[:2], -1)


# (convolution, sides of maps, maps (B, P, I)) -> maps (B, P, O)
Product = Callable[[FoldedConv, Pair, FloatArray], FloatArray]


def float_trace(
    sgm: FoldedSgm, seen: FloatArray, product: Product = float_product
) -> tuple[FloatArray, list[FloatArray]]:
    """An SGM in float: inputs (B, P, Ci) to gradient (B, P, C) and hidden tensors (B, P, H)."""
    x, hidden = seen, []
    for conv in sgm.convs[:-1]:
        x = np.maximum(product(conv, sgm.side, x), 0)
        hidden.append(x)
    return product(sgm.convs[-1], sgm.side, x), hidden
