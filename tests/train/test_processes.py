"""Work in several processes: its results in their order, and nobody left behind."""

import operator
import os
import signal
import time
from functools import partial
from multiprocessing import active_children
from pathlib import Path

import pytest
import torch

from qsgm import QsgmError
from qsgm.train.checkpoint import load_checkpoint
from qsgm.train.processes import in_processes, usual_count


@pytest.mark.parametrize("count", [1, 2])
def test_results_come_in_their_order_from_processes_of_one_thread(count: int) -> None:
    before = torch.get_num_threads()
    with in_processes(count) as in_turn:
        slow_first = [partial(time.sleep, 0.2), partial(pow, 2, 3), partial(pow, 3, 2)]
        assert [*in_turn(operator.call, slow_first)] == [None, 8, 9]
        assert [*in_turn(operator.call, [torch.get_num_threads] * 2)] == [1, 1]
        assert (set(in_turn(operator.call, [os.getpid])) == {os.getpid()}) == (count == 1)
    assert torch.get_num_threads() == before
    assert not active_children()


def test_an_error_of_the_work_is_its_callers() -> None:
    missing = partial(load_checkpoint, Path("absent.pt"))
    with pytest.raises(QsgmError, match=r"absent\.pt"), in_processes(2) as in_turn:
        [*in_turn(operator.call, [missing])]
    assert not active_children()


def test_a_process_that_is_killed_is_named_in_one_line() -> None:
    with (
        pytest.raises(QsgmError, match="pass a smaller --processes"),
        in_processes(2) as in_turn,
    ):
        [*in_turn(operator.call, [partial(os._exit, 9)])]
    assert not active_children()


def test_an_interrupt_waits_for_no_work() -> None:
    workers = []

    def interrupted() -> None:
        with in_processes(2) as in_turn:
            [*in_turn(operator.call, [os.getpid] * 2)]
            workers.extend(active_children())
            in_turn(time.sleep, [600, 600])
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert workers
    assert {one.exitcode for one in workers} == {-signal.SIGTERM}


def test_there_are_usually_as_many_as_cores_but_for_four(monkeypatch: pytest.MonkeyPatch) -> None:
    for cores, expected in ((1, 1), (2, 2), (64, 4)):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _, n=cores: {*range(n)}, raising=False)
        assert usual_count() == expected
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    assert usual_count() == 3
