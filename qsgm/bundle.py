"""The exported bundle: a folder of ONNX graphs and the manifest that describes them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm.blocks import Blocks, one_block, parse_blocks
from qsgm.errors import QsgmError
from qsgm.files import read_file, read_whole, sha256
from qsgm.manifest import (
    COMMAND,
    MANIFEST,
    MANIFEST_BYTES,
    NETWORK,
    WEIGHTS,
    Manifest,
    Method,
    OptimizerName,
    Place,
    Recipe,
    default_blocks,
    parse_manifest,
)
from qsgm.network import Network
from qsgm.runtime import open_session
from qsgm.sgm.float import FoldedConv, FoldedSgm
from qsgm.sgm.int8 import ActivationBits

MOST_BYTES = 256_000_000  # of all files of a bundle


@dataclass(frozen=True)
class Bundle:
    """A bundle whose files are all there and unaltered."""

    folder: Path
    manifest: Manifest
    contents: Mapping[str, bytes] = field(default_factory=dict, repr=False)  # by file

    @property
    def network(self) -> Network:
        """Its network's geometry."""
        return self.manifest.network

    def has(self, name: str) -> bool:
        """Whether there is such a file."""
        return name in self.manifest.files

    def read(self, name: str) -> bytes:
        """A whole file as it was when the bundle was loaded, whatever is in its place by now.

        Raises QsgmError where the bundle was made without it.
        """
        path = self.folder / name if name == MANIFEST else self.graph_path(name)
        if name in self.contents:
            return self.contents[name]
        return read_file(path, MOST_BYTES, f"a file that `{COMMAND}` wrote")

    def check_blocks(self, blocks: Blocks) -> None:
        """Refuse what the bundle has no step for.

        Raises:
            QsgmError: says what it can tune.
        """
        tuned, can = len(blocks.layers), self.manifest.blocks
        if blocks.layers[-1] != self.network.depth:
            parse_blocks(str(blocks), self.network.depth)
        if tuned > self.manifest.most_layers:
            raise QsgmError(
                f"the bundle {self.folder} can tune {self.manifest.most_layers} layers at most, "
                f"not {tuned}; pass --layers {self.manifest.most_layers}"
            )
        numbers = sorted({len(parse_blocks(text).layers) for text in can})
        if tuned not in numbers:
            raise QsgmError(
                f"the bundle {self.folder} was made to tune {' or '.join(map(str, numbers))} "
                f"layers, not {tuned}; pass --layers {numbers[-1]} or another --bundle"
            )
        if str(blocks) not in can and blocks != one_block(blocks.layers):
            raise QsgmError(
                f"the bundle {self.folder} has no step for the blocks {blocks}; choose one of "
                f"{' or '.join(can)}, or export it with `{COMMAND} --blocks {blocks}`"
            )

    def recipe(
        self,
        method: Method,
        layers: range,
        optimizer: OptimizerName | None,
        blocks: Blocks | None = None,
    ) -> Recipe:
        """The rates found for a method, with its own optimizer or the one asked for.

        Without `blocks` for those of :func:`qsgm.manifest.default_blocks`.
        """
        recipes = self.manifest.recipes[method]
        text = str(blocks or default_blocks(method, layers))
        name = optimizer or recipes.usual(text)
        if text not in recipes.rates.get(name, {}):
            other = recipes.usual(text)
            advice = f"--optimizer {other}" if name != other else "another --bundle"
            raise QsgmError(
                f"the bundle {self.folder} has no rates for {name} on the blocks {text}; pass "
                f"{advice}"
            )
        return recipes.recipe(name, text)

    def session(
        self, name: str, threads: int = 1, constants: Mapping[str, NDArray[Any]] | None = None
    ) -> ort.InferenceSession:
        """An ONNX Runtime session of one of the bundle's graphs, see :meth:`graph_path`.

        `constants` take the place of the graph's own, by initializer name.
        """
        files = {file: self.read(file) for file in (WEIGHTS, NETWORK)}
        return open_session(
            self.read(name), threads, constants or {}, files, str(self.folder / name)
        )

    def graph_path(self, name: str) -> Path:
        """The file of a graph. Raises QsgmError where the bundle was made without it."""
        if not self.has(name):
            raise QsgmError(
                f"the bundle {self.folder} was made without {name}; pass another --bundle, or make "
                f"a whole one with `{COMMAND}`"
            )
        return self.folder / name

    def peak_activation_bytes(self, name: str) -> int | None:
        """Bytes of activations alive at once in a training step, by its graph's name, if known."""
        file = self.manifest.files.get(name)
        return None if file is None else file.peak_activation_bytes

    def activation_bits(self, layer: int) -> ActivationBits:
        """Bits of an activation in the int8 SGM behind a layer."""
        return self.manifest.sgms[layer].bits

    def float_sgm(self, layer: int) -> FoldedSgm:
        """The SGM behind a layer before it was quantized."""
        data = self.read(WEIGHTS)
        convs = (
            FoldedConv(array_at(data, weight), array_at(data, bias))
            for weight, bias in self.manifest.sgms[layer].convolutions
        )
        return FoldedSgm(layer, self.network.after(layer), tuple(convs))

    def start_weights(self, layers: range) -> dict[str, NDArray[np.float32]]:
        """Starting weights (Co, Ci, kh, kw) and biases (Co,) of some layers, by name."""
        data = self.read(NETWORK)
        names = [f"{kind}{k}" for k in layers for kind in ("weight", "bias")]
        return {name: array_at(data, self.manifest.initializers[name]) for name in names}

    def network_with(self, weights: dict[str, NDArray[np.float32]]) -> bytes:
        """The whole network as an ONNX file with these weights in the place of its own."""
        data = bytearray(self.read(NETWORK))
        for name, value in weights.items():
            place = self.manifest.initializers[name]
            if value.shape != place.shape:
                raise ValueError(f"`{name}` must be {place.shape}, got {value.shape}")
            raw = np.ascontiguousarray(value, dtype="<f4").tobytes()
            data[place.offset : place.offset + len(raw)] = raw
        return bytes(data)

    def sha256(self) -> str:
        """Digest of the manifest, and so of everything in the bundle."""
        return sha256(self.read(MANIFEST))


def array_at(data: bytes, place: Place) -> NDArray[np.float32]:
    """Float32 numbers in a file."""
    count = int(np.prod(place.shape))
    values = np.frombuffer(data, dtype="<f4", count=count, offset=place.offset)
    return values.reshape(place.shape).astype(np.float32)


def load_bundle(folder: Path) -> Bundle:
    """Read a bundle and check every file against the manifest.

    Raises:
        QsgmError: a file is missing or altered, or this is no bundle.
    """
    return read_whole(folder, lambda: _load_bundle(folder))


def _load_bundle(folder: Path) -> Bundle:
    path = folder / MANIFEST
    data = read_file(path, MANIFEST_BYTES, f"a bundle written by `{COMMAND}`")
    manifest = parse_manifest(data, path)
    contents, left = {MANIFEST: data}, MOST_BYTES
    for name, expected in manifest.files.items():
        contents[name] = read_file(folder / name, left, f"a file that `{COMMAND}` wrote")
        left -= len(contents[name])
        if sha256(contents[name]) != expected.sha256:
            raise QsgmError(
                f"{folder / name} is not the file the manifest describes (its sha256 differs); "
                f"export the bundle again with `{COMMAND}`"
            )
    return Bundle(folder, manifest, contents)
