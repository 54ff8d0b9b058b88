"""The exported bundle: a folder of ONNX graphs and the manifest that describes them."""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from qsgm import defaults
from qsgm.blocks import LAYERS, Blocks, one_block, parse_blocks, single_layers, tuned_layers
from qsgm.defaults import MOST_LAYERS
from qsgm.errors import QsgmError
from qsgm.grasp.angles import ENCODINGS, AngleEncoding
from qsgm.grasp.decision import Decision
from qsgm.grasp.distractors import FILE as DISTRACTORS
from qsgm.grasp.distractors import Distractors, load_distractors
from qsgm.runtime import open_session
from qsgm.sgm.float import FoldedConv, FoldedSgm
from qsgm.sgm.int8 import ACTIVATION_BITS, LABELS, ActivationBits
from qsgm.tune.loop import short_run_factor

MANIFEST = "manifest.json"
FORMAT = "qsgm-bundle"
VERSION = 4
NETWORK = "network.onnx"
WEIGHTS = "weights.bin"
FLOAT_BYTES = 4
COMMAND = "qsgm fold-and-quantize"
MANIFEST_KEYS: dict[str, type] = {
    "encoding": str,
    "label_smoothing": float,
    "most_layers": int,
    "trunk": str,
    "blocks": list,
    "files": dict,
    "initializers": dict,
    "recipes": dict,
    "sgms": dict,
}

Method = Literal["sgm", "bp"]
Precision = Literal["int8", "float"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
OptimizerName = Literal["sgd", "adam"]
OPTIMIZERS: tuple[OptimizerName, ...] = get_args(OptimizerName)


def trunk_file(precision: Precision, tuned: int) -> str:
    """Name of the graph of the frozen layers when the last `tuned` are tuned; float if none are."""
    return f"trunk_{precision if tuned < LAYERS else 'float'}_{tuned}.onnx"


def head_file(tuned: int) -> str:
    """Name of the graph of the tuned layers without training."""
    return f"head_{tuned}.onnx"


def probe_file(tuned: int) -> str:
    """Name of the graph that compares int8, float and true gradients."""
    return f"probe_{tuned}.onnx"


def step_file(precision: Precision, optimizer: OptimizerName, blocks: Blocks) -> str:
    """Name of a training step's graph; a single block holds no SGM and is float only."""
    return f"step_{precision if blocks.sgm_layers else 'float'}_{optimizer}_{blocks}.onnx"


def default_blocks(method: Method, tuned: int) -> Blocks:
    """With SGMs every layer is a block of its own; backpropagation has a single one."""
    return one_block(tuned) if method == "bp" else single_layers(tuned)


@dataclass(frozen=True)
class Recipe:
    """How a method trains the last layers unless the user says otherwise."""

    optimizer: OptimizerName
    rates: tuple[float, ...]  # one per tuned layer, first layer first
    short_gain: float = 1.0  # what short runs multiply them with

    def rates_over(self, steps: int) -> tuple[float, ...]:
        """Where the rates of a run of so many steps start."""
        factor = short_run_factor(self.short_gain, steps)
        return tuple(factor * rate for rate in self.rates)


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

    @property
    def trunk(self) -> Precision:
        """The frozen layers' precision unless the user says otherwise."""
        precision: Precision = self.manifest["trunk"]
        return precision

    @property
    def blocks(self) -> tuple[str, ...]:
        """What it can tune with SGMs, such as `1-4,5,6`."""
        return tuple(self.manifest["blocks"])

    def check_blocks(self, blocks: Blocks) -> None:
        """Refuse what the bundle has no step for.

        Raises:
            QsgmError: says what it can tune.
        """
        tuned = len(blocks.layers)
        if tuned > self.most_layers:
            raise QsgmError(
                f"the bundle {self.folder} can tune {self.most_layers} layers at most, not "
                f"{tuned}; pass --layers {self.most_layers}"
            )
        numbers = sorted({len(parse_blocks(text).layers) for text in self.blocks})
        if tuned not in numbers:
            raise QsgmError(
                f"the bundle {self.folder} was made to tune {' or '.join(map(str, numbers))} "
                f"layers, not {tuned}; pass --layers {numbers[-1]} or another --bundle"
            )
        if str(blocks) not in self.blocks and blocks != one_block(tuned):
            raise QsgmError(
                f"the bundle {self.folder} has no step for the blocks {blocks}; choose one of "
                f"{' or '.join(self.blocks)}, or export it with `{COMMAND} --blocks {blocks}`"
            )

    def recipe(
        self,
        method: Method,
        tuned: int,
        optimizer: OptimizerName | None,
        blocks: Blocks | None = None,
    ) -> Recipe:
        """The rates found for a method, with its own optimizer or the one asked for.

        Without `blocks` for those of :func:`default_blocks`.
        """
        recipes = self.manifest["recipes"][method]
        name: OptimizerName = optimizer or recipes["optimizer"]
        text = str(blocks or default_blocks(method, tuned))
        if text not in recipes["rates"].get(name, {}):
            other = recipes["optimizer"]
            advice = f"--optimizer {other}" if name != other else "another --bundle"
            raise QsgmError(
                f"the bundle {self.folder} has no rates for {name} on the blocks {text}; pass "
                f"{advice}"
            )
        gain = recipes["short_gains"][text] if method == "sgm" and name == "sgd" else 1.0
        return Recipe(name, tuple(recipes["rates"][name][text]), gain)

    def session(
        self, name: str, threads: int = 1, constants: Mapping[str, NDArray[Any]] | None = None
    ) -> ort.InferenceSession:
        """An ONNX Runtime session of one of the bundle's graphs, see :meth:`graph_path`.

        `constants` take the place of the graph's own, by initializer name.
        """
        return open_session(self.graph_path(name), threads, constants or {})

    def graph_path(self, name: str) -> Path:
        """The file of a graph. Raises QsgmError where the bundle was made without it."""
        if name not in self.manifest["files"]:
            raise QsgmError(
                f"the bundle {self.folder} was made without {name}; pass another --bundle, or make "
                f"a whole one with `{COMMAND}`"
            )
        return self.folder / name

    def peak_activation_bytes(self, name: str) -> int | None:
        """Bytes of activations alive at once in a training step of 32 crops, by its graph's name.

        None where the manifest does not say.
        """
        found = self.manifest["files"].get(name, {}).get("peak_activation_bytes")
        return found if type(found) is int else None

    def activation_bits(self, layer: int) -> ActivationBits:
        """Of the int8 SGM behind a layer."""
        bits: ActivationBits = self.manifest["sgms"][str(layer)]["bits"]
        return bits

    def float_sgm(self, layer: int) -> FoldedSgm:
        """The SGM behind a layer before it was quantized."""
        data = (self.folder / WEIGHTS).read_bytes()
        convolutions = self.manifest["sgms"][str(layer)]["convolutions"]
        return FoldedSgm(
            layer,
            tuple(
                FoldedConv(_array_at(data, conv["weight"]), _array_at(data, conv["bias"]))
                for conv in convolutions
            ),
        )

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

    def distractors(self) -> Distractors | None:
        """The things to tell an object apart from; None in a bundle that was made without them."""
        if DISTRACTORS not in self.manifest["files"]:
            return None
        return load_distractors((self.folder / DISTRACTORS).read_bytes())

    def decision(self) -> Decision | None:
        """What tells the object from others; None in a bundle that was made without it."""
        found = self.manifest.get("decision")
        return None if found is None else Decision.from_json(found, str(self.folder / MANIFEST))

    def sha256(self) -> str:
        """Of the manifest, and so of everything in it."""
        return hashlib.sha256((self.folder / MANIFEST).read_bytes()).hexdigest()

    def _initializer(self, data: bytes, name: str) -> NDArray[np.float32]:
        return _array_at(data, self.manifest["initializers"][name])


def _array_at(data: bytes, place: Mapping[str, Any]) -> NDArray[np.float32]:
    """Float32 numbers in a file, at an offset and of a shape."""
    count = int(np.prod(place["shape"]))
    values = np.frombuffer(data, dtype="<f4", count=count, offset=place["offset"])
    return values.reshape(place["shape"]).astype(np.float32)


def load_bundle(folder: Path) -> Bundle:
    """Read a bundle and check every file against the manifest.

    Raises:
        QsgmError: a file is missing or altered, or this is no bundle.
    """
    manifest = read_manifest(folder, FORMAT, (VERSION,), COMMAND)
    _check_manifest(folder / MANIFEST, manifest)
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
    bundle = Bundle(folder, manifest)
    bundle.decision()  # a damaged one is refused here, not after a run
    return bundle


def needed_files(trunk: Precision, optimizer: OptimizerName, blocks: Sequence[str]) -> set[str]:
    """The graphs without which a bundle cannot tune all of its blocks as is usual."""
    needed = {NETWORK, WEIGHTS}
    for one in map(parse_blocks, blocks):
        tuned = len(one.layers)
        needed |= {head_file(tuned), trunk_file(trunk, tuned)}
        needed.add(step_file(defaults.PRECISION, optimizer, one))
    return needed


def _check_manifest(path: Path, manifest: Mapping[str, Any]) -> None:
    """Refuse a manifest that does not say everything that is needed, or says nonsense.

    Raises:
        QsgmError: names the first key that is wrong.
    """
    require_keys(path, manifest, MANIFEST_KEYS, COMMAND)
    for key, (expected, is_sane) in _EXPECTED.items():
        try:
            sane = is_sane(manifest)
        except (LookupError, TypeError, ValueError, ArithmeticError, AttributeError, QsgmError):
            sane = False
        if not sane:
            raise QsgmError(f"{path}: {key!r} is damaged: expected {expected}; run `{COMMAND}`")
    optimizer = manifest["recipes"]["sgm"]["optimizer"]
    needed = needed_files(manifest["trunk"], optimizer, manifest["blocks"])
    missing = sorted(needed - manifest["files"].keys())
    if missing:
        raise QsgmError(f"{path}: 'files' does not list {missing[0]}; run `{COMMAND}` again")
    _check_places(path, manifest["initializers"], manifest["most_layers"])
    _check_sgms(path, manifest["sgms"], manifest["most_layers"])


def _check_places(path: Path, places: Mapping[str, Any], most_layers: int) -> None:
    """Refuse weights and biases that do not lie inside the network's file."""
    size = _size(path.with_name(NETWORK))
    for layer in tuned_layers(most_layers):
        for name, sides in ((f"weight{layer}", 4), (f"bias{layer}", 1)):
            if not _is_place(places.get(name), sides, size):
                raise QsgmError(
                    f"{path}: 'initializers' gives {str(places.get(name))[:80]} for {name}, "
                    f"expected an offset and {sides} sides inside {NETWORK}; run `{COMMAND}` again"
                )


def _check_sgms(path: Path, sgms: Mapping[str, Any], most_layers: int) -> None:
    """Refuse SGMs that are none, or whose weights do not lie inside their file."""
    size = _size(path.with_name(WEIGHTS))
    for layer in tuned_layers(most_layers)[:-1]:
        try:
            bits, convolutions = sgms[str(layer)]["bits"], sgms[str(layer)]["convolutions"]
            sane = bits in ACTIVATION_BITS and len(convolutions) > 1
            sane = sane and all(
                _is_place(conv[name], sides, size)
                for conv in convolutions
                for name, sides in (("weight", 4), ("bias", 1))
            )
            sane = sane and _is_chain(convolutions)
        except (KeyError, TypeError):
            sane = False
        if not sane:
            raise QsgmError(
                f"{path}: 'sgms' gives {str(sgms.get(str(layer)))[:80]} for layer {layer}, expected"
                f" bits and convolutions inside {WEIGHTS}; run `{COMMAND}` again"
            )


def _is_chain(convolutions: Sequence[Mapping[str, Any]]) -> bool:
    """Whether each convolution takes what the one before it gives, and the first the label too."""
    shapes = [conv["weight"]["shape"] for conv in convolutions]
    into = [shapes[-1][0] + LABELS, *(out for out, *_ in shapes)]
    return all(
        shape[1] == channels and shape[2:] == shapes[0][2:] and conv["bias"]["shape"] == shape[:1]
        for conv, shape, channels in zip(convolutions, shapes, into, strict=False)
    )


def _size(path: Path) -> float:
    """Of a file in bytes; without end for one that is missing: it is refused later."""
    return path.stat().st_size if path.is_file() else math.inf


def _is_place(place: Any, sides: int, size: float) -> bool:
    if not isinstance(place, dict) or not isinstance(place.get("shape"), list):
        return False
    offset, shape = place.get("offset"), place["shape"]
    if not isinstance(offset, int) or not all(type(side) is int and side > 0 for side in shape):
        return False
    return len(shape) == sides and 0 <= offset <= size - FLOAT_BYTES * math.prod(shape)


def _are_blocks(manifest: Mapping[str, Any]) -> bool:
    """Whether it names blocks, each with an SGM or the last layer alone, of so many layers."""
    texts = manifest["blocks"]
    blocks = [parse_blocks(text) for text in texts]
    return (
        len(set(texts)) == len(texts)
        and max(len(one.layers) for one in blocks) == manifest["most_layers"]
        and all(one.sgm_layers or one == one_block(1) for one in blocks)
    )


def _are_recipes(manifest: Mapping[str, Any]) -> bool:
    """Whether every method has an optimizer, and rates with it for whatever it can tune."""
    numbers = [len(parse_blocks(text).layers) for text in manifest["blocks"]]
    can_tune = {"sgm": manifest["blocks"], "bp": [str(one_block(tuned)) for tuned in numbers]}
    for method in get_args(Method):
        recipe = manifest["recipes"][method]
        if recipe["optimizer"] not in OPTIMIZERS or set(recipe["rates"]) - set(OPTIMIZERS):
            return False
        if not all(text in recipe["rates"][recipe["optimizer"]] for text in can_tune[method]):
            return False
        for text, rates in (one for some in recipe["rates"].values() for one in some.items()):
            if len(rates) != len(parse_blocks(text).layers):
                return False
            if not all(_is_number(rate) and rate > 0 for rate in rates):
                return False
    gains = manifest["recipes"]["sgm"]["short_gains"]
    return all(_is_number(gains[text]) and gains[text] >= 1 for text in can_tune["sgm"])


def _is_number(value: Any) -> bool:
    """Whether it is one that a float can hold; raises OverflowError for a whole one too large."""
    return type(value) in (int, float) and math.isfinite(value)


# key: (what is expected, whether the manifest has it); in this order
_EXPECTED: dict[str, tuple[str, Callable[[Mapping[str, Any]], bool]]] = {
    "encoding": (" or ".join(ENCODINGS), lambda found: found["encoding"] in ENCODINGS),
    "label_smoothing": ("0 to below 1", lambda found: 0 <= found["label_smoothing"] < 1),
    "most_layers": (f"1 to {MOST_LAYERS}", lambda found: 1 <= found["most_layers"] <= MOST_LAYERS),
    "trunk": (" or ".join(PRECISIONS), lambda found: found["trunk"] in PRECISIONS),
    "blocks": ("texts such as 5,6 and 4,5-6, each once, with most_layers at most", _are_blocks),
    "recipes": ("positive rates, one per tuned layer, for every method", _are_recipes),
}


def require_keys(
    path: Path, manifest: Mapping[str, Any], keys: Mapping[str, type], command: str
) -> None:
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


def read_manifest(folder: Path, kind: str, versions: Sequence[int], command: str) -> dict[str, Any]:
    """Read a folder's JSON description and check that it is of the expected kind.

    Args:
        folder: holds the description.
        kind: expected value of its key `format`.
        versions: expected values of its key `version`, the newest last.
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
    except (ValueError, RecursionError) as error:  # not UTF-8, not JSON, nested without end
        raise QsgmError(f"{path} is not JSON; make it again with `{command}`") from error
    got = (manifest.get("format"), manifest.get("version")) if isinstance(manifest, dict) else None
    if got not in [(kind, version) for version in versions]:
        raise QsgmError(
            f"{path} is of format {got}, expected {(kind, versions[-1])}; make it with `{command}`"
        )
    return dict(manifest)
