"""Results that are remembered from one computation of a map's landmarks to the next, by what they were made from.

A result has the name of all that goes into it: who finds the name finds what would be computed. So remembered or not,
contents are the same to the last bit.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any, Protocol, cast

import numpy as np
import numpy.typing as npt

Arrays = Mapping[str, npt.NDArray[Any]]


class Memo(Protocol):
    """Where results are remembered."""

    def get(self, kind: str, name: str) -> Arrays | None:
        """What was put under a name; None where there is nothing."""

    def put(self, kind: str, name: str, arrays: Arrays) -> None:
        """Remembers `arrays` under a name, in place of what is there."""

    def keep(self, kind: str, name: str) -> None:
        """What is remembered under a name is of use, whether or not it is asked for."""


class Forgetful:
    """Remembers nothing."""

    def get(self, kind: str, name: str) -> Arrays | None:
        return None

    def put(self, kind: str, name: str, arrays: Arrays) -> None:
        pass

    def keep(self, kind: str, name: str) -> None:
        pass


class Noting:
    """A memo that notes what it is asked for: (kind, name)."""

    def __init__(self, memo: Memo) -> None:
        self._memo = memo
        self.asked: list[tuple[str, str]] = []

    def get(self, kind: str, name: str) -> Arrays | None:
        self.asked.append((kind, name))
        return self._memo.get(kind, name)

    def put(self, kind: str, name: str, arrays: Arrays) -> None:
        self._memo.put(kind, name, arrays)

    def keep(self, kind: str, name: str) -> None:
        self._memo.keep(kind, name)


def name_of(*parts: object) -> str:
    """A name, 32 letters, for all of `parts`: numbers, text, arrays, options, None, and sequences of these."""
    digest = hashlib.blake2b(digest_size=16)
    _feed(digest.update, parts)
    return digest.hexdigest()


def _feed(update: Callable[[bytes], None], part: object) -> None:
    if isinstance(part, np.ndarray):
        update(f"a{part.dtype.str}{part.shape}".encode())
        update(np.ascontiguousarray(part).tobytes())
    elif isinstance(part, list | tuple):
        update(f"l{len(part)}".encode())
        for item in part:
            _feed(update, item)
    elif is_dataclass(part) and not isinstance(part, type):
        update(_name_of_values(cast(Hashable, part)))
    else:
        text = part.hex() if isinstance(part, float) else str(part)
        update(f"{type(part).__name__}{len(text)}:{text}".encode())


@lru_cache(maxsize=256)
def _name_of_values(part: Any) -> bytes:
    """Of a frozen dataclass: options and cameras, which are few."""
    digest = hashlib.blake2b(type(part).__name__.encode(), digest_size=20)
    _feed(digest.update, [getattr(part, field.name) for field in fields(part)])
    return digest.digest()


def remembered(memo: Memo, kind: str, name: str, compute: Callable[[], Arrays]) -> Arrays:
    """What is remembered under a name, or what `compute` gives, which is remembered from then on."""
    found = memo.get(kind, name)
    if found is None:
        found = compute()
        memo.put(kind, name, found)
    return found
