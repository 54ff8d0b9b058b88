"""How many layers to tune, and in which blocks: accuracy and time of each on every frame."""

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Group, RenderableType
from rich.text import Text

from qsgm.bench.accuracy import ANGLE, DETECTION, METRICS, groups_of
from qsgm.bench.frames import BenchFrame
from qsgm.blocks import Blocks, parse_blocks
from qsgm.bundle import Bundle
from qsgm.tune.prepare import Watch, prepare
from qsgm.tune.report import number, plain_table
from qsgm.tune.run import peak_activation_bytes, train
from qsgm.tune.settings import Settings

Floats = NDArray[np.float64]
LEGEND = """means over frames; angle: error in degrees, modulo 180°; better: share of the
frames with a lower angle error than by the first blocks; tuning: median"""


@dataclass(frozen=True)
class LayersReport:
    """One row per way to divide the last layers into blocks."""

    settings: Settings
    bundle: Bundle
    frames: tuple[BenchFrame, ...]
    blocks: tuple[str, ...]
    results: Floats  # (blocks, frames, METRICS)
    seconds: Floats  # (blocks, frames), of the tuning alone

    def to_json(self) -> dict[str, Any]:
        groups = groups_of(self.frames)
        return {
            "bundle": str(self.bundle.folder),
            "method": self.settings.method,
            "precision": self.settings.precision,
            "epochs": self.settings.epochs,
            "seed": self.settings.seed,
            "frames": [frame.name for frame in self.frames],
            "blocks": {
                text: {
                    group: {
                        metric: number(float(self.results[i, places, k].mean()), 4)
                        for k, metric in enumerate(METRICS)
                    }
                    for group, places in groups.items()
                }
                | {
                    "tuning_s": number(float(np.median(self.seconds[i])), 3),
                    "peak_activation_bytes": peak_activation_bytes(
                        self.bundle, self.settings.precision, parse_blocks(text)
                    ),
                    "per_frame": self.results[i].round(4).tolist(),
                }
                for i, text in enumerate(self.blocks)
            },
        }

    def render(self) -> RenderableType:
        """A table per group of frames."""
        tables = [self._table(group, places) for group, places in groups_of(self.frames).items()]
        return Group(*tables, Text(LEGEND))

    def _table(self, group: str, places: Sequence[int]) -> RenderableType:
        table = plain_table(f"{group}: {len(places)} frames")
        for heading in ("blocks", "detect", "angle", "better", "tuning [s]"):
            table.add_column(heading, justify="left" if heading == "blocks" else "right")
        first = self.results[0, places, ANGLE]
        for text, results, seconds in zip(self.blocks, self.results, self.seconds, strict=True):
            angle = results[places, ANGLE]
            table.add_row(
                text,
                f"{results[places, DETECTION].mean():.3f}",
                f"{angle.mean():.2f}",
                f"{np.mean(angle < first):.0%}",
                f"{np.median(seconds[list(places)]):.2f}",
            )
        return table


def measure_layers(
    frames: Sequence[BenchFrame],
    bundle: Bundle,
    settings: Settings,
    blocks: Sequence[Blocks],
    watch: Watch,
) -> LayersReport:
    """Tune every frame once per division into blocks.

    Args:
        frames: to tune on, one by one.
        bundle: to tune.
        settings: of every run; layers and blocks do not matter.
        blocks: the divisions; the first one is what the others are compared with.
        watch: told about every run.

    Raises:
        QsgmError: the bundle has no step for some blocks, a frame cannot be read, or training
            diverged.
    """
    for one in blocks:
        bundle.check_blocks(one)
    results = np.zeros((len(blocks), len(frames), len(METRICS)))
    seconds = np.zeros(results.shape[:2])
    for column, frame in enumerate(frames):
        for row, one in enumerate(blocks):
            chosen = replace(settings, layers=len(one.layers), blocks=str(one))
            prepared = prepare(frame.read(), bundle, chosen)
            began = time.perf_counter()
            tuned = train(prepared, chosen, probe=False)
            seconds[row, column] = time.perf_counter() - began
            results[row, column] = [getattr(tuned.accuracy, metric) for metric in METRICS]
            watch("runs", column * len(blocks) + row + 1, len(frames) * len(blocks))
    names = tuple(map(str, blocks))
    return LayersReport(settings, bundle, tuple(frames), names, results, seconds)
