"""A bundle that holds one way of tuning and no more, for devices that have little room.

What stays is what `qsgm finetune` opens for these blocks with the bundle's own optimizers and its
own precision of the frozen layers: the step with SGMs in int8 and in float, backpropagation, and
the probe, by which a run says how faithful its gradients are. No number changes. `qsgm bench` of
speed, memory, resources and growth compares steps that only a whole bundle has.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import onnx

from qsgm.blocks import Blocks, one_block, single_layers
from qsgm.bundle import (
    MANIFEST,
    NETWORK,
    PRECISIONS,
    WEIGHTS,
    Bundle,
    head_file,
    probe_file,
    step_file,
    trunk_file,
)
from qsgm.errors import QsgmError
from qsgm.files import check_replaceable, new_folder
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.train.graphs.sharing import SharedConstants, constants_elsewhere
from qsgm.train.graphs.short_names import shorten


@dataclass(frozen=True)
class SlimReport:
    """What was left."""

    output: str
    blocks: str
    bytes: Mapping[str, int]  # of each file

    @property
    def total_bytes(self) -> int:
        """Of all files."""
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


def slim_bundle(bundle: Bundle, blocks: Blocks, output: Path) -> SlimReport:
    """Write what tuning these blocks takes as a bundle of its own.

    Args:
        bundle: a whole one.
        blocks: which it has steps for.
        output: absent, empty, or an earlier bundle.

    Raises:
        QsgmError: the bundle lacks the blocks, or the output folder is the bundle's own or holds
            something else.
    """
    check_replaceable(output, WEIGHTS)
    if output.resolve() == bundle.folder.resolve():
        raise QsgmError(f"{output} is the bundle itself; pass another folder to -o")
    if str(blocks) not in bundle.blocks:
        raise QsgmError(
            f"the bundle {bundle.folder} has no SGMs for the blocks {blocks}; choose one of "
            f"{' or '.join(bundle.blocks)}"
        )
    network = (bundle.folder / NETWORK).read_bytes()
    graphs = {name: onnx.load(bundle.graph_path(name)) for name in kept_graphs(bundle, blocks)}
    shared = SharedConstants(WEIGHTS, constants_elsewhere(NETWORK, network))
    sgms = kept_sgms(bundle, blocks, shared)
    shared.take_from(graphs.values())
    for graph in graphs.values():
        shorten(graph)
    files = {name: graph.SerializeToString() for name, graph in graphs.items()}
    files |= {NETWORK: network, WEIGHTS: shared.data, **kept_things(bundle)}
    manifest = kept_manifest(bundle, blocks) | {
        "sgms": sgms,
        "files": {name: kept_entry(bundle, name, data) for name, data in files.items()},
    }
    files[MANIFEST] = json.dumps(manifest, sort_keys=True, separators=(",", ":")).encode()
    with new_folder(output, WEIGHTS) as new:
        for name, data in files.items():
            (new / name).write_bytes(data)
    sizes = {name: len(data) for name, data in sorted(files.items())}
    return SlimReport(str(output), str(blocks), sizes)


def kept_graphs(bundle: Bundle, blocks: Blocks) -> list[str]:
    """Names of the graphs that tuning these blocks opens; a bundle may do without the probe."""
    tuned, recipes = len(blocks.layers), bundle.manifest["recipes"]
    sgm, bp = (recipes[method]["optimizer"] for method in ("sgm", "bp"))
    steps = [step_file(precision, sgm, blocks) for precision in PRECISIONS]
    names = [head_file(tuned), trunk_file(bundle.trunk, tuned), *steps]
    names.append(step_file("float", bp, one_block(tuned)))
    if probe_file(tuned) in bundle.manifest["files"]:
        names.append(probe_file(tuned))
    return list(dict.fromkeys(names))


def kept_things(bundle: Bundle) -> dict[str, bytes]:
    """The sheet of things to tell an object apart from, if the bundle has one."""
    there = DISTRACTORS in bundle.manifest["files"]
    return {DISTRACTORS: (bundle.folder / DISTRACTORS).read_bytes()} if there else {}


def kept_sgms(bundle: Bundle, blocks: Blocks, shared: SharedConstants) -> dict[str, Any]:
    """What the manifest says of the SGMs; their numbers go to the shared constants."""
    return {
        str(layer): {
            "bits": bundle.activation_bits(layer),
            "convolutions": [
                {"weight": shared.add_array(conv.weight), "bias": shared.add_array(conv.bias)}
                for conv in bundle.float_sgm(layer).convs
            ],
        }
        for layer in single_layers(len(blocks.layers)).sgm_layers
    }


def kept_entry(bundle: Bundle, name: str, data: bytes) -> dict[str, Any]:
    """What the manifest says of a file: what it holds, and of a step the memory it takes."""
    peak = bundle.peak_activation_bytes(name)
    memory = {} if peak is None else {"peak_activation_bytes": peak}
    return {"sha256": hashlib.sha256(data).hexdigest(), **memory}


def kept_recipe(recipe: Mapping[str, Any], text: str) -> dict[str, Any]:
    """Its own optimizer's rates of these blocks."""
    name = recipe["optimizer"]
    return {"optimizer": name, "rates": {name: {text: recipe["rates"][name][text]}}}


def kept_manifest(bundle: Bundle, blocks: Blocks) -> dict[str, Any]:
    """The bundle's own, of these blocks only."""
    sgm, bp = (bundle.manifest["recipes"][method] for method in ("sgm", "bp"))
    text, whole = str(blocks), str(one_block(len(blocks.layers)))
    gains = {"short_gains": {text: sgm["short_gains"][text]}}
    names = [f"{kind}{k}" for k in blocks.layers for kind in ("weight", "bias")]
    return bundle.manifest | {
        "most_layers": len(blocks.layers),
        "blocks": [text],
        "recipes": {"sgm": kept_recipe(sgm, text) | gains, "bp": kept_recipe(bp, whole)},
        "initializers": {name: bundle.manifest["initializers"][name] for name in names},
    }
