"""Detection and angle error of every method, on the same crops of the same frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.bench.frames import BenchFrame
from qsgm.bundle import Bundle
from qsgm.finetuning import Accuracy, Settings, Watch, prepare, train
from qsgm.report import accuracy_json, number, plain_table

UNTOUCHED = "untouched"
# Each method with its own recipe; backpropagation with both optimizers.
METHODS: Mapping[str, dict[str, Any]] = {
    "sgm int8": {"method": "sgm", "precision": "int8"},
    "sgm float": {"method": "sgm", "precision": "float"},
    "bp sgd": {"method": "bp", "precision": "float", "optimizer": "sgd"},
    "bp adam": {"method": "bp", "precision": "float", "optimizer": "adam"},
}
METRICS = ("detection_accuracy", "angle_mae_deg")


@dataclass(frozen=True)
class FrameAccuracy:
    """One frame's results by method, the untouched network first."""

    frame: BenchFrame
    accuracy: dict[str, Accuracy]


@dataclass(frozen=True)
class AccuracyReport:
    """All frames' results."""

    settings: Settings
    bundle: Bundle
    frames: tuple[FrameAccuracy, ...]

    def groups(self) -> dict[str, list[FrameAccuracy]]:
        """All frames and, where a manifest says which they are, the elongated ones."""
        elongated = [frame for frame in self.frames if frame.frame.elongated]
        groups = {"all": list(self.frames)}
        return groups | {"elongated": elongated} if elongated else groups

    def to_json(self) -> dict[str, Any]:
        return {
            "bundle": str(self.bundle.folder),
            "layers": self.settings.layers,
            "epochs": self.settings.epochs,
            "seed": self.settings.seed,
            **{
                group: {"frames": len(frames), "methods": summary(frames)}
                for group, frames in self.groups().items()
            },
            "per_frame": [
                {
                    "frame": one.frame.name,
                    "elongated": one.frame.elongated,
                    "methods": {name: accuracy_json(a) for name, a in one.accuracy.items()},
                }
                for one in self.frames
            ],
        }

    def render(self, per_frame: bool) -> RenderableType:
        """Tables of every group and, if asked for, of every frame."""
        parts: list[RenderableType] = [
            summary_table(group, frames) for group, frames in self.groups().items()
        ]
        parts.append(Text("angle error in degrees, modulo 180°; spread: standard deviation"))
        return Group(*parts, per_frame_table(self.frames)) if per_frame else Group(*parts)


def measure_accuracy(
    frames: Sequence[BenchFrame], bundle: Bundle, settings: Settings, watch: Watch
) -> AccuracyReport:
    """Tune on every frame by every method; crops and features are shared between methods."""
    results = []
    for done, frame in enumerate(frames, start=1):
        results.append(FrameAccuracy(frame, measure_frame(frame, bundle, settings)))
        watch("frames", done, len(frames))
    return AccuracyReport(settings, bundle, tuple(results))


def measure_frame(frame: BenchFrame, bundle: Bundle, settings: Settings) -> dict[str, Accuracy]:
    """One frame's accuracy by method."""
    prepared = prepare(frame.read(), bundle, settings)
    accuracy = {UNTOUCHED: prepared.zero_shot}
    for name, changes in METHODS.items():
        accuracy[name] = train(prepared, replace(settings, **changes), probe=False).accuracy
    return accuracy


def summary(frames: Sequence[FrameAccuracy]) -> dict[str, Any]:
    """Mean, median and spread (standard deviation) of every metric, by method."""
    return {
        name: {metric: statistics(values_of(frames, name, metric)) for metric in METRICS}
        for name in frames[0].accuracy
    }


def statistics(values: Sequence[float]) -> dict[str, float | None]:
    """Mean, median, standard deviation and both ends."""
    return {
        "mean": number(float(np.mean(values)), 4),
        "median": number(float(np.median(values)), 4),
        "spread": number(float(np.std(values)), 4),
        "min": number(min(values), 4),
        "max": number(max(values), 4),
    }


def values_of(frames: Sequence[FrameAccuracy], name: str, metric: str) -> list[float]:
    """One metric of one method on every frame."""
    return [float(getattr(frame.accuracy[name], metric)) for frame in frames]


def summary_table(group: str, frames: Sequence[FrameAccuracy]) -> RenderableType:
    """One row per method."""
    table = plain_table(f"{group}: {len(frames)} frames")
    table.add_column("method")
    for metric in ("detection", "angle"):
        for statistic in ("mean", "median", "spread"):
            table.add_column(f"{metric}\n{statistic}", justify="right")
    for name in frames[0].accuracy:
        cells = []
        for metric, form in zip(METRICS, ("{:.3f}", "{:.2f}"), strict=True):
            values = values_of(frames, name, metric)
            cells += [form.format(f(values)) for f in (np.mean, np.median, np.std)]
        table.add_row(name, *cells)
    return table


def per_frame_table(frames: Sequence[FrameAccuracy]) -> RenderableType:
    """One row per frame: detection and angle error of every method."""
    table = plain_table("per frame: detection, angle error")
    table.padding = (0, 1, 0, 0)
    table.add_column("frame", no_wrap=True, max_width=19)
    for name in frames[0].accuracy:
        table.add_column(name, justify="right", no_wrap=True, min_width=9)
    for frame in frames:
        cells = [
            f"{a.detection_accuracy:.2f} {a.angle_mae_deg:4.1f}" for a in frame.accuracy.values()
        ]
        table.add_row(frame.frame.name, *cells)
    return table
