"""Untouched, int8 SGMs, float SGMs, backpropagation at its best: on devices of their own.

python examples/digits/compare.py mine [LAYERS [hand]]     # hand: digits mean what they are

Backpropagation takes the best of a grid of rates for every number of epochs, chosen on other
devices than those reported on.
"""

import sys
from itertools import product
from pathlib import Path

import numpy as np

from qsgm import Samples, Settings, load_bundle, load_task, prepare, resolve
from qsgm.manifest import Recipe
from qsgm.samples.tuned import TunedNetwork
from qsgm.tune.run import train

DEVICES, CHOSEN_ON, SHOWN, ASKED = 20, 5, 200, 400
EPOCHS = (1, 3, 20)
OPTIMIZERS, RATES = ("sgd", "adam"), (3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1, 3e-1)


def main(folder, layers="2", what="both"):
    """A row per method, a column per number of epochs."""
    task, bundle = load_task(Path(__file__).with_name("digits_task.py")), load_bundle(Path(folder))
    layers, meant = int(layers), what != "hand"
    devices = [device(task, seed, meant) for seed in range(DEVICES)]
    others = [device(task, 1000 + seed, meant) for seed in range(CHOSEN_ON)]
    print(f"{'':16}" + "".join(f"{n:>16}" for n in EPOCHS))
    for precision in ("int8", "float"):
        settings = [Settings("sgm", precision, layers, epochs=n) for n in EPOCHS]
        tell(f"{precision} SGMs", [accuracies(task, bundle, devices, one) for one in settings])
    found = []
    for epochs in EPOCHS:
        settings = Settings("bp", layers=layers, epochs=epochs)
        recipes = [Recipe(name, (rate,) * layers) for name, rate in product(OPTIMIZERS, RATES)]
        best = max(
            recipes, key=lambda one: np.mean(accuracies(task, bundle, others, settings, one))
        )
        found.append(accuracies(task, bundle, devices, settings, best))
        print(f"  {epochs} epochs: {best.optimizer} {best.rates[0]:g}", file=sys.stderr)
    tell("backpropagation", found)
    tell("untouched", [accuracies(task, bundle, devices, Settings(layers=layers, epochs=0))])


def device(task, seed, own_meanings):
    """What one device is shown, and what it is asked: one hand, one meaning of digits."""
    both = task.met(np.random.default_rng([7, seed]), SHOWN + ASKED, own_meanings)
    halves = slice(SHOWN), slice(SHOWN, None)
    return [Samples(both.inputs[half], both.labels[half]) for half in halves]


def accuracies(task, bundle, devices, settings, recipe=None):
    """Of every device on what it is asked."""
    right = []
    for shown, asked in devices:
        plan = resolve(settings, bundle, recipe)
        lesson = task.lesson([shown], np.random.default_rng(0))
        result = train(prepare(lesson, bundle, plan), plan)
        network = TunedNetwork("tuned", bundle.manifest.task, result.network())
        right.append(task.scores(network.answers(asked.inputs), asked.labels)["digit_accuracy"])
    return right


def tell(name, columns):
    """Mean and spread over the devices."""
    cells = [f"{np.mean(one):.3f} +- {np.std(one):.3f}" for one in columns]
    print(f"{name:16}" + "".join(f"{one:>16}" for one in cells), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
