"""The log of localizations, read and forgotten."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Engine, and_, delete, func, not_, or_, select, true

from semdb.database import checked, retry
from semdb.database.clock import now_plus
from semdb.database.columns import POSE_COLUMNS
from semdb.database.keyframe_rows import pose_of
from semdb.database.tables import maps, queries
from semdb.errors import CodecError, NotFoundError
from semdb.types import FloatArray

CHUNK = 500  # rows that are deleted in one transaction


@dataclass(frozen=True, slots=True)
class QueryFilter:
    """Which logged localizations are wanted. `text` is part of the image's name or of the reason; times are UTC.

    Without `by_path` folders of an image do not count: whoever may not see them cannot ask for them, either.
    """

    verdict: str | None = None
    text: str | None = None
    since: datetime | None = None
    until: datetime | None = None
    keyframe_id: int | None = None
    by_path: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class LoggedQuery:
    """A localization that was logged; `world_from_camera` ``[4, 4]`` is None where there was no pose."""

    id: int
    created_at: datetime  # UTC
    image: str
    verdict: str
    world_from_camera: FloatArray | None
    confidence: float
    inliers: int
    stage: str
    reason: str
    candidates: tuple[dict[str, Any], ...]
    timing_ms: dict[str, float]


def list_queries(
    engine: Engine, map_id: int, *, before: int | None = None, limit: int = 100, wanted: QueryFilter | None = None
) -> list[LoggedQuery]:
    """The newest `limit` of a map, of those with smaller ids than `before`. Raises CodecError for a damaged row."""
    query = select(queries).where(queries.c.map_id == map_id).order_by(queries.c.id.desc()).limit(int(limit))
    if before is not None:
        query = query.where(queries.c.id < int(before))
    if wanted is not None:
        query = query.where(*_conditions(wanted))
    return [_query(row) for row in retry.read(engine, lambda c: list(c.execute(query)))]


def find_query(engine: Engine, query_id: int) -> tuple[str, LoggedQuery]:
    """The name of the map, and what was logged. Raises NotFoundError, CodecError for a damaged row."""
    statement = (
        select(queries, maps.c.name.label("map"))
        .select_from(queries.join(maps, maps.c.id == queries.c.map_id))
        .where(queries.c.id == int(query_id))
    )
    row = retry.read(engine, lambda c: c.execute(statement).one_or_none())
    if row is None:
        raise NotFoundError(f"there is no query {query_id}")
    return checked.text(row.map, f"maps.name of query {query_id}"), _query(row)


def _conditions(wanted: QueryFilter) -> list[ColumnElement[bool]]:
    c, found = queries.c, []
    if wanted.verdict is not None:
        found.append(c.verdict == wanted.verdict)
    if wanted.text is not None:
        image = _holds(c.image, wanted.text)
        if not wanted.by_path:
            folder = true() if "/" in wanted.text else _holds(c.image, wanted.text, "/")  # has a slash behind it
            image = and_(image, not_(folder))
        found.append(or_(image, _holds(c.reason, wanted.text)))
    if wanted.since is not None:
        found.append(c.created_at >= wanted.since)
    if wanted.until is not None:
        found.append(c.created_at < wanted.until)
    if wanted.keyframe_id is not None:
        found.append(_holds(c.candidates, f'"keyframe": {int(wanted.keyframe_id)},'))
    return found


def _holds(column: Any, text: str, later: str = "") -> ColumnElement[bool]:
    """Whether a text is part of a column, and `later` comes behind it; capital letters are as small ones."""
    escaped = text.lower().replace("!", "!!").replace("%", "!%").replace("_", "!_")
    return func.lower(column).like(f"%{escaped}%" + (f"{later}%" if later else ""), escape="!")


def _query(row: Any) -> LoggedQuery:
    where = f"of query {row.id}"
    pose = [getattr(row, name) for name in POSE_COLUMNS]
    try:
        candidates = tuple(dict(item) for item in json.loads(row.candidates))
        timing = {str(name): float(ms) for name, ms in json.loads(row.timing_ms).items()}
    except (TypeError, ValueError, AttributeError):
        raise CodecError(f"queries.candidates or timing_ms {where} are not the JSON that was written") from None
    return LoggedQuery(
        id=int(row.id),
        created_at=row.created_at,
        image=checked.text(row.image, f"queries.image {where}"),
        verdict=checked.text(row.verdict, f"queries.verdict {where}"),
        world_from_camera=None if pose[0] is None else pose_of(pose, f"query {row.id}"),
        confidence=checked.real(row.confidence, f"queries.confidence {where}", -1e12, 1e12),
        inliers=checked.integer(row.inliers, f"queries.inliers {where}", 0, 2**31 - 1),
        stage=checked.text(row.stage, f"queries.stage {where}"),
        reason=checked.text(row.reason, f"queries.reason {where}"),
        candidates=candidates,
        timing_ms=timing,
    )


def forget_queries(engine: Engine, older_than_s: int) -> int:
    """Deletes what was logged longer ago, by the database's clock, in chunks. Returns how many."""
    c, forgotten = queries.c, 0
    old = select(c.id).where(c.created_at < now_plus(-int(older_than_s))).order_by(c.id).limit(CHUNK)
    while ids := retry.read(engine, lambda connection: list(connection.execute(old).scalars())):
        retry.write(engine, lambda connection, ids=ids: connection.execute(delete(queries).where(c.id.in_(ids))))  # type: ignore[misc]
        forgotten += len(ids)
    return forgotten
