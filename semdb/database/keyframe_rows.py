"""Rows of one keyframe as a value: every column is looked at, and counts are compared with each other and the image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.database import checked
from semdb.database.codecs import decode_descriptors, decode_keypoints, keypoint_rows
from semdb.database.columns import POSE_COLUMNS
from semdb.database.records import KeyframeHead, StoredKeyframe, StoredObject
from semdb.errors import CodecError, UsageError
from semdb.geometry import (
    FARTHEST_POSE_M,
    pose_from,
    quat_wxyz_from_rotation,
    rotation_from_quat_wxyz,
    rotations_from_quats_wxyz,
)
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, IntArray, ObjectGeometry

MOST_OBJECTS = 10_000
FARTHEST_POINT_M = 1e6  # of a 3D point from its camera
OUTSIDE = 2.0  # pixels that a keypoint may lie outside of the image
WIDEST = 4096  # numbers of a descriptor


@dataclass(slots=True)
class KeyframeRows:
    """What the database has of some keyframes, by id."""

    frames: dict[int, Any] = field(default_factory=dict)
    objects: dict[int, list[Any]] = field(default_factory=dict)  # by ordinal
    keypoints: dict[int, Any] = field(default_factory=dict)
    descriptors: dict[int, Any] | None = None  # None: they are not wanted


def keyframe_of(rows: KeyframeRows, key: int) -> StoredKeyframe:
    """One keyframe. Raises CodecError, which names table and key, for what semdb cannot have written."""
    row, where = rows.frames[key], f"keyframe {key}"
    head = head_of(row)
    camera = head.camera
    for table, known in (("keypoints", rows.keypoints), ("descriptors", rows.descriptors)):
        if known is not None and key not in known:
            raise CodecError(f"{table} has no row of {where}")
    blob = checked.blob(rows.keypoints[key].data, f"keypoints.data of {where}")
    packed = keypoint_rows(blob, f"keypoints.data of {where}")
    _check_keypoints(packed, rows.keypoints[key], camera, where)
    described = None if rows.descriptors is None else _descriptors(rows.descriptors[key], len(packed), where)
    objects = rows.objects.get(key, [])
    return StoredKeyframe(
        id=row.id,
        map_id=row.map_id,
        recording_id=row.recording_id,
        recording=head.recording,
        frame_index=head.frame_index,
        timestamp_ns=head.timestamp_ns,
        camera=camera,
        world_from_camera=head.world_from_camera,
        objects=tuple(_object(item, ordinal, camera, where) for ordinal, item in enumerate(objects)),
        keypoints=decode_keypoints(
            blob, described, _object_index(objects, len(packed), where), f"keypoints of {where}"
        ),
    )


def head_of(row: Any, known: Camera | None = None, pose: FloatArray | None = None) -> KeyframeHead:
    """A keyframe without what is large: the columns of `keyframes` and `cameras`, names of recording and map.

    Its camera and `pose` ``[4, 4]`` where they are known already. Raises CodecError.
    """
    where = f"keyframe {row.id}"
    time = row.timestamp_ns
    limits = (-(2**63), 2**63 - 1)
    return KeyframeHead(
        id=row.id,
        map=checked.text(row.map, f"maps.name of map {row.map_id}"),
        recording=checked.text(row.recording, f"recordings.name of recording {row.recording_id}"),
        frame_index=checked.integer(row.frame_index, f"keyframes.frame_index of {where}"),
        timestamp_ns=None if time is None else checked.integer(time, f"keyframes.timestamp_ns of {where}", *limits),
        camera=checked.camera(row, f"camera {row.camera_id} ({where})") if known is None else known,
        world_from_camera=pose_of([getattr(row, name) for name in POSE_COLUMNS], where) if pose is None else pose,
    )


def heads_of(rows: Sequence[Any], damaged: Callable[[int, CodecError], None]) -> list[KeyframeHead]:
    """`head_of` many rows, whose cameras are few; those that are damaged are told."""
    numbers = [[getattr(row, name) for name in POSE_COLUMNS] for row in rows]
    usable, matrices = usable_poses(numbers)
    poses, cameras = dict(zip(np.flatnonzero(usable).tolist(), matrices, strict=True)), dict[int, Camera]()
    found = []
    for place, row in enumerate(rows):
        try:
            head = head_of(row, cameras.get(row.camera_id), poses.get(place))
        except CodecError as error:
            damaged(row.id, error)
            continue
        cameras.setdefault(row.camera_id, head.camera)
        found.append(head)
    return found


def usable_poses(rows: Sequence[Sequence[Any]]) -> tuple[BoolArray, FloatArray]:
    """Which rows of the columns `POSE_COLUMNS` are poses, ``[n]``, and these ``[m, 4, 4]``."""
    numbers = checked.numbers_of(rows, len(POSE_COLUMNS))
    usable = checked.are_poses(numbers)
    numbers = numbers[usable]
    matrices = np.zeros((len(numbers), 4, 4))
    matrices[:, :3, :3] = rotations_from_quats_wxyz(numbers[:, :4])
    matrices[:, :3, 3] = numbers[:, 4:]
    matrices[:, 3, 3] = 1.0
    return usable, matrices


def pose_of(values: Sequence[Any], where: str) -> FloatArray:
    """The pose ``[4, 4]`` of the columns `POSE_COLUMNS`. Raises CodecError."""
    numbers = checked.pose_numbers(values, where)
    return pose_from(rotation_from_quat_wxyz(numbers[:4]), numbers[4:])


def pose_columns(world_from_camera: FloatArray) -> dict[str, float]:
    """The columns qw, qx, qy, qz, tx, ty, tz of a pose ``[4, 4]``. Raises UsageError for what is none."""
    if world_from_camera.shape != (4, 4) or not np.isfinite(world_from_camera).all():
        raise UsageError("a keyframe needs a finite 4x4 pose")
    if np.abs(world_from_camera[:3, 3]).max() > FARTHEST_POSE_M:
        raise UsageError(f"a keyframe is at most {FARTHEST_POSE_M:g} m from the origin of its map")
    numbers = [*quat_wxyz_from_rotation(world_from_camera[:3, :3]), *world_from_camera[:3, 3]]
    return dict(zip(POSE_COLUMNS, map(float, numbers), strict=True))


def _check_keypoints(packed: Float32Array, row: Any, camera: Camera, where: str) -> None:
    count = checked.integer(row._mapping["count"], f"keypoints.count of {where}")  # also a method of a row
    if count != len(packed):
        raise CodecError(f"keypoints.count of {where} is {count}, but {len(packed)} are stored")
    x, y, rest, points = packed[:, 0], packed[:, 1], packed[:, 2:6], packed[:, 6:]
    inside = (x >= -OUTSIDE) & (x < camera.width + OUTSIDE) & (y >= -OUTSIDE) & (y < camera.height + OUTSIDE)
    if not inside.all():
        number = int(np.flatnonzero(~inside)[0])
        raise CodecError(
            f"keypoints.data of {where}: keypoint {number} is at ({x[number]:g}, {y[number]:g}), outside of its image "
            f"of {camera.width}x{camera.height}"
        )
    if not np.isfinite(rest).all() or (rest[:, 0] < 0).any() or (np.abs(rest[:, 3]) > 1).any():
        raise CodecError(f"keypoints.data of {where}: a size, angle, response or sign is no number")
    if np.isinf(points).any() or (np.abs(points[~np.isnan(points)]) > FARTHEST_POINT_M).any():
        raise CodecError(f"keypoints.data of {where}: a 3D point is more than {FARTHEST_POINT_M:g} m away")


def _descriptors(row: Any, count: int, where: str) -> npt.NDArray[np.generic]:
    where = f"descriptors.data of {where}"
    found = decode_descriptors(checked.blob(row.data, where), where)
    if found.shape[1] > WIDEST:
        raise CodecError(f"{where}: {found.dtype} {list(found.shape)} are no descriptors")
    if len(found) != count:
        raise CodecError(f"{where}: {len(found)} descriptors for {count} keypoints")
    if found.dtype in (np.float32, np.float16) and not np.isfinite(found).all():
        raise CodecError(f"{where}: a descriptor is not finite")
    return found


def _object_index(objects: Sequence[Any], count: int, where: str) -> IntArray:
    """The object of each keypoint ``[n]``, -1 for none."""
    if len(objects) > MOST_OBJECTS:
        raise CodecError(f"objects of {where}: {len(objects)} are more than any detector sees")
    found = np.full(count, -1, dtype=np.int32)
    end = 0
    for ordinal, item in enumerate(objects):
        if item.ordinal != ordinal:
            raise CodecError(f"objects.ordinal of {where}: {ordinal} is expected, not {checked.shown(item.ordinal)}")
        slice_of = f"of object {item.id} ({where})"
        start = checked.integer(item.start, f"object_features.start {slice_of}")
        size = checked.integer(item._mapping["count"], f"object_features.count {slice_of}")
        if size and (start < end or start + size > count):
            raise CodecError(
                f"object_features.start {slice_of}: its keypoints {start} to {start + size} overlap those of another "
                f"object, or are not among {count}"
            )
        found[start : start + size] = ordinal
        end = max(end, start + size) if size else end
    return found


def _object(row: Any, ordinal: int, camera: Camera, where: str) -> StoredObject:
    def name(column: str) -> str:
        return f"objects.{column} of object {row.id} ({where})"

    def place(column: str) -> FloatArray:
        values = [getattr(row, f"{column}_{axis}") for axis in "xyz"]
        if all(value is None for value in values):
            return np.full(3, np.nan)
        limits = (-FARTHEST_POINT_M, FARTHEST_POINT_M)
        numbers = [checked.real(v, name(f"{column}_{a}"), *limits) for v, a in zip(values, "xyz", strict=True)]
        return np.array(numbers, dtype=np.float64)

    widest = float(max(camera.width, camera.height))
    box = [checked.real(getattr(row, side), name(side), -widest, 2 * widest) for side in ("x1", "y1", "x2", "y2")]
    return StoredObject(
        id=row.id,
        ordinal=ordinal,
        category=checked.text(row.name, f"categories.name of category {row.category_id}"),
        score=checked.real(row.score, name("score"), 0.0, 1.0),
        box=np.array(box, dtype=np.float32),
        geometry=ObjectGeometry(
            checked.integer(row.pixel_area, name("pixel_area"), 0, camera.width * camera.height),
            place("centroid"),
            place("extent"),
        ),
    )
