"""A bundle's manifest: what it says, typed, and how it is read without trusting it.

`docs/bundle.md` describes the format byte by byte.
"""

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, TypeVar, get_args

from qsgm import defaults
from qsgm.blocks import Blocks, one_block, parse_blocks, single_layers
from qsgm.errors import QsgmError
from qsgm.files import is_plain
from qsgm.network import Network
from qsgm.schedule import Gains, gain_over, short_run
from qsgm.sgm.int8 import ACTIVATION_BITS, ActivationBits
from qsgm.task import Heads, TaskRecord, heads_from_json, heads_to_json, output_count

MANIFEST = "manifest.json"
FORMAT = "qsgm-bundle"
VERSION = 5
NETWORK = "network.onnx"
WEIGHTS = "weights.bin"
FLOAT_BYTES = 4
MANIFEST_BYTES = 4_000_000
COMMAND = "qsgm fold-and-quantize"

Method = Literal["sgm", "bp"]
Precision = Literal["int8", "float"]
PRECISIONS: tuple[Precision, ...] = get_args(Precision)
OptimizerName = Literal["sgd", "adam"]
OPTIMIZERS: tuple[OptimizerName, ...] = get_args(OptimizerName)
Value = TypeVar("Value")


def trunk_file(precision: Precision, layers: range) -> str:
    """Name of the graph of the frozen layers in front of `layers`; float if there are none."""
    return f"trunk_{precision if layers[0] > 1 else 'float'}_{len(layers)}.onnx"


def head_file(tuned: int) -> str:
    """Name of the graph of the last `tuned` layers without training."""
    return f"head_{tuned}.onnx"


def probe_file(tuned: int) -> str:
    """Name of the graph that compares int8, float and true gradients."""
    return f"probe_{tuned}.onnx"


def step_file(precision: Precision, optimizer: OptimizerName, blocks: Blocks) -> str:
    """Name of a training step's graph; a single block holds no SGM and is float only."""
    return f"step_{precision if blocks.sgm_layers else 'float'}_{optimizer}_{blocks}.onnx"


def default_blocks(method: Method, layers: range) -> Blocks:
    """With SGMs every layer is a block of its own; backpropagation has a single one."""
    return one_block(layers) if method == "bp" else single_layers(layers)


@dataclass(frozen=True)
class Place:
    """A float32 array in a file, little-endian, row by row."""

    offset: int  # bytes
    shape: tuple[int, ...]


@dataclass(frozen=True)
class SgmEntry:
    """An SGM: the bits of its int8 form's activations, and where the float one's numbers lie."""

    bits: ActivationBits
    convolutions: tuple[tuple[Place, Place], ...]  # weight (O, I, kh, kw) and bias (O,)


@dataclass(frozen=True)
class Recipe:
    """How a method trains the last layers unless the user says otherwise."""

    optimizer: OptimizerName
    rates: tuple[float, ...]  # one per tuned layer, first layer first
    gains: Gains = ()  # what runs of some lengths multiply them with

    def rates_over(self, steps: int) -> tuple[float, ...]:
        """Where the rates of a run of so many steps start."""
        factor = gain_over(self.gains, steps)
        return tuple(factor * rate for rate in self.rates)


@dataclass(frozen=True)
class Recipes:
    """A method's optimizer, and its rates by optimizer and blocks."""

    optimizer: OptimizerName
    rates: Mapping[OptimizerName, Mapping[str, tuple[float, ...]]]
    short_gains: Mapping[str, float] = field(default_factory=dict)  # of SGD by blocks; 1 where none
    # By optimizer and blocks, what runs of known lengths take, in the place of `short_gains`.
    gains: Mapping[OptimizerName, Mapping[str, Gains]] = field(default_factory=dict)
    optimizers: Mapping[str, OptimizerName] = field(default_factory=dict)  # usual for some blocks

    def usual(self, blocks: str) -> OptimizerName:
        """The optimizer of these blocks unless the user says otherwise."""
        return self.optimizers.get(blocks, self.optimizer)

    def recipe(self, name: OptimizerName, blocks: str) -> Recipe:
        """Rates and gains of these blocks with an optimizer. Raises LookupError without any."""
        rates, gains = self.rates[name][blocks], self.gains.get(name, {}).get(blocks)
        gain = self.short_gains.get(blocks, 1.0) if name == "sgd" else 1.0
        usual = short_run(gain) if gain != 1 else ()
        return Recipe(name, rates, usual if gains is None else gains)

    def only(self, blocks: str) -> "Recipes":
        """What these blocks take by their usual optimizer, and no more."""
        name = self.usual(blocks)
        gains = self.gains.get(name, {})
        return Recipes(
            name,
            {name: {blocks: self.rates[name][blocks]}},
            {blocks: self.short_gains[blocks]} if blocks in self.short_gains else {},
            {name: {blocks: gains[blocks]}} if blocks in gains else {},
        )


@dataclass(frozen=True)
class FileEntry:
    """A file of the bundle."""

    sha256: str
    peak_activation_bytes: int | None = None  # of a training step of 32 samples


@dataclass(frozen=True)
class Manifest:
    """Everything that a bundle says of itself."""

    task: TaskRecord
    most_layers: int  # that can be tuned
    trunk: Precision  # of the frozen layers unless the user says otherwise
    blocks: tuple[str, ...]  # what can be tuned with SGMs
    recipes: Mapping[Method, Recipes]
    initializers: Mapping[str, Place]  # the tuned layers' weights and biases, in network.onnx
    sgms: Mapping[int, SgmEntry]  # by layer, in weights.bin
    files: Mapping[str, FileEntry]
    # By how many layers are tuned, their groups unless the user says otherwise; else each alone.
    usual_blocks: Mapping[int, str] = field(default_factory=dict)

    @property
    def network(self) -> Network:
        """Its network's geometry."""
        return self.task.network

    @property
    def heads(self) -> Heads:
        """What its network gives."""
        return self.task.heads

    def to_json(self) -> dict[str, Any]:
        """Plain values, as they are written."""
        usual = {str(tuned): text for tuned, text in self.usual_blocks.items()}
        return ({"usual_blocks": usual} if usual else {}) | {
            "format": FORMAT,
            "version": VERSION,
            "task": {"name": self.task.name, **self.task.settings},
            "network": self.network.to_json(),
            "heads": heads_to_json(self.heads),
            "most_layers": self.most_layers,
            "trunk": self.trunk,
            "blocks": list(self.blocks),
            "recipes": {method: _recipes_json(one) for method, one in self.recipes.items()},
            "initializers": {name: _place_json(one) for name, one in self.initializers.items()},
            "sgms": {str(layer): _sgm_json(one) for layer, one in self.sgms.items()},
            "files": {name: _file_json(one) for name, one in self.files.items()},
        }

    def text(self) -> str:
        """The file, with a line per key."""
        return json.dumps(self.to_json(), indent=1, sort_keys=True) + "\n"


def parse_manifest(data: bytes, path: Path) -> Manifest:
    """A bundle's manifest from its file's bytes; see :func:`manifest_from`."""
    return manifest_from(parse_description(data, path, FORMAT, (VERSION,), COMMAND), path)


def manifest_from(values: Mapping[str, Any], path: Path) -> Manifest:
    """A manifest from its plain values, everything in it checked. `path` is where it lies.

    Raises:
        QsgmError: it lacks something or says nonsense; names the first key that is wrong.
    """
    read = _Reader(values, path)
    name, settings = read.part("task", "a name", _task_from)
    network = read.part("network", "layers that fit each other", Network.from_json)
    heads = read.part("heads", "what the network gives", lambda found: _heads_from(found, network))
    most = read.part(
        "most_layers",
        f"1 to {network.depth}",
        lambda found: _require(found, type(found) is int and 1 <= found <= network.depth),
    )
    trunk: Precision = read.part(
        "trunk", " or ".join(PRECISIONS), lambda found: _require(found, found in PRECISIONS)
    )
    blocks = read.part(
        "blocks",
        "texts such as 5,6 and 4,5-6, each once, with most_layers at most",
        lambda found: _blocks_from(found, network, most),
    )
    recipes = read.part(
        "recipes",
        "positive rates, one per tuned layer, for every method",
        lambda found: _recipes_from(found, blocks),
    )
    layers = network.last(most)
    initializers = read.part(
        "initializers",
        f"an offset and a shape for every tuned layer's numbers inside {NETWORK}",
        lambda found: _initializers_from(found, network, layers, size_of(path, NETWORK)),
    )
    sgms = read.part(
        "sgms",
        f"bits and convolutions inside {WEIGHTS} behind every tuned layer but the last",
        lambda found: _sgms_from(found, network, heads, layers, size_of(path, WEIGHTS)),
    )
    files = read.part("files", "a sha256 for every file by its plain name", _files_from)
    missing = sorted(needed_files(network, trunk, recipes["sgm"], blocks) - files.keys())
    if missing:
        raise QsgmError(f"{path}: 'files' does not list {missing[0]}; run `{COMMAND}` again")
    usual = dict[int, str]()
    if "usual_blocks" in values:
        usual = read.part(
            "usual_blocks",
            "by numbers of layers some of `blocks`",
            lambda found: _usual_from(found, blocks),
        )
    task = TaskRecord(name, network, heads, settings)
    return Manifest(task, most, trunk, blocks, recipes, initializers, sgms, files, usual)


def needed_files(
    network: Network, trunk: Precision, recipes: Recipes, blocks: Sequence[str]
) -> set[str]:
    """The graphs without which a bundle cannot tune all of its blocks as is usual."""
    needed = {NETWORK, WEIGHTS}
    for one in (parse_blocks(text, network.depth) for text in blocks):
        needed |= {head_file(len(one.layers)), trunk_file(trunk, one.layers)}
        needed.add(step_file(defaults.PRECISION, recipes.usual(str(one)), one))
    return needed


def size_of(manifest: Path, name: str) -> float:
    """Bytes of a file beside a manifest.

    Infinity if it is missing, so that the missing file is reported later.
    """
    path = manifest.with_name(name)
    return path.stat().st_size if path.is_file() else math.inf


def parse_description(
    data: bytes, path: Path, kind: str, versions: Sequence[int], command: str
) -> dict[str, Any]:
    """A folder's JSON description, if it is of the expected kind.

    Args:
        data: the description's bytes.
        path: of the description, for the message.
        kind: expected value of its key `format`.
        versions: expected values of its key `version`, the newest last.
        command: what the user runs to make such a folder.

    Raises:
        QsgmError: it is not JSON, or describes something else.
    """
    try:
        values = json.loads(str(data, "utf-8"))
    except (ValueError, RecursionError, MemoryError) as error:  # not UTF-8, not JSON, no end
        raise QsgmError(f"{path} is not JSON; make it again with `{command}`") from error
    got = (values.get("format"), values.get("version")) if isinstance(values, dict) else None
    if got not in [(kind, version) for version in versions]:
        raise QsgmError(
            f"{path} is of format {got}, expected {(kind, versions[-1])}; make it with `{command}`"
        )
    return dict(values)


@dataclass(frozen=True)
class _Reader:
    """Reads one key after the other; whatever is wrong with one becomes one line."""

    values: Mapping[str, Any]
    path: Path

    def part(self, key: str, expected: str, parse: Callable[[Any], Value]) -> Value:
        try:
            return parse(self.values[key])
        except (
            LookupError,
            TypeError,
            ValueError,
            ArithmeticError,
            AttributeError,
            QsgmError,
        ) as error:
            got = f"{str(self.values[key])[:60]!r}" if key in self.values else "nothing"
            raise QsgmError(
                f"{self.path}: {key!r} is damaged: expected {expected}, got {got}; run `{COMMAND}`"
            ) from error


def _require(value: Value, sane: bool) -> Value:
    if not sane:
        raise ValueError(str(value)[:40])
    return value


def _task_from(values: Any) -> tuple[str, Mapping[str, Any]]:
    name = _require(values["name"], isinstance(values["name"], str))
    rest = {key: value for key, value in values.items() if key != "name"}
    return name, MappingProxyType(rest)


def _heads_from(values: Any, network: Network) -> Heads:
    heads = heads_from_json(values)
    return _require(heads, output_count(heads) == network.outputs)


def _blocks_from(texts: Any, network: Network, most: int) -> tuple[str, ...]:
    """Texts that name blocks, each with an SGM or the last layer alone, of so many layers."""
    blocks = [parse_blocks(text, network.depth) for text in texts]
    alone = one_block(network.last(1))
    sane = (
        len(set(texts)) == len(texts)
        and max(len(one.layers) for one in blocks) == most
        and all(one.sgm_layers or one == alone for one in blocks)
    )
    return _require(tuple(texts), sane)


def _usual_from(values: Any, blocks: Sequence[str]) -> dict[int, str]:
    """Blocks by how many layers they are."""
    found = {int(tuned): _require(text, text in blocks) for tuned, text in values.items()}
    sane = all(len(parse_blocks(text).layers) == tuned for tuned, text in found.items())
    return _require(found, sane)


def _recipes_from(values: Any, blocks: Sequence[str]) -> Mapping[Method, Recipes]:
    parsed = [parse_blocks(text) for text in blocks]
    can_tune: Mapping[Method, Sequence[str]] = {
        "sgm": blocks,
        "bp": [str(one_block(one.layers)) for one in parsed],
    }
    methods: tuple[Method, ...] = get_args(Method)
    found = {method: _method_from(values[method], can_tune[method]) for method in methods}
    gains = found["sgm"].short_gains
    _require(gains, all(gains[text] >= 1 for text in blocks))
    return MappingProxyType(found)


def _method_from(values: Any, can_tune: Sequence[str]) -> Recipes:
    optimizer = _require(values["optimizer"], values["optimizer"] in OPTIMIZERS)
    rates = {
        _require(name, name in OPTIMIZERS): {
            text: tuple(map(_positive, one)) for text, one in by_blocks.items()
        }
        for name, by_blocks in values["rates"].items()
    }
    for by_blocks in rates.values():
        for text, one in by_blocks.items():
            _require(one, len(one) == len(parse_blocks(text).layers))
    _require(rates, all(text in rates[optimizer] for text in can_tune))
    short = {text: _positive(gain) for text, gain in values.get("short_gains", {}).items()}
    gains = {
        _require(name, name in rates): {
            _require(text, text in rates[name]): _gains_from(one) for text, one in by_blocks.items()
        }
        for name, by_blocks in values.get("gains", {}).items()
    }
    usual = {
        text: _require(name, text in rates[name])
        for text, name in values.get("optimizers", {}).items()
    }
    return Recipes(optimizer, rates, short, gains, usual)


def recipe_from(values: Any) -> Recipe:
    """A recipe from its fields as plain values.

    Raises:
        LookupError, TypeError, ValueError or OverflowError: they are no recipe's.
    """
    name = _require(values["optimizer"], values["optimizer"] in OPTIMIZERS)
    gains = _gains_from(values["gains"]) if values["gains"] else ()
    return Recipe(name, tuple(map(_positive, values["rates"])), gains)


def _gains_from(values: Any) -> Gains:
    """Lengths in steps, each longer than the one before, with a factor each."""
    found = tuple((_require(steps, type(steps) is int), _positive(gain)) for steps, gain in values)
    lengths = [0, *(steps for steps, _ in found)]
    return _require(found, bool(found) and all(a < b for a, b in pairwise(lengths)))


def _initializers_from(
    values: Any, network: Network, layers: range, size: float
) -> Mapping[str, Place]:
    found = {}
    for number in layers:
        layer = network.layer(number)
        shapes: dict[str, tuple[int, ...]] = {
            f"weight{number}": (layer.out, layer.into, *layer.kernel)
        }
        shapes[f"bias{number}"] = (layer.out,)
        for name, shape in shapes.items():
            found[name] = _place_from(values[name], size)
            _require(found[name], found[name].shape == shape)
    return MappingProxyType(found)


def _sgms_from(
    values: Any, network: Network, heads: Heads, layers: range, size: float
) -> Mapping[int, SgmEntry]:
    found = {}
    for number in layers[:-1]:
        one = values[str(number)]
        convolutions = tuple(
            (_place_from(conv["weight"], size), _place_from(conv["bias"], size))
            for conv in one["convolutions"]
        )
        channels, kernel = network.layer(number).out, network.sgm_kernel(number)
        _require(convolutions, len(convolutions) > 1)
        into = channels + output_count(heads)
        for weight, bias in convolutions:
            out = weight.shape[0]
            _require(weight, weight.shape == (out, into, *kernel) and bias.shape == (out,))
            into = out
        _require(into, into == channels)
        bits = _require(one["bits"], type(one["bits"]) is int and one["bits"] in ACTIVATION_BITS)
        found[number] = SgmEntry(bits, convolutions)
    return MappingProxyType(found)


def _place_from(values: Any, size: float) -> Place:
    offset, shape = values["offset"], values["shape"]
    whole = (offset, *shape)
    sane = all(type(number) is int for number in whole) and all(side > 0 for side in shape)
    _require(whole, sane and len(shape) in (1, 4))
    _require(offset, 0 <= offset <= size - FLOAT_BYTES * math.prod(shape))
    return Place(offset, tuple(shape))


def _files_from(values: Any) -> Mapping[str, FileEntry]:
    found = {}
    for name, one in values.items():
        peak = one.get("peak_activation_bytes")
        _require(name, is_plain(name))
        _require(one, isinstance(one["sha256"], str) and (peak is None or type(peak) is int))
        found[name] = FileEntry(one["sha256"], peak)
    return MappingProxyType(found)


def _positive(value: Any) -> float:
    """A number above 0 that a float can hold; raises OverflowError for a whole one too large."""
    return float(_require(value, type(value) in (int, float) and 0 < float(value) < math.inf))


def _place_json(place: Place) -> dict[str, Any]:
    return {"offset": place.offset, "shape": list(place.shape)}


def _sgm_json(sgm: SgmEntry) -> dict[str, Any]:
    pairs = sgm.convolutions
    return {
        "bits": sgm.bits,
        "convolutions": [{"weight": _place_json(w), "bias": _place_json(b)} for w, b in pairs],
    }


def _recipes_json(recipes: Recipes) -> dict[str, Any]:
    rates = {
        name: {text: list(one) for text, one in by_blocks.items()}
        for name, by_blocks in recipes.rates.items()
    }
    gains = {
        name: {text: [[*pair] for pair in one] for text, one in by_blocks.items()}
        for name, by_blocks in recipes.gains.items()
    }
    more = {
        "short_gains": dict(recipes.short_gains),
        "gains": gains,
        "optimizers": dict(recipes.optimizers),
    }
    said = {key: value for key, value in more.items() if value}
    return {"optimizer": recipes.optimizer, "rates": rates, **said}


def _file_json(file: FileEntry) -> dict[str, Any]:
    peak = file.peak_activation_bytes
    return {"sha256": file.sha256} | ({} if peak is None else {"peak_activation_bytes": peak})
