"""Meta-learned curvature: what a layer's gradient is multiplied by before it becomes a step.

Park and Oliva 2019, *Meta-Curvature*, section 4: one small matrix per axis of a convolution's
weight, here its window's positions, its input channels and its output channels, and one for the
bias. Gradient descent with it is still a feed-forward update, since a layer needs nothing but its
own gradient; it moves further along directions that have paid on other objects.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import torch
from torch import Tensor

from qsgm.network import Layer
from qsgm.train.model.arrays import CurvatureArrays


@dataclass(frozen=True)
class Curvature:
    """One layer's matrices; each multiplies its axis of the gradient from the right."""

    window: Tensor  # (kh * kw, kh * kw), positions of the kernel
    into: Tensor  # (C_in, C_in)
    out: Tensor  # (C_out, C_out)
    bias: Tensor  # (C_out, C_out)

    @staticmethod
    def identity(layer: Layer) -> "Curvature":
        """Plain gradient descent."""
        sides = layer.kernel[0] * layer.kernel[1], layer.into, layer.out, layer.out
        return Curvature(*(torch.eye(side) for side in sides))

    @property
    def matrices(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Window, into, out, bias."""
        return self.window, self.into, self.out, self.bias

    def arrays(self) -> CurvatureArrays:
        """Plain arrays, as graphs take them."""
        return CurvatureArrays(*(matrix.detach().numpy() for matrix in self.matrices))

    def precondition(self, d_weight: Tensor, d_bias: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of weight (T, K, C_out), K ordered (kh, kw, C_in), and bias (T, C_out)."""
        tasks, _, channels = d_weight.shape
        windows = d_weight.view(tasks, len(self.window), len(self.into), channels) @ self.out
        windows = windows.transpose(2, 3) @ self.into  # (T, k * k, C_out, C_in)
        windows = torch.einsum("tpoi,pq->tqio", windows, self.window)
        return windows.reshape(d_weight.shape), d_bias @ self.bias


# No layer has a curvature: plain gradient descent.
FLAT: Mapping[int, Curvature] = MappingProxyType({})
