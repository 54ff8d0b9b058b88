"""Constants that many graphs hold, once: ONNX external data in a file beside the graphs.

Any ONNX runtime finds them there when it opens a graph by its path.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto, load_model_from_string
from onnx.external_data_helper import ExternalDataInfo, set_external_data, uses_external_data

from qsgm.manifest import Place, SgmEntry
from qsgm.sgm.float import FoldedSgm
from qsgm.sgm.int8 import ActivationBits
from qsgm.train.graphs.trunk import initializer_offsets

# Smaller constants stay in the graph: naming the place of another takes as many bytes.
LEAST_BYTES = 200
# Of every constant's place, so that a runtime may map it into memory; in another file as much as a
# number takes has to do.
ALIGNMENT, LEAST_ALIGNMENT = 64, 4
# So begin the names of constants that the device exchanges, which goes with external ones only.
EXCHANGED = "sgm"


@dataclass(frozen=True)
class OtherFile:
    """A file that holds some constants anyway."""

    location: str
    data: bytes
    places: Mapping[str, tuple[int, int]]  # offset and bytes of each

    def offset_of(self, raw: bytes) -> int | None:
        """Where these bytes lie in the file, as a constant of their own, if that is aligned."""
        for offset, length in self.places.values():
            if offset % LEAST_ALIGNMENT == 0 and self.data[offset : offset + length] == raw:
                return offset
        return None


def constants_elsewhere(location: str, model: bytes) -> OtherFile:
    """The constants in another model's file."""
    return OtherFile(location, model, initializer_offsets(model))


class SharedConstants:
    """Bytes that are written once however often they are asked for."""

    def __init__(self, location: str, other: OtherFile | None = None) -> None:
        self.location = location
        self._other = other
        self._data = bytearray()
        self._offsets: dict[bytes, int] = {}

    @property
    def data(self) -> bytes:
        """What the file is to hold."""
        return bytes(self._data)

    def add(self, raw: bytes) -> int:
        """Where these bytes lie in the file."""
        if raw not in self._offsets:
            self._data.extend(bytes(-len(self._data) % ALIGNMENT))
            self._offsets[raw] = len(self._data)
            self._data.extend(raw)
        return self._offsets[raw]

    def add_array(self, array: NDArray[Any]) -> Place:
        """Where a float32 array lies in the file."""
        raw = np.ascontiguousarray(array, dtype="<f4").tobytes()
        return Place(self.add(raw), array.shape)

    def take_from(self, models: Iterable[ModelProto]) -> None:
        """Move the larger constants of these models to the file; the models are changed."""
        for model in models:
            for tensor in model.graph.initializer:
                if len(tensor.raw_data) >= LEAST_BYTES or tensor.name.startswith(EXCHANGED):
                    location, offset = self.place_of(tensor.raw_data)
                    set_external_data(tensor, location, offset, len(tensor.raw_data))
                    tensor.ClearField("raw_data")

    def place_of(self, raw: bytes) -> tuple[str, int]:
        """File and offset: the other file's where that holds them, else this one's."""
        offset = None if self._other is None else self._other.offset_of(raw)
        if self._other is None or offset is None:
            return self.location, self.add(raw)
        return self._other.location, offset


def whole_model(model: bytes, file: Callable[[str], bytes]) -> ModelProto:
    """A model that holds the constants which it left in other files, whose bytes are asked for.

    onnx.load reads them from the disk, and refuses files that have several names there, as an
    installer that links its cache makes them.
    """
    whole = load_model_from_string(model)
    for tensor in whole.graph.initializer:
        if uses_external_data(tensor):
            place = ExternalDataInfo(tensor)
            rest = file(place.location)[place.offset or 0 :]
            tensor.raw_data = rest[: place.length]
            tensor.data_location = tensor.DEFAULT
            tensor.ClearField("external_data")
    return whole


def shared_sgm(shared: SharedConstants, sgm: FoldedSgm, bits: ActivationBits) -> SgmEntry:
    """What a manifest says of an SGM whose float numbers go to the shared constants."""
    places = ((shared.add_array(conv.weight), shared.add_array(conv.bias)) for conv in sgm.convs)
    return SgmEntry(bits, tuple(places))
