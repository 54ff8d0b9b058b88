"""The comparer: convolutions written out as loops, light that does not count, damage refused."""

import base64
import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from toys import lay, table, toy

from qsgm import QsgmError
from qsgm.grasp.cells import Cells
from qsgm.grasp.comparer import INPUTS, STRIDES, Comparer, Layer, side_by_side
from qsgm.grasp.correlation import Template
from qsgm.grasp.decision import Decision
from qsgm.grasp.evidence import NAMES
from qsgm.grasp.patch import cut_patch

CENTER = (320.0, 240.0)
CELLS = Cells.of(Template(cut_patch(lay(toy(), table(), CENTER), CENTER)))
CHANNELS = (2, 3, 2, 3)


def random_comparer(seed: int = 0) -> Comparer:
    rng, into = np.random.default_rng(seed), (INPUTS, *CHANNELS[:-1])
    shapes = [(9 * before, after) for before, after in zip(into, CHANNELS, strict=True)]
    shapes += [(3 * CHANNELS[-1], 4), (4, 1)]
    layers = [
        Layer(
            rng.normal(0, 1 / math.sqrt(rows), (rows, columns)).astype(np.float32),
            rng.normal(0, 0.1, columns).astype(np.float32),
        )
        for rows, columns in shapes
    ]
    return Comparer(tuple(layers[:-2]), *layers[-2:])


def views(count: int, seed: int = 0) -> NDArray[np.uint8]:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 256, (count, 64, 64, 3)).astype(np.uint8)


def by_loops(comparer: Comparer, cells: Cells, seen: NDArray[np.uint8]) -> float:
    """The same of one view (64, 64, 3), number by number."""
    maps = side_by_side(cells, seen[None])[0].astype(float)
    for layer, stride in zip(comparer.convolutions, STRIDES, strict=True):
        side, channels = maps.shape[0], maps.shape[2]
        after = np.zeros((side // stride, side // stride, len(layer.bias)))
        for row, col in np.ndindex(*after.shape[:2]):
            total = layer.bias.astype(float)
            for down, right, channel in np.ndindex(3, 3, channels):
                y, x = stride * row + down - 1, stride * col + right - 1
                if 0 <= y < side and 0 <= x < side:
                    tap = (3 * down + right) * channels + channel
                    total = total + maps[y, x, channel] * layer.weight[tap]
            after[row, col] = np.maximum(total, 0)
        maps = after
    share = np.array(
        [
            [cells.solid[8 * i : 8 * i + 8, 8 * j : 8 * j + 8].mean() for j in range(8)]
            for i in range(8)
        ]
    )
    inside = (maps * share[..., None]).sum((0, 1)) / share.sum()
    x = np.concatenate([inside, maps.max((0, 1)), maps.mean((0, 1))])
    x = np.maximum(x @ comparer.hidden.weight + comparer.hidden.bias, 0)
    return float((x @ comparer.output.weight + comparer.output.bias)[0])


def test_logits_are_those_of_convolutions_written_out() -> None:
    comparer, seen = random_comparer(), views(2)
    expected = [by_loops(comparer, CELLS, one) for one in seen]
    assert comparer.logits(CELLS, seen) == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_all_ways_are_the_mean_of_eight_comparisons() -> None:
    comparer, seen = random_comparer(), views(2)
    expected = np.zeros(2)
    for mirrored in (False, True):
        for quarters in range(4):

            def laid(picture: Any, quarters: int = quarters, mirrored: bool = mirrored) -> Any:
                return np.rot90(picture[:, ::-1] if mirrored else picture, quarters)

            cells = replace(CELLS, image=laid(CELLS.image), solid=laid(CELLS.solid))
            expected += [by_loops(comparer, cells, laid(one)) / 8 for one in seen]
    assert comparer.logits_all_ways(CELLS, seen) == pytest.approx(expected, rel=1e-4, abs=1e-4)


def test_only_what_is_close_to_the_threshold_is_compared_in_all_ways() -> None:
    comparer, seen = random_comparer(), views(3)
    glance, all_ways = comparer.logits(CELLS, seen), comparer.logits_all_ways(CELLS, seen)
    assert np.abs(glance - all_ways).min() > 1e-3
    count = len(NAMES) + 1
    says_what_the_comparer_says = np.zeros((2, count), np.float32)
    says_what_the_comparer_says[:, -1] = 1, -1
    for far in (False, True):
        threshold = float(glance[0]) + (10.0 if far else 0.0)
        decision = Decision(
            np.zeros(count, np.float32), np.ones(count, np.float32), says_what_the_comparer_says,
            np.zeros(2, np.float32), np.array([1, -1], np.float32), 0.0, threshold, comparer,
        )  # fmt: skip
        (quality,) = decision.judged(CELLS, np.zeros((1, len(NAMES)), np.float32), seen[:1])
        odds = float((glance if far else all_ways)[0]) - threshold
        assert quality == pytest.approx(1 / (1 + math.exp(-odds)), rel=1e-4)


def test_each_view_is_compared_by_itself() -> None:
    comparer, seen = random_comparer(), views(3)
    together = comparer.logits(CELLS, seen)
    for one, logit in zip(seen, together, strict=True):
        assert comparer.logits(CELLS, one[None])[0] == pytest.approx(logit, abs=1e-5)


@settings(deadline=None, max_examples=25)
@given(gain=st.floats(0.5, 1.3), light=st.integers(0, 40))
def test_the_light_of_a_scene_makes_no_difference(gain: float, light: int) -> None:
    """Where contrast is far above a flat surface's noise, which counts as variance."""
    squares = np.where(np.indices((64, 64)).sum(axis=0) // 8 % 2, 20, 160)
    taught = np.repeat(squares[..., None], 3, axis=2).astype(np.uint8)
    cells = replace(CELLS, image=taught.astype(np.float32))
    seen = np.clip(np.rint(taught * gain + light), 0, 255).astype(np.uint8)
    here, there = (side_by_side(cells, one[None])[..., 3:6] for one in (taught, seen))
    assert np.abs(here - there).max() < 0.05


def test_the_object_itself_differs_by_nothing() -> None:
    seen = np.clip(np.rint(CELLS.image), 0, 255).astype(np.uint8)
    (both,) = side_by_side(CELLS, seen[None])
    assert np.abs(both[..., 6:9]).max() < 0.02
    np.testing.assert_allclose(both[..., :3], both[..., 3:6], atol=0.02)
    np.testing.assert_allclose(both[..., 9], 2 * CELLS.solid - 1, atol=1e-6)


def test_weights_are_kept_in_codes_of_8_bits() -> None:
    exact = random_comparer()
    kept = Comparer.from_json(json.loads(json.dumps(exact.to_json())), "here")
    for before, after in zip(exact.layers, kept.layers, strict=True):
        step = np.abs(before.weight).max(axis=0) / 127
        assert (np.abs(before.weight - after.weight) <= 0.5001 * step).all()
        np.testing.assert_array_equal(before.bias, after.bias)
    again = Comparer.from_json(kept.to_json(), "here")
    for before, after in zip(kept.layers, again.layers, strict=True):
        np.testing.assert_allclose(before.weight, after.weight, rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"channels": [2, 3, 2, 3]}, "do not fit"),
        ({"channels": [2, 3, 2, 3, 1000]}, "do not fit"),
        ({"channels": [2, 3, 2, 0, 4]}, "do not fit"),
        ({"channels": None}, "do not fit"),
        ({"codes": "AAAA"}, "do not fit"),
        ({"codes": "no base64!"}, "do not fit"),
        ({"codes": 3}, "do not fit"),
        ({"scales": [1.0]}, "do not fit"),
        ({"biases": [1e400] * 15}, "not finite"),
        ({"scales": ["a"] * 15}, "do not fit"),
    ],
)
def test_a_damaged_comparer_is_refused_in_one_line(change: dict[str, Any], said: str) -> None:
    values = random_comparer().to_json()
    assert len(values["scales"]) == 15
    assert len(base64.b64decode(values["codes"])) == sum(
        one.weight.size for one in random_comparer().layers
    )
    with pytest.raises(QsgmError, match=f"here: the comparer's numbers.* {said}") as error:
        Comparer.from_json(values | change, "here")
    assert "\n" not in str(error.value)
    missing = {name: value for name, value in values.items() if name not in change}
    with pytest.raises(QsgmError, match="do not fit"):
        Comparer.from_json(missing, "here")
