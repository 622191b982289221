"""Things by what they are and where they stand."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any

from semdb.database import checked
from semdb.database.keyframe_rows import pose_of
from semdb.database.lookups import map_id_of
from semdb.door.found import Evidence, Found, FoundLandmark, Missing, Viewpoint
from semdb.errors import CodecError, UsageError
from semdb.names import storable
from semdb.shown import for_terminal
from semdb.types import FloatArray

if TYPE_CHECKING:
    from semdb.database.landmark_search import Wanted
    from semdb.database.store import Store
    from semdb.landmarks.words import Understood, Vectors

MOST_HITS = 1000
RATHER = 0.5  # of a relation
LEAST = 0.3  # of one: what counts less is one to what only may be of a class
NEVER_SEEN, GONE, NOT_LOOKED_AT = "never_seen", "gone", "not_looked_at"


def find(
    store: Store,
    what: str,
    *,
    near: str | None = None,
    on: str | None = None,
    not_near: str | None = None,
    map: str | None = None,
    seen_after: str | int | datetime | None = None,
    origin: Sequence[float] | None = None,
    limit: int = 10,
    vectors: Callable[[], Vectors | None] = lambda: None,
) -> Found:
    """Landmarks that are what was asked for: see `semdb.api.reading.Reading.find`. `vectors` makes those of words."""
    from semdb.database import landmark_search as rows
    from semdb.landmarks.words import understand

    if not 1 <= limit <= MOST_HITS:
        raise UsageError(f"limit is between 1 and {MOST_HITS}, not {limit}")
    known = rows.known_classes(store.engine)
    asked = {"what": what, "near": near, "on": on, "not_near": not_near}
    meant = {name: understand(word, known, vectors) for name, word in asked.items() if word is not None}
    map_id = None if map is None else _map_id(store, map)
    after_ns, seen_in = _seen_after(store, seen_after, map_id)
    wanted = rows.Wanted(
        classes=meant["what"].classes,
        near=_classes(meant, "near"),
        on=_classes(meant, "on"),
        not_near=_classes(meant, "not_near"),
        map_id=map_id,
        seen_after_ns=after_ns,
        seen_in=seen_in,
        origin=None if origin is None else _origin(origin),
        limit=limit,
        perhaps=map_id is not None,
    )
    found, evidence = rows.search(store.engine, wanted)
    if not found and not wanted.perhaps:
        wanted = replace(wanted, perhaps=True)
        found, evidence = rows.search(store.engine, wanted)
    hits = tuple(_hit(row, evidence.get(int(row.landmark_id), []), wanted) for row in found)
    understood: dict[str, Mapping[str, Any]] = {name: item.as_dict() for name, item in meant.items()}
    missing = None if _is_sure(hits, wanted) else _missing(store, wanted, meant, hits)
    return Found(understood, hits, missing, partial(rows.as_text, store.engine, wanted))


def _map_id(store: Store, name: str) -> int:
    """The id of a map by its name, at the price of a small query. Raises NotFoundError, which names those there are."""
    found = map_id_of(store.engine, storable(name))
    return store.find_map(name).id if found is None else found


def _classes(meant: Mapping[str, Understood], name: str) -> tuple[str, ...]:
    return meant[name].classes if name in meant else ()


def _origin(given: Sequence[float]) -> tuple[float, float, float]:
    if len(given) != 3 or not all(math.isfinite(value) and abs(value) < 1e7 for value in given):
        raise UsageError(f"a place is three numbers in metres, X,Y,Z, not {given}")
    x, y, z = (float(value) for value in given)
    return x, y, z


def _seen_after(store: Store, given: str | int | datetime | None, map_id: int | None) -> tuple[int | None, str | None]:
    """A time in nanoseconds, or the name of a recording. Raises UsageError for what is neither."""
    if given is None or isinstance(given, int):
        return given, None
    if isinstance(given, datetime):
        return _nanoseconds(given), None
    if re.fullmatch(r"\d{1,19}", given) and len(given) >= 16:
        return int(given), None
    names = {item.name for item in store.status(map_id)}
    if given in names:
        return None, given
    try:
        return _nanoseconds(datetime.fromisoformat(given)), None
    except ValueError:
        listed = ", ".join(sorted(names)[:5]) or "none"
        raise UsageError(
            f"--seen-after {given!r} is neither a time (2026-05-31T14:00, UTC unless it says so, or nanoseconds) nor a "
            f"recording; recordings: {listed}"
        ) from None


def _nanoseconds(moment: datetime) -> int:
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return round(aware.timestamp() * 1e6) * 1000


def _hit(row: Any, sightings: Sequence[Any], wanted: Wanted) -> FoundLandmark:
    where = f"of landmark {row.landmark_id}"

    def real(name: str, low: float = -1e12, high: float = 1e12) -> float:
        return checked.real(getattr(row, name), f"landmarks.{name} {where}", low, high)

    parts = {"class": real("class_score")}
    if wanted.near:
        parts["near"] = real("near_score")
    if wanted.on:
        parts["on"] = real("on_score")
    if wanted.not_near:
        parts["not_near"] = real("not_near_score")
    parts["state"] = real("state_score")
    if wanted.origin is not None:
        parts["distance"] = real("distance_score")
    return FoundLandmark(
        landmark_id=int(row.landmark_id),
        map=row.map,
        category=row.category,
        probability=real("probability"),
        position=(real("x"), real("y"), real("z")),
        covariance=_covariance([real(f"cov_{axes}") for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]),
        size=(real("size_x"), real("size_y"), real("size_z")),
        yaw=real("yaw"),
        state=row.state,
        sightings=int(row.sightings),
        keyframes=int(row.keyframes),
        last_recording=row.last_recording,
        last_frame_index=row.last_frame_index,
        last_keyframe_id=row.last_keyframe_id,
        last_seen_ns=row.last_seen_ns,
        score=real("score"),
        parts=parts,
        distance=None if wanted.origin is None else math.sqrt(real("distance_squared", 0.0)),
        evidence=tuple(
            Evidence(
                *(int(s.object_id), int(s.keyframe_id), s.recording, int(s.frame_index)),
                *(s.name, float(s.score), float(s.coverage), float(s.visibility)),
            )
            for s in sightings
        ),
        viewpoint=_viewpoint(row),
    )


def _covariance(values: Sequence[float]) -> FloatArray:
    import numpy as np

    xx, xy, xz, yy, yz, zz = values
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], np.float64)


def _viewpoint(row: Any) -> Viewpoint | None:
    """None where the keyframe was deleted, or its pose is none."""
    if row.view_keyframe_id is None:
        return None
    names = ("qw", "qx", "qy", "qz", "tx", "ty", "tz")
    try:
        pose = pose_of([getattr(row, f"view_{name}") for name in names], f"keyframe {row.view_keyframe_id}")
    except CodecError:
        return None
    return Viewpoint(
        int(row.view_keyframe_id),
        row.view_recording,
        int(row.view_frame_index),
        pose,
        (float(row.view_x1), float(row.view_y1), float(row.view_x2), float(row.view_y2)),
        float(row.view_distance),
    )


def _is_sure(hits: Sequence[FoundLandmark], wanted: Wanted, least: float = RATHER) -> bool:
    """Whether one of the hits is rather of a class that was asked for than of another, and stands so: `least` says how
    surely.
    """
    parts = [name for name in ("near", "on") if getattr(wanted, name)]
    return any(hit.category in wanted.classes and all(hit.parts[name] >= least for name in parts) for hit in hits)


def _missing(
    store: Store, wanted: Wanted, meant: Mapping[str, Understood], hits: Sequence[FoundLandmark]
) -> Missing | None:
    """Which of three it is that nothing was found, or `hits` that are rather something else; None: they are it."""
    from semdb.database.landmark_unfound import unfound

    said = meant["what"].said
    known = unfound(store.engine, wanted)
    usual = tuple({"relation": kind, "category": name, "count": number} for kind, name, number in known.usual)
    there, gone = known.there, known.gone
    but = "; what was found is rather something else, or near that" if hits else ""
    for part, seen in known.anchors.items():
        if not seen:
            text = f"no {meant[part].said} was seen, so no place {part} one was looked at{but}"
            return Missing(NOT_LOOKED_AT, text, _candidates(there), usual)
    if gone and not there:
        text = f"{said}: was seen, and later keyframes see through its place{but}"
        return Missing(GONE, text, _candidates(gone), usual)
    if not there:
        return Missing(NEVER_SEEN, f"{said}: never seen{_called(known.loose, known.others)}{but}", (), usual)
    if _is_sure(hits, wanted, LEAST) or _is_cut_off(store, wanted, hits):
        return None  # it stands so, if not surely
    if wanted.seen_after_ns is not None or wanted.seen_in is not None:
        text = f"{said}: seen, but not since then; where it was has not been seen empty{but}"
        return Missing(NOT_LOOKED_AT, text, _candidates(there), usual)
    return Missing(NEVER_SEEN, f"{said}: seen, but never so placed{but}", _candidates(there), usual)


def _is_cut_off(store: Store, wanted: Wanted, hits: Sequence[FoundLandmark]) -> bool:
    """Whether one that is of a class that was asked for comes after the last of so many hits."""
    from semdb.database import landmark_search as rows

    return len(hits) == wanted.limit and bool(rows.search(store.engine, replace(wanted, perhaps=False, limit=1))[0])


def _called(loose: int, others: int) -> str:
    """What is said of objects that go by a name where no landmark does."""
    parts = []
    if loose:
        parts.append(f"{loose} objects are in no landmark: run semdb refine, unless they have no depth")
    if others:
        parts.append(f"{others} objects were called so, of landmarks that are rather something else")
    return f" ({'; '.join(parts)})" if parts else ""


def _candidates(listed: Sequence[Any]) -> tuple[Mapping[str, Any], ...]:
    return tuple(
        {
            "landmark": int(row.id),
            "map": row.map,
            "category": row.category,
            "position": [float(row.x), float(row.y), float(row.z)],
            "last_seen": {
                "recording": row.last_recording,
                "frame_index": row.last_frame_index,
                "timestamp_ns": row.last_seen_ns,
            },
        }
        for row in listed
    )


def lines_of(found: Found) -> list[str]:
    """What the command prints for people."""
    lines = []
    for part, item in found.understood.items():
        classes = ", ".join(item["classes"])
        if item["how"] != "class" or part != "what":
            like = f" (like {item['like']}, {item['cosine']:.2f})" if "like" in item else ""
            lines.append(for_terminal(f"{part}: {item['said']} = {classes}{like}"))
    for hit in found.hits:
        x, y, z = hit.position
        away = "" if hit.distance is None else f", {hit.distance:.2f} m away"
        seen = "" if hit.last_recording is None else f", last in {hit.last_recording} frame {hit.last_frame_index}"
        lines.append(
            for_terminal(
                f"landmark {hit.landmark_id}: {hit.category} {hit.probability:.2f} at ({x:.2f}, {y:.2f}, {z:.2f}) in "
                f"{hit.map}, {hit.state}, {hit.keyframes} keyframes{seen}{away}, score {hit.score:.2f}"
            )
        )
    if found.missing is not None:
        lines.append(for_terminal(found.missing.text))
        for place in found.missing.usual:
            lines.append(for_terminal(f"usually {place['relation']} {place['category']} ({place['count']} times)"))
    return lines
