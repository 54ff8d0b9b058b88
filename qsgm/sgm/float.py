"""A static SGM with its batchnorm folded: convolutions in float32, as plain arrays."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from qsgm.weights import to_step_layout

FloatArray = NDArray[np.float32]
Number = TypeVar("Number", np.uint8, np.float32)


@dataclass(frozen=True)
class FoldedConv:
    """A convolution of an SGM, padded to keep the size."""

    weight: FloatArray  # (O, I, k, k)
    bias: FloatArray  # (O,)


@dataclass(frozen=True)
class FoldedSgm:
    """The SGM behind layer `layer`: convolutions with ReLU between."""

    layer: int
    convs: tuple[FoldedConv, ...]

    @property
    def kernel(self) -> int:
        """Side of all its windows: 3 behind layers 1 to 3, where maps are, else 1."""
        return int(self.convs[0].weight.shape[2])


def padded_windows(x: NDArray[Number], kernel: int, frame: NDArray[Any]) -> NDArray[Number]:
    """Every position's window (N, P, kernel * kernel * C) of square maps (N, P, C).

    Around the maps every position holds `frame` (C,). For 1x1 they are returned as they are.
    """
    if kernel == 1:
        return x
    count, positions, channels = x.shape
    side, pad = round(positions**0.5), kernel // 2
    framed = np.tile(frame.astype(x.dtype), (count, side + 2 * pad, side + 2 * pad, 1))
    framed[:, pad:-pad, pad:-pad] = x.reshape(count, side, side, channels)
    windows = np.lib.stride_tricks.sliding_window_view(framed, (kernel, kernel), axis=(1, 2))
    return windows.transpose(0, 1, 2, 4, 5, 3).reshape(count, positions, -1)


def float_product(conv: FoldedConv, x: FloatArray) -> FloatArray:
    """A padded convolution of square maps (B, P, I): (B, P, O)."""
    windows = padded_windows(x, conv.weight.shape[2], np.zeros(x.shape[2], np.float32))
    flat = windows.reshape(-1, windows.shape[2]) @ to_step_layout(conv.weight).T + conv.bias
    return flat.reshape(*x.shape[:2], -1)


# (convolution, maps (B, P, I)) -> maps (B, P, O)
Product = Callable[[FoldedConv, FloatArray], FloatArray]


def float_trace(
    sgm: FoldedSgm, seen: FloatArray, product: Product = float_product
) -> tuple[FloatArray, list[FloatArray]]:
    """An SGM in float: inputs (B, P, Ci) to gradient (B, P, C) and hidden tensors (B, P, H)."""
    x, hidden = seen, []
    for conv in sgm.convs[:-1]:
        x = np.maximum(product(conv, x), 0)
        hidden.append(x)
    return product(sgm.convs[-1], x), hidden
