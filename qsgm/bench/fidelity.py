"""How faithful int8 gradients are on a folder of frames, and what they cost against float ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import mean
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.bench.frames import BenchFrame, groups_of
from qsgm.bundle import Bundle
from qsgm.fidelity import LayerFidelity
from qsgm.grasp.teach import prepare_object, train_object, tune_object
from qsgm.progress import Progress
from qsgm.tables import keyed_table, number
from qsgm.task import Scores
from qsgm.tune.plan import resolve
from qsgm.tune.probe import Probe
from qsgm.tune.report import fidelity_json, scores_json
from qsgm.tune.settings import Settings

Floats = NDArray[np.float64]
LEGEND = """cos: of int8 to float gradients, mean over a run; here its mean and the worst
frame's; probe: the worst of any; true: cosine to the true gradient that int8
costs against float; clip: share of inputs outside their ranges"""
# key of a layer's summary, heading, format
_COLUMNS = (
    ("cos_int8_float", "cos", "{:.5f}"),
    ("cos_int8_float_worst_frame", "worst", "{:.5f}"),
    ("cos_int8_float_worst_probe", "probe", "{:.4f}"),
    ("cos_true_lost_worst_frame", "true", "{:.4f}"),
    ("clipped_fraction_worst_frame", "clip", "{:.4f}"),
    ("worst_frame", "worst frame", "{}"),
)

_KEYS = tuple(
    (f"{metric} {name}", name, metric)
    for metric in ("detection_accuracy", "angle_mae_deg")
    for name in ("int8", "float")
)
_COSTS = (
    ("detection_accuracy int8", "detect", "{:.4f}"),
    ("detection_accuracy float", "float", "{:.4f}"),
    ("angle_mae_deg int8", "angle", "{:.3f}°"),
    ("angle_mae_deg float", "float", "{:.3f}°"),
    ("more", "difference", "{:+.3f}°"),
)


@dataclass(frozen=True)
class FrameRuns:
    """One int8 run, probed all along, and one float run on the same crops."""

    frame: str
    fidelity: Mapping[int, LayerFidelity]  # means over the run, by SGM layer
    probes: tuple[Probe, ...]
    int8: Scores
    floating: Scores
    warned: bool


def measure_fidelity(
    frames: Sequence[BenchFrame], bundle: Bundle, settings: Settings, watch: Progress
) -> dict[str, Any]:
    """Tune every frame with int8 SGMs, probing all along, and with float ones.

    Raises:
        QsgmError: a frame cannot be read, the bundle has no such SGMs, or training diverged.
    """
    settings = replace(settings, precision="int8")
    runs = []
    for done, frame in enumerate(frames):
        watch("runs", done, len(frames))
        runs.append(run_frame(frame, bundle, settings))
    watch("runs", len(frames), len(frames))
    return {
        "bundle": str(bundle.folder),
        "layers": {str(layer): summary(layer, runs) for layer in sorted(runs[0].fidelity)},
        "epochs": settings.epochs,
        "seed": settings.seed,
        "groups": {
            group: {
                "int8": means([runs[i].int8 for i in places]),
                "float": means([runs[i].floating for i in places]),
            }
            for group, places in groups_of(frames).items()
        },
        "warned": [run.frame for run in runs if run.warned],
        "per_frame": {
            run.frame: {str(k): fidelity_json(layer) for k, layer in run.fidelity.items()}
            | {"int8": scores_json(run.int8), "float": scores_json(run.floating)}
            for run in runs
        },
    }


def run_frame(frame: BenchFrame, bundle: Bundle, settings: Settings) -> FrameRuns:
    """Both runs; what is kept of them holds no crops."""
    plan = resolve(settings, bundle)
    prepared = prepare_object(frame.read(), bundle, plan)
    int8 = tune_object(prepared, plan)
    floating = train_object(prepared, resolve(replace(settings, precision="float"), bundle)).scores
    name, warned = frame.name, bool(int8.warnings)
    return FrameRuns(name, int8.fidelity, int8.probes, int8.scores, floating, warned)


def summary(layer: int, runs: Sequence[FrameRuns]) -> dict[str, Any]:
    """One SGM over all frames."""

    def each(metric: str) -> Floats:
        return np.array([getattr(run.fidelity[layer], metric) for run in runs])

    cosines = each("cos_int8_float")
    worst = int(cosines.argmin())
    probes = [probe.layers[layer].cos_int8_float for run in runs for probe in run.probes]
    lost = each("cos_float_true") - each("cos_int8_true")
    return {
        "cos_int8_float": number(cosines.mean(), 6),
        "cos_int8_float_worst_frame": number(cosines[worst], 6),
        "worst_frame": runs[worst].frame,
        "cos_int8_float_worst_probe": number(min(probes), 6),
        "cos_int8_true": number(each("cos_int8_true").mean(), 4),
        "cos_float_true": number(each("cos_float_true").mean(), 4),
        "cos_true_lost_worst_frame": number(lost.max(), 5),
        "clipped_fraction_worst_frame": number(each("clipped_fraction").max(), 6),
    }


def means(accuracies: Sequence[Scores]) -> dict[str, float | None]:
    """Detection and angle error over frames."""
    return {
        metric: number(mean(one[metric] or 0.0 for one in accuracies), 5)
        for metric in ("detection_accuracy", "angle_mae_deg")
    }


def render(values: Mapping[str, Any]) -> RenderableType:
    """A row per SGM, then what int8 costs in accuracy."""
    frames = len(values["per_frame"])
    left = (0, len(_COLUMNS))
    gradients = keyed_table(f"{frames} frames", "layer", _COLUMNS, values["layers"], left)
    rows = {}
    for group, found in values["groups"].items():
        int8, floating = found["int8"], found["float"]
        rows[group] = {key: found[name][metric] for key, name, metric in _KEYS}
        rows[group]["more"] = int8["angle_mae_deg"] - floating["angle_mae_deg"]
    costs = keyed_table("what int8 costs", "", _COSTS, rows)
    watch = f"the drift watch fired on {len(values['warned'])} of {frames} frames"
    return Group(gradients, Text(LEGEND), costs, Text(watch))
