"""Heads and tasks as they are kept: read as they were written, nonsense refused in one line."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from damage import JUNK, damaged
from hypothesis import given
from hypothesis import strategies as st
from toy_task import SHAPE, ToyTask

from qsgm import QsgmError
from qsgm.grasp.task import GraspTask, grasp_task
from qsgm.task import (
    Head,
    channels_of,
    heads_from_json,
    heads_to_json,
    label_span,
    output_count,
    task_record,
)

HEADS = GraspTask().heads
KEPT = heads_to_json(HEADS)


def read_or_refusal(values: Any) -> tuple[Head, ...] | str:
    """Heads, or what is said against them."""
    try:
        return heads_from_json(values)
    except QsgmError as error:
        return str(error)


@pytest.mark.parametrize("heads", [HEADS, GraspTask("paper").heads, ToyTask().heads])
def test_heads_come_back_from_what_they_write(heads: tuple[Head, ...]) -> None:
    assert heads_from_json(json.loads(json.dumps(heads_to_json(heads)))) == heads


@given(damaged(KEPT) | JUNK)
def test_other_values_are_refused_in_one_line_or_read_as_they_are(values: Any) -> None:
    heads = read_or_refusal(values)
    if isinstance(heads, str):
        assert "\n" not in heads
    else:
        assert heads_to_json(heads) == values


@pytest.mark.parametrize(
    "change",
    [
        {"kind": "hinge"},
        {"kind": ["squared"]},
        {"kind": "cross_entropy"},  # whose activation is softmax
        {"activation": "relu"},
        {"activation": None},
        {"name": 3},
        {"channels": 0},
        {"channels": True},
        {"channels": 1.0},
        {"weight": 0},
        {"weight": -1.0},
        {"weight": "1.0"},
        {"weight": True},
        {"weight": math.inf},
        {"weight": math.nan},
        {"weight": 10**400},
        {"smoothing": 1.0},
        {"smoothing": -0.1},
        {"smoothing": math.nan},
        {"where": 3},  # of three labels, from 0
        {"where": -1},
        {"where": True},
    ],
    ids=repr,
)
def test_heads_that_make_no_sense_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(QsgmError) as raised:
        heads_from_json([KEPT[0] | change, *KEPT[1:]])
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("values", [None, [], {}, 3, "heads", [None], [[]], [{}]], ids=repr)
def test_what_is_no_list_of_heads_is_refused(values: Any) -> None:
    with pytest.raises(QsgmError, match="output heads"):
        heads_from_json(values)


def test_heads_share_out_the_channels_in_order() -> None:
    heads = (SHAPE, *HEADS)
    assert output_count(heads) == 13
    assert [[*one] for one in channels_of(heads)] == [[*range(10)], [10], [11, 12]]
    low, high = label_span(heads)
    np.testing.assert_array_equal(low, np.float32([0] * 11 + [-1, -1]))
    np.testing.assert_array_equal(high, np.ones(13, np.float32))


@pytest.mark.parametrize("encoding", ["double", "paper"])
def test_the_grasping_task_comes_back_from_its_record(encoding: Any) -> None:
    task = GraspTask(encoding, 0.02)
    record = task_record(task)
    assert (record.name, record.network, record.heads) == ("grasp", task.network, task.heads)
    assert grasp_task(record, "it") == task


def test_a_record_is_not_changed_by_what_was_made_of_it() -> None:
    record = task_record(GraspTask())
    record.to_json()["encoding"] = "paper"
    assert record.to_json() == {"encoding": "double"}


def test_another_tasks_record_is_refused_by_name() -> None:
    with pytest.raises(QsgmError, match=r"^it is of the task 'toy', expected 'grasp'"):
        grasp_task(task_record(ToyTask()), "it")


@given(
    st.fixed_dictionaries({}, optional={"encoding": JUNK, "decision": JUNK | st.just({"bias": 0})})
)
def test_a_grasping_record_that_says_nonsense_is_refused_in_one_line(settings: Any) -> None:
    record = replace(task_record(GraspTask()), settings=settings)
    with pytest.raises(QsgmError) as raised:
        grasp_task(record, "it")
    assert "\n" not in str(raised.value)
    assert str(raised.value).startswith("it")
