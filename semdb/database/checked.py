"""What comes from the database is looked at once, where it becomes a value: its type, its range, its size.

A database is shared, SQLite keeps any type in any column, and rows can be damaged. Every function takes the value of a
column, says in `where` which one it is ("cameras.fx of camera 3"), and raises a CodecError that begins with that.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from datetime import datetime
from enum import StrEnum
from typing import Any, TypeVar

import numpy as np
from sqlalchemy import Column, LargeBinary, and_, case, func, literal, or_
from sqlalchemy.sql.elements import ColumnElement

from semdb.errors import CodecError
from semdb.geometry import FARTHEST_POSE_M
from semdb.types import BoolArray, Camera, FloatArray

LARGEST = 2**31 - 1  # of an INTEGER of servers
LONGEST_NAME = 255
MOST_JSON = 2**20  # bytes
MOST_DISTORTION = 4096  # bytes
LONGEST_SIDE = 65_535  # pixels
MOST_PIXELS = 2**28
LEAST_FOCAL = 1e-3  # pixels
FARTHEST_PIXEL = 1e7  # focal length and principal point
NEAR_UNIT = 1e-3  # how far the length of a stored quaternion is from one
# Bytes of blobs: more than `SEMDB_MAX_KEYPOINTS` and image sizes allow.
MOST_VECTOR = 2**20
MOST_KEYPOINTS = 2**22
MOST_DESCRIPTORS = 2**26
MOST_MASK = 2**26
MOST_FILE = 2**29
Choice = TypeVar("Choice", bound=StrEnum)
_SHOWN = 40


def up_to(column: Column[Any], most: int) -> ColumnElement[Any]:
    """A column of blobs or texts for a SELECT, empty where it has more than `most` bytes: that is never fetched."""
    empty: Any = literal(b"" if isinstance(column.type, LargeBinary) else "")
    return case((column.is_(None), None), (func.length(column) <= most, column), else_=empty).label(column.name)


def integer(value: Any, where: str, least: int = 0, most: int = LARGEST) -> int:
    """A whole number."""
    if isinstance(value, int) and not isinstance(value, bool) and least <= value <= most:
        return value
    raise CodecError(f"{where} is {shown(value)}, not a whole number from {least} to {most}")


def real(value: Any, where: str, least: float = -math.inf, most: float = math.inf) -> float:
    """A finite number."""
    if isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= most:
        with contextlib.suppress(OverflowError):  # of whole numbers that no float holds
            if math.isfinite(value):
                return float(value)
    limits = "" if math.isinf(least) and math.isinf(most) else f" from {least:g} to {most:g}"
    raise CodecError(f"{where} is {shown(value)}, not a finite number{limits}")


def text(value: Any, where: str, longest: int = LONGEST_NAME) -> str:
    """A text; it may be empty."""
    if isinstance(value, str) and len(value) <= longest and value.isascii():
        return value
    if isinstance(value, str) and len(value) <= longest:
        try:
            value.encode()
        except UnicodeEncodeError:
            raise CodecError(f"{where} is {shown(value)}, which is no text in UTF-8") from None
        return value
    raise CodecError(f"{where} is {shown(value)}, not a text of at most {longest} characters")


def blob(value: Any, where: str) -> bytes:
    """Bytes that were selected with `up_to`."""
    if isinstance(value, bytes) and value:
        return value
    if isinstance(value, bytes):
        raise CodecError(f"{where} is empty, or larger than anything that semdb writes")
    raise CodecError(f"{where} is {shown(value)}, not a blob")


def document(value: Any, where: str, longest: int = MOST_JSON) -> Any:
    """What a JSON text says."""
    try:
        return json.loads(text(value, where, longest))
    except (ValueError, RecursionError) as error:
        if isinstance(error, CodecError):
            raise
        raise CodecError(f"{where} is {shown(value)}, which is no JSON") from None


def mapping(value: Any, where: str) -> dict[str, Any]:
    """A JSON object."""
    found = document(value, where)
    if not isinstance(found, dict):
        raise CodecError(f"{where} is {shown(value)}, not a JSON object")
    return found


def choice(value: Any, where: str, kind: type[Choice]) -> Choice:
    """One of a few words."""
    try:
        return kind(value)
    except (ValueError, TypeError):
        known = ", ".join(word.value for word in kind)
        raise CodecError(f"{where} is {shown(value)}, not one of {known} (is this semdb too old?)") from None


def moment(value: Any, where: str) -> datetime:
    """A date with a time, also as the text of it that a function of SQLite makes."""
    if isinstance(value, datetime):
        return value
    try:
        return datetime.fromisoformat(text(value, where, 40))
    except ValueError:
        raise CodecError(f"{where} is {shown(value)}, not a date with a time") from None


def camera(row: Any, where: str) -> Camera:
    """The camera of a row with the columns of `cameras`; `where` is which one."""
    name = f"cameras.{{}} of {where}"
    width = integer(row.width, name.format("width"), 1, LONGEST_SIDE)
    height = integer(row.height, name.format("height"), 1, LONGEST_SIDE)
    if width * height > MOST_PIXELS:
        raise CodecError(f"{name.format('width')} is {width} by {height} pixels, more than any image that semdb reads")
    fx, fy = (real(getattr(row, axis), name.format(axis), LEAST_FOCAL, FARTHEST_PIXEL) for axis in ("fx", "fy"))
    cx, cy = (real(getattr(row, axis), name.format(axis), -FARTHEST_PIXEL, FARTHEST_PIXEL) for axis in ("cx", "cy"))
    return Camera(width, height, fx, fy, cx, cy, _distortion(row.distortion, name.format("distortion")))


def _distortion(value: Any, where: str) -> tuple[float, ...]:
    numbers = document(value, where, MOST_DISTORTION)
    if not isinstance(numbers, list) or len(numbers) not in (0, 4, 5):
        raise CodecError(f"{where} is {shown(value)}, not a list of no, four or five numbers")
    return tuple(real(number, where, -1e6, 1e6) for number in numbers)


def are_poses(numbers: FloatArray) -> BoolArray:
    """Which of the rows ``[n, 7]`` (qw, qx, qy, qz, tx, ty, tz) are poses that a map may have."""
    with np.errstate(over="ignore", invalid="ignore"):
        length = np.sqrt((numbers[:, :4] ** 2).sum(axis=1))
        found: BoolArray = (np.abs(length - 1) < NEAR_UNIT) & (np.abs(numbers[:, 4:]) <= FARTHEST_POSE_M).all(axis=1)
    return found


def pose_numbers(values: Sequence[Any], where: str) -> FloatArray:
    """The numbers ``[7]`` of one pose, in the order of `are_poses`."""
    names = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
    numbers = np.array([real(value, f"{name} of {where}") for name, value in zip(names, values, strict=True)])
    if not are_poses(numbers[np.newaxis])[0]:
        shown_numbers = ", ".join(f"{number:g}" for number in numbers)
        raise CodecError(
            f"the pose of {where} is ({shown_numbers}), not a quaternion of length 1 and a place within "
            f"{FARTHEST_POSE_M:g} m of the origin"
        )
    return numbers


def numbers_of(rows: Sequence[Sequence[Any]], width: int) -> FloatArray:
    """Numbers ``[n, width]`` of rows, NaN in those that are not all numbers."""
    try:
        values = np.array(rows)
        if values.dtype.kind in "if":
            return values.astype(np.float64).reshape(-1, width)
    except (ValueError, OverflowError):
        pass
    found = np.full((len(rows), width), np.nan)
    for place, row in enumerate(rows):
        with contextlib.suppress(OverflowError):
            if all(isinstance(value, int | float) for value in row):
                found[place] = [float(value) for value in row]
    return found


def shown(value: Any) -> str:
    """A value as messages show it, short."""
    if isinstance(value, bytes):
        return f"a blob of {len(value)} bytes"
    if value is None:
        return "NULL"
    plain = repr(value[: _SHOWN + 1] if isinstance(value, str) else value)
    return plain if len(plain) <= _SHOWN else f"{plain[:_SHOWN]}..."


def later(columns: Sequence[ColumnElement[Any]], key: Sequence[Any]) -> ColumnElement[bool]:
    """Whether a row comes after the one of `key` in the order of `columns`: for pages of lists.

    Written out, since MySQL does not use an index for a comparison of tuples.
    """
    first, *rest = columns
    beyond: ColumnElement[bool] = first > key[0]
    return and_(first >= key[0], or_(beyond, later(rest, key[1:]))) if rest else beyond
