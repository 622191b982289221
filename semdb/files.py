"""Files that people give: regular files only, of bounded size, and text in whatever encoding it came.

A named pipe or a device would hang a reader or fill the memory, so nothing is opened before it is known to be a regular
file, and nothing is read beyond a limit. All text files are decoded here, in one way. Reasons are without the name of
the file: whoever reads adds it, in the error of its own.
"""

from __future__ import annotations

import codecs
import json
import math
import os
import re
import stat
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, BinaryIO

from semdb.errors import SemdbError

MOST_TEXT_BYTES = 1 << 28
MOST_JSON_BYTES = 1 << 24
_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
# The longer ones first: UTF-32's mark begins with UTF-16's.
_MARKS = (
    (codecs.BOM_UTF8, "utf-8"),
    (codecs.BOM_UTF32_LE, "utf-32-le"),
    (codecs.BOM_UTF32_BE, "utf-32-be"),
    (codecs.BOM_UTF16_LE, "utf-16-le"),
    (codecs.BOM_UTF16_BE, "utf-16-be"),
)
_LINE_END = re.compile(r"\r\n|\r|\n")
_COMMENT = re.compile(r"^\s*(?:#|%|//)|\s(?:#|%|//).*$")
_PLAIN = re.compile(r"[^,;#%/]*")
_DIVIDED = re.compile(r"\s*,\s*|\s+")
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+(?:[eE][+-]?\d+)?")
_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
_LONGEST_NUMBER = 1000  # characters; more take Python long


_below: ContextVar[tuple[Path, ...]] = ContextVar("_below", default=())


class UnusableFileError(SemdbError):
    """Why a file cannot be used, without its name; `line` (from 1) where it is one line of it."""

    def __init__(self, reason: str, line: int | None = None) -> None:
        super().__init__(reason)
        self.line = line

    def at(self, path: Path) -> str:
        """The whole message: file, line, reason."""
        return f"{path}: {self}" if self.line is None else f"{path}, line {self.line}: {self}"


class MissingFileError(UnusableFileError):
    """There is no such file."""


def places() -> tuple[Path, ...]:
    """The folders below which files may lie here and now; () for anywhere: see `only_below`."""
    return _below.get()


@contextmanager
def only_below(folders: Sequence[Path]) -> Iterator[None]:
    """Refuses files that lie elsewhere, whatever links and ``..`` lead there; () refuses none. Of this thread only.

    `folders` are resolved. Who may name recordings need not be let read all files.
    """
    before = _below.set(tuple(folders))
    try:
        yield
    finally:
        _below.reset(before)


def check_place(path: Path, opened: int | None = None) -> None:
    """For a file that another library opens; `opened` is its number where it is open. Raises UnusableFileError."""
    folders = _below.get()
    if not folders:
        return
    number = "" if opened is None else f"/proc/self/fd/{opened}"  # which cannot be exchanged any more
    real = Path(os.path.realpath(number if number and os.path.exists(number) else path))
    if not any(real.is_relative_to(folder) for folder in folders):
        raise UnusableFileError("lies outside of where recordings may lie (SEMDB_RECORDING_ROOTS)")


def open_regular(path: Path, most_bytes: int | None = None) -> BinaryIO:
    """Opens a file for reading, unless it is none, or is larger than `most_bytes`. Links are followed.

    Raises UnusableFileError, MissingFileError.
    """
    try:
        _check_kind(os.stat(path))  # before it is opened: opening alone does something to some devices
        number = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except FileNotFoundError as error:
        raise MissingFileError("the file is missing") from error
    except (OSError, ValueError) as error:
        raise _unusable(error) from error
    file = os.fdopen(number, "rb")
    try:
        found = os.fstat(number)
        _check_kind(found)  # it may have been exchanged meanwhile
        check_place(path, number)
        if most_bytes is not None and found.st_size > most_bytes:
            raise UnusableFileError(
                f"the file is too large: {megabytes(found.st_size)}, at most {megabytes(most_bytes)}"
            )
    except BaseException:
        file.close()
        raise
    return file


def read_bytes(path: Path, most_bytes: int) -> bytes:
    """The bytes of a regular file of at most `most_bytes`. Raises UnusableFileError, MissingFileError."""
    with open_regular(path, most_bytes) as file:
        try:
            data = file.read(most_bytes + 1)
        except OSError as error:
            raise _unusable(error) from error
    if len(data) > most_bytes:  # of a size that it did not say: it grows, or is of a file system without sizes
        raise UnusableFileError(f"the file is too large: more than {megabytes(most_bytes)}")
    return data


def read_text(path: Path, most_bytes: int = MOST_TEXT_BYTES, *, escape: bool = False) -> str:
    """The text of a file; see `decode_text`. Raises UnusableFileError, MissingFileError."""
    return decode_text(read_bytes(path, most_bytes), escape=escape)


def decode_text(data: bytes, *, escape: bool = False) -> str:
    """Text in UTF-8, or in UTF-16 or UTF-32 with a byte order mark, or in UTF-16 without one.

    With `escape` bytes that are no UTF-8 become surrogates, as in names of files (`os.fsencode` turns them back);
    without, they raise UnusableFileError, as do broken UTF-16 and UTF-32.
    """
    mark, encoding = next((known for known in _MARKS if data.startswith(known[0])), (b"", _encoding_without_mark(data)))
    data = data[len(mark) :]
    errors = "surrogateescape" if escape and encoding == "utf-8" else "strict"
    try:
        return data.decode(encoding, errors)
    except UnicodeDecodeError as error:
        line = len(_LINE_END.split(data[: error.start].decode(encoding, "replace")))
        raise UnusableFileError(
            f"is no {encoding.upper()} text (byte {data[error.start]:#04x}): save the file as UTF-8", line
        ) from error


def _encoding_without_mark(data: bytes) -> str:
    """UTF-16 where nearly every other byte is zero, as in text of digits, else UTF-8."""
    start = data[:4096]
    for encoding, zeros, others in (("utf-16-le", start[1::2], start[::2]), ("utf-16-be", start[::2], start[1::2])):
        if len(zeros) and zeros.count(0) > 0.8 * len(zeros) and others.count(0) < 0.1 * len(others):
            return encoding
    return "utf-8"


def split_lines(text: str) -> list[str]:
    r"""Lines of a text, whichever of ``\n``, ``\r\n`` and ``\r`` ends them, and no other character."""
    return _LINE_END.split(text)


def numbered_lines(text: str) -> list[tuple[int, str]]:
    """Lines with their numbers (from 1), without those that are empty or a comment (``#``, ``%``, ``//``).

    What follows on a line after values is still there: see `without_comment`.
    """
    stripped = ((number, line.strip()) for number, line in enumerate(split_lines(text), start=1))
    return [(number, line) for number, line in stripped if line and not line.startswith(("#", "%", "//"))]


def without_comment(line: str) -> str:
    """A line without what follows ``#``, ``%`` or ``//`` after a space."""
    return _COMMENT.sub("", line).strip()


def fields_of(line: str) -> tuple[list[str], bool]:
    """The values of a line, and whether their decimal commas were turned into points.

    Values are divided by semicolons, white space, or commas (``1.5,2.5`` or ``1.5, 2.5``). Divided by one of the
    first two, and without a point anywhere, ``1,5`` is a number with a decimal comma.
    """
    if _PLAIN.fullmatch(line):
        return line.split(), False
    line = without_comment(line)
    if ";" in line:
        parts = [part.strip() for part in line.rstrip("; \t").split(";")]
    else:
        parts = line.split()
        if len(parts) == 1 or any(part.endswith(",") or part.startswith(",") for part in parts):
            return _DIVIDED.split(line.strip(", \t")), False
    commas = any(_DECIMAL_COMMA.fullmatch(part) for part in parts)
    if not commas or any("." in part for part in parts):
        return parts, False
    return [part.replace(",", ".") if _DECIMAL_COMMA.fullmatch(part) else part for part in parts], True


def parse_number(text: str) -> float:
    """A finite number in decimal notation. Raises ValueError with the reason."""
    if text.lower().lstrip("+-") in ("nan", "inf", "infinity"):
        raise ValueError("has a number that is not finite")
    if _NUMBER.fullmatch(text) is None:
        raise ValueError("has something that is no number")
    return _parse_float(text)


def read_json(path: Path, most_bytes: int = MOST_JSON_BYTES) -> Any:
    """What a JSON file holds. A number that no float can hold is refused, so is what is nested too deeply.

    Raises UnusableFileError, MissingFileError.
    """
    return parse_json(read_text(path, most_bytes))


def parse_json(text: str) -> Any:
    """As `read_json`, of a text."""
    try:
        return json.loads(text, parse_int=_parse_int, parse_float=_parse_float)
    except json.JSONDecodeError as error:
        line = len(split_lines(text[: error.pos]))
        raise UnusableFileError(f"is not JSON: {error.msg}", line) from error
    except RecursionError as error:
        raise UnusableFileError("is nested too deeply") from error
    except ValueError as error:
        raise UnusableFileError(str(error)) from error


def _parse_int(text: str) -> int | float:
    return int(text) if len(text) <= 20 else _parse_float(text)


def _parse_float(text: str) -> float:
    value = float(text) if len(text) <= _LONGEST_NUMBER else math.inf
    if math.isinf(value):
        raise ValueError(f"has a number that is too large: {text[:40]}…")
    return value


def megabytes(size: int) -> str:
    """A size for people."""
    return f"{size / 1e6:.0f} MB" if size >= 10e6 else f"{size / 1e6:.2g} MB"


def _check_kind(found: os.stat_result) -> None:
    for is_kind, name in _KINDS:
        if is_kind(found.st_mode):
            raise UnusableFileError(f"is {name}, not a file")


def _unusable(error: OSError | ValueError) -> UnusableFileError:
    if isinstance(error, OSError):
        return UnusableFileError(f"the file cannot be read: {error.strerror or error}")
    return UnusableFileError("no file can have this name: it holds a NUL character")
