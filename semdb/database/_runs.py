"""Compiled part of `codecs`: the runs of a mask."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import numpy as np
import numpy.typing as npt

from semdb.compiled import kernel
from semdb.types import BoolArray

_ONES = np.uint64(0x0101010101010101)
_ROOM = 4096  # runs of a mask of an object are fewer


def run_lengths(mask: BoolArray, longest: int) -> npt.NDArray[np.uint32]:
    """Lengths of the runs of `mask` in row-major order, the first being background.

    A run of more than `longest` is pieces of `longest`, a run of 0 after each, and the rest.
    """
    flat = np.ascontiguousarray(mask, dtype=np.bool_).reshape(-1).view(np.uint8)
    words = flat[: len(flat) // 8 * 8].view(np.uint64)
    room = _ROOM
    while True:
        runs = np.empty(room, np.uint32)
        room = _run_lengths(flat, words, longest, runs)
        if room <= len(runs):
            return runs[:room]


@kernel
def _run_lengths(flat, words, longest, runs):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Writes as many runs as there is room for; returns how many there are."""
    count, begin, at = 0, 0, 0
    inside, same = False, np.uint64(0)
    while at < len(flat):
        if at % 8 == 0:  # eight pixels at a time, as long as the run goes on
            word = at // 8
            while word < len(words) and words[word] == same:
                word += 1
            at = 8 * word
            if at >= len(flat):
                break
        if (flat[at] != 0) != inside:
            count = _append(runs, count, at - begin, longest)
            begin, inside = at, not inside
            same = _ONES if inside else np.uint64(0)
        at += 1
    return _append(runs, count, len(flat) - begin, longest)


@kernel
def _append(runs, count, length, longest):  # type: ignore[no-untyped-def]  # pragma: no cover
    if length > longest:
        for _ in range(length // longest):
            if count + 1 < len(runs):
                runs[count], runs[count + 1] = longest, 0
            count += 2
        length = length % longest
    if count < len(runs):
        runs[count] = length
    return count + 1
