"""Where the tensors of an ONNX file lie, found without `onnx`, which the device does not have.

A tensor may name any file as the place of its numbers, and ONNX Runtime before 1.24.1 reads it. So
whoever opens a graph that others wrote looks first. The walk is stricter than protobuf's own: what
the two could read differently is refused.
"""

from collections.abc import Iterator, Mapping
from typing import NamedTuple

# Fields that hold messages, by message: ModelProto, and on from there whatever may hold a tensor.
_INSIDE = {
    "model": {7: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_DATA_LOCATION, _EXTERNAL_DATA = 14, 13
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5
_MOST_FIELDS = 500_000


class _Field(NamedTuple):
    number: int
    value: int  # of a varint, else 0
    body: memoryview


def check_external_data(model: bytes, files: Mapping[str, bytes]) -> None:
    """Refuse a model with tensors in other files than these, or beyond their ends.

    Raises:
        ValueError: names the file; or the model is no protobuf message, or has too many parts.
    """
    waiting, left = [("model", memoryview(model))], _MOST_FIELDS
    for kind, message in waiting:
        fields = []
        for field in _fields(message):
            fields.append(field)
            left -= 1
            if not left:
                raise ValueError("its graph has too many parts")
            if field.number in _INSIDE.get(kind, ()):
                waiting.append((_INSIDE[kind][field.number], field.body))
        if kind == "tensor":
            _check_tensor(fields, files)


def _check_tensor(fields: list[_Field], files: Mapping[str, bytes]) -> None:
    entries = [_entry(field.body) for field in fields if field.number == _EXTERNAL_DATA]
    if not entries and not any(field.number == _DATA_LOCATION and field.value for field in fields):
        return
    place = dict(entries)
    name = place.get("location", "")
    if len(place) != len(entries) or name not in files:
        raise ValueError(f"it keeps numbers in the file {name!r}, which is not part of it")
    offset, length = (int(place.get(key, "0")) for key in ("offset", "length"))
    if min(offset, length) < 0 or offset + length > len(files[name]):
        raise ValueError(f"it keeps numbers beyond the end of {name!r}")


def _entry(message: memoryview) -> tuple[str, str]:
    """Key and value of a StringStringEntryProto."""
    texts = {field.number: bytes(field.body).decode() for field in _fields(message)}
    return texts.get(1, ""), texts.get(2, "")


def _fields(message: memoryview) -> Iterator[_Field]:
    """The fields of a message, in order."""
    position = 0
    while position < len(message):
        tag, position = _varint(message, position, 5)
        kind, value, size = tag & 7, 0, 0
        if kind == _VARINT:
            value, position = _varint(message, position, 10)
        elif kind == _BYTES:
            size, position = _varint(message, position, 5)
        elif kind in (_FIXED64, _FIXED32):
            size = 8 if kind == _FIXED64 else 4
        else:
            raise ValueError("it is not an ONNX file")
        if tag >> 32 or position + size > len(message):
            raise ValueError("it is not an ONNX file")
        body = message[position : position + size] if kind == _BYTES else message[:0]
        yield _Field(tag >> 3, value, body)
        position += size


def _varint(message: memoryview, position: int, most: int) -> tuple[int, int]:
    """A number of at most so many bytes, and where it ends."""
    value = 0
    for index, byte in enumerate(message[position : position + most]):
        value |= (byte & 0x7F) << 7 * index
        if byte < 0x80:
            return value, position + index + 1
    raise ValueError("it is not an ONNX file")
