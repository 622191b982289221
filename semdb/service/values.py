"""Values of the library as JSON has them: every number with all its digits, so that a client gets the same bits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from semdb.geometry import quat_wxyz_from_rotation
from semdb.types import BoolArray, Camera, FloatArray, Keypoints, ModelInfo

if TYPE_CHECKING:
    from semdb.database.landmark_reading import StoredLandmark, StoredRelation
    from semdb.database.landmark_records import LandmarkVisit
    from semdb.database.query_log import LoggedQuery
    from semdb.database.records import MapInfo, RecordingStatus
    from semdb.database.scene_reading import StoredSighting
    from semdb.door.found import Found
    from semdb.door.links import KeyframeLink
    from semdb.door.tracked import Tracked
    from semdb.door.values import Answer, Keyframe, SeenObject


def camera_dict(camera: Camera) -> dict[str, Any]:
    """Size and intrinsics in pixels, distortion k1, k2, p1, p2[, k3]."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return {name: getattr(camera, name) for name in names} | {"distortion": list(camera.distortion)}


def pose_dict(pose: FloatArray) -> dict[str, Any]:
    """``world_from_camera`` ``[4, 4]`` as position and quaternion."""
    return {"position": pose[:3, 3].tolist(), "quat_wxyz": quat_wxyz_from_rotation(pose[:3, :3]).tolist()}


def map_dict(info: MapInfo) -> dict[str, Any]:
    """A map as lists have it."""
    return {"name": info.name, "id": info.id, "keyframes": info.keyframes, "recordings": info.recordings}


def model_dict(model: ModelInfo) -> dict[str, Any]:
    """A network or feature."""
    return {"role": model.role, "name": model.name, "sha256": model.sha256, "config": model.config}


def recording_dict(found: RecordingStatus, *, with_source: bool) -> dict[str, Any]:
    """A recording; where it lies is only for those who may know."""
    return {
        "id": found.recording_id,
        "map": found.map,
        "map_id": found.map_id,
        "name": found.name,
        "format": found.format,
        "source": found.source if with_source else None,
        "state": str(found.state),
        "frame_count": found.frame_count,
        "items": {str(state): count for state, count in found.items.items()},
        "keyframes": found.keyframes,
        "objects": found.objects,
        "keypoints": found.keypoints,
        "image_bytes": found.image_bytes,
    }


def keyframe_dict(found: Keyframe) -> dict[str, Any]:
    """A keyframe without what is large."""
    return {
        "id": found.id,
        "map": found.map,
        "recording": found.recording,
        "frame_index": found.frame_index,
        "timestamp_ns": found.timestamp_ns,
        "camera": camera_dict(found.camera),
        "pose": pose_dict(found.world_from_camera),
        "world_from_camera": found.world_from_camera.tolist(),
    }


def object_dict(thing: SeenObject, *, mask: bool = False) -> dict[str, Any]:
    """An object of an image; with `mask` its pixels as COCO's run lengths."""
    found: dict[str, Any] = {
        "id": thing.id,
        "category": thing.category,
        "score": thing.score,
        "box": [float(value) for value in thing.box],
        "position": None if thing.position is None else thing.position.tolist(),
        "extent": None if thing.extent is None else [float(value) for value in thing.extent],
    }
    if mask:
        found["mask"] = run_lengths(thing.mask)
    return found


def run_lengths(mask: BoolArray) -> dict[str, Any]:
    """A mask ``[H, W]`` as COCO's uncompressed RLE: column by column, the first count is of what is outside."""
    flat = mask.ravel(order="F")
    edges = np.flatnonzero(flat[1:] != flat[:-1]) + 1
    ends = np.concatenate([edges, [flat.size]]) if flat.size else np.zeros(0, np.int64)
    counts = np.diff(ends, prepend=0).tolist()
    if flat.size and flat[0]:
        counts.insert(0, 0)
    return {"size": list(mask.shape), "counts": counts}


def mask_of(lengths: dict[str, Any]) -> BoolArray:
    """The mask ``[H, W]`` of `run_lengths`."""
    counts = np.array(lengths["counts"], np.int64)
    values = np.arange(len(counts)) % 2 == 1
    return np.repeat(values, counts).reshape(lengths["size"], order="F")


def answer_dict(answer: Answer, *, masks: bool = False, notes: Sequence[str] = ()) -> dict[str, Any]:
    """What ``semdb localize --json`` prints for an image, with the pose as a matrix, objects, and what was assumed."""
    pose = answer.world_from_camera
    return {
        **answer.as_dict(),
        "world_from_camera": None if pose is None else pose.tolist(),
        "others": [
            {"world_from_camera": other.world_from_camera.tolist(), "inliers": other.inliers} for other in answer.others
        ],
        "objects": [object_dict(thing, mask=masks) for thing in answer.objects],
        "notes": list(notes),
    }


def matches_dict(answer: Answer) -> dict[str, Any] | None:
    """Which pixels of an image match which of the best keyframe; None where none was matched."""
    found = answer.matches
    if found is None:
        return None
    return {
        "keyframe": found.keyframe_id,
        "query_xy": np.round(found.query_xy, 2).tolist(),
        "keyframe_xy": np.round(found.keyframe_xy, 2).tolist(),
    }


def tracked_dict(answer: Tracked, *, notes: Sequence[str] = ()) -> dict[str, Any]:
    """What ``semdb track --json-lines`` prints for a frame, with poses as matrices, too, and what was assumed."""
    pose, corrected = answer.world_from_camera, answer.map_from_odom
    return {
        **answer.as_dict(),
        "world_from_camera": None if pose is None else pose.tolist(),
        "map_from_odom_matrix": None if corrected is None else corrected.tolist(),
        "notes": list(notes),
    }


def keypoints_dict(keypoints: Keypoints, categories: Sequence[str]) -> dict[str, Any]:
    """Keypoints column by column, points in metres in the camera's frame, null where there is none."""
    features = keypoints.features
    return {
        "categories": list(categories),
        "x": features.xy[:, 0].tolist(),
        "y": features.xy[:, 1].tolist(),
        "size": features.size.tolist(),
        "angle": features.angle.tolist(),
        "response": features.response.tolist(),
        "laplacian": features.laplacian.tolist(),
        "object_index": keypoints.object_index.tolist(),
        "points": keypoints.points.tolist(),
    }


def landmark_dict(found: StoredLandmark, map_name: str) -> dict[str, Any]:
    """A landmark; `yaw` about the map's up."""
    return {
        "id": found.id,
        "map": map_name,
        "category": found.category,
        "probability": found.probability,
        "classes": dict(found.evidence),
        "position": list(found.position),
        "covariance": found.covariance.tolist(),
        "box": {"size": list(found.size), "yaw": found.yaw},
        "state": found.state,
        "sightings": found.sightings,
        "keyframes": found.keyframes,
        "missed": found.missed,
        "seen_through": found.seen_through,
        "first_seen_ns": found.first_seen_ns,
        "last_seen": {
            "recording": found.last_recording,
            "frame_index": found.last_frame_index,
            "timestamp_ns": found.last_seen_ns,
        },
    }


def found_dict(found: Found) -> dict[str, Any]:
    """What ``semdb find --json`` prints, with the poses of viewpoints as matrices, too."""
    content = found.as_dict()
    for shown, hit in zip(content["hits"], found.hits, strict=True):
        if hit.viewpoint is not None:
            shown["viewpoint"]["world_from_camera"] = hit.viewpoint.world_from_camera.tolist()
    return content


def relation_dict(found: StoredRelation) -> dict[str, Any]:
    """How a landmark stands to another one."""
    return {
        "landmark": found.landmark_id,
        "kind": found.kind,
        "other_landmark": found.other_landmark_id,
        "score": found.score,
    }


def sighting_dict(found: StoredSighting) -> dict[str, Any]:
    """An object that shows a landmark."""
    return {
        "landmark": found.landmark_id,
        "object": found.object_id,
        "ordinal": found.ordinal,
        "keyframe": found.keyframe_id,
        "recording": found.recording,
        "frame_index": found.frame_index,
        "timestamp_ns": found.timestamp_ns,
        "category": found.category,
        "score": found.score,
        "box": list(found.box),
        "coverage": found.coverage,
        "visibility": found.visibility,
    }


def visit_dict(found: LandmarkVisit) -> dict[str, Any]:
    """What a recording says of a landmark."""
    counts = ("keyframes", "points", "seen", "seen_through", "occluded", "missed")
    names = ("recording", "presence", *counts, "position", "size")
    return {name: getattr(found, name) for name in names}


def link_dict(found: KeyframeLink) -> dict[str, Any]:
    """What ties two keyframes together."""
    names = (
        *("map", "keyframe", "recording", "frame_index", "other_keyframe", "other_recording", "other_frame_index"),
        *("kind", "state", "inliers", "off_m", "off_deg", "reason", "provenance"),
    )
    return {name: getattr(found, name) for name in names} | {
        "first_from_second": found.first_from_second.tolist(),
        "information": found.information.tolist(),
    }


def query_dict(found: LoggedQuery, *, with_path: bool) -> dict[str, Any]:
    """A localization that was logged."""
    pose = found.world_from_camera
    return {
        "id": found.id,
        "created_at": f"{found.created_at.isoformat()}Z",
        "image": found.image if with_path else found.image.rpartition("/")[2],
        "verdict": found.verdict,
        "pose": None if pose is None else pose_dict(pose),
        "world_from_camera": None if pose is None else pose.tolist(),
        "confidence": found.confidence,
        "inliers": found.inliers,
        "stage": found.stage,
        "reason": found.reason,
        "candidates": list(found.candidates),
        "timing_ms": found.timing_ms,
    }
