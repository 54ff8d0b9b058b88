"""`sgm.pt`: a pretrained network with its SGMs, learning rates and model card."""

import json
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any

import torch

from qsgm.blocks import parse_blocks, single_layers
from qsgm.errors import QsgmError
from qsgm.files import read_file, write_bytes_atomic
from qsgm.manifest import Recipe, recipe_from
from qsgm.network import Network
from qsgm.task import TaskRecord, heads_from_json, heads_to_json, output_count
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.net import ConvNet
from qsgm.train.model.sgm import Sgm

FORMAT = "qsgm-checkpoint"
VERSION = 3
LARGEST_BYTES, FLOAT_BYTES = 64 * 2**20, 4
# Of what is not numbers: one byte there can become a hundred in memory. The shipped one has 22 KB.
LARGEST_PICKLE_BYTES = 2**20
MOST_HIDDEN, WIDEST_HIDDEN = 4, 1024
_MEND = "make one with `qsgm pretrain -o sgm.pt`"
# What parts of a wrong type, size or shape raise on their way into modules and numbers.
_UNFIT = (
    QsgmError,
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    RuntimeError,
    ArithmeticError,
    MemoryError,
)


@dataclass(frozen=True)
class Checkpoint:
    """What pretraining hands on; batchnorm not folded, everything in eval mode.

    Raises:
        ValueError: SGMs or rates do not go together. Rates are needed for any number of layers,
            each a block of its own (`6`, `5,6`, ...), and may be given for other blocks.
    """

    task: TaskRecord
    net: ConvNet
    sgms: Mapping[int, Sgm]  # by the layer they stand behind: the last ones but the very last
    curvatures: Mapping[int, Curvature]  # by layer; a layer without one descends plainly
    rates: dict[str, tuple[float, ...]]  # of SGD, by blocks such as `4,5,6`; first layer first
    card: dict[str, Any]  # how it was made, and its figures; plain JSON
    short_gain: float = 1.0  # what short runs of the meta-trained layers multiply rates with
    # By blocks, where they were tried out at a device's lengths: the usual optimizer's first.
    recipes: Mapping[str, tuple[Recipe, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        network = self.task.network
        last = [*network.last(self.most_layers)[:-1]]
        if sorted(self.sgms) != last:
            raise ValueError(f"SGMs stand behind layers {sorted(self.sgms)}, not behind {last}")
        counts = {text: len(rates) for text, rates in self.rates.items()}
        for tuned in range(1, self.most_layers + 1):
            singles = single_layers(network.last(tuned))
            if str(singles) not in counts:
                raise ValueError(f"there are no rates for layers {singles}")
        if self.short_gain < 1:
            raise ValueError(f"short runs would have their rates lowered, times {self.short_gain}")
        counts |= {text: len(one.rates) for text, some in self.recipes.items() for one in some}
        for text, count in counts.items():
            layers = len(parse_blocks(text, network.depth).layers)
            if count != layers or layers > self.most_layers:
                raise ValueError(
                    f"{count} rates for layers {text}, of which {self.most_layers} can be tuned"
                )

    @property
    def most_layers(self) -> int:
        """The largest number of layers that can be tuned."""
        return len(self.sgms) + 1


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write `sgm.pt`; nothing but tensors and plain values, so `weights_only=True` loads it."""
    data = {
        "format": FORMAT,
        "version": VERSION,
        "task": json.dumps({"name": checkpoint.task.name, **checkpoint.task.settings}),
        "network": json.dumps(checkpoint.task.network.to_json()),
        "heads": json.dumps(heads_to_json(checkpoint.task.heads)),
        "net": checkpoint.net.state_dict(),
        "sgms": {layer: sgm.state_dict() for layer, sgm in checkpoint.sgms.items()},
        "hidden": {layer: list(sgm.hidden) for layer, sgm in checkpoint.sgms.items()},
        "curvatures": {k: list(one.matrices) for k, one in checkpoint.curvatures.items()},
        "rates": {blocks: list(rates) for blocks, rates in checkpoint.rates.items()},
        "card": json.dumps(checkpoint.card),
        "short_gain": checkpoint.short_gain,
        "recipes": json.dumps(
            {text: [asdict(one) for one in some] for text, some in checkpoint.recipes.items()}
        ),
    }
    buffer = BytesIO()
    torch.save(data, buffer)
    write_bytes_atomic(path, buffer.getvalue())


def load_checkpoint(path: Path) -> Checkpoint:
    """Read `sgm.pt`, trusting nothing in it: no code runs, every shape is checked.

    Raises:
        QsgmError: it is missing, broken, not finite, or not such a file.
    """
    data = _read(path)
    if not _is_ours(data):
        raise QsgmError(f"{path} is no qsgm checkpoint of version {VERSION}; {_MEND}")
    try:
        task = _task(data)
        net = ConvNet(task.network)
        net.load_state_dict(data["net"])
        sgms = {layer: _sgm(layer, task.network, data) for layer in data["sgms"]}
        curvatures = {layer: _curvature(layer, task.network, data) for layer in data["curvatures"]}
        rates, gain = _rates(data["rates"]), _number(data["short_gain"])
        card, recipes = dict(json.loads(data["card"])), _recipes(data.get("recipes", "{}"))
        checkpoint = Checkpoint(task, net.eval(), sgms, curvatures, rates, card, gain, recipes)
    except _UNFIT as error:
        raise QsgmError(
            f"{path} does not fit this version of qsgm ({_one_line(error)}); {_MEND}"
        ) from error
    for module in (net, *sgms.values()):
        for name, value in module.state_dict().items():
            _check_finite(path, name, value)
    for layer, one in curvatures.items():
        _check_finite(path, f"the curvature of layer {layer}", *one.matrices)
    return checkpoint


def _read(path: Path) -> Any:
    content = read_file(path, LARGEST_BYTES, f"a checkpoint ({_MEND})")
    try:
        _check_archive(content)
        with warnings.catch_warnings():  # torch wonders aloud about files that are not its own
            warnings.simplefilter("ignore")
            return torch.load(BytesIO(content), map_location="cpu", weights_only=True)
    except Exception as error:  # what torch raises depends on where the file is broken
        raise QsgmError(f"{path} is not a readable checkpoint; {_MEND}") from error


def _check_archive(content: bytes) -> None:
    """Refuse what would fill the memory, before any of it is unpacked.

    Raises:
        ValueError, or what `zipfile` does: it is not an archive as torch writes them.
    """
    with zipfile.ZipFile(BytesIO(content)) as archive:
        entries = archive.infolist()
    if sum(entry.file_size for entry in entries) > LARGEST_BYTES:
        raise ValueError("its parts lie on top of each other")
    for entry in entries:
        if entry.filename.endswith(".pkl") and entry.file_size > LARGEST_PICKLE_BYTES:
            raise ValueError(f"{entry.filename} is too large")
        if entry.compress_type != zipfile.ZIP_STORED:
            raise ValueError(f"{entry.filename} is packed")


def _is_ours(data: Any) -> bool:
    if not isinstance(data, dict):
        return False
    got = data.get("format"), data.get("version")
    return tuple(map(type, got)) == (str, int) and got == (FORMAT, VERSION)


def _task(data: dict[str, Any]) -> TaskRecord:
    """What the network is for; every size is checked before anything of that size is made."""
    settings = dict(json.loads(data["task"]))
    network, heads = (json.loads(data[name]) for name in ("network", "heads"))
    record = TaskRecord(
        str(settings.pop("name")), Network.from_json(network), heads_from_json(heads), settings
    )
    if output_count(record.heads) != record.network.outputs:
        raise ValueError("the heads are not the network's")
    if FLOAT_BYTES * sum(layer.weights for layer in record.network.layers) > LARGEST_BYTES:
        raise ValueError("the network has more weights than a checkpoint could hold")
    return record


def _sgm(layer: Any, network: Network, data: dict[str, Any]) -> Sgm:
    if type(layer) is not int or not 1 <= layer < network.depth:
        raise ValueError(f"there is no SGM behind layer {layer!r}")
    sgm = Sgm(network, layer, _hidden(data["hidden"][layer]))
    sgm.load_state_dict(data["sgms"][layer])
    return sgm.eval()


def _curvature(layer: Any, network: Network, data: dict[str, Any]) -> Curvature:
    if type(layer) is not int or not 1 <= layer <= network.depth:
        raise ValueError(f"there is no layer {layer!r} to have a curvature")
    plain = Curvature.identity(network.layer(layer))
    curvature = Curvature(*data["curvatures"][layer])
    for matrix, expected in zip(curvature.matrices, plain.matrices, strict=True):
        if (matrix.shape, matrix.dtype) != (expected.shape, expected.dtype):
            raise ValueError(f"a curvature matrix of layer {layer} has another shape or type")
    return curvature


def _hidden(widths: Any) -> list[int]:
    """Checked before anything of these widths is made."""
    if not isinstance(widths, list | tuple) or not 1 <= len(widths) <= MOST_HIDDEN:
        raise ValueError(f"an SGM has 1 to {MOST_HIDDEN} hidden widths")
    for width in widths:
        if type(width) is not int or not 1 <= width <= WIDEST_HIDDEN:
            raise ValueError(f"a hidden width is not a whole number from 1 to {WIDEST_HIDDEN}")
    return list(widths)


def _rates(by_blocks: Any) -> dict[str, tuple[float, ...]]:
    rates = {str(text): tuple(map(_number, of_layers)) for text, of_layers in by_blocks.items()}
    if not all(rate > 0 for of_layers in rates.values() for rate in of_layers):
        raise ValueError("a rate is not positive")
    return rates


def _recipes(text: str) -> dict[str, tuple[Recipe, ...]]:
    """By blocks; what is said of each is what a manifest says."""
    return {
        blocks: tuple(recipe_from(one) for one in some) for blocks, some in json.loads(text).items()
    }


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not isfinite(value):
        raise ValueError("a rate or weight is not a finite number")
    return float(value)


def _one_line(error: BaseException) -> str:
    """The start of what an error says, or its kind where that cannot be shown."""
    first = next(iter(str(error).splitlines()), "")[:160]
    return first if first and first.isprintable() else type(error).__name__


def _check_finite(path: Path, name: str, *values: torch.Tensor) -> None:
    if not all(torch.isfinite(value).all() for value in values):
        raise QsgmError(f"{path}: {name} holds NaN or infinity; {_MEND}")
