"""What commands print on stdout: aligned tables for people, CSV and JSON for programs."""

from __future__ import annotations

import csv
import json
import math
import sys
from collections.abc import Iterable, Sequence
from datetime import date, datetime
from decimal import Decimal
from typing import Any, TextIO

FORMATS = ("table", "csv", "json")


def to_jsonable(value: Any) -> Any:
    """`value` with what JSON cannot hold replaced: NaN and infinities by null, bytes by hex, times by ISO 8601."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): to_jsonable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_jsonable(item) for item in value]
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, datetime | date):
        return value.isoformat()
    if isinstance(value, Decimal):  # what servers return for SUM and AVG
        return int(value) if value == value.to_integral_value() else float(value)
    if hasattr(value, "tolist"):  # numpy scalars and arrays
        return to_jsonable(value.tolist())
    return value


def print_json(value: Any, stream: TextIO | None = None) -> None:
    """Print `value` as indented JSON with a newline at the end."""
    stream = stream or sys.stdout
    json.dump(to_jsonable(value), stream, indent=2, ensure_ascii=False)
    stream.write("\n")


def cell_text(value: Any) -> str:
    """One cell of a table for people: six significant digits, ``<N bytes>`` for blobs, empty for NULL."""
    if value is None:
        return ""
    if isinstance(value, bytes):
        return f"<{len(value)} bytes>"
    value = to_jsonable(value)
    if value is None:
        return "nan"
    if isinstance(value, float):
        return f"{value:.6g}"
    return str(value).replace("\n", " ")


def print_table(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO | None = None) -> None:
    """Print rows under their column names, numbers to the right. Nothing is cut, whatever the terminal's width."""
    stream = stream or sys.stdout
    rows = [tuple(row) for row in rows]
    cells = [[cell_text(value) for value in row] for row in rows]
    widths = [max([len(name), *(len(row[i]) for row in cells)]) for i, name in enumerate(columns)]
    right = [bool(rows) and all(_is_number(row[i]) for row in rows) for i in range(len(columns))]
    lines = [list(columns), ["-" * width for width in widths], *cells]
    for line in lines:
        padded = (text.rjust(w) if r else text.ljust(w) for text, w, r in zip(line, widths, right, strict=True))
        stream.write("  ".join(padded).rstrip() + "\n")


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float | Decimal) and not isinstance(value, bool))


def print_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]], stream: TextIO | None = None) -> None:
    """Print CSV with a header: full precision, NULL empty, blobs as hex, NaN as ``nan``."""
    writer = csv.writer(stream or sys.stdout, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([value if isinstance(value, float) else to_jsonable(value) for value in row])


def print_rows(
    columns: Sequence[str], rows: Iterable[Sequence[Any]], fmt: str = "table", stream: TextIO | None = None
) -> None:
    """Print rows as ``table``, ``csv`` or ``json`` (a list of objects)."""
    if fmt == "csv":
        print_csv(columns, rows, stream)
    elif fmt == "json":
        print_json([dict(zip(columns, row, strict=True)) for row in rows], stream)
    else:
        print_table(columns, rows, stream)
