"""Steps of a peer timed and told, in whichever Python runs it: nothing of qsgm is imported."""

import json
import sys
import time
from collections.abc import Callable, Iterable
from statistics import median
from typing import Any

# Features (B, C, H, W) and labels (B, 3) of a batch to its loss; updates the weights.
Step = Callable[[Any, Any], float]
WARM_UP = 5  # first steps, in which things are compiled and allocated
CHECKED_STEPS = 20  # whose losses are printed


def timed_steps(
    step: Step, features: Any, labels: Any, rows: Iterable[Any], seconds: float
) -> tuple[list[float], list[float]]:
    """Losses and seconds of steps on one batch after the other, for so long at most."""
    losses: list[float] = []
    times: list[float] = []
    for batch in rows:
        if len(times) >= WARM_UP + CHECKED_STEPS and sum(times[WARM_UP:]) > seconds:
            break
        began = time.perf_counter()
        losses.append(step(features[batch], labels[batch]))
        times.append(time.perf_counter() - began)
    return losses, times


def tell(
    version: str, imported_at: float, set_up: float, losses: list[float], times: list[float]
) -> None:
    """Print one JSON object.

    Args:
        version: of the framework.
        imported_at: when all was imported, seconds since the epoch.
        set_up: seconds before the first step.
        losses: of all steps.
        times: of all steps, seconds.
    """
    result = {
        "version": version,
        "imported_at": imported_at,
        "setup_seconds": set_up + sum(times[:WARM_UP]),
        "steps": len(times) - WARM_UP,
        "step_seconds": median(times[WARM_UP:]),
        "losses": losses[:CHECKED_STEPS],
    }
    sys.stdout.write(json.dumps(result) + "\n")
