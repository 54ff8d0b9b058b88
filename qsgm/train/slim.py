"""A bundle that holds one way of tuning and no more, for devices that have little room.

What stays is what `qsgm finetune` opens for these blocks with the bundle's own optimizers and its
own precision of the frozen layers: the step with SGMs in int8 and in float, backpropagation, and
the probe, by which a run says how faithful its gradients are. No number changes, unless loops are
taken out. `qsgm bench` of speed, memory and resources compares steps that only a whole bundle has,
and so does `benchmarks/growth`.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from qsgm.blocks import Blocks, one_block
from qsgm.bundle import Bundle
from qsgm.errors import QsgmError
from qsgm.files import check_replaceable, new_folder, sha256
from qsgm.manifest import (
    MANIFEST,
    NETWORK,
    PRECISIONS,
    WEIGHTS,
    FileEntry,
    Manifest,
    Method,
    Recipes,
    head_file,
    probe_file,
    step_file,
    trunk_file,
)
from qsgm.progress import ignore
from qsgm.train.graphs.loops import has_loops, without_loops
from qsgm.train.graphs.memory import with_peaks
from qsgm.train.graphs.sharing import SharedConstants, constants_elsewhere, shared_sgm, whole_model
from qsgm.train.graphs.short_names import shorten

PLAIN = "bundle.txt"


@dataclass(frozen=True)
class SlimReport:
    """What was left."""

    output: str
    blocks: str
    bytes: Mapping[str, int]  # of each file

    @property
    def total_bytes(self) -> int:
        """Bytes of all files."""
        return sum(self.bytes.values())

    def to_json(self) -> dict[str, Any]:
        """Stable keys."""
        return {
            "output": self.output,
            "blocks": self.blocks,
            "files": dict(self.bytes),
            "bundle_bytes": self.total_bytes,
        }

    def __rich__(self) -> str:
        return f"{self.output}: {len(self.bytes)} files, {self.total_bytes / 1000:.0f} KB"


def slim_bundle(
    bundle: Bundle, blocks: Blocks, output: Path, *, without_scan: bool = False
) -> SlimReport:
    """Write what tuning these blocks takes as a bundle of its own.

    Args:
        bundle: a whole one.
        blocks: which it has steps for.
        output: absent, empty, or an earlier bundle.
        without_scan: steps take all crops at once, which other runtimes run, and more memory.

    Raises:
        QsgmError: the bundle lacks the blocks, or the output folder is the bundle's own or holds
            something else.
    """
    check_replaceable(output, WEIGHTS)
    if output.resolve() == bundle.folder.resolve():
        raise QsgmError(f"{output} is the bundle itself; pass another folder to -o")
    if str(blocks) not in bundle.manifest.blocks:
        raise QsgmError(
            f"the bundle {bundle.folder} has no SGMs for the blocks {blocks}; choose one of "
            f"{' or '.join(bundle.manifest.blocks)}"
        )
    network = bundle.read(NETWORK)
    graphs = {
        name: whole_model(bundle.read(name), bundle.read) for name in kept_graphs(bundle, blocks)
    }
    looping = [name for name, graph in graphs.items() if without_scan and has_loops(graph)]
    for name in looping:
        without_loops(graphs[name])
    shared = SharedConstants(WEIGHTS, constants_elsewhere(NETWORK, network))
    sgms = {
        layer: shared_sgm(shared, bundle.float_sgm(layer), bundle.activation_bits(layer))
        for layer in blocks.layers[:-1]
    }
    shared.take_from(graphs.values())
    for graph in graphs.values():
        shorten(graph)
    files = {name: graph.SerializeToString() for name, graph in graphs.items()}
    files |= {NETWORK: network, WEIGHTS: shared.data, **task_files(bundle)}
    entries = {name: kept_entry(bundle, name, data) for name, data in files.items()}
    manifest = replace(kept_manifest(bundle.manifest, blocks), sgms=sgms, files=entries)
    files[PLAIN] = plain_text(manifest, blocks).encode()
    listed = entries | {PLAIN: kept_entry(bundle, PLAIN, files[PLAIN])}
    manifest = replace(manifest, files=listed)
    with new_folder(output, WEIGHTS) as new:
        for name, data in files.items():
            (new / name).write_bytes(data)
        manifest = with_peaks(Bundle(new, manifest), dict.fromkeys(looping, blocks), ignore)
        text = json.dumps(manifest.to_json(), sort_keys=True, separators=(",", ":"))
        files[MANIFEST] = text.encode()
        (new / MANIFEST).write_bytes(files[MANIFEST])
    sizes = {name: len(data) for name, data in sorted(files.items())}
    return SlimReport(str(output), str(blocks), sizes)


def plain_text(manifest: Manifest, blocks: Blocks) -> str:
    """What a slim bundle's manifest says of a run, for readers without JSON: docs/bundle.md."""
    recipes, layers = manifest.recipes["sgm"], blocks.layers
    recipe = recipes.recipe(recipes.usual(str(blocks)), str(blocks))
    files = {"network": NETWORK, "weights": WEIGHTS, "head": head_file(len(layers))}
    files["trunk"] = trunk_file(manifest.trunk, layers)
    files |= {f"step_{one}": step_file(one, recipe.optimizer, blocks) for one in PRECISIONS}
    files |= {Path(name).stem: name for name in task_names(manifest)}
    lines = ["qsgm-bundle-text 1", f"task {manifest.task.name}"]
    lines += [f"{k} {v}" for k, v in manifest.task.settings.items() if isinstance(v, str)]
    lines += [f"layers {layers[0]} {len(layers)}", f"rates {' '.join(map(str, recipe.rates))}"]
    lines += pace_lines(recipes, str(blocks))
    for k in layers:
        weight, bias = (manifest.initializers[f"{kind}{k}"] for kind in ("weight", "bias"))
        lines.append(f"layer{k} {' '.join(map(str, weight.shape))} {weight.offset} {bias.offset}")
    lines += [f"{key} {manifest.files[name].sha256} {name}" for key, name in files.items()]
    return "\n".join(lines) + "\n"


def pace_lines(recipes: Recipes, blocks: str) -> list[str]:
    """The gain of short runs; gains by length and the optimizer, where they are unusual."""
    name = recipes.usual(blocks)
    short = recipes.short_gains.get(blocks, 1.0) if name == "sgd" else 1.0
    known = recipes.gains.get(name, {}).get(blocks, ())
    lines = [f"short_gain {short}"]
    if known:
        lines.append("gains " + " ".join(f"{steps} {factor}" for steps, factor in known))
    return lines if name == "sgd" else [*lines, f"optimizer {name}"]


def kept_graphs(bundle: Bundle, blocks: Blocks) -> list[str]:
    """Names of the graphs that tuning these blocks opens; a bundle may do without the probe."""
    layers, recipes = blocks.layers, bundle.manifest.recipes
    steps = [step_file(one, recipes["sgm"].usual(str(blocks)), blocks) for one in PRECISIONS]
    names = [head_file(len(layers)), trunk_file(bundle.manifest.trunk, layers), *steps]
    whole = one_block(layers)
    names.append(step_file("float", recipes["bp"].usual(str(whole)), whole))
    if bundle.has(probe_file(len(layers))):
        names.append(probe_file(len(layers)))
    return list(dict.fromkeys(names))


def task_files(bundle: Bundle) -> dict[str, bytes]:
    """What the task added to the bundle, by name."""
    return {name: bundle.read(name) for name in task_names(bundle.manifest)}


def task_names(manifest: Manifest) -> list[str]:
    """The task's own files: neither graphs nor constants nor text that goes with them."""
    others = (".onnx", ".bin", ".md")
    return [name for name in manifest.files if not name.endswith(others) and name != PLAIN]


def kept_entry(bundle: Bundle, name: str, data: bytes) -> FileEntry:
    """What the manifest says of a file: what it holds, and of a step the memory it takes."""
    return FileEntry(sha256(data), bundle.peak_activation_bytes(name))


def kept_manifest(manifest: Manifest, blocks: Blocks) -> Manifest:
    """The bundle's own, of these blocks only."""
    names = [f"{kind}{k}" for k in blocks.layers for kind in ("weight", "bias")]
    kept: dict[Method, Recipes] = {
        "sgm": manifest.recipes["sgm"].only(str(blocks)),
        "bp": manifest.recipes["bp"].only(str(one_block(blocks.layers))),
    }
    return replace(
        manifest,
        most_layers=len(blocks.layers),
        blocks=(str(blocks),),
        usual_blocks={k: text for k, text in manifest.usual_blocks.items() if text == str(blocks)},
        recipes=kept,
        initializers={name: manifest.initializers[name] for name in names},
    )
