"""Crops whose gradient is small sit out two epochs of three: accuracy for as many steps.

    python benchmarks/sitting_out.py --frames DIR [--epochs 3 --epochs 10] [--limit 5] [--json FILE]

A run takes as many steps either way, so whoever sits out leaves room for more passes over the
others. How large a crop's gradient is, behind the first tuned layer, is looked at anew before each
epoch and counts as no work: what is shown is the most that can be gained.
"""

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from qsgm import Settings, load_bundle
from qsgm.bench.frames import list_frames
from qsgm.bundle import Bundle
from qsgm.grasp.teach import prepare_object
from qsgm.manifest import Recipe
from qsgm.schedule import BATCH, rate_factor, steps_per_epoch
from qsgm.tables import number, table
from qsgm.task import Array, Rows
from qsgm.tune.graphs import open_probe, open_step
from qsgm.tune.loop import StepLoop
from qsgm.tune.plan import Plan, resolve
from qsgm.tune.prepare import Prepared, validate
from qsgm.tune.probe import feeds_of

# A multiple of the batch, so that no batch is smaller than others.
STAYING = 13 * BATCH
EVERY = 3  # epochs from one in which no crop sits out to the next
BP_RATE = 0.02  # the best of those of `qsgm bench accuracy` in long runs
SHOWN = ("detection_accuracy", "angle_mae_deg")
COLUMNS = ("", ("detection", "{:.4f}"), ("angle error", "{:.3f}°"))


def plans(bundle: Bundle, epochs: int) -> dict[str, Plan]:
    """A run of each method."""
    bp = Recipe("sgd", (BP_RATE,) * 3)
    return {
        "SGMs": resolve(Settings(epochs=epochs), bundle),
        "backpropagation": resolve(Settings(method="bp", epochs=epochs), bundle, bp),
    }


def scores_of(prepared: Prepared, plan: Plan, sitting_out: bool) -> list[Any]:
    """:data:`SHOWN` after one run."""
    bundle, taught = prepared.bundle, prepared.taught
    steps = plan.epochs * steps_per_epoch(taught)
    rates = dict(zip(plan.layers, plan.recipe.rates_over(steps), strict=True))
    session, probe = open_step(bundle, plan), open_probe(bundle, plan)
    loop = StepLoop(session, prepared.features, prepared.labels, prepared.start, rates)
    name = f"{'true' if plan.settings.method == 'bp' else 'float'}{plan.layers[0]}"

    def sizes() -> Array:
        feeds = feeds_of(prepared, loop.weights(), np.arange(taught))
        return np.linalg.norm(probe.run([name], feeds)[0].reshape(taught, -1), axis=1)

    def batches() -> Iterator[Rows]:
        rng, epoch = np.random.default_rng([plan.settings.seed, 1]), 0
        while True:
            some = sitting_out and epoch % EVERY > 0
            order = rng.permutation(np.argsort(-sizes())[:STAYING] if some else taught)
            yield from np.split(order, range(BATCH, len(order), BATCH))
            epoch += 1

    for step, rows in zip(range(steps), batches(), strict=False):
        loop.step(rows, rate_factor(step, steps))
    scores = validate(prepared, loop.weights())
    return [scores[one] for one in SHOWN]


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("calib"))
    parser.add_argument("--epochs", action="append", type=int)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--bundle", type=Path, default=Path("export"))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    bundle = load_bundle(asked.bundle)
    frames = [one for one in list_frames(asked.frames, asked.limit) if one.elongated is not False]
    found: dict[str, list[Any]] = {}
    for frame in track(frames, console=Console(stderr=True)):
        prepared = prepare_object(frame.read(), bundle, resolve(Settings(), bundle))
        for epochs in asked.epochs or [3, 10]:
            for method, plan in plans(bundle, epochs).items():
                for name, sitting_out in (("all", False), ("half sits out", True)):
                    scores = scores_of(prepared, plan, sitting_out)
                    found.setdefault(f"{method}, {epochs} epochs, {name}", []).append(scores)
    means = {name: np.mean(some, axis=0).tolist() for name, some in found.items()}
    Console().print(table(f"{len(frames)} frames", COLUMNS, [[k, *v] for k, v in means.items()]))
    if asked.json is not None:
        values = {
            name: {key: number(value, 4) for key, value in zip(SHOWN, row, strict=True)}
            for name, row in means.items()
        }
        asked.json.write_text(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
