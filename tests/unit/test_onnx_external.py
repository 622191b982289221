"""Weights in files of their own are part of what a model is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.errors import ModelError
from semdb.perception.encoders import load_encoder
from semdb.perception.model_files import file_sha256, onnx_sha256
from semdb.perception.onnx_external import external_files
from semdb.settings import Settings
from tests.unit import onnx_files
from tests.unit.onnx_files import write_constant_model

SETTINGS = Settings(threads=1, device="cpu")
WEIGHTS = np.array([[1.0, 2.0, 2.0, 0.0]], np.float32)


def external_tensor(name: str, location: bytes, located: int | None = 1) -> bytes:
    """A tensor ``[1, 4]`` float32 whose values are in another file."""
    field = onnx_files._field
    entry = field(1, b"location") + field(2, location)
    tensor = field(1, 1) + field(1, 4) + field(2, 1) + field(8, name.encode()) + field(13, entry)
    return tensor + (b"" if located is None else field(14, located))


def write_external(path: Path, location: bytes = b"weights.bin", located: int | None = 1, before: bytes = b"") -> Path:
    """An encoder of which the embedding is in `location`; `before` are bytes of fields before its graph."""
    write_constant_model(path, {"embedding": WEIGHTS}, batch=1)
    inside = onnx_files._field(5, onnx_files._tensor("embedding_value", WEIGHTS))
    data = path.read_bytes()
    at = data.index(inside)
    outside = onnx_files._field(5, external_tensor("embedding_value", location, located))
    graph_at = data.index(b"\x3a")  # field 7 of the model
    size, begin = onnx_files_varint(data, graph_at + 1)
    graph = data[begin : begin + size].replace(inside, outside)
    assert at > begin
    path.write_bytes(before + data[:graph_at] + onnx_files._field(7, graph) + data[begin + size :])
    (path.parent / "weights.bin").write_bytes(WEIGHTS.tobytes())
    return path


def onnx_files_varint(data: bytes, position: int) -> tuple[int, int]:
    value = shift = 0
    while True:
        byte = data[position]
        value |= (byte & 0x7F) << shift
        position, shift = position + 1, shift + 7
        if byte < 0x80:
            return value, position


def test_a_model_in_one_file_has_the_hash_of_that_file(tmp_path: Path) -> None:
    path = write_constant_model(tmp_path / "a.onnx", {"embedding": WEIGHTS})
    assert external_files(path) == []
    assert onnx_sha256(path) == file_sha256(path)
    assert load_encoder(f"onnx:{path}", SETTINGS).info.sha256 == file_sha256(path)


def test_a_changed_weight_in_another_file_is_another_model(tmp_path: Path) -> None:
    path = write_external(tmp_path / "a.onnx")
    assert external_files(path) == [tmp_path / "weights.bin"]
    first = load_encoder(f"onnx:{path}", SETTINGS)
    np.testing.assert_allclose(first.encode(np.zeros((64, 64, 3), np.uint8)), WEIGHTS[0] / 3, rtol=1e-6)
    (tmp_path / "weights.bin").write_bytes(WEIGHTS[:, ::-1].tobytes())
    second = load_encoder(f"onnx:{path}", SETTINGS)
    assert first.info.sha256 != second.info.sha256
    assert file_sha256(path) not in (first.info.sha256, second.info.sha256)
    (tmp_path / "weights.bin").unlink()
    with pytest.raises(ModelError, match=r"takes weights from .*weights\.bin, which is not there"):
        load_encoder(f"onnx:{path}", SETTINGS)


@pytest.mark.parametrize(
    "location", [b"../weights.bin", b"/etc/passwd", b"a/../../b", b"..\\b", b"C:\\b", b"", b"a\xff"]
)
def test_weights_out_of_the_folder_are_not_opened(tmp_path: Path, location: bytes) -> None:
    path = write_external(tmp_path / "a.onnx", location)
    with pytest.raises(ModelError, match="takes weights from"):
        load_encoder(f"onnx:{path}", SETTINGS)


@pytest.mark.parametrize(
    "before",
    [
        b"\x9b\x06\x08\x01\x9c\x06",  # a group with the field number 99, as an old protobuf writes it
        b"\x98\x06\x01",  # an unknown number
        b"\x9a\x06\x03abc",  # unknown bytes
        b"\x99\x06" + bytes(8),
        b"\x9d\x06" + bytes(4),
    ],
    ids=["group", "number", "bytes", "fixed64", "fixed32"],
)
def test_unknown_fields_hide_no_weights(tmp_path: Path, before: bytes) -> None:
    path = write_external(tmp_path / "a.onnx", before=before)
    load_encoder(f"onnx:{path}", SETTINGS)  # ONNX Runtime reads it
    assert external_files(path) == [tmp_path / "weights.bin"]


def nested(tensor: bytes, depth: int) -> bytes:
    """A model whose graph has a node with a graph, and so on, with `tensor` in the innermost one."""
    field = onnx_files._field
    graph = field(5, tensor)
    for _ in range(depth):
        graph = field(1, field(4, b"If") + field(5, field(1, b"then_branch") + field(6, graph) + field(20, 5)))
    return field(7, graph)


@pytest.mark.parametrize("depth", [1, 2, 10, 30])
def test_weights_of_graphs_in_nodes_are_found(tmp_path: Path, depth: int) -> None:
    path = tmp_path / "a.onnx"
    path.write_bytes(nested(external_tensor("w", b"w.bin"), depth))
    assert external_files(path) == [tmp_path / "w.bin"]


@pytest.mark.parametrize(
    ("fields", "what"),
    [
        ((7, 1, 5, 5), "a constant's value"),
        ((7, 1, 5, 10), "a constant of several"),
        ((7, 15, 1), "values of a sparse one"),
        ((7, 15, 2), "indices of a sparse one"),
        ((7, 1, 5, 22, 1), "a sparse constant"),
        ((7, 1, 5, 23, 2), "sparse constants"),
        ((7, 1, 5, 11, 5), "graphs of a node"),
        ((25, 7, 5, 5), "a node of a function"),
        ((25, 11, 5), "a default of a function"),
        ((20, 1, 5), "training's first graph"),
        ((20, 2, 5), "training's second graph"),
    ],
)
def test_weights_are_found_wherever_a_model_may_have_them(tmp_path: Path, fields: tuple[int, ...], what: str) -> None:
    message = external_tensor("w", b"w.bin")
    for number in reversed(fields):
        message = onnx_files._field(number, message)
    path = tmp_path / "a.onnx"
    path.write_bytes(message)
    assert external_files(path) == [tmp_path / "w.bin"], what


def test_entries_without_the_mark_of_being_outside_are_nothing(tmp_path: Path) -> None:
    for located in (None, 0):
        path = tmp_path / "a.onnx"
        path.write_bytes(onnx_files._field(7, onnx_files._field(5, external_tensor("w", b"w.bin", located))))
        assert external_files(path) == []


@settings(max_examples=200, deadline=None)
@given(data=st.binary(max_size=300))
def test_any_bytes_have_no_weights_or_an_error(tmp_path_factory: pytest.TempPathFactory, data: bytes) -> None:
    path = tmp_path_factory.getbasetemp() / "any.onnx"
    path.write_bytes(data)
    try:
        external_files(path)
    except ModelError as error:
        assert "takes weights from" in str(error)  # noqa: PT017
