"""Which other files an ONNX file takes its weights from: they decide what a model says, so they are hashed too.

The file is a protobuf message; only the few fields that lead to tensors are followed, so no package is needed.
Source: onnx.proto3 of ONNX (IR version 10), the messages ModelProto, GraphProto, NodeProto, AttributeProto, TensorProto
and FunctionProto; the encoding is protobuf's wire format.
"""

from __future__ import annotations

import mmap
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from semdb.errors import ModelError
from semdb.files import UnusableFileError, open_regular

# message -> field -> message of what it holds
_TREE: dict[str, dict[int, str]] = {
    "model": {7: "graph", 25: "function", 20: "training"},
    "training": {1: "graph", 2: "graph"},
    "graph": {1: "node", 5: "tensor", 15: "sparse"},
    "function": {7: "node", 11: "attribute"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
_EXTERNAL_DATA, _DATA_LOCATION = 13, 14  # of a tensor
_KEY, _VALUE = 1, 2  # of an entry
_EXTERNAL = 1
_DEEPEST = 200  # messages in messages; protobuf itself reads no more than 100
_VARINT, _FIXED64, _LENGTH_DELIMITED, _GROUP, _GROUP_END, _FIXED32 = range(6)


def external_files(path: Path) -> list[Path]:
    """The files beside `path` that hold weights of it, in the order of their names; none for most models.

    Raises ModelError where a name leads out of the folder of `path`, or the file cannot be read. What is no protobuf
    message has no such files: ONNX Runtime says what is wrong with it.
    """
    try:
        with open_regular(path) as file:
            if path.stat().st_size == 0:
                return []
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data, memoryview(data) as view:
                names = {bytes(name) for name in _locations(view)}
    except UnusableFileError as error:
        raise ModelError(f"{path}: {error}") from error
    found = set()
    for name in names:
        found.add(path.parent / _checked(path, name))
    return sorted(found)


def _checked(path: Path, location: bytes) -> str:
    try:
        name = location.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ModelError(f"{path} takes weights from a file whose name is no text: {location!r}") from error
    parts = PurePosixPath(name.replace("\\", "/")).parts
    if not parts or name.startswith(("/", "\\")) or ".." in parts or ":" in parts[0] or "\0" in name:
        raise ModelError(f"{path} takes weights from {name!r}, which is not in its folder: it is not opened")
    return name


def _locations(model: memoryview) -> Iterator[memoryview]:
    """The value of ``location`` of every tensor with external data."""
    todo: list[tuple[str, memoryview, int]] = [("model", model, 0)]
    while todo:
        kind, message, depth = todo.pop()
        if kind == "tensor":
            yield from _location_of(message)
            continue
        inner = _TREE[kind]
        try:
            for field, value in _fields(message):
                if field in inner and isinstance(value, memoryview) and depth < _DEEPEST:
                    todo.append((inner[field], value, depth + 1))
        except ValueError:
            continue  # no protobuf: ONNX Runtime will not read it either


def _location_of(tensor: memoryview) -> list[memoryview]:
    found: list[memoryview] = []
    external = False
    try:
        for field, value in _fields(tensor):
            if field == _DATA_LOCATION:
                external = value == _EXTERNAL
            elif field == _EXTERNAL_DATA and isinstance(value, memoryview):
                entry = {key: text for key, text in _fields(value) if isinstance(text, memoryview)}
                if bytes(entry.get(_KEY, b"")) == b"location":
                    found.append(entry.get(_VALUE, memoryview(b"")))
    except ValueError:
        return []  # no protobuf
    return found if external else []


def _fields(message: memoryview) -> Iterator[tuple[int, memoryview | int]]:
    """Numbers and contents of the fields: bytes, or a number. Raises ValueError for what is no message.

    Groups, which are of an older protobuf, are passed over as a reader does that does not know them: what is in them
    comes as fields, which is more than there is, never less.
    """
    position = 0
    while position < len(message):
        tag, position = _varint(message, position)
        field, kind = tag >> 3, tag & 7
        if kind == _LENGTH_DELIMITED:
            size, position = _varint(message, position)
            if position + size > len(message):
                raise ValueError("a field ends behind its message")
            yield field, message[position : position + size]
            position += size
        elif kind == _VARINT:
            number, position = _varint(message, position)
            yield field, number
        elif kind in (_FIXED64, _FIXED32):
            position += 8 if kind == _FIXED64 else 4
        elif kind not in (_GROUP, _GROUP_END):
            raise ValueError(f"wire type {kind}")


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            raise ValueError("a number ends behind its message")
        byte = message[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
    raise ValueError("a number of more than ten bytes")
