"""What changed between two recordings of a map."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from semdb.door.changed import Changes, ComparedLandmark, Crop, LandmarkChange, Visited
from semdb.errors import NotFoundError, UsageError
from semdb.names import storable
from semdb.shown import for_terminal

if TYPE_CHECKING:
    from semdb.database.landmark_records import LandmarkVisit
    from semdb.database.store import Store
    from semdb.database.visit_reading import SeenObject, VisitedLandmark
    from semdb.landmarks.changes import SeenIn, VisitedThing

Crops = Mapping[tuple[int, str], "SeenObject"]
UNOBSERVED = "unobserved"


def changes_of(store: Store, before: str, after: str, map_name: str | None) -> Changes:
    """What changed from one recording to another one: see `semdb.api.reading.Reading.changes`."""
    from semdb.database.landmark_rows import LANDMARKS
    from semdb.database.left_out import telling
    from semdb.database.visit_reading import best_objects, load_visits
    from semdb.landmarks.changes import find_changes

    before, after = storable(before), storable(after)
    if before == after:
        raise UsageError(f"--between {before} {after}: two recordings are expected, one before and one after")
    map_id, name = _map_of(store, (before, after), map_name)
    states = {item.kind: item for item in store.refinements(map_id)}
    if LANDMARKS not in states:
        raise NotFoundError(f"the map {name!r} has no landmarks: run semdb refine")
    if not states[LANDMARKS].current:
        telling(store.say)(
            f"the map {name!r} changed since its landmarks were computed: semdb refine computes them anew"
        )
    visited = load_visits(store.engine, map_id, (before, after), store.say)
    if not visited:
        raise NotFoundError(f"no landmark of the map {name!r} knows of visits: run semdb refine --step landmarks")
    found = find_changes([_thing(item, before, after) for item in visited])
    ids = sorted({thing.key for c in found for thing in (c.before, c.after) if thing is not None})
    crops = best_objects(store.engine, map_id, ids, (before, after))
    by_id = {item.id: item for item in visited}
    changes = []
    for change in found:
        one, other = change.before, change.after
        first = one if one is not None else other
        if first is None:
            continue
        same = one is None or other is None or one.key == other.key
        changes.append(
            LandmarkChange(
                kind=str(change.kind),
                category=by_id[first.key].category,
                landmark_id=first.key,
                other_landmark_id=None if same or other is None else other.key,
                score=change.score,
                distance=change.distance,
                before=_visited(by_id[first.key], before, crops),
                after=_visited(by_id[first.key if other is None else other.key], after, crops),
            )
        )
    compared = tuple(
        ComparedLandmark(
            *(item.id, item.category, item.state), _visited(item, before, crops), _visited(item, after, crops)
        )
        for item in visited
    )
    return Changes(name, before, after, tuple(changes), compared)


def _map_of(store: Store, names: tuple[str, str], map_name: str | None) -> tuple[int, str]:
    """The map that has both recordings. Raises NotFoundError, UsageError where several have."""
    map_id = None if map_name is None else store.find_map(map_name).id
    by_map: dict[tuple[int, str], set[str]] = {}
    for item in store.status(map_id):
        by_map.setdefault((item.map_id, item.map), set()).add(item.name)
    fitting = [key for key, there in by_map.items() if set(names) <= there]
    if len(fitting) == 1:
        return fitting[0]
    if fitting:
        raise UsageError(
            f"both recordings are in the maps {', '.join(name for _, name in fitting)}: name one with --map"
        )
    known = sorted({name for there in by_map.values() for name in there})
    missing = [name for name in names if name not in known]
    listed = f"recordings: {', '.join(known[:8]) or 'none'}"
    if missing:
        raise NotFoundError(f"there is no recording {missing[0]!r}; {listed}")
    raise NotFoundError(f"no map has both {names[0]!r} and {names[1]!r}: semdb align brings recordings into one map")


def _thing(item: VisitedLandmark, before: str, after: str) -> VisitedThing:
    from semdb.landmarks.changes import VisitedThing

    one, other = item.visits.get(before), item.visits.get(after)
    return VisitedThing(item.id, item.evidence, item.appearance, _seen(one), _seen(other))


def _seen(visit: LandmarkVisit | None) -> SeenIn | None:
    from semdb.landmarks.changes import SeenIn
    from semdb.landmarks.visits import Presence

    if visit is None:
        return None
    return SeenIn(
        Presence(visit.presence),
        *(visit.keyframes, visit.points, visit.seen, visit.seen_through, visit.occluded, visit.missed),
        None if visit.position is None else np.array(visit.position),
        None if visit.size is None else np.array(visit.size),
    )


def _visited(item: VisitedLandmark, recording: str, crops: Crops) -> Visited:
    visit, crop = item.visits.get(recording), crops.get((item.id, recording))
    shown = None if crop is None else Crop(crop.keyframe_id, crop.frame_index, crop.box)
    if visit is None:
        return Visited(UNOBSERVED)
    counts = (visit.keyframes, visit.points, visit.seen, visit.seen_through, visit.occluded, visit.missed)
    return Visited(visit.presence, *counts, visit.position, visit.size, shown)


def lines_of(found: Changes) -> list[str]:
    """What the command prints for people."""
    lines = []
    for change in found.changes:
        text = f"{change.kind}: {change.category} (landmark {change.landmark_id}"
        if change.other_landmark_id is not None:
            text += f", now {change.other_landmark_id}"
        text += ")"
        if change.before.position is not None:
            text += " from " + _place(change.before.position) if change.kind == "moved" else ""
        if change.kind == "moved" and change.after.position is not None and change.distance is not None:
            text += f" to {_place(change.after.position)}, {change.distance:.2f} m"
        elif change.kind == "disappeared" and change.before.position is not None:
            text += f" stood at {_place(change.before.position)}"
        elif change.kind == "appeared" and change.after.position is not None:
            text += f" at {_place(change.after.position)}"
        lines.append(for_terminal(f"{text}, score {change.score:.2f}"))
    counts = found.counts
    lines.append(
        f"{counts['moved']} moved, {counts['appeared']} appeared, {counts['disappeared']} disappeared; "
        f"{counts['in_both']} landmarks are in both, {counts['not_looked_at']} were looked at in one of them only"
    )
    return lines


def _place(position: tuple[float, float, float]) -> str:
    x, y, z = position
    return f"({x:.2f}, {y:.2f}, {z:.2f})"
