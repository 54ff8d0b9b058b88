"""A convolution's weight in its two layouts: ONNX's Conv and the training steps' product."""

import numpy as np
from numpy.typing import NDArray

from qsgm.network import Pair

Array = NDArray[np.float32]


def to_step_layout(weight: Array) -> Array:
    """(Co, Ci, kh, kw) to (Co, kh * kw * Ci), the order in which a step cuts its windows."""
    return np.ascontiguousarray(weight.transpose(0, 2, 3, 1).reshape(len(weight), -1))


def to_conv_layout(weight: Array, kernel: Pair) -> Array:
    """(Co, kh * kw * Ci) back to (Co, Ci, kh, kw)."""
    windows = weight.reshape(len(weight), *kernel, -1)
    return np.ascontiguousarray(windows.transpose(0, 3, 1, 2))
