"""A pytest plugin that says which test runs which line: `coverage run -m pytest -p covering`.

Every test is a context of coverage's, and so is every fixture that several tests share: whoever
comes first would have its lines else. Programs that tests start are told in whose context they run.
"""

import json
import os
import time
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import coverage
import pytest

# Who runs: read by coverage in programs that tests start, see `__main__`.
CONTEXT = "MUTANTS_CONTEXT"
# Where what coverage does not know is written: outcomes, seconds, fixtures.
TESTS = "MUTANTS_TESTS"

_tests: dict[str, dict[str, Any]] = {}
_shared: dict[str, float] = {}  # seconds of each fixture that several tests share


@contextmanager
def _context(name: str) -> Iterator[None]:
    measured, before = coverage.Coverage.current(), os.environ.get(CONTEXT, "")
    assert measured is not None
    os.environ[CONTEXT] = name
    measured.switch_context(name)
    try:
        yield
    finally:
        os.environ[CONTEXT] = before
        measured.switch_context(before)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A test is a context."""
    fixtures = list(getattr(item, "fixturenames", []))
    _tests[item.nodeid] = {"fixtures": fixtures, "seconds": 0.0, "passed": False}
    with _context(item.nodeid):
        return (yield)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(fixturedef: Any) -> Generator[None, object, object]:
    """So is a fixture that several tests share; its time is not the first one's."""
    if fixturedef.scope == "function":
        return (yield)
    began = time.perf_counter()
    before = os.environ.get(CONTEXT, "")
    with _context(f"fixture {fixturedef.argname}"):
        try:
            return (yield)
        finally:
            took = time.perf_counter() - began
            _shared[fixturedef.argname] = max(took, _shared.get(fixturedef.argname, 0))
            if before in _tests:
                _tests[before]["seconds"] -= took


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Outcome and seconds of a test."""
    _tests[report.nodeid]["seconds"] += report.duration
    if report.when == "call":
        _tests[report.nodeid]["passed"] = report.passed


def pytest_sessionfinish() -> None:
    """Write them."""
    Path(os.environ[TESTS]).write_text(json.dumps({"tests": _tests, "shared": _shared}, indent=1))
