"""The landmarks of a map as values: for pictures and for other programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Engine, or_, select

from semdb.database import checked, retry
from semdb.database.landmark_tables import landmark_relations, landmarks
from semdb.database.tables import categories, keyframes, recordings
from semdb.errors import CodecError
from semdb.types import FloatArray

FARTHEST_M = 1e7
STATES = ("tentative", "confirmed", "gone")


@dataclass(frozen=True, slots=True, eq=False)
class StoredLandmark:
    """A landmark of a map; `yaw` in radians about the map's up, sizes along the box's own axes, metres."""

    id: int
    category: str
    probability: float
    evidence: dict[str, float]
    position: tuple[float, float, float]
    covariance: FloatArray  # [3, 3]
    size: tuple[float, float, float]
    yaw: float
    sightings: int
    keyframes: int
    missed: int
    seen_through: int
    state: str
    first_seen_ns: int | None
    last_seen_ns: int | None
    last_recording: str | None
    last_frame_index: int | None


@dataclass(frozen=True, slots=True)
class StoredRelation:
    """How a landmark stands to another one, by ids."""

    landmark_id: int
    kind: str
    other_landmark_id: int
    score: float


def load_landmarks(
    engine: Engine, map_id: int, bad: Callable[[str], None] | None = None
) -> tuple[list[StoredLandmark], list[StoredRelation]]:
    """The landmarks of a map by id, and their relations. A damaged row is told to `bad`, or raises CodecError."""
    found = list_landmarks(engine, map_id, bad=bad)
    known = {item.id for item in found}
    kept = [
        one for one in list_relations(engine, map_id) if one.landmark_id in known and one.other_landmark_id in known
    ]
    return found, kept


def list_landmarks(
    engine: Engine,
    map_id: int,
    *,
    category: str | None = None,
    state: str | None = None,
    after: int = 0,
    limit: int | None = None,
    bad: Callable[[str], None] | None = None,
) -> list[StoredLandmark]:
    """Landmarks of a map by id, `limit` of those after an id. A damaged row is told to `bad`, or raises CodecError."""
    m = landmarks.c
    query = (
        select(*(c for c in m if c.name != "appearance"), categories.c.name.label("category"))
        .add_columns(recordings.c.name.label("last_recording"), keyframes.c.frame_index.label("last_frame_index"))
        .select_from(
            landmarks.join(categories, categories.c.id == m.category_id)
            .outerjoin(keyframes, keyframes.c.id == m.last_keyframe_id)
            .outerjoin(recordings, recordings.c.id == keyframes.c.recording_id)
        )
        .where(m.map_id == map_id, m.id > after)
        .order_by(m.id)
        .limit(limit)
    )
    for column, wanted in ((categories.c.name, category), (m.state, state)):
        if wanted is not None:
            query = query.where(column == wanted)
    found = []
    for row in retry.read(engine, lambda connection: list(connection.execute(query))):
        try:
            found.append(_landmark(row))
        except CodecError as error:
            if bad is None:
                raise
            bad(f"a landmark is left out, run semdb refine --force: {error}")
    return found


def list_relations(
    engine: Engine,
    map_id: int,
    *,
    kind: str | None = None,
    landmark: int | None = None,
    after: tuple[int, int, str] | None = None,
    limit: int | None = None,
) -> list[StoredRelation]:
    """How landmarks of a map stand to each other, by ids and kind, `limit` of those after a key; or those of one."""
    r, one, other = landmark_relations.c, landmarks.alias("one"), landmarks.alias("other")
    query = (
        select(*r)
        .select_from(
            landmark_relations.join(one, one.c.id == r.landmark_id).join(other, other.c.id == r.other_landmark_id)
        )
        .where(one.c.map_id == map_id, other.c.map_id == map_id)
        .order_by(r.landmark_id, r.other_landmark_id, r.kind)
        .limit(limit)
    )
    if kind is not None:
        query = query.where(r.kind == kind)
    if landmark is not None:
        query = query.where(or_(r.landmark_id == landmark, r.other_landmark_id == landmark))
    if after is not None:
        query = query.where(checked.later((r.landmark_id, r.other_landmark_id, r.kind), after))
    return [
        StoredRelation(int(x.landmark_id), str(x.kind), int(x.other_landmark_id), float(x.score))
        for x in retry.read(engine, lambda connection: list(connection.execute(query)))
    ]


def _landmark(row: Any) -> StoredLandmark:
    where = f"of landmark {row.id}"

    def real(name: str, low: float = -FARTHEST_M, high: float = FARTHEST_M) -> float:
        return checked.real(getattr(row, name), f"landmarks.{name} {where}", low, high)

    def count(name: str) -> int:
        return checked.integer(getattr(row, name), f"landmarks.{name} {where}", 0, 2**31 - 1)

    def time(name: str) -> int | None:
        value = getattr(row, name)
        return None if value is None else checked.integer(value, f"landmarks.{name} {where}", -(2**63), 2**63 - 1)

    if row.state not in STATES:
        raise CodecError(f"landmarks.state {where} is {checked.shown(row.state)}")
    xx, xy, xz, yy, yz, zz = (real(f"cov_{axes}") for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    try:
        evidence = {str(name): float(value) for name, value in json.loads(row.evidence).items()}
    except (TypeError, ValueError, AttributeError):
        raise CodecError(f"landmarks.evidence {where} is no JSON object of numbers") from None
    return StoredLandmark(
        id=int(row.id),
        category=checked.text(row.category, f"categories.name {where}"),
        probability=real("probability", 0.0, 1.0),
        evidence=evidence,
        position=(real("x"), real("y"), real("z")),
        covariance=np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]),
        size=(real("size_x", 0.0), real("size_y", 0.0), real("size_z", 0.0)),
        yaw=real("yaw", -10.0, 10.0),
        sightings=count("sightings"),
        keyframes=count("keyframes"),
        missed=count("missed"),
        seen_through=count("seen_through"),
        state=row.state,
        first_seen_ns=time("first_seen_ns"),
        last_seen_ns=time("last_seen_ns"),
        last_recording=row.last_recording,
        last_frame_index=row.last_frame_index,
    )
