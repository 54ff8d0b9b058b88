"""The built-in task `arrays`: samples and labels in an `.npz`, network and heads as data."""

import io
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from qsgm.errors import QsgmError, as_text
from qsgm.files import read_file
from qsgm.network import Network
from qsgm.samples.lesson import Samples, checked_samples
from qsgm.samples.task import SampleTask
from qsgm.task import Array, Heads, output_count

NAME = "arrays"
SAMPLES, LABELS, GROUPS = "samples", "labels", "groups"
MOST_BYTES = 500_000_000
EXPECTED = "an .npz of `samples` (N, H, W, C) and `labels` (N, L) or (N,)"
_HEADERS = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


@dataclass(frozen=True)
class ArraysTask(SampleTask):
    """Whatever an array of samples shows."""

    def read(self, path: Path) -> Samples:
        return samples_in(read_npz(path, (SAMPLES, LABELS)), self.network, self.heads, path)


def samples_in(
    arrays: Mapping[str, NDArray[Any]], network: Network, heads: Heads, path: Path
) -> Samples:
    """Samples of a network; classes become labels. Raises QsgmError where they do not fit."""
    if SAMPLES not in arrays:
        raise QsgmError(f"{path} holds no `{SAMPLES}`: expected {EXPECTED}")
    labels = arrays.get(LABELS)
    known = None if labels is None else _as_labels(labels, heads, path)
    return checked_samples(Samples(arrays[SAMPLES], known), network, heads, str(path))


def _as_labels(labels: NDArray[Any], heads: Heads, path: Path) -> Array:
    """Labels as they are, or classes of the only head as one channel each."""
    if labels.ndim != 1 or labels.dtype.kind not in "iu":
        return labels
    classes = output_count(heads)
    if len(heads) != 1 or heads[0].kind != "cross_entropy":
        raise QsgmError(f"{path}: classes go with a single head of cross entropy; pass (N, L)")
    if not all(0 <= label < classes for label in labels.tolist()):
        raise QsgmError(
            f"{path}: classes from {labels.min()} to {labels.max()}, expected 0 to {classes - 1}"
        )
    one_hot: Array = np.eye(classes, dtype=np.float32)[labels]
    return one_hot


def read_npz(path: Path, names: tuple[str, ...]) -> dict[str, NDArray[Any]]:
    """Those of an archive's arrays that have these names, trusting nothing in it.

    Shapes and types are read first, and bounded before anything is unpacked; no code runs.

    Raises:
        QsgmError: it is no such archive, damaged or too large.
    """
    content = read_file(path, MOST_BYTES, EXPECTED)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            known = [entry for entry in archive.infolist() if _name(entry) in names]
            if len({_name(entry) for entry in known}) < len(known):
                raise ValueError("a name is there twice")
            if sum(entry.file_size for entry in known) > MOST_BYTES:
                raise ValueError(f"more than {MOST_BYTES / 1e6:g} MB unpacked")
            return {_name(entry): _array(archive, entry) for entry in known}
    # A damaged archive raises what its packer does.
    except Exception as error:
        first = next(iter(str(error).splitlines()), type(error).__name__)
        raise QsgmError(
            f"{path} cannot be read ({as_text(first, 120)}); expected {EXPECTED}"
        ) from error


def _name(entry: zipfile.ZipInfo) -> str:
    return entry.filename.removesuffix(".npy")


def _array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> NDArray[Any]:
    """One array, as large as its header says and the archive's index agrees."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{entry.filename} is packed in a way of its own")
    with archive.open(entry) as file:
        version = npy.read_magic(file)
        if version not in _HEADERS:
            raise ValueError(f"{entry.filename} is of version {version}")
        shape, fortran, dtype = _HEADERS[version](file)
        if dtype.hasobject or dtype.kind not in "iuf":
            raise ValueError(f"{entry.filename} holds {dtype}, no numbers")
        size = math.prod(shape) * dtype.itemsize
        if not 0 <= size <= entry.file_size or any(side < 0 for side in shape):
            raise ValueError(f"{entry.filename} says {shape}, which is not in it")
        data = file.read(size + 1)
    if len(data) != size:
        raise ValueError(f"{entry.filename} has other numbers than {shape}")
    array = np.frombuffer(data, dtype)
    shaped = array.reshape(shape, order="F" if fortran else "C")
    return np.asarray(shaped, dtype.newbyteorder("="), order="C")  # a single number stays one
