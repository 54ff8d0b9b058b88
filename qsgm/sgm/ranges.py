"""What calibration saw of a tensor, channel by channel, and the range that int8 gets from it.

An observer is a histogram that never grows: values are counted and dropped. onnxruntime's
histogram calibrators keep every tensor in memory until the end, fail when a batch is smaller than
the others, and know tensors only, not channels; hence these.

Bins are intervals [k * 2^e, (k + 1) * 2^e) with integers k and e. A wider grid's bins are made of
whole bins of a finer one, and e depends on nothing but the extremes seen so far: the histogram is
the same, count for count, in whatever order and grouping values came.

Calibrators turn an observer into a range. Each looks at both ends of every channel.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.sgm.float import FloatArray, FoldedSgm
from qsgm.sgm.int8 import SgmRanges

BINS = 4096  # per channel; at least half of them lie within the extremes
# A grid finer than this times the largest magnitude could not be told from float32's own.
FINEST_BITS = 24
LEAST_EXPONENT = -149  # of float32's smallest number
# The percentile calibrator may clip one value in so many at either end.
CLIPPED_ONE_IN = 10_000
# Clips that the entropy calibrator tries, between one bin a level and the extremes.
ENTROPY_CLIPS = 128
NEXT_TO_NOTHING = 1e-4  # of a value, as in onnxruntime's
# A run that reaches so many times what a typical one reaches has blown up. Other runs would have to
# pay for it with nearly all of their codes.
BLOWN_UP = 8.0

# Numbers of several rows that are looked at side by side; and up to here float32 has powers of two.
LONG_ROW = 512
LARGEST_FACTOR = 2.0**126

Float64Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Span = tuple[FloatArray, FloatArray]  # low and high end of each channel, (C,) each


class Observer:
    """Counts the values of each channel of one tensor.

    Attributes:
        low, high: extremes (C,); inf and -inf before the first value.
        zeros: how many values were exactly zero, (C,).
        counts: values per bin, (C, BINS).
        exponent: e of each channel's bins, (C,).
        first: k of each channel's first bin, (C,).
    """

    def __init__(self, channels: int) -> None:
        self.low: FloatArray = np.full(channels, np.inf, np.float32)
        self.high: FloatArray = np.full(channels, -np.inf, np.float32)
        self.zeros: IntArray = np.zeros(channels, np.int64)
        self.counts: IntArray = np.zeros((channels, BINS), np.int64)
        self.exponent: IntArray = np.full(channels, LEAST_EXPONENT, np.int64)
        self.first: IntArray = np.zeros(channels, np.int64)

    def update(self, values: FloatArray) -> None:
        """Look at values (..., C) before they are dropped. Raises QsgmError unless all finite."""
        flat = values.reshape(-1, values.shape[-1])
        if not len(flat):
            return
        low, high = by_channel(np.minimum, flat), by_channel(np.maximum, flat)
        if not np.isfinite([low, high]).all():
            raise QsgmError(
                f"calibration saw values from {low.min():g} to {high.max():g}, expected finite"
                " ones: the checkpoint's SGMs and rates do not work; pretrain again"
            )
        if (low < self.low).any() or (high > self.high).any():
            self._cover(low, high)
        bins = bin_numbers_of_many(flat, self.exponent, positive=bool((low >= 0).all()))
        bins += (np.arange(len(low)) * BINS - self.first).astype(np.int32)
        np.add.at(self.counts.reshape(-1), bins.reshape(-1), 1)
        self.zeros += by_channel(np.add, flat == 0)

    def merge(self, other: "Observer") -> None:
        """Take in what another observer of the same tensor has seen."""
        self._cover(other.low, other.high)
        self.counts += regridded(other, self.exponent, self.first)
        self.zeros += other.zeros

    def edges(self) -> Float64Array:
        """The ends of the bins, (C, BINS + 1)."""
        k = (self.first[:, None] + np.arange(BINS + 1)).astype(np.float64)
        return k * np.ldexp(1.0, self.exponent)[:, None]

    def _cover(self, low: FloatArray, high: FloatArray) -> None:
        """Move to the grid of the values seen and those about to come."""
        # Not in place: calibrators give these arrays away.
        self.low, self.high = np.minimum(self.low, low), np.maximum(self.high, high)
        exponent, first = grid(self.low, self.high)
        if (exponent != self.exponent).any() or (first != self.first).any():
            self.counts = regridded(self, exponent, first)
            self.exponent, self.first = exponent, first


def bin_numbers(values: NDArray[Any], exponent: IntArray) -> IntArray:
    """The k of the bin that each value (..., C) lies in; exact, as 2^e is a power of two."""
    k: IntArray = np.floor(values * np.ldexp(1.0, -exponent)).astype(np.int64)
    return k


def bin_numbers_of_many(
    values: FloatArray, exponent: IntArray, *, positive: bool
) -> NDArray[np.int32]:
    """:func:`bin_numbers` of values (N, C) for which the grid was made, and so below 2^24.

    In float32, which is quicker, a product with a power of two is exact where that is at least 1
    and not infinite.
    """
    factor = np.ldexp(1.0, -exponent)
    if factor.min() >= 1 and factor.max() <= LARGEST_FACTOR:
        factor = factor.astype(np.float32)
    scaled = values * factor
    return (scaled if positive else np.floor(scaled)).astype(np.int32)


def by_channel(operation: np.ufunc, values: NDArray[Any]) -> NDArray[Any]:
    """An operation over the rows of (N, C): (C,). Numpy's own is slow where a row is short."""
    count, channels = values.shape
    rows = max(1, LONG_ROW // channels)
    whole = count - count % rows
    if whole:
        wide = operation.reduce(values[:whole].reshape(-1, rows * channels), axis=0)
        values = np.concatenate([wide.reshape(rows, channels), values[whole:]])
    found: NDArray[Any] = operation.reduce(values, axis=0)
    return found


def grid(low: FloatArray, high: FloatArray) -> tuple[IntArray, IntArray]:
    """The finest bins of which BINS hold the span (C,): their exponent and the first one's k."""
    seen = low <= high
    bottom = np.where(seen, low, 0).astype(np.float64)
    top = np.where(seen, high, 0).astype(np.float64)
    exponent = np.maximum(
        exponent_above(np.maximum(-bottom, top)) - FINEST_BITS,
        exponent_above((top - bottom) / BINS),
    ).clip(LEAST_EXPONENT)
    # Where the span's ends do not fall on bins' ends it may take one bin too many.
    many = bin_numbers(top, exponent) - bin_numbers(bottom, exponent) >= BINS
    exponent = exponent + many
    return exponent, bin_numbers(bottom, exponent)


def exponent_above(x: Float64Array) -> IntArray:
    """The e for which 2^(e-1) <= |x| < 2^e; LEAST_EXPONENT for zero."""
    return np.where(x == 0, LEAST_EXPONENT, np.frexp(x)[1]).astype(np.int64)


def regridded(seen: Observer, exponent: IntArray, first: IntArray) -> IntArray:
    """An observer's counts (C, BINS) on a grid that is as wide as its own, or wider."""
    channel, number = np.nonzero(seen.counts)
    # No k is as long as 62 bits, and no shift may be longer than 63.
    wider = (exponent - seen.exponent).clip(0, 62)
    k = (seen.first[channel] + number) >> wider[channel]
    counts = np.zeros_like(seen.counts)
    np.add.at(counts, (channel, k - first[channel]), seen.counts[channel, number])
    return counts


# (what was seen, number of codes) -> range
Calibrator = Callable[[Observer, int], Span]


def min_max(seen: Observer, levels: int) -> Span:  # noqa: ARG001
    """Everything that was seen."""
    return seen.low, seen.high


def percentile(seen: Observer, levels: int) -> Span:  # noqa: ARG001
    """All values but the outermost 0.01 % at either end, and the rest of the bins they end in."""
    edges, upto = seen.edges(), seen.counts.cumsum(axis=1)
    total = upto[:, -1:]
    cut = total // CLIPPED_ONE_IN
    channels = np.arange(len(total))
    low = edges[channels, (upto > cut).argmax(axis=1)]
    high = edges[channels, (upto >= total - cut).argmax(axis=1) + 1]
    return within(seen, low, high)


def mean_squared_error(seen: Observer, levels: int) -> Span:
    """The range with the smallest expected error squared, clipping's and rounding's together.

    Rounding to steps of (high - low) / (levels - 1) costs a twelfth of a step squared per value
    (Bennett 1948). Not so exact zeros, of which ReLU makes many: they have a code of their own. The
    sum is convex in (low, high): taking the best of either end in turn finds its minimum, to a bin.
    """
    origin = seen.low.astype(np.float64)[:, None]
    span = seen.high.astype(np.float64)[:, None] - origin
    # Of the span, so that float64 holds the squares of a tail beside those of the rest.
    ends = ((seen.edges() - origin) / np.where(span > 0, span, 1)).clip(0, 1)
    lows, highs = ends[:, :-1], ends[:, 1:]
    below = clipping_error(seen.counts, ends)
    above = clipping_error(seen.counts[:, ::-1], 1 - ends[:, ::-1])[:, ::-1]
    rounding = (seen.counts.sum(axis=1) - seen.zeros)[:, None] / (12 * (levels - 1) ** 2)

    low, high = lows[:, :1], highs[:, -1:]
    for _ in range(BINS):
        before = low, high
        best = (above + (highs - low) ** 2 * rounding).argmin(axis=1)
        high = np.take_along_axis(highs, best[:, None], axis=1)
        best = (below + (high - lows) ** 2 * rounding).argmin(axis=1)
        low = np.take_along_axis(lows, best[:, None], axis=1)
        if np.array_equal((low, high), before):
            break
    return within(seen, (origin + low * span)[:, 0], (origin + high * span)[:, 0])


def clipping_error(counts: IntArray, ends: Float64Array) -> Float64Array:
    """Sum of squares that clipping to each bin's low end costs the values below it.

    Args:
        counts: (C, N).
        ends: of the bins, (C, N + 1); their values are taken to lie in the middle.

    Returns:
        (C, N).
    """
    low, centre = ends[:, :-1], (ends[:, :-1] + ends[:, 1:]) / 2
    moments = [counts, counts * centre, counts * centre**2]
    number, first, second = (moment.cumsum(axis=1) - moment for moment in moments)
    cost: Float64Array = low**2 * number - 2 * low * first + second
    return cost


def entropy(seen: Observer, levels: int) -> Span:
    """The range in which codes tell most of the distribution, as TensorRT's calibrator has it.

    Of the values clipped to +-t, that is the smallest Kullback-Leibler divergence from their
    histogram, with what is clipped in its outermost bins, to the same histogram in `levels` steps.
    Exact zeros are left out: they have a code of their own, and would drown the rest.
    """
    counts = seen.counts.copy()
    with_zeros = np.flatnonzero(seen.zeros)
    counts[with_zeros, -seen.first[with_zeros]] -= seen.zeros[with_zeros]
    used = bin_numbers(seen.high, seen.exponent) - seen.first + 1
    clips = np.array(
        [
            entropy_clip(row[:bins], int(first), levels)
            for row, bins, first in zip(counts, used, seen.first, strict=True)
        ]
    )
    low, high = np.take_along_axis(seen.edges(), clips, axis=1).T
    return within(seen, low, high)


def entropy_clip(counts: IntArray, first: int, levels: int) -> tuple[int, int]:
    """The bins [start, end) of one channel (bins) to keep; `first`: the first one's k.

    No clip has fewer bins than levels, unless there are no more: it would seem to lose nothing. Of
    equals it is the widest.
    """
    bins = len(counts)
    clip = np.arange(max(first, -first - bins, 0), max(-first, first + bins)) + 1  # t in bins
    starts, ends = (-clip - first).clip(0), (clip - first).clip(None, bins)
    wide = np.flatnonzero(ends - starts >= min(levels, bins))
    some = np.unique(np.linspace(0, len(wide) - 1, ENTROPY_CLIPS).astype(int))
    tried = wide[some][::-1]
    losses = [divergence(counts, starts[i], ends[i], levels) for i in tried]
    best = tried[int(np.argmin(losses))]
    return int(starts[best]), int(ends[best])


def divergence(counts: IntArray, start: int, end: int, levels: int) -> float:
    """Kullback-Leibler divergence [nats] of bins (N,) clipped to [start, end) and then in steps.

    A step spreads its values evenly over those of its bins that are not empty. What was clipped may
    lie in a step that has none of its own: there is :data:`NEXT_TO_NOTHING` instead.
    """
    kept = counts[start:end]
    clipped = kept.astype(np.float64)
    clipped[0] += counts[:start].sum()
    clipped[-1] += counts[end:].sum()
    filled = clipped > 0
    step = np.arange(len(kept)) * levels // len(kept)
    spread = np.bincount(step, kept) / np.maximum(np.bincount(step, filled), 1)
    p, q = clipped[filled], np.maximum(spread[step][filled], NEXT_TO_NOTHING)
    p, q = p / max(p.sum(), 1), q / q.sum()
    return float(p @ np.log(p / q))


def within(seen: Observer, low: Float64Array, high: Float64Array) -> Span:
    """A range (C,), no wider than what was seen."""
    return (
        low.clip(seen.low, seen.high).astype(np.float32),
        high.clip(seen.low, seen.high).astype(np.float32),
    )


# By name; of equals, the earlier one is taken.
CALIBRATORS: dict[str, Calibrator] = {
    "minmax": min_max,
    "percentile": percentile,
    "mse": mean_squared_error,
    "entropy": entropy,
}


class SgmObservers:
    """Observers of everything in one SGM that gets a range: its activation, its hidden tensors."""

    def __init__(self, sgm: FoldedSgm) -> None:
        self._labels = sgm.labels
        self._activation = Observer(len(sgm.convs[-1].bias))
        self._hidden = [Observer(len(conv.bias)) for conv in sgm.convs[:-1]]
        # The largest value of each tensor, by run.
        self._tops: list[list[float]] = []

    def update(self, seen: FloatArray, hidden: list[FloatArray]) -> None:
        """One batch: inputs (B, P, Ci) and hidden tensors (B, P, H), after ReLU."""
        self._activation.update(seen[..., : -self._labels])
        for observer, values in zip(self._hidden, hidden, strict=True):
            observer.update(values)

    def merge(self, other: "SgmObservers") -> None:
        """Take in what was seen in another run."""
        self._activation.merge(other._activation)
        for observer, others in zip(self._hidden, other._hidden, strict=True):
            observer.merge(others)
        self._tops += other.tops()

    def tops(self) -> list[list[float]]:
        """The largest value of each tensor, by merged run; of what was seen, if none was merged."""
        tensors = [self._activation, *self._hidden]
        return self._tops or [[float(tensor.high.max()) for tensor in tensors]]

    def ranges(self, calibrator: str, levels: int, labels: Span) -> SgmRanges:
        """What a calibrator makes of it, for so many codes; labels have a range of their own.

        No range is wider than :data:`BLOWN_UP` times a typical run's.
        """
        span = CALIBRATORS[calibrator]
        low, high = span(self._activation, levels)
        limit, *limits = BLOWN_UP * np.median(self.tops(), axis=0).astype(np.float32)
        hidden = (span(observer, levels)[1] for observer in self._hidden)
        return SgmRanges(
            np.concatenate([np.minimum(low, limit), labels[0]]),
            np.concatenate([np.minimum(high, limit), labels[1]]),
            tuple(np.minimum(high, top) for high, top in zip(hidden, limits, strict=True)),
        )
