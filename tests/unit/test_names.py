r"""Names that are no UTF-8 are written as text and become the same bytes again."""

from __future__ import annotations

import os
import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.names import path_text, written


@pytest.mark.parametrize(
    ("name", "text"),
    [
        (b"caf\xe9", r"caf\udce9"),
        ("café".encode(), "café"),
        (rb"a\b", r"a\b"),
        (rb"caf\udce9", r"caf\udc5cudce9"),
        (b"\xff\\udcff", r"\udcff\udc5cudcff"),
    ],
)
def test_written_names(name: bytes, text: str) -> None:
    assert written(os.fsdecode(name)) == text
    assert os.fsencode(path_text(text)) == name


@given(st.binary(max_size=40) | st.text(string.ascii_letters + r"\udc5ce9", max_size=30).map(str.encode))
def test_every_name_comes_back(name: bytes) -> None:
    text = written(os.fsdecode(name))
    text.encode("utf-8")  # fits into databases, JSON, and terminals
    assert os.fsencode(path_text(text)) == name


def test_different_names_are_written_differently() -> None:
    names = [b"\xe9", rb"\udce9", rb"\udc5cudce9", b"\\\xe9", rb"\\udce9", b"\\udc5c\xe9"]
    assert len({written(os.fsdecode(name)) for name in names}) == len(names)


def test_other_lone_surrogates_are_text_too() -> None:
    assert written("a\ud800") == r"a\ud800"
