"""Names of landmarks that outlive a new computation: a landmark keeps the id with which it shares most sightings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Identities:
    """`ids` of new landmarks, None for those that need a new one; `merged`: which one took in an old id."""

    ids: tuple[int | None, ...]
    merged: Mapping[int, int]  # old id -> number of the new landmark


def keep_ids(old: Mapping[int, int], new: Sequence[Sequence[int]]) -> Identities:
    """`old` gives the landmark of each object that had one, `new` the objects of each landmark.

    Of all pairs of an old and a new landmark the one that shares most objects comes first, of equal ones that of the
    lower id. An old landmark that gets none of them is merged into the one that has most of its objects.
    """
    shared: Counter[tuple[int, int]] = Counter()
    for number, objects in enumerate(new):
        for key in objects:
            if key in old:
                shared[old[key], number] += 1
    ids: list[int | None] = [None] * len(new)
    taken: set[int] = set()
    ordered = sorted(shared.items(), key=lambda item: (-item[1], item[0]))
    for (key, number), _ in ordered:
        if key not in taken and ids[number] is None:
            ids[number] = key
            taken.add(key)
    merged: dict[int, int] = {}
    for (key, number), _ in ordered:
        if key not in taken and key not in merged:
            merged[key] = number
    return Identities(tuple(ids), merged)
