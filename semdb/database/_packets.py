"""Compiled parts of `blobs`: rows of a whole number and a blob, or of a number, in what a server sent."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from semdb.compiled import kernel


@kernel
def split_rows(data, start, stop, number, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Whole packets of ``data[start:stop]``, the next of which has this `number`, as long as they are such rows.

    ``out[n, 3]`` gets the whole number, and where its blob begins and ends. Returns how many there are, and where the
    rest begins: what is incomplete, something else, or beyond the room.
    """
    found = 0
    while found < len(out) and start + 5 < stop:
        size = int(data[start]) | int(data[start + 1]) << 8 | int(data[start + 2]) << 16
        end = start + 4 + size
        if end > stop or size >= 0xFFFFFF or data[start + 3] != (number + found) % 256:
            break
        at, digits = start + 5, int(data[start + 4])
        value, wrong = 0, digits < 1 or digits > 18 or at + digits > end
        for place in range(at, at if wrong else at + digits):
            digit = int(data[place]) - 48
            wrong |= digit < 0 or digit > 9
            value = 10 * value + digit
        at += digits
        if wrong or at >= end:
            break
        length, wide = int(data[at]), 0
        if length > 250:
            wide = 2 if length == 0xFC else 3 if length == 0xFD else 9
            length = 0
            for place in range(min(wide, end - at - 1)):
                length |= int(data[at + 1 + place]) << 8 * place
        at += 1 + wide
        if wide > 3 or at + length != end:
            break
        out[found, 0], out[found, 1], out[found, 2] = value, at, end
        found, start = found + 1, end
    return found, start


@kernel
def split_numbers(data, start, stop, number, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The same for rows of one whole number alone, of at most 18 digits: ``out[n]`` gets them."""
    found = 0
    while found < len(out) and start + 5 < stop:
        size, digits = int(data[start]), int(data[start + 4])
        end = start + 4 + size
        if end > stop or data[start + 1] or data[start + 2] or data[start + 3] != (number + found) % 256:
            break
        if digits + 1 != size or digits < 1 or digits > 18:
            break
        value, wrong = 0, False
        for place in range(start + 5, end):
            digit = int(data[place]) - 48
            wrong |= digit < 0 or digit > 9
            value = 10 * value + digit
        if wrong:
            break
        out[found] = value
        found, start = found + 1, end
    return found, start
