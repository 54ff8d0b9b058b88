"""A small network that looks at the taught object and at what lies at a candidate, side by side.

Both pictures are moved and turned so that the object lies alike; the network says how likely they
show the same thing (two channels of one network, Zagoruyko and Komodakis 2015). It learnt that on
drawn objects (:mod:`qsgm.train.grasp.comparer`) and learns nothing on the device; what it says is
the strongest piece of evidence that :mod:`qsgm.grasp.decision` weighs. 24,000 weights of 8 bits.
"""

import base64
import binascii
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.grasp.cells import SIDE, Cells
from qsgm.grasp.correlation import NOISE_VARIANCE

Floats = NDArray[np.float32]

# The light of what is seen is made that of the demonstration, contrast within these bounds.
LEAST_GAIN, MOST_GAIN = 0.4, 2.5
LEVELS = 64.0  # that make 1
# Taught, seen and how far apart they are, three channels each, and the mask.
INPUTS = 10
KERNEL = 3
STRIDES = (2, 2, 2, 1)
LAST_SIDE = SIDE // 8
# How the last maps are summed up: their mean over the object, their largest, their mean.
SUMMARIES = 3
MOST_CHANNELS = 256
_LARGEST_CODE = 127
_TINY = 1e-3


@dataclass(frozen=True)
class Layer:
    """Weights of a convolution, or of a product behind the last maps."""

    weight: Floats  # (K, Co); of a convolution row by row, column by column, channel by channel
    bias: Floats  # (Co,)


@dataclass(frozen=True)
class Comparer:
    """Four convolutions of 3x3 and two products behind them, ReLU between."""

    convolutions: tuple[Layer, ...]
    hidden: Layer
    output: Layer

    def logits(self, cells: Cells, seen: NDArray[np.uint8]) -> Floats:
        """Log odds (N,) of what is seen (N, 64, 64, 3) being the object, at a glance."""
        return self._logits(side_by_side(cells, seen), _coarse(cells))

    def logits_all_ways(self, cells: Cells, seen: NDArray[np.uint8]) -> Floats:
        """Mean log odds (N,) by pictures laid in all eight ways: turned by quarters, mirrored.

        It learnt on all of them, and errs differently in each.
        """
        x, share = side_by_side(cells, seen), _coarse(cells)
        ways = [
            self._logits(np.rot90(some, quarters, (1, 2)), np.rot90(its, quarters))
            for some, its in ((x, share), (x[:, :, ::-1], share[:, ::-1]))
            for quarters in range(4)
        ]
        return np.asarray(np.mean(ways, axis=0), np.float32)

    def _logits(self, pictures: Floats, share: Floats) -> Floats:
        """Log odds (N,) by pictures (N, 64, 64, 10), and the object's share of the last maps."""
        x = pictures
        for layer, stride in zip(self.convolutions, STRIDES, strict=True):
            x = np.maximum(_windows(x, stride) @ layer.weight + layer.bias, np.float32(0))
        x = np.maximum(_summed_up(x, share) @ self.hidden.weight + self.hidden.bias, np.float32(0))
        return np.asarray((x @ self.output.weight + self.output.bias)[:, 0], np.float32)

    @property
    def layers(self) -> tuple[Layer, ...]:
        """All of them, front to back."""
        return (*self.convolutions, self.hidden, self.output)

    def to_json(self) -> dict[str, Any]:
        """What :meth:`from_json` reads: codes of 8 bits, and a scale for each channel."""
        codes, scales, biases = [], list[float](), list[float]()
        for layer in self.layers:
            scale = np.maximum(np.abs(layer.weight).max(axis=0) / _LARGEST_CODE, np.float32(1e-9))
            codes.append(np.rint(layer.weight / scale).astype(np.int8).tobytes())
            scales += [float(f"{value:.9g}") for value in scale]
            biases += [float(f"{value:.9g}") for value in layer.bias]
        return {
            "channels": [len(layer.bias) for layer in self.layers[:-1]],
            "codes": base64.b64encode(b"".join(codes)).decode(),
            "scales": scales,
            "biases": biases,
        }

    @staticmethod
    def from_json(values: Mapping[str, Any], where: str) -> "Comparer":
        """Read a comparer back.

        Raises:
            QsgmError: its numbers are not what they should be.
        """
        try:
            layers = _layers_from(values)
        except (KeyError, TypeError, ValueError, OverflowError, binascii.Error) as error:
            raise QsgmError(f"{where}: the comparer's numbers do not fit; {_ADVICE}") from error
        if not all(np.isfinite(one.weight).all() and np.isfinite(one.bias).all() for one in layers):
            raise QsgmError(f"{where}: the comparer's numbers are not finite; {_ADVICE}")
        return Comparer(tuple(layers[:-2]), *layers[-2:])


def _layers_from(values: Mapping[str, Any]) -> list[Layer]:
    """All layers. Raises what wrong values raise."""
    shapes = _shapes(_channels_from(values["channels"]))
    sizes, wide = ([rows * columns for rows, columns in shapes], [one for _, one in shapes])
    codes = np.frombuffer(base64.b64decode(values["codes"], validate=True), np.int8)
    with np.errstate(over="ignore"):  # infinity is refused by whoever asks
        scales, biases = (
            np.split(np.array(values[name], np.float32).reshape(sum(wide)), _ends(wide))
            for name in ("scales", "biases")
        )
    weights = np.split(codes.astype(np.float32).reshape(sum(sizes)), _ends(sizes))
    return [
        Layer(weight.reshape(shape) * scale, bias)
        for weight, shape, scale, bias in zip(weights, shapes, scales, biases, strict=True)
    ]


def _channels_from(values: Any) -> list[int]:
    channels = [int(count) for count in values]
    if len(channels) != len(STRIDES) + 1 or not all(1 <= one <= MOST_CHANNELS for one in channels):
        raise ValueError(f"channels are {channels}")
    return channels


_ADVICE = "make it again with this version of qsgm"


def side_by_side(cells: Cells, seen: NDArray[np.uint8]) -> Floats:
    """Taught, seen in the same light, their difference and the mask: (N, 64, 64, 10)."""
    solid = cells.solid[..., None]
    size = np.float32(cells.solid.sum() + _TINY)
    taught, here = cells.image[None], seen.astype(np.float32)
    mean, spread = _light(taught, solid, size)
    its_mean, its_spread = _light(here, solid, size)
    gain = np.clip(np.sqrt(spread / its_spread), LEAST_GAIN, MOST_GAIN)
    lit = (here - its_mean) * gain
    own = np.broadcast_to(taught - mean, lit.shape)
    mask = np.broadcast_to(2 * solid - 1, (*lit.shape[:3], 1))
    apart = np.abs(lit - own)
    levels = np.float32(LEVELS)
    return np.concatenate([own / levels, lit / levels, apart / levels, mask], axis=-1)


def _light(images: Floats, solid: Floats, size: np.float32) -> tuple[Floats, Floats]:
    """Mean (N, 1, 1, 3) and variance (N, 1, 1, 1), all channels together, over the mask."""
    mean = (images * solid).sum(axis=(1, 2), keepdims=True) / size
    around = (images - mean) * solid
    variance = (around * around).sum(axis=(1, 2, 3), keepdims=True) / size
    return mean, np.asarray(variance + np.float32(NOISE_VARIANCE), np.float32)


def _windows(maps: Floats, stride: int) -> Floats:
    """Windows (N, h, w, 9 C) of maps (N, H, W, C) with a row of zeros around them."""
    reach = KERNEL // 2
    padded = np.pad(maps, ((0, 0), (reach, reach), (reach, reach), (0, 0)))
    height, width = (side - KERNEL + 1 for side in padded.shape[1:3])
    taps = [
        padded[:, down : down + height : stride, right : right + width : stride]
        for down in range(KERNEL)
        for right in range(KERNEL)
    ]
    return np.concatenate(taps, axis=-1)


def _coarse(cells: Cells) -> Floats:
    """What each pixel of the last maps has of the object (8, 8); sums to 1."""
    each = SIDE // LAST_SIDE
    coarse = cells.solid.reshape(LAST_SIDE, each, LAST_SIDE, each).mean(axis=(1, 3))
    return np.asarray(coarse / (coarse.sum() + np.float32(_TINY)), np.float32)


def _summed_up(maps: Floats, share: Floats) -> Floats:
    """Mean over the object, largest and mean (N, 3 C) of the last maps (N, 8, 8, C)."""
    inside = (maps * share[..., None]).sum(axis=(1, 2))
    return np.concatenate([inside, maps.max(axis=(1, 2)), maps.mean(axis=(1, 2))], axis=1)


def _shapes(channels: Sequence[int]) -> list[tuple[int, int]]:
    """Weights' shapes (K, Co) of layers with these channels, the last of which gives one."""
    *convolved, hidden = channels
    into = [INPUTS, *convolved[:-1]]
    shapes = [
        (KERNEL * KERNEL * before, after) for before, after in zip(into, convolved, strict=True)
    ]
    return [*shapes, (SUMMARIES * convolved[-1], hidden), (hidden, 1)]


def _ends(sizes: Sequence[int]) -> list[int]:
    """Where each part but the last ends."""
    return [int(end) for end in np.cumsum(sizes)[:-1]]
