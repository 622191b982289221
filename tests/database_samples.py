"""Made-up but consistent descriptions and keyframes for tests of the database, from a seed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from sqlalchemy import select

from semdb.database import landmark_tables, retry, tables
from semdb.database.ids import SharedIds
from semdb.database.landmark_records import (
    GravityRow,
    LandmarkRelation,
    LandmarkRow,
    LandmarkSet,
    LandmarkSighting,
    LandmarkView,
    LandmarkVisit,
)
from semdb.database.landmark_rows import replace_landmarks
from semdb.database.records import KeyframeRecord, RecordingPlan
from semdb.database.store import Store
from semdb.geometry import pose_from, so3_exp
from semdb.landmarks.identity import keep_ids
from semdb.types import (
    Camera,
    Description,
    Detection,
    Features,
    Keypoints,
    ModelInfo,
    ObjectGeometry,
)

CAMERA = Camera(64, 48, 52.5, 52.25, 31.5, 23.5)
DISTORTED = Camera(64, 48, 51.7, 51.6, 31.8, 25.5, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633))
MODELS = (
    ModelInfo("detector", "recorded", "", '{"score_threshold": 0.5}'),
    ModelInfo("encoder", "gist", "", "{}"),
    ModelInfo("features", "surf", "", '{"max_keypoints": 1500}'),
)
OTHER_MODELS = (MODELS[0], ModelInfo("encoder", "onnx:resnet50.onnx", "ab" * 32, "{}"), MODELS[2])
CATEGORIES = ("chair", "cup", "laptop", "tv", "person", "potted plant")
PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8\xff\xe0"


def description(
    seed: int,
    categories: Sequence[str] | None = None,
    *,
    keypoints: int = 60,
    vector_size: int = 128,
    models: tuple[ModelInfo, ...] = MODELS,
    camera: Camera = CAMERA,
    binary: bool = False,
) -> Description:
    """A description with objects of `categories` (a few at random when None) and keypoints on and off them."""
    rng = np.random.default_rng(seed)
    if categories is None:
        categories = [str(name) for name in rng.choice(CATEGORIES, size=int(rng.integers(1, 5)))]
    detections, geometry = [], []
    for category in categories:
        x1, y1 = int(rng.integers(0, 40)), int(rng.integers(0, 30))
        x2, y2 = x1 + int(rng.integers(3, 20)), y1 + int(rng.integers(3, 15))
        mask = np.zeros((camera.height, camera.width), dtype=np.bool_)
        mask[y1 : y2 + 1, x1 : x2 + 1] = rng.random((y2 - y1 + 1, x2 - x1 + 1)) < 0.9
        detections.append(Detection(category, float(rng.uniform(0.5, 1)), np.array([x1, y1, x2, y2], np.float32), mask))
        centroid = rng.uniform([-1, -1, 1], [1, 1, 4]) if rng.random() < 0.85 else np.full(3, np.nan)
        extent = rng.uniform(0.1, 1, 3) if np.isfinite(centroid).all() else np.full(3, np.nan)
        geometry.append(ObjectGeometry(int(mask.sum()), centroid, extent))
    object_index = np.sort(rng.integers(0, len(categories) + 2, keypoints)).astype(np.int32)
    object_index[object_index >= len(categories)] = -1
    points = rng.uniform(-2, 4, (keypoints, 3)).astype(np.float32)
    points[rng.random(keypoints) < 0.2] = np.nan
    if binary:
        descriptors = rng.integers(0, 256, (keypoints, 32), dtype=np.uint8)
    else:
        descriptors = rng.normal(size=(keypoints, 64)).astype(np.float32)
    features = Features(
        xy=rng.uniform(0, 48, (keypoints, 2)).astype(np.float32),
        size=rng.uniform(5, 40, keypoints).astype(np.float32),
        angle=rng.uniform(0, 360, keypoints).astype(np.float32),
        response=rng.uniform(0, 1, keypoints).astype(np.float32),
        laplacian=rng.choice([-1, 1], keypoints).astype(np.int8),
        descriptors=descriptors,
    )
    vector = rng.normal(size=vector_size).astype(np.float32)
    vector /= np.linalg.norm(vector)
    return Description(
        camera, tuple(detections), tuple(geometry), Keypoints(features, object_index, points), vector, models
    )


def pose(seed: int) -> np.ndarray:
    """A pose within a few metres."""
    rng = np.random.default_rng(seed + 1_000_000)
    return pose_from(so3_exp(rng.normal(size=3)), rng.uniform(-3, 3, 3))


def record(frame_index: int, described: Description, *, depth: bool = True, image_size: int = 400) -> KeyframeRecord:
    """A keyframe with pictures that begin as PNG and JPEG files do."""
    rng = np.random.default_rng(frame_index)
    return KeyframeRecord(
        frame_index=frame_index,
        timestamp_ns=None if frame_index == 0 else 1_305_031_229_528_748_000 + frame_index * 33_333_333,
        camera=described.camera,
        world_from_camera=pose(frame_index),
        image_bytes=(PNG if frame_index % 2 else JPEG) + rng.bytes(image_size),
        depth_bytes=PNG + rng.bytes(image_size) if depth else None,
        depth_scale=5000.0 if depth else None,
        depth_registration="7scenes" if depth and frame_index % 2 else "",
        description=described,
    )


def plan(name: str, frame_indexes: Sequence[int], *, fingerprint: str = "f" * 64, frames: int = 100) -> RecordingPlan:
    return RecordingPlan(name, "tum", f"recordings/{name}", frames, fingerprint, tuple(frame_indexes))


def fill(
    store: Store,
    map_name: str = "room",
    name: str = "first visit",
    frame_indexes: Sequence[int] = (0, 3, 7, 12, 20),
    *,
    seed: int = 0,
) -> tuple[int, int, list[int]]:
    """Ingest a made-up recording. Returns the ids of map, recording and keyframes."""
    map_id = store.ensure_map(map_name)
    planned = store.plan_recording(map_id, plan(name, frame_indexes), MODELS)
    ids = [
        store.write_keyframe(planned.recording_id, record(index, description(seed + index))).keyframe_id
        for index in planned.pending
    ]
    store.finish_recording(planned.recording_id)
    return map_id, planned.recording_id, ids


def stored_landmarks(store: Store, map_id: int) -> list[int]:
    """A table with a cup on it and a chair beside it, a sink with a cup, a banana, and a book on the floor.

    Returns their ids. Sightings are the objects of the map's first keyframes, as far as they go.
    """
    things = [
        ("dining table", (2.0, 1.0, 0.4), (1.6, 0.9, 0.75)),
        ("cup", (2.2, 1.1, 0.82), (0.1, 0.1, 0.1)),
        ("chair", (1.0, 1.0, 0.45), (0.4, 0.4, 0.9)),
        ("sink", (-2.0, 0.0, 0.9), (0.6, 0.5, 0.2)),
        ("cup", (-1.8, 0.3, 0.95), (0.1, 0.1, 0.1)),
        ("banana", (2.4, 0.9, 0.8), (0.2, 0.05, 0.04)),
        ("book", (0.0, -1.0, 0.02), (0.2, 0.15, 0.03)),
    ]
    SharedIds(store.engine).categories([*(name for name, *_ in things), "vase"])
    query = select(tables.objects.c.id, tables.objects.c.keyframe_id)
    query = query.select_from(tables.objects.join(tables.keyframes).join(tables.recordings))
    query = query.where(tables.recordings.c.map_id == map_id).order_by(tables.objects.c.id)
    with store.engine.connect() as connection:
        seen = [(int(row.id), int(row.keyframe_id)) for row in connection.execute(query)]
    rows = []
    for number, (name, position, size) in enumerate(things):
        mine = seen[number :: len(things)]
        rows.append(
            LandmarkRow(
                *(name, 0.97, {name: 0.97, "vase": 0.03}, position, np.eye(3) * 1e-4, size, 0.1),
                *(max(len(mine), 1), 1, 0, "confirmed", seen[0][1], seen[-1][1], 10**9 * number, 10**9 * (number + 5)),
                tuple(LandmarkSighting(key, 0.9, 0.8) for key, _ in mine),
                tuple(LandmarkView(key, 0.7, 1.5) for key, _ in mine[:3]),
                (
                    LandmarkVisit("first visit", "present", 1, 0, 0, 0, 0, 0, position, size),
                    LandmarkVisit(
                        "second visit", "absent" if name == "book" else "unobserved", 0, 9, 0, 9, 0, 0, None, None
                    ),
                ),
                perhaps={"vase": 0.03},
            )
        )
    relations = [
        (1, "on", 0, 0.98),
        (2, "next_to", 0, 0.9),
        (4, "near", 3, 0.8),
        (3, "near", 4, 0.8),
        (5, "on", 0, 0.9),
    ]
    found = LandmarkSet(
        tuple(rows),
        tuple(LandmarkRelation(*relation) for relation in relations),
        GravityRow((0.0, 0.0, 1.0), 0.9, 0.0, 0.8, given=False),
    )
    written = retry.write(store.engine, lambda connection: replace_landmarks(connection, map_id, found, keep_ids))
    assert written == len(things)
    with store.engine.connect() as connection:
        return list(
            connection.execute(
                select(landmark_tables.landmarks.c.id).order_by(landmark_tables.landmarks.c.id)
            ).scalars()
        )
