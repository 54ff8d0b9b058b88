"""The suite on other random numbers, which finds tests that pass by luck.

PYTHONPATH=tests QSGM_SEED_SHIFT=1 python -m pytest -p shifted_seeds --hypothesis-seed 1

Seeds that tests give are moved; those that the product gives itself are what it is made of.
"""

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import settings

SHIFT = int(os.environ.get("QSGM_SEED_SHIFT", "1"))
HERE = str(Path(__file__).parent)


def pytest_configure() -> None:
    settings.register_profile("shifted", settings.get_profile("qsgm"), derandomize=False)
    settings.load_profile("shifted")
    patch = pytest.MonkeyPatch()
    patch.setattr(np.random, "default_rng", shifted(np.random.default_rng))
    patch.setattr(torch, "manual_seed", shifted(torch.manual_seed))


def shifted(seeded: Callable[..., Any]) -> Callable[..., Any]:
    """What takes a seed, given another one where a test asks."""

    def other(seed: Any = None) -> Any:
        asked_by = sys._getframe(1).f_code.co_filename
        return seeded(moved(seed) if asked_by.startswith(HERE) else seed)

    return other


def moved(seed: Any) -> Any:
    """One number, or several that are a seed together; a generator stays."""
    if isinstance(seed, int):
        return seed + SHIFT
    return [*seed, SHIFT] if isinstance(seed, (tuple, list)) else seed
