"""Landmarks of a map as a table (CSV), as JSON, or as features with footprints (GeoJSON, in metres of the map)."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from semdb.database.landmark_reading import StoredLandmark, StoredRelation, load_landmarks
from semdb.database.landmark_rows import load_gravity
from semdb.errors import UsageError
from semdb.exchange.source import ExportOptions, MapSource, new_file
from semdb.landmarks.boxes import Box, turned_box
from semdb.types import FloatArray

COLUMNS = (
    *("landmark_id", "category", "probability", "x", "y", "z", "size_x", "size_y", "size_z", "yaw", "state"),
    *("sightings", "keyframes", "missed", "seen_through", "first_seen_ns", "last_seen_ns"),
    *("last_recording", "last_frame_index"),
)


def write_landmarks(source: MapSource, out: Path, options: ExportOptions) -> str:
    """Writes by the ending of `out`: ``.csv``, ``.json`` or ``.geojson``. Raises UsageError for another one."""
    path = new_file(out)
    kind = path.suffix.lower()
    if kind not in (".csv", ".json", ".geojson"):
        raise UsageError(f"{out}: landmarks are written as .csv, .json or .geojson: name the file so")
    things, relations = load_landmarks(source.store.engine, source.map_id, source.store.say)
    if not things:
        raise UsageError(f"the map {source.name!r} has no landmarks: run semdb refine first")
    gravity = load_gravity(source.store.engine, source.map_id)
    up = np.array((0.0, 0.0, 1.0) if gravity is None else gravity.up)
    with path.open("w", encoding="utf-8", newline="") as file:
        if kind == ".csv":
            _csv(file, things)
        else:
            made = _features(things, up) if kind == ".geojson" else _object(things, relations)
            floor = None if gravity is None else gravity.floor
            json.dump({**made, "map": source.name, "up": up.tolist(), "floor": floor}, file, indent=1)
            file.write("\n")
    source.tell("exporting", len(source.heads))
    return f"{len(things)} landmarks, {len(relations)} relations" if kind == ".json" else f"{len(things)} landmarks"


def box_of(thing: StoredLandmark, up: FloatArray) -> Box:
    """The box of a landmark in its map."""
    return turned_box(np.array(thing.position), np.array(thing.size), thing.yaw, up)


def _row(thing: StoredLandmark) -> dict[str, Any]:
    x, y, z = thing.position
    sx, sy, sz = thing.size
    values = (
        *(thing.id, thing.category, thing.probability, x, y, z, sx, sy, sz, thing.yaw, thing.state),
        *(thing.sightings, thing.keyframes, thing.missed, thing.seen_through),
        *(thing.first_seen_ns, thing.last_seen_ns, thing.last_recording, thing.last_frame_index),
    )
    return dict(zip(COLUMNS, values, strict=True))


def _csv(file: TextIO, things: Sequence[StoredLandmark]) -> None:
    writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(_row(thing) for thing in things)


def _object(things: Sequence[StoredLandmark], relations: Sequence[StoredRelation]) -> dict[str, Any]:
    return {
        "landmarks": [
            {**_row(thing), "evidence": thing.evidence, "covariance": thing.covariance.tolist()} for thing in things
        ],
        "relations": [
            {
                "landmark_id": item.landmark_id,
                "kind": item.kind,
                "other_landmark_id": item.other_landmark_id,
                "score": item.score,
            }
            for item in relations
        ],
    }


def _features(things: Sequence[StoredLandmark], up: FloatArray) -> dict[str, Any]:
    """Polygons of footprints at the height of the lower side; coordinates are metres of the map, not degrees."""
    features = []
    for thing in things:
        ring = box_of(thing, up).corners[:4].tolist()
        geometry = {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}
        features.append({"type": "Feature", "id": thing.id, "geometry": geometry, "properties": _row(thing)})
    return {"type": "FeatureCollection", "features": features}
