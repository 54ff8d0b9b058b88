"""How faithful int8 gradients are on a folder of frames, and what they cost against float ones."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.bench.accuracy import groups_of
from qsgm.bench.frames import BenchFrame
from qsgm.bundle import Bundle
from qsgm.tune.prepare import KeptFeatures, Watch, prepare
from qsgm.tune.report import accuracy_json, fidelity_json, number, plain_table
from qsgm.tune.run import FinetuneResult, train
from qsgm.tune.settings import Settings

Floats = NDArray[np.float64]
LEGEND = """cos: of int8 to float gradients, mean over a run; here its mean and the worst
frame's; probe: the worst of any; true: cosine to the true gradient that int8
costs against float; clip: share of inputs outside their ranges"""


@dataclass(frozen=True)
class FidelityReport:
    """One int8 run, probed all along, and one float run per frame."""

    settings: Settings
    bundle: Bundle
    frames: tuple[BenchFrame, ...]
    int8: tuple[FinetuneResult, ...]
    floating: tuple[FinetuneResult, ...]

    @property
    def layers(self) -> list[int]:
        """Those in front of SGMs."""
        return sorted(self.int8[0].fidelity)

    def means(self, layer: int, metric: str) -> Floats:
        """One metric's mean over each frame's run, (frames,)."""
        return np.array([getattr(run.fidelity[layer], metric) for run in self.int8])

    def summary(self, layer: int) -> dict[str, Any]:
        """Of one SGM over all frames."""
        cosines = self.means(layer, "cos_int8_float")
        worst = int(cosines.argmin())
        probes = [probe.layers[layer].cos_int8_float for run in self.int8 for probe in run.probes]
        lost = self.means(layer, "cos_float_true") - self.means(layer, "cos_int8_true")
        return {
            "cos_int8_float": number(cosines.mean(), 6),
            "cos_int8_float_worst_frame": number(cosines[worst], 6),
            "worst_frame": self.frames[worst].name,
            "cos_int8_float_worst_probe": number(min(probes), 6),
            "cos_int8_true": number(self.means(layer, "cos_int8_true").mean(), 4),
            "cos_float_true": number(self.means(layer, "cos_float_true").mean(), 4),
            "cos_true_lost_worst_frame": number(lost.max(), 5),
            "clipped_fraction_worst_frame": number(self.means(layer, "clipped_fraction").max(), 6),
        }

    def accuracies(self) -> dict[str, Floats]:
        """Detection and angle error of both runs, (frames, 2) each."""
        runs = {"int8": self.int8, "float": self.floating}
        return {
            name: np.array(
                [[run.accuracy.detection_accuracy, run.accuracy.angle_mae_deg] for run in some]
            )
            for name, some in runs.items()
        }

    def to_json(self) -> dict[str, Any]:
        groups = groups_of(self.frames).items()
        return {
            "bundle": str(self.bundle.folder),
            "layers": {str(layer): self.summary(layer) for layer in self.layers},
            "epochs": self.settings.epochs,
            "seed": self.settings.seed,
            "groups": {group: self._accuracies_json(places) for group, places in groups},
            "warned": list(self.warned),
            "per_frame": self._frames_json(),
        }

    @property
    def warned(self) -> tuple[str, ...]:
        """Names of the frames on which the drift watch fired."""
        runs = zip(self.frames, self.int8, strict=True)
        return tuple(frame.name for frame, run in runs if run.warnings)

    def _accuracies_json(self, places: Sequence[int]) -> dict[str, Any]:
        return {
            name: {
                metric: number(values[list(places), i].mean(), 5)
                for i, metric in enumerate(("detection_accuracy", "angle_mae_deg"))
            }
            for name, values in self.accuracies().items()
        }

    def _frames_json(self) -> dict[str, Any]:
        runs = zip(self.frames, self.int8, self.floating, strict=True)
        return {
            frame.name: {
                **{str(k): fidelity_json(layer) for k, layer in int8.fidelity.items()},
                "int8": accuracy_json(int8.accuracy),
                "float": accuracy_json(floating.accuracy),
            }
            for frame, int8, floating in runs
        }

    def render(self) -> RenderableType:
        """A table per SGM, then what int8 costs in accuracy."""
        table = plain_table(f"{len(self.frames)} frames")
        for heading in ("layer", "cos", "worst", "probe", "true", "clip", "worst frame"):
            table.add_column(heading, justify="left" if heading == "worst frame" else "right")
        for layer in self.layers:
            row = self.summary(layer)
            table.add_row(
                str(layer),
                f"{row['cos_int8_float']:.5f}",
                f"{row['cos_int8_float_worst_frame']:.5f}",
                f"{row['cos_int8_float_worst_probe']:.4f}",
                f"{row['cos_true_lost_worst_frame']:.4f}",
                f"{row['clipped_fraction_worst_frame']:.4f}",
                row["worst_frame"],
            )
        watch = f"the drift watch fired on {len(self.warned)} of {len(self.frames)} frames"
        return Group(table, Text(LEGEND), self._accuracy_table(), Text(watch))

    def _accuracy_table(self) -> RenderableType:
        table = plain_table("what int8 costs")
        for heading in ("", "detect", "float", "angle", "float", "difference"):
            table.add_column(heading, justify="right" if heading else "left")
        both = self.accuracies()
        for group, places in groups_of(self.frames).items():
            int8, floating = (values[list(places)].mean(axis=0) for values in both.values())
            table.add_row(
                f"{group}: {len(places)}",
                f"{int8[0]:.4f}",
                f"{floating[0]:.4f}",
                f"{int8[1]:.3f}°",
                f"{floating[1]:.3f}°",
                f"{int8[1] - floating[1]:+.3f}°",
            )
        return table


def measure_fidelity(
    frames: Sequence[BenchFrame], bundle: Bundle, settings: Settings, watch: Watch
) -> FidelityReport:
    """Tune every frame with int8 SGMs, probing all along, and with float ones.

    Raises:
        QsgmError: a frame cannot be read, the bundle has no such SGMs, or training diverged.
    """
    settings = replace(settings, precision="int8")
    int8, floating = [], []
    for done, frame in enumerate(frames):
        watch("runs", done, len(frames))
        prepared = prepare(frame.read(), bundle, settings)
        # A run holds its crops' features; what is kept here does not need them.
        int8.append(without_features(train(prepared, settings)))
        plain = train(prepared, replace(settings, precision="float"), probe=False)
        floating.append(without_features(plain))
    watch("runs", len(frames), len(frames))
    return FidelityReport(settings, bundle, tuple(frames), tuple(int8), tuple(floating))


def without_features(result: FinetuneResult) -> FinetuneResult:
    """The same result without what takes megabytes."""
    light = replace(result.prepared, source=KeptFeatures(result.prepared.source.of(np.arange(0))))
    return replace(result, prepared=light)
