"""Constants that many graphs hold, once: ONNX external data in one file beside the graphs.

Any ONNX runtime finds them there when it opens a graph by its path.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from onnx import ModelProto
from onnx.external_data_helper import set_external_data

# Smaller constants stay in the graph: naming the place of another takes as many bytes.
LEAST_BYTES = 200
# Of every constant's place, so that a runtime may map it into memory.
ALIGNMENT = 64
# So begin the names of constants that the device exchanges, which goes with external ones only.
EXCHANGED = "sgm"


class SharedConstants:
    """Bytes that are written once however often they are asked for."""

    def __init__(self, location: str) -> None:
        self.location = location
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

    def add_array(self, array: NDArray[Any]) -> dict[str, Any]:
        """Offset and shape of a float32 array in the file."""
        raw = np.ascontiguousarray(array, dtype="<f4").tobytes()
        return {"offset": self.add(raw), "shape": list(array.shape)}

    def take_from(self, models: Iterable[ModelProto]) -> None:
        """Move the larger constants of these models to the file; the models are changed."""
        for model in models:
            for tensor in model.graph.initializer:
                if len(tensor.raw_data) >= LEAST_BYTES or tensor.name.startswith(EXCHANGED):
                    offset, length = self.add(tensor.raw_data), len(tensor.raw_data)
                    set_external_data(tensor, self.location, offset, length)
                    tensor.ClearField("raw_data")
