"""What frames that are no keyframes show, beside the keyframes: rows of `frame_views`."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, Engine, and_, delete, exists, insert, or_, select

from semdb.database import checked, retry
from semdb.database.codecs import decode_descriptors, decode_keypoints, encode_descriptors, encode_keypoints
from semdb.database.columns import POSE_COLUMNS
from semdb.database.engine import check_packet
from semdb.database.keyframe_rows import FARTHEST_POINT_M, pose_columns, pose_of
from semdb.database.pose_errors import map_of
from semdb.database.reading import Bad
from semdb.database.refinements import FRAMES, replace_refinement
from semdb.database.tables import cameras, frame_views, keyframes, recordings
from semdb.database.writing import descriptor_dtype_of
from semdb.errors import CodecError
from semdb.types import Camera, FloatArray, Keypoints

CHUNK = 500
_STATEMENT = 4096  # bytes beside blobs
_CAMERA = [cameras.c[name] for name in ("width", "height", "fx", "fy", "cx", "cy", "distortion")]


@dataclass(frozen=True, slots=True)
class FrameHead:
    """Frame `frame_index` of the recording of a keyframe, and its pose ``[4, 4]`` in the frame of that keyframe."""

    keyframe_id: int
    frame_index: int
    keyframe_from_camera: FloatArray
    camera: Camera
    recording_id: int


@dataclass(frozen=True, slots=True)
class FrameRow:
    """A frame with its keypoints, none of them on an object, and its grey image as a file, JPEG or PNG."""

    head: FrameHead
    keypoints: Keypoints
    grey: bytes


def write_frame_views(engine: Engine, recording_id: int, found: Sequence[FrameRow], dtype: str = "float32") -> int:
    """Writes the frames of a recording in place of those that are there; `dtype` as of `KeyframeRecord`.

    Returns how many there are now: those of keyframes that were deleted meanwhile are left out. Programs that keep the
    map in memory see by its `refinements` that they are others.
    """
    map_id = map_of(engine, recording_id)
    if map_id is None:
        return 0  # it was deleted meanwhile
    parameters = {"recording": recording_id, "sha256": _digest(found)}
    return replace_refinement(
        engine, map_id, FRAMES, None, parameters, lambda connection: _replace(connection, recording_id, found, dtype)
    )


def _digest(found: Sequence[FrameRow]) -> str:
    """Tells what is written from what was there."""
    digest = hashlib.sha256()
    for one in found:
        digest.update(f"{one.head.keyframe_id} {one.head.frame_index} ".encode())
        for part in (one.head.keyframe_from_camera, one.keypoints.points, one.keypoints.features.descriptors):
            digest.update(np.ascontiguousarray(part).tobytes())
        digest.update(one.grey)
    return digest.hexdigest()


def _replace(connection: Connection, recording_id: int, found: Sequence[FrameRow], dtype: str) -> int:
    query = select(keyframes.c.id).where(keyframes.c.recording_id == recording_id).with_for_update()
    there = sorted(connection.execute(query).scalars())
    for start in range(0, len(there), CHUNK):
        own = frame_views.c.keyframe_id.in_(there[start : start + CHUNK])
        connection.execute(delete(frame_views).where(own))
    if dtype == "auto":
        of_map = select(recordings.c.map_id).where(recordings.c.id == recording_id)
        dtype = descriptor_dtype_of(connection, int(connection.execute(of_map).scalar() or 0))
    kept = [one for one in found if one.head.keyframe_id in set(there)]
    for one in kept:
        row = {
            "keyframe_id": one.head.keyframe_id,
            "frame_index": one.head.frame_index,
            **pose_columns(one.head.keyframe_from_camera),
            "count": len(one.keypoints),
            "keypoints": encode_keypoints(one.keypoints, small=dtype == "uint8"),
            "descriptors": encode_descriptors(one.keypoints.features.descriptors, dtype),
            "grey": one.grey,
        }
        size = _STATEMENT + sum(len(value) for value in row.values() if isinstance(value, bytes))
        check_packet(connection, size, f"the frame_views row of frame {one.head.frame_index}")
        connection.execute(insert(frame_views), row)  # one by one: blobs go as they are
    return len(kept)


def load_frame_heads(engine: Engine, map_id: int, bad: Bad | None = None) -> list[FrameHead]:
    """Those of a map by keyframe and frame, but for frames that have become keyframes since: these are there already.

    What is damaged is told to `bad`, or raises CodecError.
    """
    c = frame_views.c
    pose = [c[name] for name in POSE_COLUMNS]
    joined = frame_views.join(keyframes, keyframes.c.id == c.keyframe_id)
    joined = joined.join(recordings, recordings.c.id == keyframes.c.recording_id)
    joined = joined.join(cameras, cameras.c.id == keyframes.c.camera_id)
    query = select(*pose, c.keyframe_id, c.frame_index, keyframes.c.recording_id, *_CAMERA).select_from(joined)
    k = keyframes.alias().c
    now_one = exists().where(k.recording_id == keyframes.c.recording_id, k.frame_index == c.frame_index)
    query = query.where(recordings.c.map_id == map_id, ~now_one).order_by(c.keyframe_id, c.frame_index)
    # by those that have any: a database would begin with all keyframes of the map, of which most have none
    of_any = select(c.keyframe_id).distinct().order_by(c.keyframe_id)

    def work(connection: Connection) -> list[Any]:
        ids = list(connection.execute(of_any).scalars())
        rows: list[Any] = []
        for start in range(0, len(ids), CHUNK):
            rows += connection.execute(query.where(c.keyframe_id.in_(ids[start : start + CHUNK]))).all()
        return rows

    found = []
    for row in retry.read(engine, work):
        where = f"of frame_views of keyframe {row.keyframe_id}"
        try:
            index = checked.integer(row.frame_index, f"frame_index {where}")
            placed = pose_of(tuple(row)[: len(pose)], f"the pose {where}")
            found.append(
                FrameHead(
                    int(row.keyframe_id),
                    index,
                    placed,
                    checked.camera(row, f"the camera {where}"),
                    int(row.recording_id),
                )
            )
        except CodecError as error:
            _tell(bad, int(row.keyframe_id), error)
    return found


def load_frames(engine: Engine, heads: Sequence[FrameHead], bad: Bad | None = None) -> list[FrameRow]:
    """Those of `heads` that are there and whole, in their order; see `load_frame_heads`."""
    c = frame_views.c
    if not heads:
        return []
    either = or_(*(and_(c.keyframe_id == one.keyframe_id, c.frame_index == one.frame_index) for one in heads))
    blobs = [
        checked.up_to(c.keypoints, checked.MOST_KEYPOINTS),
        checked.up_to(c.descriptors, checked.MOST_DESCRIPTORS),
        checked.up_to(c.grey, checked.MOST_FILE),
    ]
    query = select(c.keyframe_id, c.frame_index, *blobs).where(either)
    rows = {(row.keyframe_id, row.frame_index): row for row in retry.read(engine, lambda c: list(c.execute(query)))}
    found = []
    for head in heads:
        row = rows.get((head.keyframe_id, head.frame_index))
        if row is None:
            continue
        try:
            found.append(_frame(head, row))
        except CodecError as error:
            _tell(bad, head.keyframe_id, error)
    return found


def _frame(head: FrameHead, row: Any) -> FrameRow:
    where = f"frame_views of keyframe {head.keyframe_id}, frame {head.frame_index}"
    described = decode_descriptors(checked.blob(row.descriptors, where), where)
    nowhere = np.full(len(described), -1, np.int32)
    keypoints = decode_keypoints(checked.blob(row.keypoints, where), described, nowhere, where)
    points, xy = keypoints.points, keypoints.features.xy
    far = np.isinf(points).any() or (np.abs(points[~np.isnan(points)]) > FARTHEST_POINT_M).any()
    if far or not np.isfinite(xy).all():
        raise CodecError(f"{where}: a keypoint is nowhere")
    return FrameRow(head, keypoints, checked.blob(row.grey, where))


def _tell(bad: Bad | None, keyframe_id: int, error: CodecError) -> None:
    if bad is None:
        raise error
    bad(keyframe_id, CodecError(f"{error}; `semdb refine --frames` writes it anew"))
