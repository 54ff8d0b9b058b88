"""`sgm.pt`: a pretrained network with its SGMs, learning rates and model card."""

import json
import struct
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from io import BytesIO
from math import isfinite
from pathlib import Path
from typing import Any, get_args

import torch

from qsgm.blocks import LAYERS, parse_blocks, single_layers
from qsgm.errors import QsgmError
from qsgm.files import write_bytes_atomic
from qsgm.grasp.angles import AngleEncoding
from qsgm.grasp.decision import Decision
from qsgm.train.model.curvature import Curvature
from qsgm.train.model.graspnet import GraspNet, Loss
from qsgm.train.model.sgm import SGM_LAYERS, Sgm

FORMAT = "qsgm-checkpoint"
VERSION = 2
LARGEST_BYTES = 64 * 2**20
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

    net: GraspNet
    sgms: Mapping[int, Sgm]  # by the layer they stand behind: the last ones but layer 6
    curvatures: Mapping[int, Curvature]  # by layer; a layer without one descends plainly
    loss: Loss
    rates: dict[str, tuple[float, ...]]  # of SGD, by blocks such as `4,5,6`; first layer first
    card: dict[str, Any]  # how it was made, and its figures; plain JSON
    short_gain: float = 1.0  # what short runs of three layers and more multiply rates with
    decision: Decision | None = None  # whether a candidate is the object; older files have none

    def __post_init__(self) -> None:
        last = [*range(LAYERS - len(self.sgms), LAYERS)]
        if sorted(self.sgms) != last:
            raise ValueError(f"SGMs stand behind layers {sorted(self.sgms)}, not behind {last}")
        counts = {text: len(rates) for text, rates in self.rates.items()}
        for tuned in range(1, self.most_layers + 1):
            if str(single_layers(tuned)) not in counts:
                raise ValueError(f"there are no rates for layers {single_layers(tuned)}")
        if self.short_gain < 1:
            raise ValueError(f"short runs would have their rates lowered, times {self.short_gain}")
        for text, count in counts.items():
            layers = len(parse_blocks(text).layers)
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
        "net": checkpoint.net.state_dict(),
        "sgms": {layer: sgm.state_dict() for layer, sgm in checkpoint.sgms.items()},
        "hidden": {layer: list(sgm.hidden) for layer, sgm in checkpoint.sgms.items()},
        "curvatures": {k: list(one.matrices) for k, one in checkpoint.curvatures.items()},
        "loss": asdict(checkpoint.loss),
        "rates": {blocks: list(rates) for blocks, rates in checkpoint.rates.items()},
        "card": json.dumps(checkpoint.card),
        "short_gain": checkpoint.short_gain,
        "decision": None if checkpoint.decision is None else checkpoint.decision.to_json(),
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
        net = GraspNet()
        net.load_state_dict(data["net"])
        sgms = {layer: _sgm(layer, data) for layer in data["sgms"]}
        curvatures = {layer: _curvature(layer, data) for layer in data["curvatures"]}
        loss, rates = _loss(data["loss"]), _rates(data["rates"])
        card = dict(json.loads(data["card"]))
        gain = _number(data["short_gain"])
        weighed = data.get("decision")
        decision = None if weighed is None else Decision.from_json(weighed, str(path))
        checkpoint = Checkpoint(net.eval(), sgms, curvatures, loss, rates, card, gain, decision)
    except _UNFIT as error:
        raise QsgmError(
            f"{path} does not fit this version of qsgm ({_one_line(error)}); {_MEND}"
        ) from error
    _check_finite(path, net, *sgms.values())
    _check_curvatures(path, curvatures)
    return checkpoint


def _read(path: Path) -> Any:
    _check_size(path)
    try:
        with warnings.catch_warnings():  # torch wonders aloud about files that are not its own
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what torch raises depends on where the file is broken
        raise QsgmError(f"{path} is not a readable checkpoint; {_MEND}") from error


def _check_size(path: Path) -> None:
    """Refuse what would fill the memory, before any of it is read."""
    try:
        if not path.is_file():
            raise QsgmError(f"{path}: expected a checkpoint, found no such file; {_MEND}")
        size = max(path.stat().st_size, _unpacked_bytes(path))
    except OSError as error:
        raise QsgmError(f"{path} is not a readable checkpoint; {_MEND}") from error
    if size > LARGEST_BYTES:
        raise QsgmError(f"{path} has {size // 2**20} MB, a checkpoint has less than 64; {_MEND}")


def _unpacked_bytes(path: Path) -> int:
    """Size of everything in the archive that a checkpoint is; 0 for other files."""
    try:
        with zipfile.ZipFile(path) as archive:
            return sum(entry.file_size for entry in archive.infolist())
    except (zipfile.BadZipFile, ValueError, NotImplementedError, struct.error):
        return 0


def _is_ours(data: Any) -> bool:
    if not isinstance(data, dict):
        return False
    got = data.get("format"), data.get("version")
    return tuple(map(type, got)) == (str, int) and got == (FORMAT, VERSION)


def _sgm(layer: Any, data: dict[str, Any]) -> Sgm:
    if type(layer) is not int or layer not in SGM_LAYERS:
        raise ValueError(f"there is no SGM behind layer {layer!r}")
    sgm = Sgm(layer, _hidden(data["hidden"][layer]))
    sgm.load_state_dict(data["sgms"][layer])
    return sgm.eval()


def _curvature(layer: Any, data: dict[str, Any]) -> Curvature:
    if type(layer) is not int or not 1 <= layer <= LAYERS:
        raise ValueError(f"there is no layer {layer!r} to have a curvature")
    plain = Curvature.identity(layer)
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


def _loss(fields: Any) -> Loss:
    loss = Loss(**fields)
    if loss.encoding not in get_args(AngleEncoding):
        raise ValueError(f"the angle encoding is none of {get_args(AngleEncoding)}")
    if not 0 <= _number(loss.label_smoothing) < 1:
        raise ValueError("the label smoothing is not in [0, 1)")
    if _number(loss.angle_weight) <= 0:
        raise ValueError("the angle's weight is not positive")
    return loss


def _rates(by_blocks: Any) -> dict[str, tuple[float, ...]]:
    rates = {str(text): tuple(map(_number, of_layers)) for text, of_layers in by_blocks.items()}
    if not all(rate > 0 for of_layers in rates.values() for rate in of_layers):
        raise ValueError("a rate is not positive")
    return rates


def _number(value: Any) -> float:
    if type(value) not in (int, float) or not isfinite(value):
        raise ValueError("a rate or weight is not a finite number")
    return float(value)


def _one_line(error: BaseException) -> str:
    """The start of what an error says, or its kind where that cannot be shown."""
    first = next(iter(str(error).splitlines()), "")[:160]
    return first if first and first.isprintable() else type(error).__name__


def _check_curvatures(path: Path, curvatures: Mapping[int, Curvature]) -> None:
    for layer, curvature in curvatures.items():
        if not all(torch.isfinite(matrix).all() for matrix in curvature.matrices):
            raise QsgmError(
                f"{path}: the curvature of layer {layer} holds NaN or infinity; {_MEND}"
            )


def _check_finite(path: Path, *modules: torch.nn.Module) -> None:
    for module in modules:
        for name, value in module.state_dict().items():
            if not torch.isfinite(value).all():
                raise QsgmError(f"{path}: {name} holds NaN or infinity; {_MEND}")
