"""A watch for each of ten people, made by the other nine: what it gains from seven repetitions.

python examples/watch/compare.py FOLDER [PERSON ...]     # 0 to 9; then a table of all in FOLDER

Shown is the first third of each exercise's set with one arm; asked are the rest of those sets and
the sets with the other arm, and both arms take turns. FOLDER keeps a bundle and a JSON file of
figures by person, so that a comparison goes on where it stopped. Every method takes the best of a
grid for each figure, which for each person the other nine choose; `at its best`: all ten do.
"""

import json
import sys
import time
from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from qsgm import Settings, load_bundle, load_task, prepare, resolve
from qsgm.manifest import Recipe
from qsgm.samples.lesson import SampleLesson
from qsgm.tune.run import train, tune

EPOCHS, ASKED = (1, 3, 20), ("rest of the set", "other arm")
GRID = [Recipe("adam", (rate, rate)) for rate in (3e-3, 1e-2, 3e-2)]
GRID += [
    Recipe("adam", rates) for rates in ((1e-3, 3e-2), (3e-3, 1e-2), (3e-3, 3e-2), (1e-2, 3e-2))
]
GRID += [Recipe("sgd", rates) for rates in ((0.05, 0.1), (0.1, 0.1), (0.1, 0.2), (0.3, 0.3))]
ALONE = [Recipe("adam", (rate,)) for rate in (1e-2, 3e-2, 1e-1)] + [Recipe("sgd", (0.3,))]
NEIGHBOURS = (1, 3, 5, 9)
METHODS = {
    "int8 SGMs": Settings("sgm", "int8", 2),
    "float SGMs": Settings("sgm", "float", 2),
    "backpropagation": Settings("bp", layers=2),
    "last layer alone": Settings("bp", layers=1),
}
FILE = Path(__file__).with_name("watch_task.py")


def main(folder, *people):
    """Figures of these people, then a table of all there are."""
    task = load_task(FILE)
    for person in map(int, people or range(10)):
        kept = Path(folder) / f"{person}.json"
        if not kept.exists():
            began = time.process_time()
            bundle = bundle_without(task, person, Path(folder) / f"{person}")
            print(person, round(time.process_time() - began), "s", file=sys.stderr, flush=True)
            kept.write_text(json.dumps(figures_of(task, bundle, person), indent=1))
    print_table([json.loads(one.read_text()) for one in sorted(Path(folder).glob("?.json"))])


def bundle_without(task, person, folder):
    """The bundle of a host that does not know one of the ten."""
    if not folder.exists():
        from qsgm.train import build
        from qsgm.train.export import ExportOptions

        without = replace(task, left_out=person)
        build(without, folder, config=sizes(without), options=ExportOptions(epochs=2))
    return load_bundle(folder)


def sizes(task):
    """Half of the usual steps, rates at which backpropagation does well, no meta-training."""
    from qsgm.train import quicker, usual_config

    half = quicker(usual_config(task), 0.5)
    rates = replace(half.rates, tasks=8, early_tasks=1, early_epochs=3, early_crops_per_task=40)
    return replace(
        half,
        hidden=(64, 64),
        first_rates=(0.1, 0.2),
        own_runs=usual_config(task).own_runs,
        backbone=replace(half.backbone, steps=400),
        maml=replace(half.maml, outer_steps=1),
        rates=rates,
    )


def figures_of(task, bundle, person):
    """Figures by name, means over both arms, each of what is asked."""
    both = [dict(figures_by(task, bundle, person, arm)) for arm in (0, 1)]
    return {name: np.mean([one[name] for one in both], axis=0).tolist() for name in both[0]}


def figures_by(task, bundle, person, arm):
    """Accuracies, seconds and cosines, shown one arm."""
    lesson, settings = lesson_by(task, person, arm), Settings(layers=task.tuned)
    prepared = prepare(lesson, bundle, resolve(settings, bundle))
    yield "untouched//", worth(prepared.untouched)
    last = prepare(lesson, bundle, resolve(replace(settings, layers=1), bundle))
    for epochs, (name, how) in product(EPOCHS, METHODS.items()):
        start, recipes = (last, ALONE) if how.layers == 1 else (prepared, GRID)
        if how.method == "sgm":
            plan = resolve(replace(how, epochs=epochs), bundle)
            yield f"{name}, the bundle's rates/{epochs}/", worth(train(start, plan).scores)
        for one in recipes:
            asked = replace(how, epochs=epochs, optimizer=one.optimizer)
            result = train(start, resolve(asked, bundle, one))
            rates = " ".join(f"{rate:g}" for rate in one.rates)
            yield f"{name}/{epochs}/{one.optimizer} {rates}", worth(result.scores)
            yield f"seconds, {name}/{epochs}/{one.optimizer} {rates}", result.seconds["tuning"]
    spaces = {"network's features": last.features[:, 0], "statistics": statistics(lesson.inputs)}
    for (space, seen), count in product(spaces.items(), NEIGHBOURS):
        yield f"neighbours by {space}//{count}", worth(neighbours(lesson, seen, count))
    asked = replace(METHODS["int8 SGMs"], optimizer="adam")
    probed = tune(prepared, resolve(asked, bundle, Recipe("adam", (0.003, 0.03))))
    for layer, one in probed.fidelity.items():
        yield f"cosine int8,float, layer {layer}", one.cos_int8_float
        yield f"cosine int8,true, layer {layer}", one.cos_int8_true
        yield (
            f"cosine int8,true, layer {layer}, at the start",
            probed.probes[0].layers[layer].cos_int8_true,
        )


@dataclass(frozen=True)
class WearersLesson(SampleLesson):
    """Windows that are shown, then those that are asked: of the same sets, of the other arm."""

    other: int = 0  # the first of the other arm

    def scores(self, outputs, rows):
        right = outputs.argmax(axis=1) == self.labels[rows].argmax(axis=1)
        return {name: right[(rows >= self.other) == bool(i)].mean() for i, name in enumerate(ASKED)}


def lesson_by(task, person, arm):
    """One person's sets, in windows that do not overlap those shown."""
    module = sys.modules[type(task).__module__]
    motion, starts, lengths = module.pool()

    def of(arm, kind, first, last):
        start, length = starts[person, arm, kind], lengths[person, arm, kind]
        at = range(int(first * length), int(last * length) - module.LENGTH + 1, module.HOP)
        return [motion[start + i : start + i + module.LENGTH] for i in at]

    kinds = range(module.SETS[2])
    parts = [
        [of(arm, kind, 0, 1 / 3) for kind in kinds],
        [of(arm, kind, 1 / 3, 1) for kind in kinds],
    ]
    parts.append([of(1 - arm, kind, 0, 1) for kind in kinds])
    inputs = np.concatenate([one for part in parts for one in part])[:, None]
    known = np.concatenate([[k] * len(one) for part in parts for k, one in enumerate(part)])
    taught, rest, _ = (sum(map(len, part)) for part in parts)
    return WearersLesson(task, inputs, module.ONE_HOT[known], taught, taught + rest)


def statistics(inputs):
    """Of every channel the mean, the spread, both ends and how fast it changes, (N, 30)."""
    x = inputs[:, 0]
    parts = x.mean(1), x.std(1), x.min(1), x.max(1), np.abs(np.diff(x, axis=1)).mean(1)
    return np.concatenate(parts, axis=1)


def neighbours(lesson, seen, count):
    """Scores of the classes that most of the nearest windows shown have."""
    seen = seen / (seen[: lesson.taught].std(axis=0) + 1e-6)
    shown, asked = seen[: lesson.taught], seen[lesson.taught :]
    apart = (asked**2).sum(1)[:, None] + (shown**2).sum(1) - 2 * asked @ shown.T
    votes = lesson.labels[np.argsort(apart, axis=1)[:, :count]].sum(axis=1)
    return lesson.scores(votes, np.arange(lesson.taught, len(lesson)))


def worth(scores):
    """Accuracies of what is asked, in their order."""
    return [float(scores[name]) for name in ASKED]


def print_table(people):
    """Mean and spread over people; `both` is the mean of what is asked."""
    grids = defaultdict(dict)
    for name in people[0]:
        values = np.array([one[name] for one in people])
        if values.ndim == 2:
            method, epochs, recipe = name.split("/")
            grids[method, epochs][recipe] = np.column_stack([values, values.mean(axis=1)])
        elif name.startswith("cosine"):
            print(f"{name:44} {values.mean():.5f}")
    columns = [*ASKED, "both"]
    print(
        f"\n{len(people):2} people{'':27}{'epochs':>8}" + "".join(f"{one:>18}" for one in columns)
    )
    for (method, epochs), grid in grids.items():
        print_row(method, epochs, [chosen_by_others(grid, i) for i in range(len(columns))])
        if method == "backpropagation":
            best = [max((one[:, i] for one in grid.values()), key=np.mean) for i in range(3)]
            print_row(f"{method} at its best", epochs, best)
    print("\nmeans of both, 95 % intervals over people:")
    for epochs in map(str, EPOCHS):
        print_beside(grids, epochs)


def print_beside(grids, epochs):
    """Errors by the bundle's rates, beside backpropagation's and the untouched network's."""
    of_bp, untouched = grids["backpropagation", epochs], grids["untouched", ""][""][:, -1]
    default = grids["int8 SGMs, the bundle's rates", epochs][""][:, -1]
    chosen = chosen_by_others(of_bp, -1)
    best = max((one[:, -1] for one in of_bp.values()), key=np.mean)
    print(
        f"{epochs:>2} epochs: errors over backpropagation's {quotient(default, chosen)}"
        f" (at its best {quotient(default, best)}), more by {interval(chosen - default)};"
        f" right more often than untouched by {interval(default - untouched)}"
    )


def quotient(right, others):
    """Errors over others', who may have made none."""
    wrong = (1 - others).mean()
    return f"{(1 - right).mean() / wrong:.2f}" if wrong else "-"


def interval(differences):
    """Their mean, and where that of people drawn anew lies in 95 of 100 cases."""
    rng, count = np.random.default_rng(0), len(differences)
    low, high = np.percentile(rng.choice(differences, (20000, count)).mean(axis=1), (2.5, 97.5))
    return f"{differences.mean():.3f} ({low:.3f} to {high:.3f})"


def print_row(method, epochs, columns):
    """One method's figures by what was asked."""
    cells = [f"{one.mean():.3f} +- {one.std():.3f}" for one in columns]
    print(f"{method:36}{epochs:>8}" + "".join(f"{one:>18}" for one in cells))


def chosen_by_others(grid, column):
    """Of each person what that setting gives that is best for all others."""
    values = np.stack([one[:, column] for one in grid.values()])  # (settings, people)
    others = values.sum(axis=1, keepdims=True) - values
    return values[others.argmax(axis=0), np.arange(values.shape[1])]


if __name__ == "__main__":
    main(*sys.argv[1:])
