"""Cost of a step by batch, layers and width, of a job by its crops; where int8 wins.

    python benchmarks/growth --frames DIR [--repeats 100] [--threads 1] [--json FILE]
        [--picture FILE]

Batch, layers and crops are timed on the bundle's own graphs, width on graphs built here, with
random weights (wide.py) and otherwise as the exporter builds them. Whatever is compared takes turns
in one process, so that what else the machine does hits all of it; medians are kept.
"""

import argparse
import json
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

from chart import draw
from jobs import Series, crops_series, series, sgm_jobs, trunk_jobs, wide_jobs
from rich.console import Console
from rich.table import Table
from rich.text import Text

from qsgm import defaults, load_bundle
from qsgm.bench.frames import list_frames
from qsgm.bench.timing import step_jobs
from qsgm.schedule import BATCH
from qsgm.tables import CLOSE, number, table
from qsgm.tune.graphs import running_graphs

# A layer in front of an SGM that is timed alone, by the SGM's kernel.
LAYER_BEFORE = {1: 4, 3: 3}
LEAST_SAVED = 0.05  # of float's time; with less saved, int8 does not count as quicker
LEGENDS = {
    "width": "width: times the channels of every layer but the last; wider: SGMs whose hidden "
    "channels grow as much, else they are the bundle's",
    "crops": "a job: four fifths of the crops are trained on; medians of a few, no probes",
    "sgm_3x3": "16, 8: bits of an activation, in two u8 planes or one; u8: weights as this package "
    "runs them, exact on every CPU; s8: as exact on CPUs with VNNI",
}


def measure(asked: argparse.Namespace) -> dict[str, Series]:
    """Milliseconds by what grows, its size, and variant."""
    bundle, frame = load_bundle(asked.bundle), list_frames(asked.frames, 1)[0]
    threads, repeats = asked.threads, asked.repeats
    layers = [count for count in asked.layers if count <= bundle.manifest.most_layers]
    with running_graphs(bundle):
        found = {
            "batch": series(
                asked.batches, repeats, partial(step_jobs, bundle, defaults.LAYERS, threads)
            ),
            "layers": series(layers, repeats, lambda n: step_jobs(bundle, n, threads)),
            "width": series(asked.widths, repeats, partial(wide_jobs, bundle, threads)),
            "crops": crops_series(frame.read(), bundle, asked.crops, asked.epochs, threads),
            "trunk": series(asked.widths, repeats, partial(trunk_jobs, bundle, threads)),
        }
        for kernel, layer in LAYER_BEFORE.items():
            if layer in bundle.manifest.sgms:
                jobs = partial(sgm_jobs, bundle, layer, threads)
                found[f"sgm_{kernel}x{kernel}"] = series(asked.widths, repeats, jobs)
    return found


def tables(found: dict[str, Series]) -> Iterator[Table | Text]:
    """A row per size, and what int8 takes of float's time."""
    for name, sizes in found.items():
        first = next(iter(sizes.values()))
        pairs = int8_pairs(first)
        columns = [(variant.replace("_", "\n"), "{:.3f}") for variant in first]
        columns += [(int8.replace("_", "\n") + " /", "{:.2f}") for int8, _ in pairs]
        rows = [
            [size, *ms.values(), *(ms[int8] / ms[floating] for int8, floating in pairs)]
            for size, ms in sizes.items()
        ]
        yield table(f"{name}: ms; /: over float", ["", *columns], rows, left=(), padding=CLOSE)
        if name in LEGENDS:
            yield Text(LEGENDS[name], style="dim")


def int8_pairs(variants: Any) -> list[tuple[str, str]]:
    """Variants in int8, each with the float one that it stands for."""
    return [
        (name, "sgm_float_wider" if name == "sgm_int8_wider" else floating)
        for floating in ("sgm_float", "float")
        if floating in variants
        for name in variants
        if "int8" in name
    ]


def where_int8_wins(found: dict[str, Series]) -> str:
    """One line, from these times."""
    parts, lost = [], []
    for name in ("width", *(name for name in found if name == "trunk" or "sgm" in name)):
        sizes = found[name]
        for int8, floating in int8_pairs(next(iter(sizes.values()))):
            most = 1 - LEAST_SAVED
            won = [size for size, ms in sizes.items() if ms[int8] <= most * ms[floating]]
            if won:
                parts.append(f"{name} {', '.join(map(str, won))} ({int8})")
            else:
                lost.append(f"{name} ({int8})")
    nowhere = [f"nowhere: {', '.join(lost)}"] if lost else []
    return f"int8 saves {LEAST_SAVED:.0%} of float's time or more: {'; '.join(parts + nowhere)}"


def counts(text: str) -> list[int]:
    """Whole numbers between commas."""
    return [int(part) for part in text.split(",")]


def main() -> None:
    """Measure, print, write and draw what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=Path, default=Path("calib"))
    parser.add_argument("--bundle", type=Path, default=Path("export"))
    parser.add_argument("--threads", type=int, default=1, help="of ONNX Runtime")
    parser.add_argument("--repeats", type=int, default=100, help="of every step, pass and SGM")
    parser.add_argument("--epochs", type=int, default=20, help="of the jobs")
    for name, sizes in (
        ("batches", "8,16,32,64,128"),
        ("layers", "1,2,3,4,5,6"),
        ("widths", "1,2,4,8"),
        ("crops", "250,500,1000,2000"),
    ):
        parser.add_argument(f"--{name}", type=counts, default=counts(sizes))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    found = measure(asked)
    console = Console()
    console.print(f"steps of SGD, {defaults.LAYERS} layers, {BATCH} crops unless said otherwise")
    console.print(*tables(found), where_int8_wins(found), sep="\n")
    values = {
        "threads": asked.threads,
        "epochs": asked.epochs,
        "ms": {
            name: {
                size: {key: number(one, 4) for key, one in ms.items()} for size, ms in sizes.items()
            }
            for name, sizes in found.items()
        },
        "where_int8_wins": where_int8_wins(found),
    }
    if asked.json is not None:
        asked.json.write_text(json.dumps(values, indent=1))
    if asked.picture is not None:
        draw(values, asked.picture)


if __name__ == "__main__":
    main()
