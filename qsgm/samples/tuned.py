"""A tuned network: a folder with a stand-alone ONNX network, what it is for, and the report."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError, as_text
from qsgm.files import read_file, read_whole
from qsgm.manifest import MANIFEST_BYTES, NETWORK
from qsgm.network import Network
from qsgm.runtime import Value, check_interface, open_session, running
from qsgm.samples.lesson import Samples, checked_samples
from qsgm.task import Array, Inputs, TaskRecord, heads_from_json, heads_to_json, output_count
from qsgm.tuned_folder import (
    DESCRIPTION,
    VERSION,
    read_description,
    require_keys,
    unaltered,
    write_tuned,
)

MOST_BYTES = 256_000_000
_ADVICE = "tune it again with `qsgm finetune`"


@dataclass(frozen=True)
class NetworkDescription:
    """What a tuned network's folder says of it."""

    name: str
    task: TaskRecord
    made: Mapping[str, Any]  # by what


class TunedNetwork:
    """A tuned network, ready to answer."""

    def __init__(self, name: str, task: TaskRecord, network: bytes, threads: int = 1) -> None:
        self.name, self.task = name, task
        what, pixels = f"the network of {name!r}", task.network.input_kind == "pixels"
        kind = "tensor(uint8)" if pixels else "tensor(float)"
        takes: dict[str, Value] = {"frame": (kind, (None, None, task.network.input_shape[2]))}
        gives: dict[str, Value] = {"heatmap": ("tensor(float)", (task.network.outputs, None, None))}
        self._session = open_session(network, threads, name=what)
        check_interface(self._session, what, takes, gives, _ADVICE)

    def answers(self, inputs: Inputs) -> Array:
        """Activated outputs (N, L) for samples (N, H, W, C).

        Raises:
            QsgmError: the samples are others, or the network's answers are not finite.
        """
        task = self.task
        seen = checked_samples(Samples(inputs), task.network, task.heads, "the samples").inputs
        with running(f"the tuned network {self.name!r}", _ADVICE):
            maps = [self._session.run(["heatmap"], {"frame": one})[0] for one in seen]
        if not all(one.shape == (task.network.outputs, 1, 1) for one in maps):
            raise QsgmError(f"{self.name!r} answers {maps[0].shape} numbers to a sample; {_ADVICE}")
        outputs: NDArray[np.float32] = np.stack(maps)[:, :, 0, 0]
        if not np.isfinite(outputs).all():
            raise QsgmError(f"{self.name!r} answers with NaN or infinity; {_ADVICE}")
        return outputs


def save_network(
    folder: Path,
    task: TaskRecord,
    network: bytes,
    name: str,
    made: Mapping[str, Any],
    report: Mapping[str, Any],
) -> None:
    """Write a tuned network; it appears complete or not at all. Raises QsgmError."""
    description = {
        "name": name,
        "task": {"name": task.name, **task.settings},
        "network": task.network.to_json(),
        "heads": heads_to_json(task.heads),
        "made": dict(made),
    }
    write_tuned(folder, network, description, report)


def task_named_in(folder: Path) -> str | None:
    """The task of a tuned network; None for a tuned object of grasping, or what is neither."""
    try:
        values = json.loads(read_file(folder / DESCRIPTION, MANIFEST_BYTES, "a tuned network"))
        return str(values["task"]["name"])
    except (QsgmError, ValueError, LookupError, TypeError, RecursionError, AttributeError):
        return None


def load_network(folder: Path, threads: int = 1) -> TunedNetwork:
    """Read a tuned network, trusting nothing in it.

    Raises:
        QsgmError: something is missing or altered, or this is no tuned network.
    """
    about, network = read_network(folder)
    return TunedNetwork(about.name, about.task, network, threads)


def read_network(folder: Path) -> tuple[NetworkDescription, bytes]:
    """What a tuned network's folder says, and the network as an ONNX file; nothing is run.

    Raises:
        QsgmError: something is missing or altered, or this is no tuned network.
    """
    return read_whole(folder, lambda: _read(folder))


def _read(folder: Path) -> tuple[NetworkDescription, bytes]:
    path = folder / DESCRIPTION
    values = read_description(folder, (VERSION,), "a tuned network")
    keys = {"name": str, "task": dict, "network": dict, "heads": list, "sha256": str}
    require_keys(path, values, keys)
    settings = dict(values["task"])
    require_keys(path, settings, {"name": str})
    try:
        network, heads = Network.from_json(values["network"]), heads_from_json(values["heads"])
        if output_count(heads) != network.outputs:
            raise QsgmError("the heads are not the network's")
    except QsgmError as error:
        raise QsgmError(f"{path}: {error}; {_ADVICE}") from error
    content = unaltered(folder, NETWORK, values["sha256"], MOST_BYTES, _ADVICE)
    task = TaskRecord(as_text(settings.pop("name")), network, heads, settings)
    made = values.get("made")
    known = made if isinstance(made, dict) else {}
    return NetworkDescription(as_text(values["name"]), task, known), content
