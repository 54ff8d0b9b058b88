"""A task file: Python that defines one object, `task`. A bundle names its task, it has no code."""

import importlib.util
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.files import read_file
from qsgm.network import Network
from qsgm.samples.arrays import NAME as ARRAYS
from qsgm.samples.arrays import ArraysTask
from qsgm.samples.lesson import Samples, checked_samples
from qsgm.samples.task import TUNED, SampleTask
from qsgm.task import Described

GRASP = "grasp"
BUILT_IN = (GRASP, ARRAYS)
MOST_BYTES = 1_000_000
_EXPECTED = "a task file, Python that defines `task`"


def load_task(path: Path) -> SampleTask:
    """Run a task file and take its `task`.

    Raises:
        QsgmError: it is missing, does not run, or defines no task.
    """
    source = read_file(path, MOST_BYTES, _EXPECTED)
    found = getattr(_run(path, source), "task", None)
    if not isinstance(found, SampleTask):
        got = "nothing" if found is None else f"a {type(found).__name__}"
        raise QsgmError(
            f"{path}: `task` is {got}, expected a qsgm.SampleTask; write `task = MyTask(...)`"
        )
    types = {"name": str, "network": Network, "heads": tuple}
    for name, kind in types.items():
        if not isinstance(getattr(found, name), kind):
            got = type(getattr(found, name)).__name__
            raise QsgmError(f"{path}: `task.{name}` is a {got}, expected a {kind.__name__}")
    if found.name in BUILT_IN or not re.fullmatch(r"[\w.-]{1,60}", found.name):
        raise QsgmError(
            f"{path}: {found.name!r} is no name for a task: expected letters and digits, and none "
            f"of {', '.join(BUILT_IN)}"
        )
    return found


def task_for(kept: Described, where: str, task: SampleTask | None) -> SampleTask:
    """The task of a bundle, checkpoint or tuned network.

    Args:
        kept: what it says of its task.
        where: it is, for messages.
        task: what the user gave; None: a built-in one.

    Raises:
        QsgmError: it is another one's, or there is none.
    """
    if task is None:
        if kept.name != ARRAYS:
            raise QsgmError(
                f"{where} is of the task {kept.name!r}, which is not built in: pass --task FILE.py"
            )
        return ArraysTask(kept.name, kept.network, kept.heads, tuned_of(kept))
    if task.name != kept.name:
        raise QsgmError(f"{where} is of the task {kept.name!r}, the task file of {task.name!r}")
    if (task.network, task.heads) != (kept.network, kept.heads):
        raise QsgmError(
            f"{where} has another network or other heads than the task file: make it again, or "
            "pass the file that it was made with"
        )
    return task


def task_of_bundle(bundle: Bundle, task: SampleTask | None) -> SampleTask:
    """The task of a bundle, see :func:`task_for`."""
    return task_for(bundle.manifest.task, f"the bundle {bundle.folder}", task)


def read_samples(task: SampleTask, path: Path) -> Samples:
    """What a task reads in a file, checked.

    Raises:
        QsgmError: the file cannot be read, or holds what does not fit the task.
    """
    try:
        found = task.read(path)
    except QsgmError:
        raise
    except Exception as error:  # whatever somebody's code raises
        raise QsgmError(f"the task {task.name!r} cannot read {path}: {_told(error)}") from error
    return checked_samples(found, task.network, task.heads, str(path))


def tuned_of(kept: Described) -> int:
    """How many of the last layers are tuned unless the user says otherwise."""
    found, depth = kept.to_json().get("tuned"), kept.network.depth
    return found if type(found) is int and 1 <= found <= depth else min(TUNED, depth)


def _run(path: Path, source: bytes) -> ModuleType:
    """A module of its own name, known to Python: dataclasses and pickle look it up there."""
    name = f"qsgm_task_{re.sub(r'[^0-9a-zA-Z_]', '_', path.stem)}"
    spec = importlib.util.spec_from_loader(name, loader=None, origin=str(path))
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    module.__file__ = str(path)
    sys.modules[name] = module
    try:
        exec(compile(source, str(path), "exec"), vars(module))
    except Exception as error:  # whatever somebody's code raises
        raise QsgmError(f"{path} does not run: {_told(error)}") from error
    return module


def _told(error: Exception) -> str:
    first: Any = next(iter(str(error).splitlines()), "")
    line = getattr(error, "lineno", None)
    place = error.__traceback__
    while place is not None and place.tb_next is not None:
        place = place.tb_next
    at = line or (place.tb_lineno if place is not None else 0)
    return f"{type(error).__name__} in line {at}: {first}"
