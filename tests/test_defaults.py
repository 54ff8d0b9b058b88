"""What the command line offers before anything is measured."""

import os
import re
import runpy
from pathlib import Path

import pytest

from qsgm import defaults
from qsgm.tune.settings import Settings

DEPLOY = Path(__file__).parents[1] / "deploy"


@pytest.mark.parametrize(("cores", "offered"), [(8, "1,2"), (2, "1,2"), (1, "1"), (None, "1")])
def test_more_threads_are_offered_where_there_are_more_cores(
    cores: int | None, offered: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    assert runpy.run_path(str(defaults.__file__))["THREAD_COUNTS"] == offered


def test_an_object_is_taught_as_long_wherever_it_is_taught() -> None:
    places = {
        "native/main.c": r"\.epochs = (\d+)",
        "web/page.js": r"EPOCHS = (\d+)",
        "ros2/qsgm_ros/finder.py": r"epochs: int = (\d+)",
        "ros2/config/finder.yaml": r"epochs: (\d+)",
    }
    found = [re.findall(said, (DEPLOY / name).read_text()) for name, said in places.items()]
    assert found == [[str(Settings().epochs)]] * len(places)
