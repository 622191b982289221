"""How far poses may differ that are one for the caller: numbers, or text such as ``0.1m,5deg``."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from semdb.errors import UsageError
from semdb.types import Tolerance

EXAMPLE = "0.1m,5deg"
_TEXT = re.compile(r"\s*([0-9.eE+-]+)\s*m\s*,\s*([0-9.eE+-]+)\s*deg\s*")


def as_tolerance(given: Sequence[float]) -> Tolerance:
    """Of metres and degrees. Raises UsageError for what is no tolerance."""
    try:
        metres, degrees = (float(value) for value in given)
    except (TypeError, ValueError):
        raise UsageError(f"accept {given!r}: two numbers are expected, metres and degrees, as (0.1, 5)") from None
    if not (math.isfinite(metres) and metres > 0 and math.isfinite(degrees) and 0 < degrees <= 180):
        raise UsageError(f"accept {metres:g} m, {degrees:g} deg: both must be above 0, and degrees at most 180")
    return Tolerance(metres, degrees)


def parse_tolerance(text: str) -> Tolerance:
    """Of ``0.1m,5deg``. Raises UsageError for other text."""
    found = _TEXT.fullmatch(text)
    try:
        numbers = [float(part) for part in found.groups()] if found else []
    except ValueError:
        numbers = []
    if not numbers:
        raise UsageError(f"--accept {text}: metres and degrees are expected, as {EXAMPLE}")
    return as_tolerance(numbers)
