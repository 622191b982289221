"""Regular files only, of bounded size, and text in whatever encoding people's tools write."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.files import (
    MissingFileError,
    UnusableFileError,
    decode_text,
    fields_of,
    numbered_lines,
    open_regular,
    parse_json,
    parse_number,
    read_bytes,
    read_json,
    read_text,
    split_lines,
    without_comment,
)

TEXT = "1.5 rgb/a.png\n# küche\n2.5 rgb/b.png\n"


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"], ids=str)
@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"], ids=["unix", "windows", "old mac"])
def test_text_is_read_in_every_encoding_and_with_every_end_of_line(encoding: str, end: str) -> None:
    data = TEXT.replace("\n", end).encode(encoding)
    assert split_lines(decode_text(data)) == ["1.5 rgb/a.png", "# küche", "2.5 rgb/b.png", ""]


def test_utf16_be_with_a_mark() -> None:
    assert decode_text(b"\xfe\xff" + TEXT.encode("utf-16-be")) == TEXT


@given(st.text(st.characters(codec="utf-8", exclude_characters="\0"), min_size=1))
def test_marked_text_comes_back(text: str) -> None:
    for encoding in ("utf-8-sig", "utf-16", "utf-32"):
        assert decode_text(text.encode(encoding)) == text


@given(st.binary(max_size=200))
def test_any_bytes_are_text_or_one_reason(data: bytes) -> None:
    for escape in (False, True):
        with contextlib.suppress(UnusableFileError):
            decode_text(data, escape=escape)


def test_bytes_that_are_no_utf8_stay_in_names_and_are_named_elsewhere(tmp_path: Path) -> None:
    data = b"ok\n1.5 caf\xe9.png\n"
    assert os.fsencode(decode_text(data, escape=True)) == data
    with pytest.raises(UnusableFileError, match=r"is no UTF-8 text \(byte 0xe9\): save the file as UTF-8") as caught:
        decode_text(data)
    assert caught.value.at(tmp_path / "a.txt") == f"{tmp_path}/a.txt, line 2: {caught.value}"


def test_lines_without_comments_keep_their_numbers() -> None:
    text = "# a\n1 2\n\n% b\n  // c\n3 4 # ok\n5 6\n"
    assert numbered_lines(text) == [(2, "1 2"), (6, "3 4 # ok"), (7, "5 6")]
    assert without_comment("3 4\t# ok") == "3 4"
    assert without_comment("3 4 // ok") == "3 4"
    assert without_comment("rgb/a#1.png") == "rgb/a#1.png"


@pytest.mark.parametrize(
    ("line", "values", "commas"),
    [
        ("1.5 2.5 -3e-2", ["1.5", "2.5", "-3e-2"], False),
        ("1.5\t2.5\t# ok", ["1.5", "2.5"], False),
        ("1.5,2.5,3", ["1.5", "2.5", "3"], False),
        ("1.5, 2.5, 3,", ["1.5", "2.5", "3"], False),
        ("1.5, 2.5 3", ["1.5", "2.5", "3"], False),
        ("1.5;2.5;3", ["1.5", "2.5", "3"], False),
        ("1,5;2,5;3", ["1.5", "2.5", "3"], True),
        ("1,5 2,5 3", ["1.5", "2.5", "3"], True),
        ("1,5e-3\t-2,5", ["1.5e-3", "-2.5"], True),
        ("1305031098,6659 1 2", ["1305031098.6659", "1", "2"], True),
        ("1,5 2.5", ["1,5", "2.5"], False),  # thousands, or nothing that makes sense: no number
        ("1.305,5 2", ["1.305,5", "2"], False),
    ],
)
def test_values_of_a_line(line: str, values: list[str], commas: bool) -> None:
    assert fields_of(line) == (values, commas)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("nan", "has a number that is not finite"),
        ("-Infinity", "has a number that is not finite"),
        ("-1.#IND000", "has something that is no number"),
        ("1_0", "has something that is no number"),
        ("\u0661", "has something that is no number"),
        ("1,5", "has something that is no number"),
        ("1" * 400, "has a number that is too large"),
        ("1e999", "has a number that is too large"),
        ("9" * 100_000, "has a number that is too large"),
    ],
)
def test_what_is_no_number(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as caught:
        parse_number(text)
    assert len(str(caught.value)) < 100


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_come_back(value: float) -> None:
    assert parse_number(repr(value)) == value


@pytest.mark.parametrize(
    ("text", "reason", "line"),
    [
        ("[" * 100_000, "is nested too deeply", None),
        ('{"a":' * 100_000 + "1" + "}" * 100_000, "is nested too deeply", None),
        (f'{{"fx": {"9" * 400}}}', "has a number that is too large: 99999", None),
        ('{"fx": 1e999}', "has a number that is too large: 1e999", None),
        ('{"a": 1,\r\r"b": }', "is not JSON: Expecting value", 3),
        ("// my camera\n{}", "is not JSON", 1),
    ],
    ids=["lists", "objects", "digits", "exponent", "comma", "comment"],
)
def test_json_that_is_refused_in_one_line(text: str, reason: str, line: int | None) -> None:
    with pytest.raises(UnusableFileError, match=reason) as caught:
        parse_json(text)
    assert caught.value.line == line
    assert len(str(caught.value)) < 120


def test_json_in_utf16(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(json.dumps({"1": "Küche"}).encode("utf-16"))
    assert read_json(tmp_path / "a.json") == {"1": "Küche"}
    (tmp_path / "b.json").write_bytes(b'{"1": "K\xfcche"}')
    with pytest.raises(UnusableFileError, match="is no UTF-8 text"):
        read_json(tmp_path / "b.json")


def special_files(folder: Path) -> dict[str, Path]:
    os.mkfifo(folder / "pipe")
    (folder / "dir").mkdir()
    (folder / "link").symlink_to("/dev/zero")
    (folder / "pipe-link").symlink_to(folder / "pipe")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(folder / "socket"))
    listener.close()
    return {
        "pipe": folder / "pipe",
        "folder": folder / "dir",
        "device": folder / "link",
        "named pipe": folder / "pipe-link",
        "socket": folder / "socket",
    }


def test_only_regular_files_are_opened(tmp_path: Path) -> None:
    def look() -> None:
        for kind, path in special_files(tmp_path).items():
            with pytest.raises(UnusableFileError, match=f"is a .*{kind}, not a file"):
                open_regular(path)

    thread = threading.Thread(target=look, daemon=True)  # a reader that waits for a writer would never come back
    thread.start()
    thread.join(20)
    assert not thread.is_alive()
    with pytest.raises(UnusableFileError, match="a device, not a file"):
        read_bytes(Path("/dev/zero"), 10)
    with pytest.raises(MissingFileError, match="the file is missing"):
        read_text(tmp_path / "none")
    with pytest.raises(UnusableFileError, match="it holds a NUL character"):
        read_text(tmp_path / "a\0b")
    with pytest.raises(UnusableFileError, match="the file cannot be read: File name too long"):
        read_text(tmp_path / ("a" * 300))


def test_large_files_are_refused_before_they_are_read(tmp_path: Path) -> None:
    with (tmp_path / "sparse").open("wb") as file:
        file.truncate(60 << 30)
    with pytest.raises(UnusableFileError, match="the file is too large: 64425 MB, at most 268 MB"):
        read_text(tmp_path / "sparse")
    (tmp_path / "ten").write_bytes(bytes(10))
    assert read_bytes(tmp_path / "ten", 10) == bytes(10)
    with pytest.raises(UnusableFileError, match="too large"):
        read_bytes(tmp_path / "ten", 9)
    with pytest.raises(UnusableFileError, match="too large: more than"):
        read_bytes(Path("/proc/self/maps"), 10)  # a file that says that it has 0 bytes
