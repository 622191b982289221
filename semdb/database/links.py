"""Links between keyframes, and covariances of their poses: rows of `loop_closures` and `pose_covariances`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, and_, delete, insert, or_, select

from semdb.database import checked, retry
from semdb.database.codecs import decode_array, encode_array
from semdb.database.columns import POSE_COLUMNS
from semdb.database.keyframe_rows import pose_columns, pose_of
from semdb.database.pose_records import Link, LinkKind, LinkState
from semdb.database.reading import Bad
from semdb.database.tables import keyframes, loop_closures, planned_links, pose_covariances, recordings
from semdb.errors import CodecError, UsageError
from semdb.storable_names import NAME_LENGTH
from semdb.types import FloatArray

CHUNK = 500
MOST_MATRIX = 1024  # bytes of the blob of a 6x6 matrix
LARGEST_ID = 2**63 - 1
Key = tuple[int, int, str]  # of a link: both keyframes and its kind
_LINK = (*POSE_COLUMNS, "information", "inliers", "state", "reason", "provenance")


def link_row(link: Link) -> dict[str, Any]:
    """The columns that tables of links share. Raises UsageError for a pose or information that is none."""
    return {
        **pose_columns(link.first_from_second),
        "information": matrix_blob(link.information, "the information of a link"),
        "inliers": int(link.inliers),
        "state": link.state.value,
        "reason": link.reason,
        "provenance": link.provenance[:NAME_LENGTH],
    }


def matrix_blob(matrix: FloatArray, what: str) -> bytes:
    """A 6x6 matrix as a blob of float64. Raises UsageError for one that is none."""
    values = np.asarray(matrix, np.float64)
    if values.shape != (6, 6) or not np.isfinite(values).all():
        raise UsageError(f"{what} is a finite 6x6 matrix, not {values.shape} with {np.isfinite(values).sum()} numbers")
    return encode_array((values + values.T) / 2)


def matrix_of(value: object, where: str) -> FloatArray:
    """The 6x6 matrix of a blob, read-only. Raises CodecError."""
    found = decode_array(checked.blob(value, where), where)
    if found.shape != (6, 6) or found.dtype != np.float64 or not np.isfinite(found).all():
        raise CodecError(f"{where}: a finite float64 [6, 6] is expected, not {found.dtype} {list(found.shape)}")
    if (np.diagonal(found) < 0).any():
        raise CodecError(f"{where}: a variance is below 0")
    return found


def write_links(connection: Connection, links: Sequence[Link]) -> None:
    """Writes links between keyframes, in place of those of the same kind between the same two, whichever is first."""
    c = loop_closures.c
    for link in links:
        one = and_(c.keyframe_id == link.first, c.other_keyframe_id == link.second)
        two = and_(c.keyframe_id == link.second, c.other_keyframe_id == link.first)
        connection.execute(delete(loop_closures).where(c.kind == link.kind.value, or_(one, two)))
        row = {"keyframe_id": link.first, "other_keyframe_id": link.second, "kind": link.kind.value}
        connection.execute(insert(loop_closures), {**row, **link_row(link)})


def write_planned_links(connection: Connection, recording_id: int) -> None:
    """Turns planned links of a recording whose keyframes are both stored into links; those that are there stay."""
    p, one, two = planned_links.c, keyframes.alias(), keyframes.alias()
    first, second = one.c, two.c
    there = select(loop_closures.c.keyframe_id).where(
        loop_closures.c.keyframe_id == first.id,
        loop_closures.c.other_keyframe_id == second.id,
        loop_closures.c.kind == p.kind,
    )
    query = (
        select(first.id, second.id, p.kind, *(p[name] for name in _LINK))
        .select_from(planned_links)
        .join(one, and_(first.recording_id == p.recording_id, first.frame_index == p.frame_index))
        .join(two, and_(second.recording_id == p.recording_id, second.frame_index == p.other_frame_index))
        .where(p.recording_id == recording_id, ~there.exists())
    )
    columns = ["keyframe_id", "other_keyframe_id", "kind", *_LINK]
    rows = [dict(zip(columns, row, strict=True)) for row in connection.execute(query)]
    if rows:
        connection.execute(insert(loop_closures), rows)


def list_links(
    engine: Engine, map_id: int | None = None, *, odometry: bool = True, bad: Bad | None = None
) -> list[Link]:
    """Links of a map's keyframes, or of all, by the keyframes' ids and kind; without `odometry` only closures.

    A damaged row is left out and told to `bad` with its first keyframe, or raises CodecError.
    """
    return page_of_links(engine, map_id, odometry=odometry, bad=bad)[0]


def page_of_links(
    engine: Engine,
    map_id: int | None = None,
    *,
    odometry: bool = True,
    after: Key | None = None,
    limit: int | None = None,
    bad: Bad | None = None,
) -> tuple[list[Link], Key | None]:
    """As `list_links`, so many rows of those after a key, and the key of the last row, where there may be more."""
    c = loop_closures.c
    columns = [checked.up_to(column, MOST_MATRIX) if column.name == "information" else column for column in c]
    query = select(*columns).order_by(c.keyframe_id, c.other_keyframe_id, c.kind).limit(limit)
    if after is not None:
        query = query.where(checked.later((c.keyframe_id, c.other_keyframe_id, c.kind), after))
    if map_id is not None:
        query = query.join(keyframes, keyframes.c.id == c.keyframe_id)
        query = query.join(recordings, recordings.c.id == keyframes.c.recording_id)
        query = query.where(recordings.c.map_id == map_id)
    if not odometry:
        query = query.where(c.kind != LinkKind.ODOMETRY.value)
    found, rows = [], retry.read(engine, lambda connection: list(connection.execute(query)))
    for row in rows:
        try:
            found.append(_link(row))
        except CodecError as error:
            if bad is None:
                raise
            bad(row.keyframe_id if isinstance(row.keyframe_id, int) else 0, error)
    last = rows[-1] if rows and len(rows) == limit else None
    return found, None if last is None else (last.keyframe_id, last.other_keyframe_id, last.kind)


def _link(row: Any) -> Link:
    where = f"of the link of keyframes {checked.shown(row.keyframe_id)} and {checked.shown(row.other_keyframe_id)}"
    return Link(
        first=checked.integer(row.keyframe_id, f"loop_closures.keyframe_id {where}", 1, LARGEST_ID),
        second=checked.integer(row.other_keyframe_id, f"loop_closures.other_keyframe_id {where}", 1, LARGEST_ID),
        kind=checked.choice(row.kind, f"loop_closures.kind {where}", LinkKind),
        first_from_second=pose_of([getattr(row, name) for name in POSE_COLUMNS], where.removeprefix("of ")),
        information=matrix_of(row.information, f"loop_closures.information {where}"),
        inliers=checked.integer(row.inliers, f"loop_closures.inliers {where}"),
        state=checked.choice(row.state, f"loop_closures.state {where}", LinkState),
        reason=checked.text(row.reason, f"loop_closures.reason {where}", checked.MOST_JSON),
        provenance=checked.text(row.provenance, f"loop_closures.provenance {where}"),
    )


def write_covariances(connection: Connection, covariances: Mapping[int, FloatArray]) -> None:
    """Writes covariances ``[6, 6]`` of keyframes, whose former ones are gone already."""
    rows = [
        {"keyframe_id": key, "data": matrix_blob(value, f"the covariance of keyframe {key}")}
        for key, value in covariances.items()
    ]
    if rows:
        connection.execute(insert(pose_covariances), rows)


def load_covariances(engine: Engine, keyframe_ids: Sequence[int], bad: Bad | None = None) -> dict[int, FloatArray]:
    """Covariances ``[6, 6]`` of the poses of those keyframes that have any: translation (m) then rotation (rad).

    Of left perturbations in the world frame, as those of localizations. A damaged row is left out and told to `bad`, or
    raises CodecError.
    """
    c, found = pose_covariances.c, dict[int, FloatArray]()
    keys = [int(key) for key in keyframe_ids]
    data = checked.up_to(c.data, MOST_MATRIX)
    for start in range(0, len(keys), CHUNK):
        query = select(c.keyframe_id, data).where(c.keyframe_id.in_(keys[start : start + CHUNK]))
        for row in retry.read(engine, lambda connection, query=query: list(connection.execute(query))):  # type: ignore[misc]
            try:
                found[int(row.keyframe_id)] = matrix_of(
                    row.data, f"pose_covariances.data of keyframe {row.keyframe_id}"
                )
            except CodecError as error:
                if bad is None:
                    raise
                bad(row.keyframe_id if isinstance(row.keyframe_id, int) else 0, error)
    return found
