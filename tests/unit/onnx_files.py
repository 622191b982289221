"""Writes tiny ONNX files byte by byte (protobuf wire format), so that tests need no package to make them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

_FLOAT, _INT64 = 1, 7
Shape = Sequence[int | str]


def write_constant_model(
    path: Path,
    outputs: Mapping[str, npt.NDArray[np.generic]],
    metadata: Mapping[str, str] | None = None,
    batch: int | str = "B",
) -> Path:
    """A model that gives `outputs` whatever the image is; `batch` is how many it takes at once, a name for any."""
    nodes = [_node("Identity", [f"{name}_value"], [name]) for name in outputs]
    tensors = [_tensor(f"{name}_value", value) for name, value in outputs.items()]
    declared = {name: (_type_of(value), value.shape) for name, value in outputs.items()}
    return _write(path, nodes, tensors, declared, metadata, batch)


def write_mean_embedding_model(path: Path) -> Path:
    """A model whose `embedding` ``[B, 3]`` is the mean of each channel."""
    node = _node("ReduceMean", ["image"], ["embedding"], {"axes": [2, 3], "keepdims": 0})
    return _write(path, [node], [], {"embedding": (_FLOAT, ("B", 3))}, None)


def write_mean_score_model(
    path: Path,
    boxes: npt.NDArray[np.float32],
    labels: npt.NDArray[np.int64],
    masks: npt.NDArray[np.float32],
    metadata: Mapping[str, str] | None = None,
) -> Path:
    """A detector of three objects whose `scores` are the means of the red, green and blue channels."""
    constants = {"boxes": boxes, "labels": labels, "masks": masks}
    nodes = [_node("Identity", [f"{name}_value"], [name]) for name in constants]
    nodes.append(_node("ReduceMean", ["image"], ["scores"], {"axes": [0, 2, 3], "keepdims": 0}))
    tensors = [_tensor(f"{name}_value", value) for name, value in constants.items()]
    declared: dict[str, tuple[int, Shape]] = {name: (_type_of(value), value.shape) for name, value in constants.items()}
    declared["scores"] = (_FLOAT, (3,))
    return _write(path, nodes, tensors, declared, metadata)


def _write(
    path: Path,
    nodes: list[bytes],
    tensors: list[bytes],
    outputs: Mapping[str, tuple[int, Shape]],
    metadata: Mapping[str, str] | None,
    batch: int | str = "B",
) -> Path:
    graph = b"".join(_field(1, node) for node in nodes) + _field(2, b"tiny")
    graph += b"".join(_field(5, tensor) for tensor in tensors)
    graph += _field(11, _value_info("image", _FLOAT, (batch, 3, "H", "W")))
    graph += b"".join(_field(12, _value_info(name, *declared)) for name, declared in outputs.items())
    model = _field(1, 8) + _field(7, graph) + _field(8, _field(1, b"") + _field(2, 17))
    for key, value in (metadata or {}).items():
        model += _field(14, _field(1, key.encode()) + _field(2, value.encode()))
    path.write_bytes(model)
    return path


def _type_of(value: npt.NDArray[np.generic]) -> int:
    return {"float32": _FLOAT, "int64": _INT64}[value.dtype.name]


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _node(
    op: str, inputs: list[str], outputs: list[str], attributes: Mapping[str, int | list[int]] | None = None
) -> bytes:
    node = b"".join(_field(1, name.encode()) for name in inputs)
    node += b"".join(_field(2, name.encode()) for name in outputs) + _field(4, op.encode())
    for name, value in (attributes or {}).items():
        body = _field(1, name.encode())
        if isinstance(value, int):
            body += _field(3, value) + _field(20, 2)
        else:
            body += b"".join(_field(8, item) for item in value) + _field(20, 7)
        node += _field(5, body)
    return node


def _tensor(name: str, value: npt.NDArray[np.generic]) -> bytes:
    dims = b"".join(_field(1, int(n)) for n in value.shape)
    return dims + _field(2, _type_of(value)) + _field(8, name.encode()) + _field(9, value.tobytes())


def _value_info(name: str, elem_type: int, shape: Shape) -> bytes:
    dims = b"".join(_field(1, _field(1, n) if isinstance(n, int) else _field(2, n.encode())) for n in shape)
    tensor_type = _field(1, elem_type) + _field(2, dims)
    return _field(1, name.encode()) + _field(2, _field(1, tensor_type))
