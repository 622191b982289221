"""JSON of a service about things, queries and jobs as the values that the library answers with, bit for bit."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from typing import Any

import numpy as np

from semdb.client.values import box_of, real, three_of
from semdb.database.jobs import PLANNED, Job
from semdb.database.landmark_reading import StoredLandmark, StoredRelation
from semdb.database.landmark_records import LandmarkVisit
from semdb.database.query_log import LoggedQuery
from semdb.database.scene_reading import StoredSighting
from semdb.localization.coverage import Coverage

Document = Mapping[str, Any]


def landmark_of(found: Document) -> StoredLandmark:
    """A landmark."""
    names = ("id", "category", "probability", "sightings", "keyframes", "missed", "seen_through", "state")
    last = found["last_seen"]
    return StoredLandmark(
        **{name: found[name] for name in names},
        evidence=dict(found["classes"]),
        position=three_of(found["position"]),
        covariance=np.array(found["covariance"], np.float64),
        size=three_of(found["box"]["size"]),
        yaw=found["box"]["yaw"],
        first_seen_ns=found["first_seen_ns"],
        last_seen_ns=last["timestamp_ns"],
        last_recording=last["recording"],
        last_frame_index=last["frame_index"],
    )


def relation_of(found: Document) -> StoredRelation:
    """How a landmark stands to another one."""
    return StoredRelation(found["landmark"], found["kind"], found["other_landmark"], found["score"])


def sighting_of(found: Document) -> StoredSighting:
    """An object that shows a landmark."""
    names = ("ordinal", "recording", "frame_index", "timestamp_ns", "category", "score", "coverage", "visibility")
    return StoredSighting(
        **{name: found[name] for name in names},
        landmark_id=found["landmark"],
        object_id=found["object"],
        keyframe_id=found["keyframe"],
        box=box_of(found["box"]),
    )


def visit_of(found: Document) -> LandmarkVisit:
    """What a recording says of a landmark."""
    names = ("recording", "presence", "keyframes", "points", "seen", "seen_through", "occluded", "missed")
    places: dict[str, Any] = {name: _place(found[name]) for name in ("position", "size")}
    return LandmarkVisit(**{name: found[name] for name in names}, **places)


def coverage_of(found: Document) -> Coverage:
    """What keyframes cover."""
    names = ("map", "keyframes", "radius_m", "near", "nearest_m", "nearest_keyframe")
    places: dict[str, Any] = {name: _place(found[name]) for name in ("position", "low", "high")}
    return Coverage(**{name: found[name] for name in names}, **places, directions=tuple(found["directions"]))


def query_of(found: Document) -> LoggedQuery:
    """A localization of the log."""
    names = ("id", "image", "verdict", "confidence", "inliers", "stage", "reason")
    matrix = found["world_from_camera"]
    return LoggedQuery(
        **{name: found[name] for name in names},
        created_at=_time(found["created_at"]),
        world_from_camera=None if matrix is None else np.array(matrix, np.float64),
        # of the two scores the log has the class score as a number, whatever it is
        candidates=tuple(one | {"class_score": real(one.get("class_score"))} for one in found["candidates"]),
        timing_ms=found["timing_ms"],
    )


def job_of(found: Document) -> Job:
    """A job of a service. Workers that have it are `planned` here, as in the database."""
    state = PLANNED if found["state"] == "working" else found["state"]
    finished = found["finished_at"]
    return Job(
        id=found["job"],
        map=found["map"],
        who="",
        state=state,
        request={"name": found["name"]},
        result=tuple(found["recordings"]),
        error=found["error"],
        attempts=found["attempts"],
        created_at=_time(found["created_at"]),
        finished_at=None if finished is None else _time(finished),
    )


def _place(values: Any) -> tuple[float, float, float] | None:
    return None if values is None else three_of(values)


def _time(text: str) -> datetime:
    """As the database has it: UTC, and it does not say so."""
    return datetime.fromisoformat(text).replace(tzinfo=None)
