"""The geometry of a sequential network, counted once: sides, positions, windows, numbers.

Everything that a graph builder, a training loop or a report has to know of a network beside its
weights. Layers are numbered from 1; sizes are (height, width), and a 1-D network has height 1.
"""

from dataclasses import asdict, dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, get_args

from qsgm.errors import QsgmError

Pair = tuple[int, int]  # height, width
# u8 inputs are pixels, which the network sees in [-1, 1]; float32 ones are seen as they are.
InputKind = Literal["pixels", "numbers"]
ONE: Pair = (1, 1)
NONE: Pair = (0, 0)
MOST_LAYERS = 64
LARGEST_SIDE = 4096
WIDEST = 4096


@dataclass(frozen=True)
class Layer:
    """A convolution, then ReLU and an average pool where set."""

    into: int  # channels
    out: int
    kernel: Pair = ONE
    stride: Pair = ONE
    padding: Pair = NONE  # zeros, on both sides
    relu: bool = True
    pool: Pair = ONE  # its window; (1, 1): none
    pool_stride: Pair = ONE

    @property
    def weights(self) -> int:
        """Numbers in its weight and its bias."""
        return self.out * (self.window + 1)

    @property
    def window(self) -> int:
        """Numbers that one output is computed of: kh * kw * into."""
        return self.kernel[0] * self.kernel[1] * self.into

    def convolved(self, side: Pair) -> Pair:
        """The map that the convolution makes of one of this size."""
        height, width = (
            (length + 2 * pad - kernel) // stride + 1
            for length, pad, kernel, stride in zip(
                side, self.padding, self.kernel, self.stride, strict=True
            )
        )
        return height, width

    def pooled(self, side: Pair) -> Pair:
        """The map that the pool makes of one of this size."""
        height, width = (
            (length - pool) // stride + 1
            for length, pool, stride in zip(side, self.pool, self.pool_stride, strict=True)
        )
        return height, width


def conv(
    into: int,
    out: int,
    kernel: int | Pair = 1,
    *,
    stride: int | Pair = 1,
    padding: int | Pair = 0,
    relu: bool = True,
    pool: int | Pair = 1,
    pool_stride: int | Pair = 1,
) -> Layer:
    """A layer whose sizes may be given as one number for both directions."""
    return Layer(
        into,
        out,
        _pair(kernel),
        _pair(stride),
        _pair(padding),
        relu,
        _pair(pool),
        _pair(pool_stride),
    )


@dataclass(frozen=True)
class Network:
    """Layers one after the other, and what the first of them is given.

    Raises:
        QsgmError: the layers do not fit each other or the input; names the first that does not.
    """

    input_shape: tuple[int, int, int]  # height, width, channels
    layers: tuple[Layer, ...]
    input_kind: InputKind = "pixels"

    def __post_init__(self) -> None:
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise QsgmError(f"a network has 1 to {MOST_LAYERS} layers, got {len(self.layers)}")
        if self.input_kind not in get_args(InputKind):
            raise QsgmError(f"inputs are pixels or numbers, got {self.input_kind!r}")
        if not all(1 <= side <= LARGEST_SIDE for side in self.input_shape):
            raise QsgmError(f"an input has sides from 1 to {LARGEST_SIDE}, got {self.input_shape}")
        self._check_channels()
        for number, layer in enumerate(self.layers, 1):
            _check_sizes(number, layer)
        for number, layer in enumerate(self.layers, 1):
            if min(self.after(number)) < 1:
                raise QsgmError(
                    f"layer {number} has nothing to see: a kernel {layer.kernel} with a pool "
                    f"{layer.pool} on maps of {self.before(number)}"
                )
        if area(self.after(self.depth)) != 1:
            raise QsgmError(
                f"the last layer gives maps of {self.after(self.depth)}, expected one position: "
                "add a pool or a layer as large as its map"
            )

    @property
    def depth(self) -> int:
        """How many layers there are."""
        return len(self.layers)

    @property
    def outputs(self) -> int:
        """Channels of the last layer."""
        return self.layers[-1].out

    def layer(self, number: int) -> Layer:
        """A layer by its number, from 1."""
        return self.layers[number - 1]

    def last(self, tuned: int) -> range:
        """Numbers of the last `tuned` layers. Raises QsgmError unless there are as many."""
        if not 1 <= tuned <= self.depth:
            raise QsgmError(f"cannot tune the last {tuned} layers: choose 1 to {self.depth}")
        return range(self.depth + 1 - tuned, self.depth + 1)

    def before(self, number: int) -> Pair:
        """Sides of the map that a layer sees."""
        return self._maps[number - 1]

    def convolved(self, number: int) -> Pair:
        """Sides of the map that a layer's convolution makes, in front of its pool."""
        return self.layer(number).convolved(self.before(number))

    def after(self, number: int) -> Pair:
        """Sides of the map that a layer gives."""
        return self._maps[number]

    def channels_before(self, number: int) -> int:
        """Channels of what a layer sees."""
        return self.layer(number).into

    def positions_before(self, number: int) -> int:
        """Positions in the map that a layer sees."""
        return area(self.before(number))

    def windows(self, number: int) -> int:
        """Positions at which a layer's convolution looks."""
        return area(self.convolved(number))

    def positions_after(self, number: int) -> int:
        """Positions in the map that a layer gives."""
        return area(self.after(number))

    def pools_all(self, number: int) -> bool:
        """Whether a layer's pool covers the whole map that its convolution makes of a sample."""
        layer = self.layer(number)
        return layer.pool != ONE and layer.pool == self.convolved(number)

    def macs(self, number: int) -> int:
        """Multiply-adds of a layer's convolution on one sample."""
        return self.windows(number) * self.layer(number).window * self.layer(number).out

    def sgm_kernel(self, number: int) -> Pair:
        """Windows of the SGM behind a layer: 3 along a side where there is one, else 1."""
        height, width = (3 if side > 1 else 1 for side in self.after(number))
        return height, width

    def to_json(self) -> dict[str, Any]:
        """Plain values, as the manifest has them."""
        return {
            "input_shape": list(self.input_shape),
            "input_kind": self.input_kind,
            "layers": [
                {name: _plain(value) for name, value in asdict(layer).items()}
                for layer in self.layers
            ],
        }

    @staticmethod
    def from_json(values: Any) -> "Network":
        """Read what :meth:`to_json` wrote, trusting nothing in it.

        Raises:
            QsgmError: it describes no network.
        """
        try:
            height, width, channels = values["input_shape"]
            layers = tuple(_layer_from(one) for one in values["layers"])
            kind: InputKind = values["input_kind"]
            return Network((_whole(height), _whole(width), _whole(channels)), layers, kind)
        except (KeyError, TypeError, ValueError) as error:
            raise QsgmError(f"this is no description of a network ({error})") from error

    @cached_property
    def _maps(self) -> tuple[Pair, ...]:
        """Sides of the maps: the input's, then those behind every layer."""
        maps = [(self.input_shape[0], self.input_shape[1])]
        for layer in self.layers:
            maps.append(layer.pooled(layer.convolved(maps[-1])))
        return tuple(maps)

    def _check_channels(self) -> None:
        if self.layers[0].into != self.input_shape[2]:
            raise QsgmError(
                f"layer 1 takes {self.layers[0].into} channels, the input has {self.input_shape[2]}"
            )
        for number, (layer, following) in enumerate(pairwise(self.layers), 1):
            if layer.out != following.into:
                raise QsgmError(
                    f"layer {number + 1} takes {following.into} channels, layer {number} gives "
                    f"{layer.out}"
                )


def area(side: Pair) -> int:
    """Positions in a map of this size."""
    return side[0] * side[1]


def _check_sizes(number: int, layer: Layer) -> None:
    """Refuse sizes that are none, or padding that a window could lie in alone."""
    positive = (layer.into, layer.out, *layer.kernel, *layer.stride, *layer.pool)
    if not all(1 <= size <= WIDEST for size in (*positive, *layer.pool_stride)):
        raise QsgmError(f"layer {number} has a size outside of 1 to {WIDEST}: {layer}")
    if not all(0 <= p < k for p, k in zip(layer.padding, layer.kernel, strict=True)):
        raise QsgmError(
            f"layer {number} is padded by {layer.padding}, expected less than its kernel "
            f"{layer.kernel}"
        )


def _plain(value: Any) -> Any:
    """A pair as JSON has it."""
    return list(value) if isinstance(value, tuple) else value


def _layer_from(values: Any) -> Layer:
    sizes = {
        name: _pair_from(values[name])
        for name in ("kernel", "stride", "padding", "pool", "pool_stride")
    }
    if type(values["relu"]) is not bool:
        raise TypeError("`relu` is no truth value")
    return Layer(_whole(values["into"]), _whole(values["out"]), relu=values["relu"], **sizes)


def _pair_from(values: Any) -> Pair:
    height, width = values
    return _whole(height), _whole(width)


def _whole(value: Any) -> int:
    if type(value) is not int:
        raise TypeError(f"{str(value)[:40]!r} is no whole number")
    return value


def _pair(size: int | Pair) -> Pair:
    return (size, size) if isinstance(size, int) else size
