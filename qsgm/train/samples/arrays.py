"""The task `arrays` on the host: a JSON file says network and heads, an `.npz` holds the samples.

{"network": {"input_shape": [8, 8, 1], "input_kind": "pixels", "layers": [...]},
 "heads": [...], "tuned": 2, "samples": "pool.npz"}

`samples` lies beside the JSON file. Where the archive has `groups` (N,), every lesson is of one
group: a person, a machine, a day; that is what a device meets.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qsgm.errors import QsgmError
from qsgm.files import read_file, sha256
from qsgm.network import Network
from qsgm.samples.arrays import GROUPS, LABELS, NAME, SAMPLES, ArraysTask, read_npz, samples_in
from qsgm.samples.lesson import Samples
from qsgm.samples.task import TUNED
from qsgm.task import Array, Inputs, heads_from_json

MOST_BYTES = 1_000_000


@dataclass(frozen=True)
class PooledArrays(ArraysTask):
    """Samples of a pool, a group at a time."""

    inputs: Inputs = field(default_factory=lambda: np.zeros(0, np.uint8), repr=False)
    labels: Array = field(default_factory=lambda: np.zeros(0, np.float32), repr=False)
    groups: tuple[NDArray[np.int64], ...] = field(default=(), repr=False)  # rows of each
    sha256: str = ""  # of the pool: an unfinished pretraining goes on with the same only

    def draw(self, rng: np.random.Generator, count: int) -> Samples:
        among = self.groups[rng.integers(len(self.groups))]
        rows = rng.choice(among, count, replace=count > len(among))
        return Samples(self.inputs[rows], self.labels[rows])

    def example(self, rng: np.random.Generator, count: int) -> Samples:
        rows = rng.choice(len(self.labels), count, replace=count > len(self.labels))
        return Samples(self.inputs[rows], self.labels[rows])


def load_arrays_task(path: Path) -> PooledArrays:
    """Read such a JSON file and the samples it names, trusting nothing. Raises QsgmError."""
    data = read_file(path, MOST_BYTES, "a JSON file of the task `arrays`")
    try:
        values: Any = json.loads(data)
        network, heads = Network.from_json(values["network"]), heads_from_json(values["heads"])
        tuned, name = values.get("tuned", TUNED), values["samples"]
        if type(tuned) is not int or not isinstance(name, str):
            raise ValueError("`tuned` is a whole number, `samples` a file's name")
        pool = path.parent / name
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise QsgmError(
            f"{path} is no task `{NAME}` ({type(error).__name__}: {error}); expected JSON with "
            "network, heads and samples"
        ) from error
    arrays = read_npz(pool, (SAMPLES, LABELS, GROUPS))
    found = samples_in(arrays, network, heads, pool)
    if found.labels is None:
        raise QsgmError(f"{pool} holds no `{LABELS}`, without which nothing can be learnt")
    groups = _rows_of(arrays.get(GROUPS), len(found), pool)
    digest = sha256(found.inputs.tobytes() + found.labels.tobytes())
    return PooledArrays(NAME, network, heads, tuned, found.inputs, found.labels, groups, digest)


def _rows_of(groups: NDArray[Any] | None, count: int, pool: Path) -> tuple[NDArray[np.int64], ...]:
    if groups is None:
        return (np.arange(count),)
    if groups.shape != (count,):
        raise QsgmError(f"{pool}: `{GROUPS}` is {groups.shape}, expected ({count},)")
    return tuple(np.flatnonzero(groups == one) for one in np.unique(groups))
