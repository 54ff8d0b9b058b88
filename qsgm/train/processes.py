"""Work for one core, or for several processes of one core each: results come in their order."""

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from multiprocessing import active_children, get_context
from typing import Protocol, TypeVar

import torch

from qsgm.errors import QsgmError

Item = TypeVar("Item")
Done = TypeVar("Done")


class InTurn(Protocol):
    """What :func:`map` does, here or in other processes."""

    def __call__(
        self, work: Callable[[Item], Done], items: Iterable[Item], /
    ) -> Iterator[Done]: ...


MOST = 4  # unless more are asked for: each takes some 400 MB


def usual_count() -> int:
    """As many as there are cores for this process, but for :data:`MOST`."""
    known = getattr(os, "sched_getaffinity", None)  # not everywhere
    return min(MOST, len(known(0)) if known else os.cpu_count() or 1)


@contextmanager
def in_processes(count: int) -> Iterator[InTurn]:
    """:func:`map` in so many processes, with 1 in this one; always on one thread each.

    How many they are changes no result. What they are given has to be picklable.

    Raises:
        QsgmError: one of them was killed.
    """
    if count == 1:
        with one_thread():
            yield map
        return
    others = {*active_children()}
    pool = ProcessPoolExecutor(count, get_context("spawn"), _begin)
    try:
        yield pool.map
    except BrokenProcessPool as error:
        raise QsgmError(
            f"one of {count} processes was killed, perhaps for the memory it took; pass a smaller "
            "--processes"
        ) from error
    except BaseException:
        # What they are at may take a minute, and nobody waits for it any more.
        for process in {*active_children()} - others:
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch on one thread: thousands of tiny operations only wait for a second one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _begin() -> None:
    """A process of the pool: an interrupt is for the one that waits for it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
