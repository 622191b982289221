"""Where the poses of recordings come from, and those that a plan brings: estimated ones, kept until they are stored.

What is stored late of a recording that was moved into another map goes through `map_from_recording`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, and_, insert, select

from semdb.database import checked, retry
from semdb.database.columns import POSE_COLUMNS
from semdb.database.keyframe_rows import pose_columns, pose_of
from semdb.database.links import MOST_MATRIX, link_row, matrix_blob, matrix_of
from semdb.database.pose_records import Link, PlannedPoses, PoseSource, RecordingPoses, World
from semdb.database.tables import map_models, maps, planned_links, planned_poses, pose_sources, recordings
from semdb.errors import UsageError
from semdb.types import FloatArray

ROWS = 500  # of one statement


def insert_poses(connection: Connection, recording_id: int, map_id: int, planned: PlannedPoses | None) -> None:
    """Writes where the poses of a new recording come from, and the estimated ones.

    Raises UsageError where its frame and that of the map's other recordings are not the same.
    """
    _refuse_mixed(connection, recording_id, map_id, estimated=planned is not None)
    found = RecordingPoses()
    if planned is not None:
        found = RecordingPoses(PoseSource.ESTIMATED, World.FIRST_KEYFRAME, planned.upright)
    connection.execute(insert(pose_sources), {"recording_id": recording_id, **source_row(found)})
    if planned is None:
        return
    rows: list[dict[str, Any]] = [
        {
            "recording_id": recording_id,
            "frame_index": index,
            **pose_columns(pose),
            "covariance": _covariance(planned, index),
        }
        for index, pose in planned.poses.items()
    ]
    for start in range(0, len(rows), ROWS):
        connection.execute(insert(planned_poses), rows[start : start + ROWS])
    insert_links(connection, recording_id, planned.links)


def insert_links(connection: Connection, recording_id: int, links: Sequence[Link]) -> None:
    """Writes links between planned frames, which are those of their keyframes once these are stored."""
    rows = [
        {
            "recording_id": recording_id,
            "frame_index": link.first,
            "other_frame_index": link.second,
            "kind": link.kind.value,
            **link_row(link),
        }
        for link in links
    ]
    for start in range(0, len(rows), ROWS):
        connection.execute(insert(planned_links), rows[start : start + ROWS])


def _covariance(planned: PlannedPoses, index: int) -> bytes | None:
    known = planned.covariances.get(index)
    return None if known is None else matrix_blob(known, f"the covariance of frame {index}")


def _refuse_mixed(connection: Connection, recording_id: int, map_id: int, *, estimated: bool) -> None:
    r, p = recordings.c, pose_sources.c
    query = select(r.name, p.world, maps.c.name.label("map")).join(maps, maps.c.id == r.map_id)
    query = query.join(pose_sources, p.recording_id == r.id, isouter=True)
    others = list(connection.execute(query.where(r.map_id == map_id, r.id != recording_id).order_by(r.id)))
    advice = "give --align to find out, or another map (--map)"
    if estimated and others:
        raise UsageError(
            f"the map {others[0].map!r} holds the recording {others[0].name!r} already, and where one with estimated "
            f"poses lies in its frame is not known: {advice}"
        )
    for other in others:
        if other.world == World.FIRST_KEYFRAME:
            raise UsageError(
                f"the frame of the map {other.map!r} is that of the estimated poses of {other.name!r}, and where "
                f"another recording lies in it is not known: {advice}"
            )


def source_row(found: RecordingPoses) -> dict[str, Any]:
    """The columns of `pose_sources` but the recording's."""
    return {
        "pose_source": found.source.value,
        "world": found.world.value,
        "upright": None if found.upright is None else int(found.upright),
        **pose_columns(found.map_from_recording),
    }


def recording_poses(engine: Engine, recording_id: int) -> RecordingPoses:
    """Where the poses of a recording come from. Raises CodecError."""
    return retry.read(engine, lambda connection: poses_of(connection, recording_id))


def poses_of(connection: Connection, recording_id: int) -> RecordingPoses:
    """As `recording_poses`, within a transaction; recorded where nothing is said."""
    query = select(pose_sources).where(pose_sources.c.recording_id == recording_id)
    row = connection.execute(query).one_or_none()
    return RecordingPoses() if row is None else _source(row)


def all_recording_poses(engine: Engine) -> dict[int, RecordingPoses]:
    """Where poses come from, by recording. Raises CodecError."""
    rows = retry.read(engine, lambda connection: list(connection.execute(select(pose_sources))))
    return {int(row.recording_id): _source(row) for row in rows}


def _source(row: Any) -> RecordingPoses:
    where = f"of recording {row.recording_id}"
    upright = None if row.upright is None else checked.integer(row.upright, f"pose_sources.upright {where}", 0, 1)
    return RecordingPoses(
        checked.choice(row.pose_source, f"pose_sources.pose_source {where}", PoseSource),
        checked.choice(row.world, f"pose_sources.world {where}", World),
        None if upright is None else bool(upright),
        pose_of([getattr(row, name) for name in POSE_COLUMNS], f"the frame {where}"),
    )


def load_planned_poses(engine: Engine, recording_id: int) -> dict[int, FloatArray]:
    """Estimated poses ``[4, 4]`` of a plan by frame index, as they were estimated; empty where it brings none."""
    c = planned_poses.c
    query = select(c.frame_index, *(c[name] for name in POSE_COLUMNS)).where(c.recording_id == recording_id)
    rows = retry.read(engine, lambda connection: list(connection.execute(query.order_by(c.frame_index))))
    where = f"of recording {recording_id}"
    return {
        checked.integer(index, f"planned_poses.frame_index {where}"): pose_of(numbers, f"frame {index} {where}")
        for index, *numbers in rows
    }


@dataclass(frozen=True, slots=True)
class Place:
    """Into which map a keyframe goes, and through which motion. `planned` is a covariance as it was estimated.

    `encoder` is the model whose vectors count there, None where the map names none.
    """

    map_id: int
    motion: tuple[float, ...] | None  # of `map_from_recording`; None: it stays as it is
    planned: bytes | None
    encoder: int | None = None

    def moved(self, columns: Mapping[str, Any]) -> dict[str, float]:
        """The columns of a pose that become others."""
        if self.motion is None:
            return {}
        pose = pose_of([columns[name] for name in POSE_COLUMNS], "the keyframe")
        return pose_columns(self._map_from_recording() @ pose)

    def covariance(self, frame_index: int) -> bytes | None:
        """The covariance as it is to be stored; None where there is none. Raises CodecError."""
        if self.planned is None or self.motion is None:
            return self.planned
        found = matrix_of(self.planned, f"planned_poses.covariance of frame {frame_index}")
        return matrix_blob(turned(found, self._map_from_recording()), "a covariance")

    def _map_from_recording(self) -> FloatArray:
        return pose_of(self.motion or (), "the frame of the recording")


def place_of(connection: Connection, recording_id: int, frame_index: int) -> Place:
    """Where a keyframe of a recording goes now. Of a recording that is not there, nowhere: map 0."""
    s, p = pose_sources.c, planned_poses.c
    mine = and_(p.recording_id == recordings.c.id, p.frame_index == frame_index)
    covariance = checked.up_to(p.covariance, MOST_MATRIX)
    m = map_models.c
    encoder = select(m.model_id).where(m.map_id == recordings.c.map_id, m.role == "encoder").scalar_subquery()
    query = (
        select(recordings.c.map_id, covariance, *(s[name] for name in POSE_COLUMNS), encoder.label("encoder"))
        .join(pose_sources, s.recording_id == recordings.c.id, isouter=True)
        .join(planned_poses, mine, isouter=True)
        .where(recordings.c.id == recording_id)
    )
    row = connection.execute(query).one_or_none()
    if row is None:
        return Place(0, None, None)
    numbers = tuple(getattr(row, name) for name in POSE_COLUMNS)
    still = numbers[0] is None or numbers == (1, 0, 0, 0, 0, 0, 0)
    return Place(row.map_id, None if still else numbers, row.covariance, row.encoder)


def turned(covariance: FloatArray, motion: FloatArray) -> FloatArray:
    """A covariance ``[6, 6]`` of left perturbations, in the world that `motion` ``[4, 4]`` leads to."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = motion[:3, :3]
    return np.asarray(both @ covariance @ both.T)
