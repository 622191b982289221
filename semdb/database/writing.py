"""Writing a keyframe: all its rows in one transaction, once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, NoReturn

import numpy as np
from sqlalchemy import Connection, Engine, Table, bindparam, func, insert, select, update
from sqlalchemy.exc import IntegrityError

from semdb.class_score import strengths
from semdb.database import retry, tables
from semdb.database.codecs import (
    HEAD,
    dtype_of,
    encode_array,
    encode_descriptors,
    encode_keypoints,
    encode_mask,
    image_format,
)
from semdb.database.columns import STRENGTH_COLUMNS
from semdb.database.engine import check_packet
from semdb.database.ids import SharedIds, new_id
from semdb.database.items import Claim, held_by
from semdb.database.keyframe_rows import pose_columns
from semdb.database.planning import check_models, map_model_ids
from semdb.database.pose_sources import place_of
from semdb.database.records import ChangeKind, ItemState, KeyframeRecord, RecordingState, WriteResult
from semdb.errors import LeaseLostError, NotFoundError, UnstorableError, UsageError
from semdb.types import Description, ModelInfo

_STATEMENT_OVERHEAD = 4096  # bytes of a statement beside its blobs
_item = tables.ingest_items.c
# Statements of each keyframe with conditions are built once: that takes as long as to run them.
_MARK_DONE = update(tables.ingest_items).values(state=ItemState.DONE.value, error=None, worker=None, lease_until=None)
_TAKE_CLAIMED = _MARK_DONE.where(held_by(bindparam("of_recording"), bindparam("of_frame"), bindparam("of_token")))
_TAKE = _MARK_DONE.values(attempts=_item.attempts + 1).where(
    _item.recording_id == bindparam("of_recording"),
    _item.frame_index == bindparam("of_frame"),
    _item.state.not_in((ItemState.DONE.value, ItemState.DELETED.value)),
)
_OBJECT_IDS = select(tables.objects.c.ordinal, tables.objects.c.id).where(
    tables.objects.c.keyframe_id == bindparam("of_keyframe")
)


class _MovedError(Exception):
    """The recording is in another map, or its map has another encoder, than when its keyframe was made ready."""


@dataclass(frozen=True, slots=True)
class _Target:
    """What every keyframe of a recording shares."""

    map_id: int
    map_name: str
    model_ids: Mapping[ModelInfo, int]
    descriptor_dtype: str  # of its last keyframe, "float32" where it has none


@dataclass(frozen=True, slots=True)
class _Rows:
    """The rows of a keyframe, encoded outside of the transaction, without the ids that it will get."""

    keyframe: dict[str, Any]
    image: dict[str, Any]
    vector: dict[str, Any]
    objects: list[dict[str, Any]]
    slices: list[dict[str, Any]]  # by ordinal
    categories: list[dict[str, Any]]
    keypoints: dict[str, Any]
    descriptors: dict[str, Any]
    quality: dict[str, Any] | None


class KeyframeWriter:
    """Writes keyframes. Remembers what recordings share, so one long-lived writer is faster than many."""

    def __init__(self, engine: Engine, ids: SharedIds) -> None:
        self._engine = engine
        self._ids = ids
        self._targets: dict[int, _Target] = {}

    def forget(self) -> None:
        """Forget what was remembered: recordings may have been deleted."""
        self._targets = {}
        self._ids.forget()

    def write(self, recording_id: int, record: KeyframeRecord, claimed: Claim | None = None) -> WriteResult:
        """Store one planned keyframe; a keyframe that is there stays as it is.

        With `claimed` only while that claim holds: LeaseLostError when it does not, and nothing is written.
        Raises ProvenanceError for other models than the map's, NotFoundError without such a recording, UsageError
        for a frame that is not in its plan or a description that contradicts itself, UnstorableError for a value that
        the database will never take, DatabaseError when it gives up.
        """
        _check_description(record.description)
        failure: IntegrityError | None = None
        for _ in range(3):
            target = self._target(recording_id)
            check_models(target.model_ids, record.description.models, f"the map {target.map_name!r}")
            rows = self._encode(target, record)
            try:
                work = partial(_write, target=target, recording_id=recording_id, rows=rows, claimed=claimed)
                return retry.write(self._engine, work)
            except _MovedError:
                self.forget()  # the recording is in another map, or described by another encoder, by now
            except IntegrityError as error:
                # Another writer stored the same keyframe, or a row that was remembered has been deleted.
                failure = error
                self.forget()
        raise UnstorableError(
            f"frame {record.frame_index} of the recording {recording_id} could not be stored "
            f"({failure or 'the recording moved from map to map'})"
        ) from failure

    def _target(self, recording_id: int) -> _Target:
        known = self._targets.get(recording_id)
        if known is not None:
            return known

        def work(connection: Connection) -> _Target:
            query = (
                select(tables.maps.c.id, tables.maps.c.name, tables.recordings.c.state)
                .join(tables.recordings, tables.recordings.c.map_id == tables.maps.c.id)
                .where(tables.recordings.c.id == recording_id)
            )
            row = connection.execute(query).one_or_none()
            if row is None or row.state == RecordingState.DELETING:
                raise _no_recording(recording_id)
            if row.state == RecordingState.PLANNED:
                change = update(tables.recordings).where(tables.recordings.c.id == recording_id)
                connection.execute(change.values(state=RecordingState.INGESTING.value))
            models = map_model_ids(connection, row.id)
            return _Target(row.id, row.name, models, descriptor_dtype_of(connection, row.id))

        target = retry.write(self._engine, work)
        self._targets[recording_id] = target
        return target

    def _encode(self, target: _Target, record: KeyframeRecord) -> _Rows:
        description = record.description
        by_role = {info.role: model_id for info, model_id in target.model_ids.items()}
        names = {*(d.category for d in description.detections), *(item[0] for item in description.evidence)}
        category_ids = self._ids.categories(names)
        index = description.keypoints.object_index
        ordinals = np.arange(len(description.detections))
        starts = np.searchsorted(_sort_key(index), ordinals, side="left")
        ends = np.searchsorted(_sort_key(index), ordinals, side="right")
        keyframe = {
            "frame_index": record.frame_index,
            "timestamp_ns": record.timestamp_ns,
            "camera_id": self._ids.camera(record.camera),
            **pose_columns(record.world_from_camera),
        }
        points = description.keypoints.points
        dtype = target.descriptor_dtype if record.descriptor_dtype == "auto" else record.descriptor_dtype
        features, described = {"model_id": by_role["features"]}, description.keypoints.features.descriptors
        return _Rows(
            keyframe=keyframe,
            image=_image_row(record),
            vector={
                "model_id": by_role["encoder"],
                "vector": encode_array(description.cnn_vector.astype(np.float32, copy=False)),
            },
            objects=_object_rows(description, category_ids, by_role["detector"]),
            slices=[
                {**features, "start": int(start), "count": int(end - start)}
                for start, end in zip(starts, ends, strict=True)
            ],
            categories=_category_rows(description, category_ids, by_role["detector"], target.map_id),
            keypoints={
                **features,
                "count": len(description.keypoints),
                "count_3d": int(np.isfinite(points).all(axis=1).sum()),
                "data": encode_keypoints(description.keypoints, small=dtype != "float32"),
            },
            descriptors={**features, "data": encode_descriptors(described, dtype)},
            quality=None if record.quality is None else asdict(record.quality),
        )


def _sort_key(object_index: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    """`object_index` with the background (-1) after all objects, as keypoints are sorted."""
    return np.where(object_index < 0, np.iinfo(np.int32).max, object_index)


def _check_description(description: Description) -> None:
    index = description.keypoints.object_index
    key = _sort_key(index)
    if (np.diff(key) < 0).any():
        raise UsageError("the keypoints of a description are sorted by object, the background last; these are not")
    if len(index) and index.max() >= len(description.detections):
        raise UsageError(f"a keypoint lies on object {index.max()} of {len(description.detections)}")
    if len(description.geometry) != len(description.detections):
        raise UsageError("a description has one geometry per detection")
    for detection in description.detections:
        if not np.isfinite([detection.score, *detection.box]).all():
            raise UsageError(
                f"score and box of an object are finite numbers; those of a {detection.category!r} are not"
            )
    if description.cnn_vector.ndim != 1 or not np.isfinite(description.cnn_vector).all():
        raise UsageError("the CNN vector of a description is one finite row")


def descriptor_dtype_of(connection: Connection, map_id: int) -> str:
    """How descriptors of float are stored in a map: as in its last keyframe, whole in a new map."""
    k, r, d = tables.keyframes.c, tables.recordings.c, tables.descriptors.c
    query = select(func.substr(d.data, 1, HEAD)).join(tables.keyframes, k.id == d.keyframe_id)
    query = query.join(tables.recordings, r.id == k.recording_id).where(r.map_id == map_id)
    head = connection.execute(query.order_by(k.id.desc()).limit(1)).scalar()
    if head is not None:
        return dtype_of(bytes(head))
    return "float32"


def _image_row(record: KeyframeRecord) -> dict[str, Any]:
    return {
        "rgb_format": image_format(record.image_bytes),
        "depth_format": image_format(record.depth_bytes),
        "depth_scale": None if record.depth_scale is None else float(record.depth_scale),
        "depth_registration": record.depth_registration,
        "rgb_bytes": len(record.image_bytes),
        "depth_bytes": len(record.depth_bytes or b""),
        "rgb": record.image_bytes,
        "depth": record.depth_bytes,
    }


def _object_rows(description: Description, category_ids: Mapping[str, int], model_id: int) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    pairs = zip(description.detections, description.geometry, strict=True)
    for ordinal, (detection, geometry) in enumerate(pairs):
        row: dict[str, Any] = {
            "ordinal": ordinal,
            "category_id": category_ids[detection.category],
            "model_id": model_id,
            "score": float(detection.score),
            "pixel_area": int(geometry.pixel_area),
            "mask": encode_mask(detection.mask),
        }
        row.update(zip(("x1", "y1", "x2", "y2"), (float(v) for v in detection.box), strict=True))
        for name in ("centroid", "extent"):
            for axis, value in zip("xyz", getattr(geometry, name), strict=True):
                row[f"{name}_{axis}"] = float(value) if np.isfinite(value) else None
        rows.append(row)
    return rows


def _category_rows(
    description: Description, category_ids: Mapping[str, int], model_id: int, map_id: int
) -> list[dict[str, Any]]:
    counts, found = description.category_counts, strengths(description.evidence)
    held = sum(sum(pair) for pair in found.values())
    return [
        {
            "category_id": category_ids[name],
            "model_id": model_id,
            "map_id": map_id,
            "count": counts.get(name, 0),
            **dict(zip(STRENGTH_COLUMNS, (*found.get(name, (0, 0)), held), strict=True)),
        }
        for name in sorted({*counts, *found})
    ]


def _write(
    connection: Connection, target: _Target, recording_id: int, rows: _Rows, claimed: Claim | None
) -> WriteResult:
    frame_index = rows.keyframe["frame_index"]
    # First, so that whoever comes second to the same keyframe waits here, before anything large is sent.
    taken = _take(connection, recording_id, frame_index, claimed)
    if not taken:
        keyframes, items = tables.keyframes.c, tables.ingest_items.c
        there = select(keyframes.id).where(keyframes.recording_id == recording_id, keyframes.frame_index == frame_index)
        keyframe_id = connection.execute(there).scalar()
        if keyframe_id is not None:
            own = select(items.attempts).where(items.recording_id == recording_id, items.frame_index == frame_index)
            # A commit whose answer was lost is run again: then what is there is what this claim stored.
            mine = claimed is not None and connection.execute(own).scalar() == claimed.token
            return WriteResult(int(keyframe_id), created=mine)
        _refuse(connection, recording_id, frame_index)
    place = place_of(connection, recording_id, frame_index)
    if place.map_id != target.map_id or place.encoder not in (None, rows.vector["model_id"]):
        raise _MovedError
    keyframe = {**rows.keyframe, "recording_id": recording_id, **place.moved(rows.keyframe)}
    keyframe_id = new_id(connection, tables.keyframes, keyframe)
    _write_children(connection, keyframe_id, rows)
    if (covariance := place.covariance(frame_index)) is not None:
        connection.execute(insert(tables.pose_covariances), {"keyframe_id": keyframe_id, "data": covariance})
    change = {"map_id": target.map_id, "keyframe_id": keyframe_id, "kind": ChangeKind.ADDED.value}
    connection.execute(insert(tables.keyframe_changes), change)
    return WriteResult(keyframe_id, created=True)


def _take(connection: Connection, recording_id: int, frame_index: int, claimed: Claim | None) -> bool:
    """Marks an item done. False when there is none to be done: stored already, of another claim, or not planned."""
    place = {"of_recording": recording_id, "of_frame": frame_index}
    if claimed is None:
        return connection.execute(_TAKE, place).rowcount == 1
    return connection.execute(_TAKE_CLAIMED, {**place, "of_token": claimed.token}).rowcount == 1


def _refuse(connection: Connection, recording_id: int, frame_index: int) -> NoReturn:
    """Raises the error for a keyframe that may not be written."""
    items = tables.ingest_items.c
    query = select(tables.recordings.c.state).where(tables.recordings.c.id == recording_id)
    if connection.execute(query).scalar() in (None, RecordingState.DELETING.value):
        raise _no_recording(recording_id)
    planned = select(items.state).where(items.recording_id == recording_id, items.frame_index == frame_index)
    if connection.execute(planned).scalar() is None:
        raise UsageError(f"frame {frame_index} is not in the plan of the recording {recording_id}")
    raise LeaseLostError(f"frame {frame_index} of the recording {recording_id} is another worker's by now, or deleted")


def _no_recording(recording_id: int) -> NotFoundError:
    return NotFoundError(f"there is no recording with the id {recording_id}: it was deleted, or never planned")


def _write_children(connection: Connection, keyframe_id: int, rows: _Rows) -> None:
    key = {"keyframe_id": keyframe_id}
    singles: tuple[tuple[Table, dict[str, Any]], ...] = (
        (tables.keyframe_images, rows.image),
        (tables.cnn_vectors, rows.vector),
        (tables.keypoints, rows.keypoints),
        (tables.descriptors, rows.descriptors),
    )
    for table, row in singles:
        _check_size(connection, table, row, rows.keyframe["frame_index"])
        connection.execute(insert(table), {**key, **row})
    if rows.quality is not None:
        connection.execute(insert(tables.keyframe_qualities), {**key, **rows.quality})
    if rows.categories:
        connection.execute(insert(tables.keyframe_categories), [{**key, **row} for row in rows.categories])
    if not rows.objects:
        return
    for row in rows.objects:
        _check_size(connection, tables.objects, row, rows.keyframe["frame_index"], 2)  # written in hexadecimal
    connection.execute(insert(tables.objects), [{**key, **row} for row in rows.objects])
    object_ids = {row.ordinal: row.id for row in connection.execute(_OBJECT_IDS, {"of_keyframe": keyframe_id})}
    slices = [{**row, "object_id": object_ids[ordinal]} for ordinal, row in enumerate(rows.slices)]
    connection.execute(insert(tables.object_features), slices)


def _check_size(connection: Connection, table: Table, row: dict[str, Any], frame_index: int, factor: int = 1) -> None:
    """Raises UnstorableError where the server does not take a row of `factor` bytes for each of its blobs'."""
    size = _STATEMENT_OVERHEAD + sum(factor * len(value) for value in row.values() if isinstance(value, bytes))
    check_packet(connection, size, f"the {table.name} row of frame {frame_index}")
