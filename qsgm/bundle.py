"""The exported bundle: a folder of ONNX graphs and the manifest that describes them."""

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm.angles import AngleEncoding
from qsgm.errors import QsgmError
from qsgm.runtime import open_session

LAYERS = 6
MANIFEST = "manifest.json"
FORMAT = "qsgm-bundle"
VERSION = 1
NETWORK = "network.onnx"
MANIFEST_KEYS: dict[str, type] = {
    "encoding": str,
    "label_smoothing": float,
    "most_layers": int,
    "files": dict,
    "initializers": dict,
    "recipes": dict,
}

Method = Literal["sgm", "bp"]
Precision = Literal["int8", "float"]
OptimizerName = Literal["sgd", "adam"]


def trunk_file(tuned: int) -> str:
    """Name of the graph of the frozen layers when the last `tuned` layers are tuned."""
    return f"trunk_{tuned}.onnx"


def head_file(tuned: int) -> str:
    """Name of the graph of the tuned layers without training."""
    return f"head_{tuned}.onnx"


def probe_file(tuned: int) -> str:
    """Name of the graph that compares int8, float and true gradients."""
    return f"probe_{tuned}.onnx"


def step_file(method: Method, precision: Precision, optimizer: OptimizerName, tuned: int) -> str:
    """Name of a training step's graph; backpropagation has one precision, float."""
    variant = "bp" if method == "bp" or tuned == 1 else f"sgm_{precision}"
    return f"step_{variant}_{optimizer}_{tuned}.onnx"


@dataclass(frozen=True)
class Recipe:
    """How a method trains the last layers unless the user says otherwise."""

    optimizer: OptimizerName
    rates: tuple[float, ...]  # one per tuned layer, first layer first


@dataclass(frozen=True)
class Bundle:
    """A bundle whose files are all there and unaltered."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def encoding(self) -> AngleEncoding:
        """What the two angle channels stand for."""
        encoding: AngleEncoding = self.manifest["encoding"]
        return encoding

    @property
    def label_smoothing(self) -> float:
        """Of the quality label, in [0, 1)."""
        return float(self.manifest["label_smoothing"])

    @property
    def most_layers(self) -> int:
        """The largest number of layers this bundle can tune."""
        return int(self.manifest["most_layers"])

    def sgm_layers(self, tuned: int) -> tuple[int, ...]:
        """Layers with an SGM behind them when the last `tuned` layers are tuned."""
        return tuple(range(LAYERS + 1 - tuned, LAYERS))

    def recipe(self, method: Method, tuned: int, optimizer: OptimizerName | None) -> Recipe:
        """The rates found for a method, with its own optimizer or the one asked for."""
        recipes = self.manifest["recipes"]["bp" if tuned == 1 else method]
        name: OptimizerName = optimizer or recipes["optimizer"]
        return Recipe(name, tuple(recipes["rates"][name][str(tuned)]))

    def session(self, name: str, threads: int = 1) -> ort.InferenceSession:
        """An ONNX Runtime session of one of the bundle's graphs."""
        return open_session(self.folder / name, threads)

    def start_weights(self, tuned: int) -> dict[str, NDArray[np.float32]]:
        """The tuned layers' starting weights (Co, Ci, kh, kw) and biases (Co,), by name."""
        data = (self.folder / NETWORK).read_bytes()
        names = [f"{kind}{k}" for k in tuned_layers(tuned) for kind in ("weight", "bias")]
        return {name: self._initializer(data, name) for name in names}

    def network_with(self, weights: dict[str, NDArray[np.float32]]) -> bytes:
        """The whole network as an ONNX file with these weights in the place of its own."""
        data = bytearray((self.folder / NETWORK).read_bytes())
        for name, value in weights.items():
            place = self.manifest["initializers"][name]
            if list(value.shape) != place["shape"]:
                raise ValueError(f"`{name}` must be {place['shape']}, got {list(value.shape)}")
            raw = np.ascontiguousarray(value, dtype="<f4").tobytes()
            data[place["offset"] : place["offset"] + len(raw)] = raw
        return bytes(data)

    def _initializer(self, data: bytes, name: str) -> NDArray[np.float32]:
        place = self.manifest["initializers"][name]
        count = int(np.prod(place["shape"]))
        values = np.frombuffer(data, dtype="<f4", count=count, offset=place["offset"])
        return values.reshape(place["shape"]).astype(np.float32)


def tuned_layers(tuned: int) -> range:
    """Numbers of the last `tuned` layers."""
    return range(LAYERS + 1 - tuned, LAYERS + 1)


def load_bundle(folder: Path) -> Bundle:
    """Read a bundle and check every file against the manifest.

    Raises:
        QsgmError: a file is missing or altered, or this is no bundle.
    """
    manifest = read_manifest(folder, FORMAT, VERSION, "qsgm fold-and-quantize")
    require_keys(folder / MANIFEST, manifest, MANIFEST_KEYS, "qsgm fold-and-quantize")
    for name, expected in manifest["files"].items():
        path = folder / name
        if not path.is_file():
            raise QsgmError(
                f"the bundle {folder} lacks {name}; export it again with `qsgm fold-and-quantize`"
            )
        wanted = expected.get("sha256") if isinstance(expected, dict) else None
        if hashlib.sha256(path.read_bytes()).hexdigest() != wanted:
            raise QsgmError(
                f"{path} is not the file the manifest describes (its sha256 differs); "
                "export the bundle again with `qsgm fold-and-quantize`"
            )
    return Bundle(folder, manifest)


def require_keys(path: Path, manifest: dict[str, Any], keys: dict[str, type], command: str) -> None:
    """Refuse a description that lacks a key, or has a value of another type under it.

    Raises:
        QsgmError: names the first such key.
    """
    for key, kind in keys.items():
        value = manifest.get(key)
        if not isinstance(value, kind) or isinstance(value, bool):
            got = "nothing" if key not in manifest else type(value).__name__
            raise QsgmError(
                f"{path}: {key!r} holds {got}, expected {kind.__name__}; make it with `{command}`"
            )


def read_manifest(folder: Path, kind: str, version: int, command: str) -> dict[str, Any]:
    """Read a folder's JSON description and check that it is of the expected kind.

    Args:
        folder: holds the description.
        kind: expected value of its key `format`.
        version: expected value of its key `version`.
        command: what the user runs to make such a folder.

    Raises:
        QsgmError: it is missing, not JSON, or describes something else.
    """
    path = folder / (MANIFEST if kind == FORMAT else "object.json")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise QsgmError(
            f"{folder} holds no {path.name}; expected a folder written by `{command}`"
        ) from error
    except ValueError as error:
        raise QsgmError(f"{path} is not JSON; make it again with `{command}`") from error
    got = (manifest.get("format"), manifest.get("version")) if isinstance(manifest, dict) else None
    if got != (kind, version):
        raise QsgmError(
            f"{path} is of format {got}, expected {(kind, version)}; make it with `{command}`"
        )
    return dict(manifest)
