"""Where feed-forward training pays: a step's time and memory as a network grows deeper.

    python benchmarks/depth.py [--depths 3,6,12,18,24] [--repeats 15] [--json FILE] [--picture FILE]

Layers of one width, random weights, all of them tuned in steps of SGD: by backpropagation, with an
SGM behind every layer, and in the groups in which SGMs pay. SGMs are as wide as pretraining makes
them. All steps of a depth take turns; times are medians of CPU time, which other processes leave as
it is, memory is activations alive at once.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from growth.wide import quantized, random_net, random_sgm
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import track

from qsgm.bench.charts import (
    BLUE,
    GREEN,
    GREY,
    RED,
    SMALL,
    caption,
    label_ends,
    new_page,
    style,
    write_chart,
)
from qsgm.bench.timing import median_seconds
from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.network import Network, conv
from qsgm.runtime import open_session
from qsgm.schedule import BATCH
from qsgm.sgm.float import FoldedSgm
from qsgm.tables import CLOSE, number, table
from qsgm.task import Head
from qsgm.train.graphs.memory import live_peak, traced
from qsgm.train.graphs.optimizers import Sgd
from qsgm.train.graphs.step import step_model
from qsgm.train.grouping import sgm_cost, usual_blocks
from qsgm.train.model.arrays import FoldedNet
from qsgm.train.samples.drawn import HIDDEN, MOST_LATE
from qsgm.tune.noop_step import noop_step
from qsgm.weights import to_step_layout

# isort: split
import onnxruntime as ort  # behind qsgm, which keeps it from reporting home

CLASSES = 8
HEADS = (Head("class", "cross_entropy", CLASSES, "softmax"),)
DEPTHS = (3, 6, 12, 18, 24)
# variant: what it is called, and its colour
NAMES = {
    "backprop": ("backprop", RED),
    "alone": ("SGM each", GREY),
    "groups": ("groups", GREEN),
    "groups_int8": ("groups, int8", BLUE),
}
KINDS = {
    "maps": "maps 12x12, 16 channels",
    "rows": "rows of 64, 16 channels",
    "dense": "dense, 128",
}


def network_of(kind: str, depth: int) -> Network:
    """So many layers of one width; the last one gives the classes."""
    if kind == "dense":
        last = conv(128, CLASSES, relu=False)
        return Network((1, 1, 128), (*[conv(128, 128)] * (depth - 1), last), "numbers")
    side, kernel, padding = (
        ((12, 12), (3, 3), (1, 1)) if kind == "maps" else ((1, 64), (1, 3), (0, 1))
    )
    inner = conv(16, 16, kernel, padding=padding)
    last = conv(16, CLASSES, relu=False, pool=side)
    return Network((*side, 16), (*[inner] * (depth - 1), last), "numbers")


def sgms_of(network: Network) -> dict[int, FoldedSgm]:
    """An SGM behind every layer but the last: the late ones wider, the others as their layers."""
    first_late = network.depth + 1 - MOST_LATE
    return {
        k: random_sgm(network, k, HIDDEN if k >= first_late else (network.layer(k).out,))
        for k in range(1, network.depth)
    }


def measure(network: Network, repeats: int, threads: int) -> dict[str, Any]:
    """Every variant's step of all layers: milliseconds and bytes, and over backpropagation's."""
    net, sgms, layers = random_net(network), sgms_of(network), network.last(network.depth)
    int8 = {k: quantized(sgm, 16, HEADS) for k, sgm in sgms.items()}
    costs = {
        k: sgm_cost(network, k, [conv.weight.shape for conv in sgm.convs])
        for k, sgm in sgms.items()
    }
    groups = usual_blocks(network, network.depth, costs, MOST_LATE)[network.depth]
    steps: dict[str, tuple[Blocks, Mapping[int, Any]]] = {
        "backprop": (one_block(layers), {}),
        "alone": (single_layers(layers), sgms),
        "groups": (groups, sgms),
        "groups_int8": (groups, int8),
    }
    with tempfile.TemporaryDirectory() as folder:
        files = {name: Path(folder) / f"{name}.onnx" for name in steps}
        for name, (blocks, some) in steps.items():
            model = step_model(net, blocks, some, HEADS, Sgd())
            files[name].write_bytes(model.SerializeToString())
        peaks = {name: peak_of(file, net, steps[name][0], threads) for name, file in files.items()}
        jobs = {
            name: noop_step(open_session(file.read_bytes(), threads), start_of(net), steps[name][0])
            for name, file in files.items()
        }
        seconds = median_seconds(jobs, repeats, time.process_time)
        ms = {name: 1000 * one for name, one in seconds.items()}
    told = {
        name: {
            "ms": number(ms[name], 4),
            "peak_bytes": peaks[name],
            "ms_over_backprop": number(ms[name] / ms["backprop"], 3),
            "peak_over_backprop": number(peaks[name] / peaks["backprop"], 3),
        }
        for name in steps
    }
    return {"groups": str(groups), "steps": told}


def start_of(net: FoldedNet) -> dict[str, Any]:
    """All weights in the layout of step graphs."""
    arrays = dict(enumerate(net.layers, start=1))
    weights = {f"weight{k}": to_step_layout(layer.weight) for k, layer in arrays.items()}
    return weights | {f"bias{k}": layer.bias for k, layer in arrays.items()}


def peak_of(file: Path, net: FoldedNet, blocks: Blocks, threads: int) -> int:
    """Bytes of activations alive at once in a step."""
    trace = traced(file, lambda session: noop_step(session, start_of(net), blocks)(), threads)
    return live_peak(trace.nodes, trace.bound).bytes


def draw(values: dict[str, Any], path: Path) -> None:
    """A row per network: time and memory by depth."""
    kinds = values["networks"]
    margins = {"left": 0.07, "right": 0.865, "top": 0.95, "bottom": 0.13}
    figure: Figure = new_page(
        (8.6, 2.7 * len(kinds)), len(kinds), 2, wspace=0.6, hspace=0.5, **margins
    )
    panels = [(kind, key) for kind in kinds for key in ("ms", "peak_bytes")]
    for axes, (kind, key) in zip(figure.axes, panels, strict=True):
        depths, unit = [*kinds[kind]], 1 if key == "ms" else 1e6
        what = "step [ms]" if key == "ms" else "activations [MB]"
        style(axes, f"{KINDS[kind]}: {what}", "layers, all tuned")
        ends = []
        for name, (called, colour) in NAMES.items():
            line = [kinds[kind][d]["steps"][name][key] / unit for d in depths]
            axes.plot(
                [*map(int, depths)], line, color=colour, linewidth=1.6, marker="o", markersize=3.5
            )
            ends.append((f"{called} {line[-1]:.3g}", line[-1], colour))
        axes.set_ylim(bottom=0)
        axes.set_xticks([*map(int, depths)], depths)
        axes.grid(axis="y", color=GREY, alpha=0.15, linewidth=0.6)
        label_ends(axes, ends, gap=0.1)
    caption(
        figure,
        f"Steps of SGD on {BATCH} samples, float but for the last line; ONNX Runtime, CPU time, "
        f"medians of {values['repeats']}."
        "\nGroups: those in which SGMs pay, chosen as `fold-and-quantize --task` chooses them.",
        (0.03, 0.02),
    )
    for axes in figure.axes:
        axes.title.set_fontsize(SMALL + 0.5)
    write_chart(figure, path)


def render(values: dict[str, Any]) -> Any:
    """Ratios to backpropagation, by network and depth."""
    columns = ["", "\nlayers", ("bp\n[ms]", "{:.2f}"), ("bp\n[MB]", "{:.2f}")]
    titles = ("{}\nalone", "\ngroups", "\nint8")
    columns += [(title.format(what), "{:.2f}") for what in ("time", "bytes") for title in titles]
    rows = []
    for kind, by_depth in values["networks"].items():
        for depth, one in by_depth.items():
            bp, *others = one["steps"].values()
            ratios = [
                step[key] for key in ("ms_over_backprop", "peak_over_backprop") for step in others
            ]
            rows.append([kind, depth, bp["ms"], bp["peak_bytes"] / 1e6, *ratios])
    return table("over backpropagation", columns, rows, padding=CLOSE)


def main() -> None:
    """Measure, print, and write what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--depths", default=",".join(map(str, DEPTHS)))
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    asked = parser.parse_args()
    depths = [int(one) for one in asked.depths.split(",")]
    jobs = [(kind, depth) for kind in KINDS for depth in depths]
    found: dict[str, Any] = {kind: {} for kind in KINDS}
    for kind, depth in track(jobs, console=Console(stderr=True)):
        found[kind][str(depth)] = measure(network_of(kind, depth), asked.repeats, asked.threads)
    values = {"batch": BATCH, "threads": asked.threads, "repeats": asked.repeats}
    values |= {"onnxruntime": ort.__version__, "networks": found}
    Console().print(render(values))
    if asked.json is not None:
        asked.json.write_text(json.dumps(values, indent=1))
    if asked.picture is not None:
        draw(values, asked.picture)


if __name__ == "__main__":
    main()
