"""docs/bundle.md says enough: a reader written from it alone tunes the same weights.

Nothing of qsgm is used to read the bundle or to run it, only to compare.
"""

import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pytest
from numpy.typing import NDArray

from qsgm import Settings, load_bundle, resolve
from qsgm.grasp.teach import prepare_object, train_object

Arrays = dict[str, NDArray[Any]]


def session(folder: Path, name: str, manifest: dict[str, Any]) -> ort.InferenceSession:
    data = (folder / name).read_bytes()
    assert hashlib.sha256(data).hexdigest() == manifest["files"][name]["sha256"]
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    return ort.InferenceSession(str(folder / name), options, ["CPUExecutionProvider"])


def place(data: bytes, where: dict[str, Any]) -> NDArray[np.float32]:
    count = math.prod(where["shape"])
    return np.frombuffer(data, "<f4", count, where["offset"]).reshape(where["shape"])


def read_and_tune(
    folder: Path, precision: str, samples: NDArray[np.uint8], labels: NDArray[np.float32]
) -> Arrays:
    """Three layers for one epoch on the first 800 samples, as the page says."""
    manifest = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))
    assert (manifest["format"], manifest["version"]) == ("qsgm-bundle", 5)
    depth, tuned, epochs, taught = len(manifest["network"]["layers"]), 3, 1, 800
    layers = range(depth + 1 - tuned, depth + 1)
    blocks = ",".join(map(str, layers))
    trunk = session(folder, f"trunk_{manifest['trunk']}_{tuned}.onnx", manifest)
    cut = [samples[first : first + 8] for first in range(0, len(samples), 8)]
    features = np.concatenate([trunk.run(["features"], {"samples": some})[0] for some in cut])
    network, state = (folder / "network.onnx").read_bytes(), dict[str, NDArray[Any]]()
    for k in layers:
        weight = place(network, manifest["initializers"][f"weight{k}"])
        state[f"weight{k}"] = weight.transpose(0, 2, 3, 1).reshape(len(weight), -1)
        state[f"bias{k}"] = place(network, manifest["initializers"][f"bias{k}"])
    recipe = manifest["recipes"]["sgm"]
    optimizer = recipe.get("optimizers", {}).get(blocks, recipe["optimizer"])
    steps = epochs * math.ceil(taught / 32)
    assert blocks not in recipe.get("gains", {}).get(optimizer, {})
    shortness = math.log(500 / steps) / math.log(500 / 75)
    gain = recipe["short_gains"][blocks] ** min(1.0, max(0.0, shortness))
    step = session(folder, f"step_{precision}_{optimizer}_{blocks}.onnx", manifest)
    outputs = [value.name for value in step.get_outputs()]
    for value in step.get_inputs():
        if f"{value.name}_next" in outputs and value.name not in state:
            state[value.name] = np.zeros(value.shape, np.float32)
    order = np.random.default_rng([0, 1]).permutation(taught)
    for t, first in enumerate(range(0, taught, 32)):
        rates = {
            f"rate{k}": np.array((1 - t / steps) * (gain * rate), np.float32)
            for k, rate in zip(layers, recipe["rates"][optimizer][blocks], strict=True)
        }
        feeds = {"features": features, "labels": labels, "rows": order[first : first + 32]}
        got = dict(zip(outputs, step.run(outputs, feeds | rates | state), strict=True))
        state = {name: got[f"{name}_next"] for name in state}
    shapes = {k: manifest["network"]["layers"][k - 1] for k in layers}
    return {
        f"weight{k}": state[f"weight{k}"]
        .reshape(one["out"], *one["kernel"], one["into"])
        .transpose(0, 3, 1, 2)
        for k, one in shapes.items()
    } | {f"bias{k}": state[f"bias{k}"] for k in layers}


@pytest.mark.parametrize("precision", ["float", "int8"])
def test_a_reader_written_from_the_page_tunes_the_same_weights(
    bundle_folder: Path, frame: NDArray[np.uint8], precision: Any
) -> None:
    bundle = load_bundle(bundle_folder)
    plan = resolve(Settings(precision=precision, epochs=1), bundle)
    prepared = prepare_object(frame, bundle, plan)
    expected = train_object(prepared, plan).weights
    crops = prepared.lesson.cut(np.arange(1000))
    got = read_and_tune(bundle_folder, precision, crops, prepared.labels)
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        np.testing.assert_array_equal(got[name], value)


def test_float_sgms_lie_where_the_manifest_says(bundle_folder: Path) -> None:
    manifest = json.loads((bundle_folder / "manifest.json").read_text())
    data, bundle = (bundle_folder / "weights.bin").read_bytes(), load_bundle(bundle_folder)
    for layer, entry in manifest["sgms"].items():
        for conv, read in zip(
            entry["convolutions"], bundle.float_sgm(int(layer)).convs, strict=True
        ):
            np.testing.assert_array_equal(place(data, conv["weight"]), read.weight)
            np.testing.assert_array_equal(place(data, conv["bias"]), read.bias)
