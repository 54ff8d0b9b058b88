"""Observers count what numpy counts; calibrators find what a search over all values finds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from qsgm import QsgmError
from qsgm.sgm.float import FloatArray, FoldedConv, FoldedSgm
from qsgm.sgm.ranges import (
    BINS,
    CALIBRATORS,
    ENTROPY_CLIPS,
    Observer,
    SgmObservers,
    divergence,
    entropy,
    entropy_clip,
    mean_squared_error,
    min_max,
    percentile,
)

# Smallest and largest of a class, a sine and a cosine.
LABELS = np.float32([0, -1, -1]), np.float32([1, 1, 1])
finite = st.floats(allow_nan=False, allow_infinity=False, width=32)
# Everything that float32 holds, and everyday numbers, which bins do not tell apart on their own.
values_of_two_channels = arrays(
    np.float32,
    st.tuples(st.integers(1, 40), st.just(2)),
    elements=st.one_of(finite, st.floats(-8, 8, width=32), st.just(0.0)),
)


def observed(values: FloatArray) -> Observer:
    observer = Observer(values.shape[-1])
    observer.update(values)
    return observer


def assert_equal(got: Observer, expected: Observer) -> None:
    for name, value in vars(expected).items():
        np.testing.assert_array_equal(getattr(got, name), value, err_msg=name)


@given(values_of_two_channels)
def test_the_histogram_is_numpys(values: FloatArray) -> None:
    observer = observed(values)
    np.testing.assert_array_equal(observer.low, values.min(axis=0))
    np.testing.assert_array_equal(observer.high, values.max(axis=0))
    np.testing.assert_array_equal(observer.zeros, (values == 0).sum(axis=0))
    for channel, edges in enumerate(observer.edges()):
        # The last of numpy's bins is closed, the others are open above, as all are here.
        expected, _ = np.histogram(values[:, channel].astype(np.float64), np.append(edges, np.inf))
        np.testing.assert_array_equal(observer.counts[channel], expected[:-1])
        assert expected[-1] == 0


@given(values_of_two_channels, st.data())
def test_any_order_and_grouping_gives_the_same_histogram(
    values: FloatArray, data: st.DataObject
) -> None:
    order = data.draw(st.permutations(range(len(values))))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(values)), max_size=4)))
    whole, frames = observed(values), []
    for part in np.split(values[order], cuts):
        frame = Observer(2)
        for row in np.array_split(part, data.draw(st.integers(1, 3))):
            frame.update(row)
        frames.append(frame)
    merged = Observer(2)
    for frame in data.draw(st.permutations(frames)):
        merged.merge(frame)
    assert_equal(merged, whole)


@given(values_of_two_channels)
def test_half_of_the_bins_lie_within_the_extremes_unless_float32_has_no_finer_grid(
    values: FloatArray,
) -> None:
    observer = observed(values)
    width = np.ldexp(1.0, observer.exponent)
    span = observer.high.astype(np.float64) - observer.low
    magnitude = np.maximum(np.abs(observer.low), np.abs(observer.high)).astype(np.float64)
    finest = np.maximum(magnitude * 2.0**-23, 2.0**-149)
    assert ((width <= span / (BINS // 2 - 1)) | (width <= finest)).all()


@given(array_shapes(min_dims=1, max_dims=4, max_side=3))
def test_all_but_the_last_axis_are_samples(shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    observer = observed(values)
    assert observer.counts.sum(axis=1).tolist() == [values.size // shape[-1]] * shape[-1]
    assert_equal(observer, observed(values.reshape(-1, shape[-1])))


def test_what_an_observer_keeps_does_not_grow() -> None:
    rng = np.random.default_rng(0)
    observer = Observer(3)
    sizes = {name: array.nbytes for name, array in vars(observer).items()}
    for spread in (1e-3, 1, 1e6):
        observer.update(rng.normal(0, spread, (50, 7, 3)).astype(np.float32))
        observer.merge(observed(rng.normal(0, spread, (400, 3)).astype(np.float32)))
    assert {name: array.nbytes for name, array in vars(observer).items()} == sizes
    assert observer.counts.sum() == 3 * 3 * (50 * 7 + 400)


def test_a_range_given_away_stays_as_it_was() -> None:
    observer = observed(np.float32([[0], [1]]))
    low, high = min_max(observer, 256)
    observer.update(np.float32([[-5], [5]]))
    assert (low.item(), high.item()) == (0, 1)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_refused(bad: float) -> None:
    observer = Observer(2)
    with pytest.raises(QsgmError, match=r"expected finite ones.*pretrain again"):
        observer.update(np.float32([[0, 1], [2, bad]]))
    assert observer.counts.sum() == 0


@given(values_of_two_channels, st.sampled_from(sorted(CALIBRATORS)), st.sampled_from([256, 65536]))
def test_ranges_lie_within_what_was_seen(values: FloatArray, name: str, levels: int) -> None:
    observer = observed(values)
    low, high = CALIBRATORS[name](observer, levels)
    assert low.dtype == high.dtype == np.float32
    assert (observer.low <= low).all()
    assert (low <= high).all()
    assert (high <= observer.high).all()


@pytest.mark.parametrize("name", sorted(CALIBRATORS))
@pytest.mark.parametrize("value", [0, 3, -0.5, 1e-40])
def test_a_constant_channel_gets_its_value(name: str, value: float) -> None:
    observer = observed(np.full((20, 1), value, np.float32))
    low, high = CALIBRATORS[name](observer, 256)
    assert low == high == np.float32(value)


def heavy_tailed(kind: str, count: int = 40_000) -> FloatArray:
    """(count, 3): after ReLU, signed, and far from zero."""
    rng = np.random.default_rng(7)
    draw = {
        "normal": rng.normal,
        "laplace": rng.laplace,
        "student": lambda size: rng.standard_t(4, size),
    }[kind]
    x = draw(size=(count, 3))
    return np.stack([np.maximum(x[:, 0], 0), 30 * x[:, 1] - 4, np.exp(x[:, 2] / 8)], axis=1).astype(
        np.float32
    )


KINDS = ("normal", "laplace", "student")


@pytest.mark.parametrize("kind", KINDS)
def test_the_percentile_leaves_one_in_ten_thousand_at_either_end(kind: str) -> None:
    values = heavy_tailed(kind)
    observer = observed(values)
    low, high = percentile(observer, 256)
    width = np.ldexp(1.0, observer.exponent)
    ordered = np.sort(values, axis=0)
    assert ((ordered[4] - width < low) & (low <= ordered[4])).all()
    assert ((ordered[-5] <= high) & (high < ordered[-5] + width)).all()
    assert (high < values.max(axis=0)).all()


def test_the_percentile_of_fewer_values_is_all_of_them() -> None:
    values = heavy_tailed("student", 9_999)
    np.testing.assert_array_equal(
        percentile(observed(values), 256), [values.min(axis=0), values.max(axis=0)]
    )


def rounding_error(values: FloatArray, low: float, high: float, levels: int) -> float:
    """Mean squared error of values (N,) clipped to a range and rounded to its codes."""
    step = (high - low) / (levels - 1)
    codes = np.rint((values.astype(np.float64) - low) / step).clip(0, levels - 1)
    return float(np.mean((low + codes * step - values) ** 2))


@pytest.mark.parametrize("levels", [16, 256])
@pytest.mark.parametrize("kind", KINDS)
def test_no_range_rounds_and_clips_with_less_error_than_the_chosen_one(
    kind: str, levels: int
) -> None:
    values = heavy_tailed(kind)
    low, high = mean_squared_error(observed(values), levels)
    for channel, column in enumerate(values.T):
        error = rounding_error(column, low[channel], high[channel], levels)
        bottom, top = column.min(), column.max()
        middle = np.median(column)
        others = [
            rounding_error(
                column, middle + a * (bottom - middle), middle + b * (top - middle), levels
            )
            for a in np.linspace(0.02, 1, 30)
            for b in np.linspace(0.02, 1, 30)
        ]
        assert error < 1.05 * min(others)
        if kind == "student" and levels == 16:  # it was worth clipping
            assert error < 0.8 * rounding_error(column, bottom, top, levels)


def test_with_codes_to_spare_squared_errors_are_least_without_clipping() -> None:
    values = heavy_tailed("normal")
    low, high = mean_squared_error(observed(values), 65536)
    np.testing.assert_allclose(low, values.min(axis=0), atol=1e-2 * np.ptp(values))
    np.testing.assert_allclose(high, values.max(axis=0), rtol=1e-2)


def test_exact_zeros_do_not_count_as_rounded() -> None:
    values = heavy_tailed("student")[:, :1]
    sparse = np.concatenate([values, np.zeros((10**6, 1), np.float32)])
    np.testing.assert_array_equal(
        mean_squared_error(observed(sparse), 256), mean_squared_error(observed(values), 256)
    )
    np.testing.assert_array_equal(entropy(observed(sparse), 256), entropy(observed(values), 256))


def test_the_divergence_is_the_published_one() -> None:
    # TensorRT's example of how 8 bins become 2 steps (Migacz 2017, "8-bit inference with
    # TensorRT"): [1 0 2 3 | 5 3 1 7] -> [2 0 2 2 | 4 4 4 4].
    counts = np.array([1, 0, 2, 3, 5, 3, 1, 7])
    p, q = counts / 22, np.array([2, 1, 2, 2, 4, 4, 4, 4]) / 22
    expected = sum(p[i] * np.log(p[i] / q[i]) for i in range(8) if counts[i])
    assert divergence(counts, 0, 8, 2) == pytest.approx(expected, rel=1e-12)
    # What is clipped joins the outermost bins of the one histogram, not of the other.
    p, q = np.array([3, 3, 16]) / 22, np.array([2.5, 2.5, 5]) / 10
    expected = float(np.sum(p * np.log(p / q)))
    assert divergence(counts, 2, 5, 2) == pytest.approx(expected, rel=1e-12)
    # One in an empty step costs what onnxruntime's smoothing makes of it, and is never infinite.
    expected = 0.75 * np.log(0.75) + 0.25 * np.log(0.25 * 3 / 1e-4)
    assert divergence(np.array([3, 0, 0, 1]), 0, 2, 2) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("kind", KINDS)
def test_entropy_takes_the_clip_with_the_least_divergence(kind: str) -> None:
    values = heavy_tailed(kind)
    observer = observed(values)
    low, high = entropy(observer, 256)
    edges = observer.edges()
    for channel in range(3):
        column = values[:, channel]
        counts, _ = np.histogram(column[column != 0], edges[channel])
        start = np.searchsorted(edges[channel], low[channel], "right") - 1
        end = np.searchsorted(edges[channel], high[channel])
        chosen = divergence(counts, start, end, 256)
        bins = int(np.flatnonzero(observer.counts[channel])[-1]) + 1
        assert chosen <= divergence(counts, 0, bins, 256)
        # From one bin to the next the divergence jumps by more than clips apart differ, so that
        # only those which are tried can be compared.
        first = int(observer.first[channel])
        reach = max(-first, first + bins)  # in bins, of the value that is farthest from zero
        clips = [(max(-t - first, 0), min(t - first, bins)) for t in range(1, reach + 1)]
        wide = [(a, b) for a, b in clips if b - a >= 256]
        some = np.linspace(0, len(wide) - 1, ENTROPY_CLIPS).astype(int)
        assert chosen == min(divergence(counts, *wide[i], 256) for i in some)


def test_entropy_clips_a_lonely_outlier_and_nothing_where_codes_outnumber_bins() -> None:
    values = np.append(np.random.default_rng(0).exponential(size=50_000), 80)[:, None]
    observer = observed(values.astype(np.float32))
    assert entropy(observer, 256)[1].item() < 25
    assert entropy(observer, 65536)[1].item() == 80


def test_of_clips_that_lose_as_little_entropy_takes_the_widest() -> None:
    counts = np.zeros(1000, np.int64)
    counts[0] = 5
    assert entropy_clip(counts, 0, 256) == (0, 1000)


def test_every_number_is_counted_once() -> None:
    values = heavy_tailed("student")
    assert (observed(values).counts.sum(axis=1) == len(values)).all()


@pytest.mark.parametrize("levels", [256, 65536])
@pytest.mark.parametrize("name", sorted(CALIBRATORS))
def test_every_tensor_of_an_sgm_has_its_calibrators_range(name: str, levels: int) -> None:
    values = heavy_tailed("student")
    hidden = [np.maximum(values, 0), np.maximum(values[:, :2], 0)]
    shapes = ((3, 6), (2, 3), (3, 2))  # three inputs and a label; hidden, hidden, gradient
    convs = [
        FoldedConv(np.zeros((o, i, 1, 1), np.float32), np.zeros(o, np.float32)) for o, i in shapes
    ]
    whole, part = (SgmObservers(FoldedSgm(4, (1, 1), tuple(convs))) for _ in range(2))
    inputs = np.concatenate([values, np.full((len(values), 3), 7, np.float32)], axis=1)
    for observers, rows in ((whole, slice(0, 999)), (part, slice(999, None))):
        observers.update(inputs[rows, None], [tensor[rows, None] for tensor in hidden])
    whole.merge(part)
    ranges = whole.ranges(name, levels, LABELS)
    low, high = CALIBRATORS[name](observed(values), levels)
    np.testing.assert_array_equal(ranges.input_low, [*low, 0, -1, -1])
    np.testing.assert_array_equal(ranges.input_high, [*high, 1, 1, 1])
    for got, tensor in zip(ranges.hidden_high, hidden, strict=True):
        np.testing.assert_array_equal(got, CALIBRATORS[name](observed(tensor), levels)[1])


def test_a_run_that_blew_up_widens_ranges_to_eight_times_a_typical_runs_at_most() -> None:
    rng = np.random.default_rng(0)
    widths = [(4, 4 + 3, 1, 1), (4, 4, 1, 1)]
    convs = tuple(FoldedConv(np.zeros(w, np.float32), np.zeros(4, np.float32)) for w in widths)
    sgm = FoldedSgm(4, (1, 1), convs)
    total = SgmObservers(sgm)
    highest = np.zeros(4, np.float32)
    for scale in (1.0, 1.2, 500.0, 0.9, 1.1):
        one = SgmObservers(sgm)
        seen = rng.uniform(0, scale, (50, 1, 7)).astype(np.float32)
        hidden = rng.uniform(0, 2 * scale, (50, 1, 4)).astype(np.float32)
        one.update(seen, [hidden])
        # On its own a run is the typical one.
        alone = one.ranges("minmax", 256, LABELS)
        np.testing.assert_array_equal(alone.input_high[:4], seen[..., :4].max(axis=(0, 1)))
        if scale < 2:
            highest = np.maximum(highest, alone.input_high[:4])
        total.merge(one)
    ranges = total.ranges("minmax", 256, LABELS)
    assert (ranges.input_high[:4] >= highest).all()
    assert (ranges.input_high[:4] < 8 * 1.2).all()
    assert (ranges.hidden_high[0] < 8 * 2.4).all()
    assert (ranges.hidden_high[0] > 8 * 1.5).all()
