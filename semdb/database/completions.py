"""Classes of keyframes as they should have been seen: those of `keyframe_categories`, completed by landmarks.

Written with the landmarks of a map (`semdb refine`), and used as long as the map holds what they were computed from:
whoever asks looks whether that is so, and takes `keyframe_categories` otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import Connection, Engine, Table, delete, insert, select

from semdb.class_score import MOST_OBJECTS
from semdb.database import retry
from semdb.database.landmark_records import CompletedClass
from semdb.database.records import ChangeKind
from semdb.database.refinements import map_state_of
from semdb.database.row_changes import write_groups
from semdb.database.tables import (
    completed_categories,
    keyframe_categories,
    keyframe_changes,
    map_completions,
    refinements,
)

STEP = "landmarks"  # of `semdb refine`, that they come from
CHUNK = 1000  # keyframes, or rows, of a statement


@dataclass(frozen=True, slots=True)
class _Shown:
    """What is known of a class in a keyframe."""

    count: int = 0
    upper: int = 0
    lower: int = 0


_Keyframes = dict[int, dict[int, _Shown]]  # by keyframe and class


def completion_of(engine: Engine, map_id: int) -> str | None:
    """The state of a map that its completed classes belong to; None where they are not to be used, or there are none.

    One read of a key where there are none; else as dear as `map_state`.
    """

    def work(connection: Connection) -> str | None:
        c, f = map_completions.c, refinements.c
        query = select(c.map_state).join(refinements, (f.map_id == c.map_id) & (f.map_state == c.map_state))
        found = connection.execute(query.where(c.map_id == map_id, f.kind == STEP)).scalar()
        return str(found) if found is not None and found == map_state_of(connection, map_id) else None

    return retry.read(engine, work)


def replace_completions(
    connection: Connection, map_id: int, completed: Sequence[CompletedClass], category_ids: Mapping[str, int]
) -> None:
    """Write the completed classes of a map in place of those that are there, within a transaction of its refinement.

    Each of `completed` is what a keyframe shows of a class at least (`category_ids` has the ids by name); a class that
    no keyframe of the map has is passed over. Where nothing is added there are no rows, nor where the map is not what
    it was when it was read. The log of changes has the keyframes that are completed, or were, so that indexes look
    again.
    """
    f, c = refinements.c, map_completions.c
    state = connection.execute(select(f.map_state).where(f.map_id == map_id, f.kind == STEP)).scalar()
    before_state = connection.execute(select(c.map_state).where(c.map_id == map_id)).scalar()
    seen = _shown(connection, keyframe_categories, map_id)
    before = seen if before_state is None else _shown(connection, completed_categories, map_id)
    after = {key: dict(found) for key, found in seen.items()}
    if state != map_state_of(connection, map_id):
        completed = ()  # the map may come to be so again, with keyframes of which these say nothing
    added = _complete(after, [(one.keyframe_id, category_ids[one.category], one.upper, one.lower) for one in completed])
    connection.execute(delete(map_completions).where(c.map_id == map_id))
    rows = []
    if added:
        connection.execute(insert(map_completions), {"map_id": map_id, "map_state": state or ""})
        rows = [row for key in sorted(after) for row in _rows(map_id, key, after[key])]
    own = completed_categories.c.map_id == map_id  # a keyframe that was moved has rows of two maps
    write_groups(connection, completed_categories, "keyframe_id", select(completed_categories).where(own), rows, own)
    changed = set(added)
    if before_state == state:  # who opened the map while this step was forgotten knows of none
        changed |= {key for key, found in before.items() if key in seen and found != seen[key]}
    kind = ChangeKind.REDESCRIBED.value
    entries = [{"map_id": map_id, "keyframe_id": key, "kind": kind} for key in sorted(changed)]
    for start in range(0, len(entries), CHUNK):
        connection.execute(insert(keyframe_changes), entries[start : start + CHUNK])


def _complete(shown: _Keyframes, completed: Sequence[tuple[int, int, int, int]]) -> set[int]:
    """Puts keyframe, class, upper and lower strength into `shown`; the keyframes to which that adds something."""
    classes = {category for found in shown.values() for category in found}
    added = set()
    for keyframe_id, category_id, upper, lower in completed:
        if category_id not in classes or keyframe_id not in shown:
            continue
        known = shown[keyframe_id].get(category_id, _Shown())
        if upper > known.upper or lower > known.lower:
            more = replace(known, upper=max(known.upper, upper), lower=max(known.lower, lower))
            shown[keyframe_id][category_id] = more
            added.add(keyframe_id)
    return added


def _shown(connection: Connection, table: Table, map_id: int) -> _Keyframes:
    """What `table` has of each keyframe of a map. What is no number there, on SQLite, is none."""
    c = table.c
    query = select(c.keyframe_id, c.category_id, c.count, c.upper_strength, c.lower_strength)
    found: _Keyframes = {}
    for key, category, *numbers in connection.execute(query.where(c.map_id == map_id)):
        of_keyframe = found.setdefault(int(key), {})
        known = of_keyframe.get(int(category), _Shown())
        count, upper, lower = map(_number, numbers)
        of_keyframe[int(category)] = _Shown(known.count + count, known.upper + upper, known.lower + lower)
    return found


def _number(value: Any) -> int:
    return min(int(value), MOST_OBJECTS) if isinstance(value, int | float) and value >= 1 else 0


def _rows(map_id: int, keyframe_id: int, found: Mapping[int, _Shown]) -> list[dict[str, Any]]:
    held = sum(shown.upper + shown.lower for shown in found.values())
    return [
        {
            "map_id": map_id,
            "category_id": category,
            "keyframe_id": keyframe_id,
            "count": shown.count,
            "upper_strength": shown.upper,
            "lower_strength": shown.lower,
            "keyframe_strength": held,
        }
        for category, shown in sorted(found.items())
    ]
