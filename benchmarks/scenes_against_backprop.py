"""Scenes looked through after static SGMs and after backpropagation at its best.

    python benchmarks/scenes_against_backprop.py [--frames DIR] [--limit N] [--json FILE]

Each tunes the same three layers on the same crops, for 1, 3 and 20 epochs. Backpropagation has a
grid of optimizers and rates, and its best of each length is chosen on the very scenes that are
reported, in its favour; the network as it comes is there to show what tuning is worth. Every method
answers at its own threshold for 2 % false alarms.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from qsgm.bench.frames import list_frames, spread
from qsgm.bench.judging import Tally, paired_difference
from qsgm.bench.scenes import MethodResults, ScenePlan, TunedMethod, measure_scenes
from qsgm.bench.subjects import drawn_subjects, subjects_of
from qsgm.bundle import Bundle, load_bundle
from qsgm.manifest import Recipe
from qsgm.tune.settings import Settings

LENGTHS = (1, 3, 20)
GRID = {"sgd": (0.003, 0.01, 0.03), "adam": (0.0003, 0.001, 0.003)}
NOTHING = 1e-12  # a rate at which nothing is learnt


@dataclass(frozen=True)
class Row:
    """One method's answers, of one length of run."""

    name: str
    epochs: int
    results: MethodResults

    @property
    def right(self) -> np.ndarray:
        return Tally.of(self.results.at_false_alarm_rate().results).right


def methods(bundle: Bundle, layers: int) -> Iterator[tuple[str, int, TunedMethod]]:
    """Everything that is compared: its name, its epochs, and it."""
    still = Recipe("sgd", (NOTHING,) * layers)
    bp = Settings(method="bp", precision="float", layers=layers, epochs=1)
    yield "untouched", 0, TunedMethod("untouched", bundle, bp, still)
    for epochs in LENGTHS:
        int8 = Settings(precision="int8", layers=layers, epochs=epochs)
        yield "sgm int8", epochs, TunedMethod("sgm int8", bundle, int8)
        bp = Settings(method="bp", precision="float", layers=layers, epochs=epochs)
        for optimizer, rates in GRID.items():
            for rate in rates:
                recipe = Recipe(optimizer, (rate,) * layers)  # type: ignore[arg-type]
                yield f"bp {optimizer} {rate:g}", epochs, TunedMethod("bp", bundle, bp, recipe)


def measured(plan: ScenePlan, bundle: Bundle, layers: int) -> list[Row]:
    """Every method's answers to the same scenes."""
    named = list(methods(bundle, layers))

    def watch(_: str, done: int, total: int) -> None:
        Console(stderr=True).print(f"{done} of {total} objects")

    results = measure_scenes(plan, [method for _, _, method in named], watch)
    return [Row(name, epochs, one) for (name, epochs, _), one in zip(named, results, strict=True)]


def best_of(rows: Sequence[Row], epochs: int) -> Row:
    """Backpropagation's best of a length."""
    tried = [row for row in rows if row.epochs == epochs and row.name.startswith("bp")]
    return max(tried, key=lambda row: row.right.mean())


def turn_error(row: Row) -> float:
    """Mean of right places, of objects that are longer than wide [degrees]."""
    answers = row.results.at_false_alarm_rate().results
    turns = [
        one.turn_error_deg
        for one in answers
        if one.outcome == "right_place" and one.truth.elongated is not False
    ]
    return float(np.mean(turns)) if turns else float("nan")


def figures(row: Row) -> tuple[str, str]:
    """Right place and turn, as they print."""
    return f"{row.right.mean():.3f}", f"{turn_error(row):.2f}"


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=Path)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--bundle", type=Path, default=Path("export"))
    parser.add_argument("--scenes", type=int, default=3, help="pairs per condition and object")
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    bundle = load_bundle(asked.bundle)
    known = drawn_subjects(0) if asked.frames is None else subjects_of(list_frames(asked.frames))
    taught = tuple(spread(len(known), asked.limit))
    rows = measured(ScenePlan(tuple(known), taught, count=asked.scenes), bundle, 3)
    table = Table("epochs", "method", "right place", "turn", "misses, sgm / bp", "difference, 95 %")
    values = [
        {"method": row.name, "epochs": row.epochs, "right_place": float(row.right.mean())}
        for row in rows
    ]
    untouched = rows[0]
    table.add_row("0", untouched.name, *figures(untouched))
    for epochs in LENGTHS:
        mine = next(row for row in rows if row.epochs == epochs and row.name == "sgm int8")
        theirs = best_of(rows, epochs)
        quotient = (1 - mine.right.mean()) / max(1 - theirs.right.mean(), 1e-9)
        off, (low, high) = paired_difference(mine.right, theirs.right, 0)
        for row in (mine, theirs):
            extra = (f"{quotient:.2f}", f"{off:+.3f} ({low:+.3f} to {high:+.3f})")
            shown = extra if row is mine else ()
            table.add_row(str(epochs), row.name, *figures(row), *shown)
    Console(width=110).print(table)
    if asked.json is not None:
        asked.json.write_text(json.dumps(values, indent=1))


if __name__ == "__main__":
    main()
