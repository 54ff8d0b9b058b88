"""`sgm.pt`: a pretrained network with its SGMs, learning rates and model card."""

import json
import pickle
import warnings
import zipfile
from dataclasses import asdict, dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import torch

from qsgm.errors import QsgmError
from qsgm.files import write_bytes_atomic
from qsgm.train.graspnet import GraspNet, Loss
from qsgm.train.sgm import SGM_LAYERS, Sgm

FORMAT = "qsgm-checkpoint"
VERSION = 1
LARGEST_BYTES = 64 * 2**20
_MEND = "make one with `qsgm pretrain -o sgm.pt`"


@dataclass(frozen=True)
class Checkpoint:
    """What pretraining hands on; batchnorm not folded, everything in eval mode."""

    net: GraspNet
    sgms: dict[int, Sgm]  # by the layer they stand behind
    loss: Loss
    rates: dict[int, tuple[float, ...]]  # of SGD, by number of tuned layers; first layer first
    card: dict[str, Any]  # how it was made, and its figures; plain JSON


def save_checkpoint(path: Path, checkpoint: Checkpoint) -> None:
    """Write `sgm.pt`; nothing but tensors and plain values, so `weights_only=True` loads it."""
    data = {
        "format": FORMAT,
        "version": VERSION,
        "net": checkpoint.net.state_dict(),
        "sgms": {layer: sgm.state_dict() for layer, sgm in checkpoint.sgms.items()},
        "hidden": {layer: list(sgm.hidden) for layer, sgm in checkpoint.sgms.items()},
        "loss": asdict(checkpoint.loss),
        "rates": {tuned: list(rates) for tuned, rates in checkpoint.rates.items()},
        "card": json.dumps(checkpoint.card),
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
    if not isinstance(data, dict) or (data.get("format"), data.get("version")) != (FORMAT, VERSION):
        raise QsgmError(f"{path} is no qsgm checkpoint of version {VERSION}; {_MEND}")
    try:
        net = GraspNet()
        net.load_state_dict(data["net"])
        sgms = {int(layer): _sgm(int(layer), data) for layer in data["sgms"]}
        loss = Loss(**data["loss"])
        rates = {int(n): tuple(float(r) for r in rates) for n, rates in data["rates"].items()}
        card = dict(json.loads(data["card"]))
    except (KeyError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        reason = str(error).splitlines()[0][:160]
        raise QsgmError(f"{path} does not fit this version of qsgm ({reason}); {_MEND}") from error
    _check_finite(path, net, *sgms.values())
    return Checkpoint(net.eval(), sgms, loss, rates, card)


def _read(path: Path) -> Any:
    if not path.is_file():
        raise QsgmError(f"{path}: expected a checkpoint, found no such file; {_MEND}")
    if path.stat().st_size > LARGEST_BYTES:
        size = path.stat().st_size // 2**20
        raise QsgmError(f"{path} has {size} MB, a checkpoint has less than 64 MB; {_MEND}")
    try:
        with warnings.catch_warnings():  # torch wonders aloud about files that are not its own
            warnings.simplefilter("ignore")
            return torch.load(path, map_location="cpu", weights_only=True)
    except (
        pickle.UnpicklingError,
        zipfile.BadZipFile,
        RuntimeError,
        EOFError,
        ValueError,
        OSError,
        KeyError,
        IndexError,
        AttributeError,
        TypeError,
    ) as error:
        raise QsgmError(f"{path} is not a readable checkpoint; {_MEND}") from error


def _sgm(layer: int, data: dict[str, Any]) -> Sgm:
    if layer not in SGM_LAYERS:
        raise ValueError(f"there is no SGM behind layer {layer}")
    sgm = Sgm(layer, [int(width) for width in data["hidden"][layer]])
    sgm.load_state_dict(data["sgms"][layer])
    return sgm.eval()


def _check_finite(path: Path, *modules: torch.nn.Module) -> None:
    for module in modules:
        for name, value in module.state_dict().items():
            if not torch.isfinite(value).all():
                raise QsgmError(f"{path}: {name} holds NaN or infinity; {_MEND}")
