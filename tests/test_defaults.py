"""What the command line offers before anything is measured."""

import os
import runpy

import pytest

from qsgm import defaults


@pytest.mark.parametrize(("cores", "offered"), [(8, "1,2"), (2, "1,2"), (1, "1"), (None, "1")])
def test_more_threads_are_offered_where_there_are_more_cores(
    cores: int | None, offered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert runpy.run_path(str(defaults.__file__))["THREAD_COUNTS"] == offered
