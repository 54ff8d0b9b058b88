"""Detection and angle error of every method and run length, on the same crops of the same frames.

Every run is followed on the way: its learning curve starts at the untouched network and ends at
the tuned one.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from qsgm.bench.frames import BenchFrame, groups_of
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.grasp.crops import TRAIN_CROPS
from qsgm.grasp.teach import prepare_object
from qsgm.manifest import Method, OptimizerName, Precision, Recipe
from qsgm.progress import Progress
from qsgm.schedule import steps_per_epoch
from qsgm.tables import TIGHT, number, table
from qsgm.tune.plan import resolve
from qsgm.tune.prepare import Prepared, validate
from qsgm.tune.run import Keeper, train
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

LEGEND = """means over frames after so many epochs (ep.); then the longest run's median and
spread (standard deviation); angle: error in degrees, modulo 180°
bp best: of a grid, the optimizer and rate with the lowest angle error on these
very frames, for every run length anew, which favours backpropagation"""


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
    groups: dict[str, list[int]]  # of frames, by place
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
    watch: Progress,
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
        prepared = prepare_object(frame.read(), bundle, resolve(settings, bundle))
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
    tuned = bundle.network.last(layers)
    sgm = bundle.recipe("sgm", tuned, None)
    return {
        SGM_INT8: Variant("sgm", "int8", sgm),
        "sgm float": Variant("sgm", "float", sgm),
        "bp sgd": Variant("bp", "float", bundle.recipe("bp", tuned, "sgd")),
        "bp adam": Variant("bp", "float", bundle.recipe("bp", tuned, "adam")),
    }


def bp_grid(layers: int) -> list[Variant]:
    """Backpropagation with every optimizer and rate of the grid."""
    return [
        Variant("bp", "float", Recipe(optimizer, (rate,) * layers))
        for optimizer, rates in GRID.items()
        for rate in rates
    ]


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
    keeper = Keeper(steps)
    train(prepared, resolve(chosen, prepared.bundle, variant.recipe), (keeper,))
    scores = [validate(prepared, keeper.kept[step]) for step in steps]
    return np.array([[some[metric] for metric in METRICS] for some in scores], float)


def curve_steps(epochs: int) -> tuple[int, ...]:
    """Steps at which a run is looked at: none, two to every doubling, and its last one."""
    last = epochs * steps_per_epoch(TRAIN_CROPS)
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


def report_json(report: AccuracyReport) -> dict[str, Any]:
    """The main run length's figures, then all lengths' with the grid and the learning curves."""
    main, groups = report.runs[-1], report.groups
    return {
        "bundle": str(report.bundle.folder),
        "layers": report.settings.layers,
        "trunk": report.settings.trunk or report.bundle.manifest.trunk,
        "epochs": report.settings.epochs,
        "seed": report.settings.seed,
        **{
            group: {"frames": len(places), "methods": summary(main, places)}
            for group, places in groups.items()
        },
        "per_frame": [
            {
                "frame": frame.name,
                "elongated": frame.elongated,
                "methods": one_frame(main, i),
                "runs": {str(runs.epochs): one_frame(runs, i) for runs in report.runs},
            }
            for i, frame in enumerate(report.frames)
        ],
        "chosen_on": report.judged,
        "runs": [runs_json(runs, groups, report.judged) for runs in report.runs],
    }


def runs_json(runs: Runs, groups: dict[str, list[int]], judged: str) -> dict[str, Any]:
    """One run length: every group's figures, what `bp best` is, and the learning curves."""
    return {
        "epochs": runs.epochs,
        "steps": runs.steps[-1],
        "bp_best": _recipe_json(runs.best),
        "sgm_int8_over_bp_best": {
            group: {m: number(over_best(runs, places, k), 4) for k, m in enumerate(METRICS)}
            for group, places in groups.items()
        },
        **{group: summary(runs, places) for group, places in groups.items()},
        "grid": [
            _recipe_json(recipe)
            | {group: _means(curves[places, -1]) for group, places in groups.items()}
            for recipe, curves in runs.grid.items()
        ],
        "curves": {
            "frames": judged,
            "steps": list(runs.steps),
            "methods": {
                name: {m: curve_json(values[groups[judged], :, k]) for k, m in enumerate(METRICS)}
                for name, values in runs.methods.items()
            },
        },
    }


def one_frame(runs: Runs, place: int) -> dict[str, Any]:
    """One frame's results by method."""
    return {name: _means(values[[place], -1]) for name, values in runs.methods.items()}


def summary(runs: Runs, places: Sequence[int]) -> dict[str, Any]:
    """Mean, median, spread and both ends of every metric at the end of the runs, by method."""
    return {
        name: {m: statistics(values[places, -1, k].tolist()) for k, m in enumerate(METRICS)}
        for name, values in runs.methods.items()
    }


def statistics(values: Sequence[float]) -> dict[str, float | None]:
    """Mean, median, standard deviation and both ends."""
    array = np.array(values, float)
    mean, median, spread = array.mean(), np.median(array), array.std()
    found = {"mean": mean, "median": median, "spread": spread, "min": min(values)}
    return {name: number(float(value), 4) for name, value in (found | {"max": max(values)}).items()}


def curve_json(values: Floats) -> dict[str, list[float | None]]:
    """Mean and quartiles over the frames of one metric (frames, steps)."""
    low, high = np.quantile(values, (0.25, 0.75), axis=0)
    lines = {"mean": values.mean(axis=0), "lower_quartile": low, "upper_quartile": high}
    return {name: [number(value, 4) for value in line] for name, line in lines.items()}


def over_best(runs: Runs, places: Sequence[int], metric: int) -> float:
    """Mean of `sgm int8` over that of `bp best`, at the end of the runs."""
    ours, best = (runs.methods[name][places, -1, metric].mean() for name in (SGM_INT8, BP_BEST))
    return float(ours / best) if best else np.nan


def _recipe_json(recipe: Recipe) -> dict[str, Any]:
    return {"optimizer": recipe.optimizer, "rate": recipe.rates[0]}


def _means(values: Floats) -> dict[str, float | None]:
    """Of every metric over frames: (frames, METRICS)."""
    return {m: number(values[:, k].mean(), 4) for k, m in enumerate(METRICS)}


def render(values: Mapping[str, Any], per_frame: bool) -> RenderableType:
    """Tables of every group, of the best backpropagation and, if asked for, of every frame."""
    groups = [group for group in ("all", "elongated") if group in values]
    parts: list[RenderableType] = [
        *(summary_table(values, group) for group in groups),
        best_table(values),
        Text(LEGEND),
    ]
    return Group(*parts, per_frame_table(values)) if per_frame else Group(*parts)


def summary_table(values: Mapping[str, Any], group: str) -> Table:
    """One row per method; means of every run length, median and spread of the main one."""
    runs, main = values["runs"], values[group]["methods"]
    forms = ("{:.3f}", "{:.2f}")
    columns: list[str | tuple[str, str]] = ["\nmethod"]
    for run in runs:
        columns += zip((f"{run['epochs']} ep.\ndetect", "\nangle"), forms, strict=True)
    for heading, form in zip(("detect", "angle"), forms, strict=True):
        columns += [(f"{heading}\nmedian", form), ("\nspread", form)]
    rows = [
        [name, *(run[group][name][m]["mean"] for run in runs for m in METRICS)]
        + [main[name][m][statistic] for m in METRICS for statistic in ("median", "spread")]
        for name in main
    ]
    return table(f"{group}: {values[group]['frames']} frames", columns, rows, padding=TIGHT)


def best_table(values: Mapping[str, Any]) -> Table:
    """One row per run length: what `bp best` is, and how `sgm int8` compares with it."""
    judged = values["chosen_on"]
    rows = []
    for run in values["runs"]:
        best, ratios = run["bp_best"], run["sgm_int8_over_bp_best"][judged].values()
        rows.append([_epochs(run), run["steps"], best["optimizer"], f"{best['rate']:g}", *ratios])
    columns = ["\nrun length", "\nsteps", "bp best:\noptimizer", "\nrate"]
    ratio = ("sgm int8 / bp best:\ndetection", "{:.3f}"), ("\nangle error", "{:.3f}")
    title = f"{judged}: {SGM_INT8} against {BP_BEST}"
    return table(title, [*columns, *ratio], rows, left=(2,))


def per_frame_table(values: Mapping[str, Any]) -> Table:
    """One row per frame: detection and angle error of every method, main run length."""
    detection, angle = METRICS
    rows = [
        [
            frame["frame"],
            *(f"{m[detection]:.2f} {m[angle]:4.1f}" for m in frame["methods"].values()),
        ]
        for frame in values["per_frame"]
    ]
    title = f"per frame, {_epochs(values)}: detection, angle error"
    made = table(title, ["frame", *values["all"]["methods"]], rows, padding=TIGHT)
    made.columns[0].max_width = 18
    return made


def _epochs(values: Mapping[str, Any]) -> str:
    return f"{values['epochs']} epoch{'' if values['epochs'] == 1 else 's'}"
