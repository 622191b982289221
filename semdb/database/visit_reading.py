"""What two recordings of a map say of its landmarks."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, select

from semdb.database import checked, retry
from semdb.database.codecs import decode_array
from semdb.database.landmark_records import LandmarkVisit
from semdb.database.landmark_rows import CHUNK, VISIT_COUNTS
from semdb.database.landmark_tables import landmark_sightings, landmark_visits, landmarks
from semdb.database.tables import categories, keyframes, objects, recordings
from semdb.errors import CodecError
from semdb.types import Float32Array

PRESENCES = ("present", "absent", "unobserved")
FARTHEST_M = 1e7
MOST_APPEARANCE = 1 << 16  # bytes


@dataclass(frozen=True, slots=True, eq=False)
class VisitedLandmark:
    """A landmark with what recordings say of it, by the name of the recording."""

    id: int
    category: str
    state: str
    evidence: Mapping[str, float]
    appearance: Float32Array | None
    visits: Mapping[str, LandmarkVisit]


@dataclass(frozen=True, slots=True)
class SeenObject:
    """An object that shows a landmark, with its box (x1, y1, x2, y2) in the image of its keyframe."""

    landmark_id: int
    recording: str
    keyframe_id: int
    frame_index: int
    box: tuple[float, float, float, float]


def load_visits(
    engine: Engine, map_id: int, names: Sequence[str], bad: Callable[[str], None] | None = None
) -> list[VisitedLandmark]:
    """The landmarks of a map that any of the recordings had in view, by id.

    A damaged row is told to `bad`, or raises CodecError.
    """
    m, v, r = landmarks.c, landmark_visits.c, recordings.c
    query = (
        select(
            m.id, m.state, m.evidence, checked.up_to(m.appearance, MOST_APPEARANCE), categories.c.name.label("category")
        )
        .add_columns(r.name.label("recording"), *(column for column in v if column.name != "landmark_id"))
        .select_from(
            landmark_visits.join(landmarks, m.id == v.landmark_id)
            .join(recordings, r.id == v.recording_id)
            .join(categories, categories.c.id == m.category_id)
        )
        .where(m.map_id == map_id, r.map_id == map_id, r.name.in_(list(names)))
        .order_by(m.id)
    )
    rows: dict[int, list[Any]] = {}
    for row in retry.read(engine, lambda connection: list(connection.execute(query))):
        rows.setdefault(int(row.id), []).append(row)
    found = []
    for key, mine in rows.items():
        try:
            found.append(_landmark(key, mine))
        except CodecError as error:
            if bad is None:
                raise
            bad(f"a landmark is left out, run semdb refine --force: {error}")
    return found


def visits_of_landmark(engine: Engine, map_id: int, landmark_id: int) -> list[LandmarkVisit]:
    """What the recordings of a map say of one landmark, by the recording's id. Raises CodecError for a damaged row."""
    v, r = landmark_visits.c, recordings.c
    query = (
        select(
            r.name.label("recording"), *(column for column in v if column.name not in ("landmark_id", "recording_id"))
        )
        .select_from(landmark_visits.join(recordings, r.id == v.recording_id))
        .where(v.landmark_id == int(landmark_id), r.map_id == map_id)
        .order_by(r.id)
    )
    rows = retry.read(engine, lambda connection: list(connection.execute(query)))
    return [_visit(row, f"of landmark {landmark_id}") for row in rows]


def _landmark(key: int, rows: Sequence[Any]) -> VisitedLandmark:
    first, where = rows[0], f"of landmark {key}"
    try:
        evidence = {str(name): float(value) for name, value in json.loads(first.evidence).items()}
    except (TypeError, ValueError, AttributeError):
        raise CodecError(f"landmarks.evidence {where} is no JSON object of numbers") from None
    appearance = None
    if first.appearance is not None:
        name = f"landmarks.appearance {where}"
        appearance = decode_array(checked.blob(first.appearance, name), name)
        if appearance.ndim != 1:
            raise CodecError(f"{name} is no vector")
    return VisitedLandmark(
        id=key,
        category=checked.text(first.category, f"categories.name {where}"),
        state=checked.text(first.state, f"landmarks.state {where}", 16),
        evidence=evidence,
        appearance=appearance,
        visits={str(row.recording): _visit(row, where) for row in rows},
    )


def _visit(row: Any, where: str) -> LandmarkVisit:
    if row.presence not in PRESENCES:
        raise CodecError(f"landmark_visits.presence {where} is {checked.shown(row.presence)}")

    def three(names: Sequence[str]) -> tuple[float, float, float] | None:
        if any(getattr(row, name) is None for name in names):
            return None
        x, y, z = (
            checked.real(getattr(row, name), f"landmark_visits.{name} {where}", -FARTHEST_M, FARTHEST_M)
            for name in names
        )
        return x, y, z

    counts = {
        name: checked.integer(getattr(row, name), f"landmark_visits.{name} {where}", 0, 2**31 - 1)
        for name in VISIT_COUNTS
    }
    return LandmarkVisit(
        recording=str(row.recording),
        presence=row.presence,
        position=three(("x", "y", "z")),
        size=three(("size_x", "size_y", "size_z")),
        **counts,
    )


def best_objects(
    engine: Engine, map_id: int, ids: Sequence[int], names: Sequence[str]
) -> dict[tuple[int, str], SeenObject]:
    """Of each landmark and recording the object that shows it best: most of it in sight, then the largest."""
    s, o, k, r = landmark_sightings.c, objects.c, keyframes.c, recordings.c
    query = (
        select(s.landmark_id, s.coverage, s.visibility, o.pixel_area, o.x1, o.y1, o.x2, o.y2, o.keyframe_id)
        .add_columns(k.frame_index, r.name.label("recording"))
        .select_from(
            landmark_sightings.join(objects, o.id == s.object_id)
            .join(keyframes, k.id == o.keyframe_id)
            .join(recordings, r.id == k.recording_id)
        )
        .where(r.map_id == map_id, r.name.in_(list(names)))
    )

    def work(connection: Connection) -> list[Any]:
        found: list[Any] = []
        for start in range(0, len(ids), CHUNK):
            found += connection.execute(query.where(s.landmark_id.in_(list(ids[start : start + CHUNK]))))
        return found

    best: dict[tuple[int, str], tuple[tuple[float, float, int], SeenObject]] = {}
    for row in retry.read(engine, work):
        key = int(row.landmark_id), str(row.recording)
        rank = round(row.coverage * row.visibility, 1), float(row.pixel_area), -int(row.frame_index)
        if key not in best or rank > best[key][0]:
            box = (float(row.x1), float(row.y1), float(row.x2), float(row.y2))
            best[key] = rank, SeenObject(*key, int(row.keyframe_id), int(row.frame_index), box)
    return {key: item for key, (_, item) in best.items()}
