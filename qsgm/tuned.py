"""A tuned object: a folder with a stand-alone ONNX network, how to read it, and the report."""

import hashlib
import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.angles import ENCODINGS, AngleEncoding
from qsgm.bundle import NETWORK, read_manifest, require_keys
from qsgm.errors import QsgmError
from qsgm.files import new_folder
from qsgm.predict import Detection, locate, refine
from qsgm.runtime import open_session, running

FORMAT = "qsgm-object"
VERSION = 1
DESCRIPTION = "object.json"
REPORT = "report.json"
_COMMAND = "qsgm finetune -o DIR"
_ADVICE = "tune the object again with `qsgm finetune`"
_KEYS: dict[str, type] = {"name": str, "encoding": str, "offset_rad": float, "sha256": str}


@dataclass(frozen=True)
class ObjectDescription:
    """What `predict` has to know beside the network."""

    name: str
    encoding: AngleEncoding
    offset_rad: float  # orientation of the demonstration as the network sees it


class TunedObject:
    """A tuned object, ready to be looked for."""

    def __init__(self, description: ObjectDescription, network: Path | bytes, threads: int) -> None:
        self.description = description
        self._session = open_session(network, threads)
        inputs = [value.name for value in self._session.get_inputs()]
        outputs = [value.name for value in self._session.get_outputs()]
        if (inputs, outputs) != (["frame"], ["heatmap"]):
            raise QsgmError(
                f"the network of {description.name!r} takes {inputs} and gives {outputs}, expected "
                f"a frame and its heatmap; {_ADVICE}"
            )

    def heatmap(self, frame: NDArray[np.uint8]) -> NDArray[np.float32]:
        """A frame (H, W, 3) to quality, sine and cosine (3, rows, cols)."""
        with running(f"the object {self.description.name!r}", _ADVICE):
            heatmap: NDArray[np.float32] = self._session.run(["heatmap"], {"frame": frame})[0]
        return heatmap

    def locate(self, frame: NDArray[np.uint8]) -> tuple[Detection, NDArray[np.float32]]:
        """Where the object is in a frame (H, W, 3), and the heatmap that says so.

        The heatmap finds it, a second and closer look says where exactly and how far turned.
        """
        heatmap = self.heatmap(frame)
        height, width = frame.shape[:2]
        how = self.description.offset_rad, self.description.encoding
        coarse = locate(heatmap, (height, width), *how)
        if not coarse.found:
            return coarse, heatmap
        return refine(coarse, frame, self.heatmap, *how), heatmap


def save_object(
    folder: Path, description: ObjectDescription, network: bytes, report: dict[str, Any]
) -> None:
    """Write a tuned object; the folder appears complete or not at all.

    Raises:
        QsgmError: the folder cannot be written, or holds something else.
    """
    head = {"format": FORMAT, "version": VERSION, "sha256": hashlib.sha256(network).hexdigest()}
    with new_folder(folder, DESCRIPTION) as new:
        (new / NETWORK).write_bytes(network)
        (new / DESCRIPTION).write_text(json.dumps(head | asdict(description), indent=1) + "\n")
        (new / REPORT).write_text(json.dumps(report, indent=1) + "\n")


def load_object(folder: Path, threads: int = 1) -> TunedObject:
    """Read a tuned object back.

    Raises:
        QsgmError: it is missing, altered, or something else.
    """
    manifest = read_manifest(folder, FORMAT, VERSION, _COMMAND)
    require_keys(folder / DESCRIPTION, manifest, _KEYS, _COMMAND)
    description = ObjectDescription(manifest["name"], manifest["encoding"], manifest["offset_rad"])
    if description.encoding not in ENCODINGS or not math.isfinite(description.offset_rad):
        raise QsgmError(
            f"{folder / DESCRIPTION}: expected encoding {' or '.join(ENCODINGS)} and a finite "
            f"offset_rad, got {description.encoding!r} and {description.offset_rad}; {_ADVICE}"
        )
    path = folder / NETWORK
    if not path.is_file() or hashlib.sha256(path.read_bytes()).hexdigest() != manifest["sha256"]:
        raise QsgmError(f"{path} is missing or altered; {_ADVICE}")
    return TunedObject(description, path, threads)
