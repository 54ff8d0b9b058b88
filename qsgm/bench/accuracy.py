"""Detection and angle error of every method and run length, on the same crops of the same frames.

Every run is followed on the way: its learning curve starts at the untouched network and ends at
the tuned one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from qsgm.bench.frames import BenchFrame
from qsgm.bundle import Bundle, Method, OptimizerName, Precision, Recipe
from qsgm.errors import QsgmError
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.tune.loop import BATCH
from qsgm.tune.prepare import Prepared, Watch, prepare, validate
from qsgm.tune.run import train
from qsgm.tune.settings import Settings

Floats = NDArray[np.float64]

METRICS = ("detection_accuracy", "angle_mae_deg")
DETECTION, ANGLE = range(len(METRICS))
UNTOUCHED, SGM_INT8, BP_BEST = "untouched", "sgm int8", "bp best"
# What `bp best` is chosen from; one rate for all layers, momentum 0.9 for SGD.
GRID: Mapping[OptimizerName, tuple[float, ...]] = {
    "sgd": (0.003, 0.01, 0.02, 0.03),
    "adam": (0.0003, 0.001, 0.002, 0.003),
}


@dataclass(frozen=True)
class Variant:
    """One way to tune."""

    method: Method
    precision: Precision
    recipe: Recipe


# One frame's learning curves: (steps, METRICS).
Curves = dict[Variant, Floats]


@dataclass(frozen=True)
class Runs:
    """All runs of one length, on all frames; each array is (frames, steps, `METRICS`)."""

    epochs: int
    steps: tuple[int, ...]  # 0 is the untouched network, the last one the end of the run
    methods: dict[str, Floats]  # by name, the untouched network first and `bp best` last
    grid: dict[Recipe, Floats]  # of backpropagation; a run that diverged is all NaN
    best: Recipe  # the one of the grid that is `bp best`


@dataclass(frozen=True)
class AccuracyReport:
    """All frames' results."""

    settings: Settings
    bundle: Bundle
    frames: tuple[BenchFrame, ...]
    groups: dict[str, list[int]]  # of frames, by place; see `groups_of`
    runs: tuple[Runs, ...]  # by length, the main one last

    @property
    def judged(self) -> str:
        """The group that `bp best` was chosen on: the elongated frames where they are known."""
        return list(self.groups)[-1]


def measure_accuracy(
    frames: Sequence[BenchFrame],
    bundle: Bundle,
    settings: Settings,
    short: Sequence[int],
    watch: Watch,
) -> AccuracyReport:
    """Tune on every frame by every method; crops and features are shared between all runs.

    Args:
        frames: to tune on, one by one.
        bundle: to tune.
        settings: its epochs are the main run length; method, precision and optimizer do not matter.
        short: epochs of further runs; those that are not below the main length are left out.
        watch: told about every frame.

    Raises:
        QsgmError: a frame cannot be read, or training diverged with the bundle's own rates.
    """
    lengths = (*sorted({epochs for epochs in short if epochs < settings.epochs}), settings.epochs)
    methods, grid = own_methods(bundle, settings.layers), bp_grid(settings.layers)
    curves: list[dict[int, Curves]] = []
    for done, frame in enumerate(frames, start=1):
        prepared = prepare(frame.read(), bundle, settings)
        curves.append(
            {
                epochs: measure_runs(prepared, replace(settings, epochs=epochs), methods, grid)
                for epochs in lengths
            }
        )
        watch("frames", done, len(frames))
    groups = groups_of(frames)
    judged = list(groups.values())[-1]
    runs = [
        gather(epochs, [of_frame[epochs] for of_frame in curves], methods, grid, judged)
        for epochs in lengths
    ]
    return AccuracyReport(settings, bundle, tuple(frames), groups, tuple(runs))


def own_methods(bundle: Bundle, layers: int) -> dict[str, Variant]:
    """Each method with the bundle's recipe; backpropagation with both optimizers."""
    sgm = bundle.recipe("sgm", layers, None)
    return {
        SGM_INT8: Variant("sgm", "int8", sgm),
        "sgm float": Variant("sgm", "float", sgm),
        "bp sgd": Variant("bp", "float", bundle.recipe("bp", layers, "sgd")),
        "bp adam": Variant("bp", "float", bundle.recipe("bp", layers, "adam")),
    }


def bp_grid(layers: int) -> list[Variant]:
    """Backpropagation with every optimizer and rate of the grid."""
    return [
        Variant("bp", "float", Recipe(optimizer, (rate,) * layers))
        for optimizer, rates in GRID.items()
        for rate in rates
    ]


def groups_of(frames: Sequence[BenchFrame]) -> dict[str, list[int]]:
    """Places of all frames and, where a manifest says which they are, of the elongated ones."""
    elongated = [i for i, frame in enumerate(frames) if frame.elongated]
    groups = {"all": list(range(len(frames)))}
    return groups | {"elongated": elongated} if elongated else groups


def measure_runs(
    prepared: Prepared,
    settings: Settings,
    methods: Mapping[str, Variant],
    grid: Sequence[Variant],
) -> Curves:
    """One frame's learning curves of one length; no run is made twice."""
    curves = {variant: learning_curve(prepared, settings, variant) for variant in methods.values()}
    for variant in grid:
        if variant in curves:
            continue
        try:
            curves[variant] = learning_curve(prepared, settings, variant)
        except QsgmError:  # diverged, as high rates may: it is then not the best
            curves[variant] = np.full((len(curve_steps(settings.epochs)), len(METRICS)), np.nan)
    return curves


def learning_curve(prepared: Prepared, settings: Settings, variant: Variant) -> Floats:
    """`METRICS` on the validation crops after each of `curve_steps` of one run: (steps, 2)."""
    steps = curve_steps(settings.epochs)
    chosen = replace(settings, method=variant.method, precision=variant.precision)
    result = train(prepared, chosen, probe=False, recipe=variant.recipe, keep=steps)
    accuracies = [validate(prepared, result.kept[step], chosen) for step in steps]
    return np.array([[getattr(a, metric) for metric in METRICS] for a in accuracies])


def curve_steps(epochs: int) -> tuple[int, ...]:
    """Steps at which a run is looked at: none, two to every doubling, and its last one."""
    last = epochs * -(-TRAIN_CROPS // BATCH)
    doublings = range(2 * last.bit_length())
    return tuple(
        sorted({0, last} | {s for s in (round(2 ** (k / 2)) for k in doublings) if s < last})
    )


def gather(
    epochs: int,
    curves: Sequence[Curves],  # by frame
    methods: Mapping[str, Variant],
    grid: Sequence[Variant],
    judged: Sequence[int],
) -> Runs:
    """One length's runs by name; the lowest mean angle error on `judged` is the grid's best.

    The frames that choose are those reported on, which favours backpropagation.
    """
    together = {variant: np.stack([of[variant] for of in curves]) for variant in curves[0]}
    errors = [np.mean(together[variant][judged, -1, ANGLE]) for variant in grid]
    best = grid[int(np.argmin(np.nan_to_num(errors, nan=np.inf)))]
    own = {name: together[variant] for name, variant in methods.items()}
    steps = curve_steps(epochs)
    untouched = np.repeat(own[SGM_INT8][:, :1], len(steps), axis=1)
    return Runs(
        epochs,
        steps,
        {UNTOUCHED: untouched, **own, BP_BEST: together[best]},
        {variant.recipe: together[variant] for variant in grid},
        best.recipe,
    )
