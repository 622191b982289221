"""RVL, the lossless compression of depth that compressedDepth topics and RTAB-Map use, compiled.

Source: A. D. Wilson, Fast Lossless Depth Image Compression, ISS 2017. A stream of 32-bit little-endian words holds
numbers in nibbles from the top, each three bits from the lowest on and a mark that more follow: runs of zeros and of
pixels in turn, each pixel as the difference to the one before with its sign in the lowest bit.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call, assignment"
from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.compiled import kernel

MOST_PIXELS = 1 << 26


def decode_rvl(stream: bytes, columns: int, rows: int) -> npt.NDArray[np.uint16]:
    """The values ``[rows, columns]`` of a stream. Raises ValueError where it ends early or holds more."""
    if not 0 < columns * rows <= MOST_PIXELS or columns <= 0 or rows <= 0:
        raise ValueError(f"says that it has {columns}x{rows} pixels")
    words = np.frombuffer(stream[: len(stream) // 4 * 4], "<u4")
    values = np.zeros(columns * rows, np.uint16)
    if not _decode(words, values):
        raise ValueError("is damaged or cut off: its RVL stream does not give the pixels that it says")
    return values.reshape(rows, columns)


def encode_rvl(values: npt.NDArray[np.uint16]) -> bytes:
    """The stream of values ``[H, W]``; `decode_rvl` gives them back."""
    flat = np.ascontiguousarray(values, np.uint16).ravel()
    words = np.zeros(flat.size * 3 + 16, np.uint32)  # each number has at most six nibbles
    return bytes(words[: _encode(flat, words)].astype("<u4"))


@kernel
def _decode(words, values):  # type: ignore[no-untyped-def]  # pragma: no cover
    position, word, left = 0, np.uint32(0), 0
    done, previous = 0, 0
    while done < values.size:
        for kind in range(2):
            count, position, word, left = _number(words, position, word, left)
            if count < 0 or count > values.size - done:
                return False
            if kind == 0:
                done += count
                continue
            for _ in range(count):
                coded, position, word, left = _number(words, position, word, left)
                if coded < 0:
                    return False
                previous += (coded >> 1) ^ -(coded & 1)
                values[done] = np.uint16(previous & 0xFFFF)
                done += 1
        if count == 0 and position >= words.size and left == 0 and done < values.size:
            return False
    return True


@kernel(inline="always")
def _number(words, position, word, left):  # type: ignore[no-untyped-def]  # pragma: no cover
    """The next number (-1 at the end, or where it is longer than any) and the state after it."""
    value, shift = 0, 0
    while True:
        if left == 0:
            if position >= words.size:
                return -1, position, word, left
            word = words[position]
            position += 1
            left = 8
        nibble = np.int64(word >> np.uint32(28))
        word = np.uint32(word << np.uint32(4))
        left -= 1
        value |= (nibble & 7) << shift
        shift += 3
        if nibble < 8:
            return value, position, word, left
        if shift > 30:
            return -1, position, word, left


@kernel
def _encode(values, words):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Fills `words`; returns how many it took."""
    place, previous, at = 0, 0, 0
    while at < values.size:
        zeros = at
        while zeros < values.size and values[zeros] == 0:
            zeros += 1
        place = _put(words, place, zeros - at)
        end = zeros
        while end < values.size and values[end] != 0:
            end += 1
        place = _put(words, place, end - zeros)
        for k in range(zeros, end):
            difference = np.int64(values[k]) - previous
            place = _put(words, place, (difference << 1) ^ (difference >> 63))
            previous = np.int64(values[k])
        at = end
    return (place + 7) // 8


@kernel(inline="always")
def _put(words, place, value):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes a number in nibbles from `place` on; returns the place after it."""
    while True:
        nibble = value & 7
        value >>= 3
        if value:
            nibble |= 8
        words[place // 8] |= np.uint32(nibble) << np.uint32(28 - 4 * (place % 8))
        place += 1
        if not value:
            return place
