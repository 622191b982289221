"""What commands print on stdout: lines and aligned tables for people, CSV and JSON for programs."""

from __future__ import annotations

import csv
import json
import os
import sys
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from decimal import Decimal
from itertools import chain
from typing import Any, Self, TextIO

from semdb.jsonable import to_jsonable
from semdb.shown import for_json, for_terminal, number, width

FORMATS = ("table", "csv", "json")
_COLOURS = {"green": "32", "yellow": "33", "red": "31"}
SIGMA_NOTE = "one standard deviation against the poses of the map's keyframes, where it is largest"
MOST_HELD = 2**25  # characters of rows in memory, of statements that may give any number of them


def print_lines(*lines: str) -> None:
    """Print lines for people on stdout, each as one line whatever names it holds."""
    for line in lines:
        print(for_terminal(line), flush=True)


def painted(text: str, colour: str) -> str:
    """`text` in a colour (``green``, ``yellow``, ``red``) where stdout is a terminal that shows it, else as it is."""
    if not sys.stdout.isatty() or os.environ.get("NO_COLOR") or os.environ.get("TERM") == "dumb":
        return text
    return f"\x1b[{_COLOURS[colour]}m{text}\x1b[0m"


def print_painted(before: str, word: str, after: str, *, colour: str) -> None:
    """As `print_lines`, a line with a `word` in a colour."""
    print(for_terminal(before) + painted(for_terminal(word), colour) + for_terminal(after), flush=True)


class JsonList:
    """Prints a list as `print_json` does, each item when it is added. A context manager that ends the list.

    After an error the list ends with the items that were there; without any nothing is printed.
    """

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout
        self._begun = False

    def add(self, value: Any) -> None:
        """Prints an item."""
        text = "\n".join(f"  {line}" for line in _json(value, self._stream).split("\n"))
        self._stream.write((",\n" if self._begun else "[\n") + text)
        self._stream.flush()
        self._begun = True

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._begun:
            self._stream.write("\n]\n")
        elif kind is None:
            self._stream.write("[]\n")


def print_json(value: Any, stream: TextIO | None = None) -> None:
    """Print `value` as indented JSON with a newline at the end."""
    stream = stream or sys.stdout
    stream.write(_json(value, stream) + "\n")


def _json(value: Any, stream: TextIO) -> str:
    document = for_json(json.dumps(to_jsonable(value), indent=2, ensure_ascii=False, default=str))
    try:
        document.encode(stream.encoding or "utf-8")
    except (LookupError, UnicodeEncodeError):  # a terminal of another encoding
        return for_json(document, ascii_only=True)
    return document


def _print_json_array(values: Iterable[Any], stream: TextIO) -> None:
    """As `print_json` of a list. Of very many values all but the first `MOST_HELD` are printed as they come."""
    held: list[str] = []  # an error that comes with the first ones leaves stdout empty
    size, before = 0, "[\n"
    for value in values:
        held.append(before + textwrap.indent(_json(value, stream), "  "))
        size, before = size + len(held[-1]), ",\n"
        if size > MOST_HELD:
            stream.writelines(held)
            held.clear()
    stream.writelines(held)
    stream.write("[]\n" if before == "[\n" else "\n]\n")


def cell_text(value: Any) -> str:
    """One cell of a table for people: numbers whole up to 15 digits, kind and size of a blob, empty for NULL."""
    if value is None:
        return ""
    if isinstance(value, bytes | bytearray | memoryview):
        from semdb.database.blob_text import describe_blob

        return describe_blob(bytes(value))
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, float | Decimal):
        return number(value)
    return for_terminal(to_jsonable(value))


def print_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO | None = None) -> None:
    """Print rows under their column names, numbers to the right. Nothing is cut, whatever the terminal's width.

    Of very many rows the first `MOST_HELD` make the widths, and the others are printed as they come.
    """
    stream = stream or sys.stdout
    heads = [for_terminal(name) for name in columns]
    left = iter(rows)
    cells: list[list[str]] = []
    numbers, held = [True] * len(heads), 0
    for row in left:
        cells.append([cell_text(value) for value in row])
        numbers = [right and _is_number(value) for right, value in zip(numbers, row, strict=True)]
        held += sum(map(len, cells[-1])) + 100
        if held > MOST_HELD:
            break
    widths = [max([width(name), *(width(row[i]) for row in cells)]) for i, name in enumerate(heads)]
    right = [bool(cells) and is_number for is_number in numbers]
    first = [heads, ["-" * columns_wide for columns_wide in widths], *cells]
    for line in chain(first, ([cell_text(value) for value in row] for row in left)):
        padded = (_pad(text, w, r) for text, w, r in zip(line, widths, right, strict=True))
        stream.write("  ".join(padded).rstrip() + "\n")


def _pad(text: str, wide: int, right: bool) -> str:
    space = " " * (wide - width(text))
    return space + text if right else text + space


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float | Decimal) and not isinstance(value, bool))


def print_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO | None = None) -> None:
    """Print CSV with a header: full precision, NULL empty, blobs as hex, NaN as ``nan``.

    Text is as it is stored; only on a terminal, which would obey control characters, they are escaped.
    """
    stream = stream or sys.stdout
    writer = csv.writer(stream, lineterminator="\n")
    shown = stream.isatty()
    writer.writerow([for_terminal(name) for name in columns] if shown else columns)
    for row in rows:
        values = [_csv_value(value) for value in row]
        writer.writerow(
            [for_terminal(value) if isinstance(value, str) else value for value in values] if shown else values
        )


def _csv_value(value: Any) -> Any:
    if isinstance(value, float):
        return value
    return number(value) if isinstance(value, Decimal) else to_jsonable(value)


def distinct(columns: Sequence[str]) -> list[str]:
    """The names of columns as keys: of equal ones the second and later are numbered, ``id``, ``id_2``, ``id_3``.

    A number that another column's own name has is passed over.
    """
    taken, names = set(columns), []
    seen: Counter[str] = Counter()
    for name in columns:
        seen[name] += 1
        key = name
        if seen[name] > 1:
            while (key := f"{name}_{seen[name]}") in taken:
                seen[name] += 1
            taken.add(key)
        names.append(key)
    return names


def print_rows(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], fmt: str = "table", stream: TextIO | None = None
) -> None:
    """Print rows as ``table``, ``csv`` or ``json``: a list of objects, whose keys are `distinct`."""
    if fmt == "csv":
        print_csv(columns, rows, stream)
    elif fmt == "json":
        keys = distinct(columns)
        _print_json_array((dict(zip(keys, row, strict=True)) for row in rows), stream or sys.stdout)
    else:
        print_table(columns, rows, stream)
