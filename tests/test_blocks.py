"""Blocks: what their text says, and what is no text of blocks."""

from contextlib import suppress
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from qsgm import QsgmError
from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers
from qsgm.grasp.network import GRASPNET


@st.composite
def any_blocks(draw: st.DrawFn) -> Blocks:
    first = draw(st.integers(1, 6))
    cuts = draw(st.sets(st.integers(first + 1, 6))) if first < 6 else set()
    ends = [first, *sorted(cuts), 7]
    return Blocks(tuple(range(start, end) for start, end in pairwise(ends)))


@given(any_blocks())
def test_blocks_come_back_from_their_text(blocks: Blocks) -> None:
    assert parse_blocks(str(blocks)) == parse_blocks(str(blocks), 6) == blocks


@given(any_blocks())
def test_blocks_hold_every_layer_once_and_an_sgm_behind_each_but_the_last(blocks: Blocks) -> None:
    numbers = [number for group in blocks.groups for number in group]
    assert numbers == [*blocks.layers]
    assert blocks.layers[-1] == 6
    behind = {number for number in numbers[:-1] if f"{number}," in str(blocks)}
    assert set(blocks.sgm_layers) == behind


def test_texts_are_as_short_as_they_can_be() -> None:
    three, one = GRASPNET.last(3), GRASPNET.last(1)
    assert str(single_layers(three)) == "4,5,6"
    assert str(one_block(three)) == "4-6"
    assert str(single_layers(one)) == str(one_block(one)) == "6"
    assert str(Blocks((range(1, 5), range(5, 6), range(6, 7)))) == "1-4,5,6"


RUBBISH = ["", "7", "0", "5", "4,6", "6,5", "5-5,6", "6-6", "6-4", "4-", "4 ,5,6", "4,5,6,", ",6"]
RUBBISH += ["4,,5,6", "4-5-6", "04-6", "4,5-7", "0-6", "4,5,6\n", "\u0664,5,6", "bp", "4;5;6", "-6"]


@pytest.mark.parametrize("text", RUBBISH)
def test_what_is_no_text_of_blocks_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(QsgmError, match="gives no blocks of layers: expected every") as raised:
        parse_blocks(text, 6)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("text", ["7", "5", "4,5-7"])
def test_only_a_networks_depth_tells_that_blocks_end_elsewhere(text: str) -> None:
    assert str(parse_blocks(text)) == text
    with pytest.raises(QsgmError, match="from the first tuned one to layer 6"):
        parse_blocks(text, 6)


@given(st.text(alphabet="123456,-0 ", max_size=14) | st.text(max_size=40))
def test_any_text_is_either_canonical_or_refused(text: str) -> None:
    for depth in (None, 6):
        with suppress(QsgmError):
            assert str(parse_blocks(text, depth)) == text


@pytest.mark.parametrize("tuned", [0, -1, 7])
def test_another_number_of_layers_is_refused(tuned: int) -> None:
    with pytest.raises(QsgmError, match=f"last {tuned} layers: choose 1 to 6"):
        GRASPNET.last(tuned)
    assert [*GRASPNET.last(2)] == [5, 6]
