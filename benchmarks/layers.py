"""Last layers in one division into blocks or another: accuracy and time of each on every frame.

    python benchmarks/layers.py --frames DIR [--blocks 4,5,6 --blocks 3-4,5,6] [--limit 5]
        [--int8] [--epochs 20] [--json FILE]

Without `--blocks` all layers on their own, from one to as many as the bundle can tune.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track

from qsgm import Settings, load_bundle
from qsgm.bench.frames import BenchFrame, list_frames
from qsgm.blocks import parse_blocks
from qsgm.bundle import Bundle
from qsgm.grasp.teach import prepare_object, train_object
from qsgm.tables import number, table
from qsgm.tune.plan import resolve

COLUMNS = ("blocks", ("detection", "{:.3f}"), ("angle error", "{:.2f}°"))
COLUMNS += (("better than first", "{:.0%}"), ("tuning [s]", "{:.2f}"))


def results_of(frame: BenchFrame, bundle: Bundle, settings: Settings) -> tuple[float, float, float]:
    """Detection, angle error [degrees], and seconds of the tuning alone."""
    plan = resolve(settings, bundle)
    result = train_object(prepare_object(frame.read(), bundle, plan), plan)
    detection, angle = (result.scores[name] for name in ("detection_accuracy", "angle_mae_deg"))
    return detection, angle, result.seconds["tuning"]


def means(results: Any, first: Any) -> dict[str, Any]:
    """Over the frames, of results (frames, 3); `first` are those of the first division."""
    return {
        "detection_accuracy": number(results[:, 0].mean(), 4),
        "angle_mae_deg": number(results[:, 1].mean(), 4),
        "better_than_first": number(np.mean(results[:, 1] < first[:, 1]), 4),
        "tuning_s": number(np.median(results[:, 2]), 3),
        "per_frame": results[:, :2].round(4).tolist(),
    }


def measure(
    frames: Sequence[BenchFrame], bundle: Bundle, settings: Settings, divisions: Sequence[str]
) -> dict[str, Any]:
    """Tune every frame once per division into blocks."""
    blocks = [parse_blocks(text, bundle.network.depth) for text in divisions]
    for one in blocks:
        bundle.check_blocks(one)
    chosen = [replace(settings, layers=len(one.layers), blocks=str(one)) for one in blocks]
    runs = track(frames, console=Console(stderr=True))
    results = np.array([[results_of(frame, bundle, one) for one in chosen] for frame in runs])
    return {str(one): means(results[:, k], results[:, 0]) for k, one in enumerate(blocks)}


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("calib"))
    parser.add_argument("--blocks", action="append", help="layers in groups, such as 3-4,5,6")
    parser.add_argument("--limit", type=int)
    parser.add_argument("--int8", action="store_true")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--bundle", type=Path, default=Path("export"))
    parser.add_argument("--json", type=Path)
    asked = parser.parse_args()
    bundle, frames = load_bundle(asked.bundle), list_frames(asked.frames, asked.limit)
    settings = Settings(precision="int8" if asked.int8 else "float", epochs=asked.epochs)
    divisions = asked.blocks or [text for text in bundle.manifest.blocks if "-" not in text]
    values = measure(frames, bundle, settings, divisions)
    rows = [[text, *list(row.values())[:-1]] for text, row in values.items()]
    Console().print(table(f"{len(frames)} frames, {asked.epochs} epochs", COLUMNS, rows))
    if asked.json is not None:
        names = [frame.name for frame in frames]
        asked.json.write_text(json.dumps({"frames": names, "blocks": values}, indent=1))


if __name__ == "__main__":
    main()
