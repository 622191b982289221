"""JSON of a service as the values that the library answers with, bit for bit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from semdb.database.records import MapInfo, RecordingState, RecordingStatus
from semdb.door.changed import Changes, ComparedLandmark, Crop, LandmarkChange, Visited
from semdb.door.found import Evidence, Found, FoundLandmark, Missing, Viewpoint
from semdb.door.links import KeyframeLink
from semdb.door.tracked import Tracked
from semdb.door.values import Answer, Keyframe, KeyframeContent, SeenObject, frozen
from semdb.errors import UsageError
from semdb.tracking.states import TrackSource, TrackState
from semdb.types import Camera, Candidate, ConsistentPose, Features, FloatArray, Keypoints, ModelInfo, Verdict

Document = Mapping[str, Any]


def floats(value: Any) -> Any:
    """Numbers as float64 that cannot be written to; None for null."""
    return None if value is None else frozen(np.array(value, np.float64))


def real(value: Any) -> float:
    """A number, NaN where JSON has null."""
    return math.nan if value is None else float(value)


def map_of(found: Document) -> MapInfo:
    """A map."""
    return MapInfo(found["id"], found["name"], found["keyframes"], found["recordings"])


def model_of(found: Document) -> ModelInfo:
    """A network or feature."""
    return ModelInfo(found["role"], found["name"], found["sha256"], found["config"])


def recording_of(found: Document) -> RecordingStatus:
    """A recording; `source` is empty where the token may not know it."""
    names = ("map", "name", "format", "frame_count", "keyframes", "objects", "keypoints", "image_bytes", "map_id")
    return RecordingStatus(
        recording_id=found["id"],
        source=found["source"] or "",
        state=RecordingState(found["state"]),
        items=dict(found["items"]),
        **{name: found[name] for name in names},
    )


def camera_of(found: Document) -> Camera:
    """A camera."""
    names = ("width", "height", "fx", "fy", "cx", "cy")
    return Camera(**{name: found[name] for name in names}, distortion=tuple(found["distortion"]))


def keyframe_of(found: Document, content: KeyframeContent) -> Keyframe:
    """A keyframe that asks `content` for what is large."""
    names = ("id", "map", "recording", "frame_index", "timestamp_ns")
    return Keyframe(
        **{name: found[name] for name in names},
        camera=camera_of(found["camera"]),
        world_from_camera=floats(found["world_from_camera"]),
        content=content,
    )


def object_of(found: Document) -> SeenObject:
    """An object of an image."""
    size, packed = (0, 0), b""
    if found.get("mask") is not None:
        height, width = found["mask"]["size"]
        size, packed = (width, height), packed_mask(found["mask"]["counts"], height, width)
    return SeenObject(
        category=found["category"],
        score=found["score"],
        box=frozen(np.array(found["box"], np.float32)),
        position=floats(found["position"]),
        extent=floats(found["extent"]),
        id=found["id"],
        size=size,
        packed=packed,
    )


def packed_mask(counts: Sequence[int], height: int, width: int) -> bytes:
    """COCO's run lengths, down the columns, as eight pixels a byte along the rows."""
    runs = np.array(counts, np.int64)
    columns = np.repeat(np.arange(len(runs)) % 2 == 1, runs)
    return np.packbits(columns.reshape(height, width, order="F")).tobytes()


def answer_of(found: Document, image: str) -> Answer:
    """Where an image was taken; `image` is what it is called here."""
    return Answer(
        image=image,
        verdict=Verdict(found["verdict"]),
        map=found["map"],
        world_from_camera=floats(found["world_from_camera"]),
        covariance=floats(found["covariance"]),
        confidence=real(found["confidence"]),
        inliers=found["inliers"],
        stage=found["stage"],
        reason=found["reason"],
        objects=tuple(object_of(thing) for thing in found["objects"]),
        candidates=tuple(
            Candidate(
                one["keyframe"],
                one["recording"],
                one["frame_index"],
                real(one["class_score"]),
                real(one["cosine"]),
                one["inliers"],
            )
            for one in found["candidates"]
        ),
        others=tuple(ConsistentPose(floats(o["world_from_camera"]), o["inliers"]) for o in found["others"]),
        ranked_share=real(found["ranked_share"]),
        keyframes_matched=found["keyframes_matched"],
        refinements=dict(found["refinements"]),
        timing_ms={name: real(value) for name, value in found["timing_ms"].items()},
        frame_index=found["frame_index"],
        timestamp_ns=found["timestamp_ns"],
    )


def tracked_of(found: Document, name: str) -> Tracked:
    """Where a moving camera is; `name` is what the image is called here."""
    plain = ("time_s", "map", "inliers", "reason", "latency_ms", "confidence", "frame_index", "timestamp_ns")
    return Tracked(
        **{field: found[field] for field in plain},
        image=name,
        state=TrackState(found["state"]),
        source=TrackSource(found["source"]),
        world_from_camera=floats(found["world_from_camera"]),
        covariance=floats(found["covariance"]),
        map_from_odom=floats(found["map_from_odom_matrix"]),
        smoothed=found["smoothed"],
    )


def keypoints_of(found: Document) -> tuple[Keypoints, tuple[str, ...]]:
    """Keypoints without descriptors, and the class of each object."""
    count = len(found["x"])
    points = np.array(found["points"], np.float64).astype(np.float32).reshape(count, 3)  # null is NaN
    features = Features(
        xy=np.array([found["x"], found["y"]], np.float32).T.copy(),
        size=np.array(found["size"], np.float32),
        angle=np.array(found["angle"], np.float32),
        response=np.array(found["response"], np.float32),
        laplacian=np.array(found["laplacian"], np.int8),
        descriptors=np.empty((count, 0), np.float32),
    )
    return Keypoints(features, np.array(found["object_index"], np.int32), points), tuple(found["categories"])


def link_of(found: Document) -> KeyframeLink:
    """What ties two keyframes together."""
    names = (
        *("map", "keyframe", "recording", "frame_index", "other_keyframe", "other_recording", "other_frame_index"),
        *("kind", "state", "inliers", "reason", "provenance"),
    )
    return KeyframeLink(
        **{name: found[name] for name in names},
        off_m=real(found["off_m"]),
        off_deg=real(found["off_deg"]),
        first_from_second=floats(found["first_from_second"]),
        information=floats(found["information"]),
    )


def found_of(found: Document) -> Found:
    """The answer of a search."""
    missing = found["missing"]
    return Found(
        understood=found["understood"],
        hits=tuple(_hit(hit) for hit in found["hits"]),
        missing=None
        if missing is None
        else Missing(missing["reason"], missing["text"], tuple(missing["candidates"]), tuple(missing["usual_places"])),
        statement=_no_statement,
    )


def _no_statement() -> str:
    raise UsageError("the statement of a search is known to semdb.open only: a service does not tell it")


def _hit(hit: Document) -> FoundLandmark:
    last, view = hit["last_seen"], hit["viewpoint"]
    return FoundLandmark(
        landmark_id=hit["landmark"],
        map=hit["map"],
        category=hit["category"],
        probability=hit["probability"],
        position=three_of(hit["position"]),
        covariance=np.array(hit["covariance"], np.float64),
        size=three_of(hit["box"]["size"]),
        yaw=hit["box"]["yaw"],
        state=hit["state"],
        sightings=hit["sightings"],
        keyframes=hit["keyframes"],
        last_recording=last["recording"],
        last_frame_index=last["frame_index"],
        last_keyframe_id=last["keyframe"],
        last_seen_ns=last["timestamp_ns"],
        score=hit["score"],
        parts=hit["parts"],
        distance=hit["distance"],
        evidence=tuple(Evidence(**one) for one in hit["evidence"]),
        viewpoint=None
        if view is None
        else Viewpoint(
            view["keyframe"],
            view["recording"],
            view["frame_index"],
            _pose(view),
            box_of(view["crop"]),
            view["distance"],
        ),
    )


def _pose(view: Document) -> FloatArray:
    return np.array(view["world_from_camera"], np.float64)


def three_of(values: Sequence[float]) -> tuple[float, float, float]:
    """Three numbers."""
    x, y, z = values
    return x, y, z


def box_of(values: Sequence[float]) -> tuple[float, float, float, float]:
    """Four numbers."""
    x1, y1, x2, y2 = values
    return x1, y1, x2, y2


def changes_of(found: Document) -> Changes:
    """What changed between two recordings."""
    before, after = found["between"]
    return Changes(
        map=found["map"],
        before=before,
        after=after,
        changes=tuple(
            LandmarkChange(
                one["kind"],
                one["category"],
                one["landmark"],
                one["other_landmark"],
                one["score"],
                one["distance"],
                _visited(one["before"]),
                _visited(one["after"]),
            )
            for one in found["changes"]
        ),
        landmarks=tuple(
            ComparedLandmark(
                one["landmark"], one["category"], one["state"], _visited(one["before"]), _visited(one["after"])
            )
            for one in found["landmarks"]
        ),
    )


def _visited(found: Document) -> Visited:
    names = ("presence", "keyframes", "points", "seen", "seen_through", "occluded", "missed")
    crop = found["crop"]
    return Visited(
        **{name: found[name] for name in names},
        position=None if found["position"] is None else three_of(found["position"]),
        size=None if found["size"] is None else three_of(found["size"]),
        crop=None if crop is None else Crop(crop["keyframe"], crop["frame_index"], box_of(crop["box"])),
    )
