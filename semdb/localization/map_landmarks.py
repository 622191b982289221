"""The confirmed landmarks of a map as images are matched with them, read once and kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.database.landmark_reading import StoredLandmark, load_landmarks
from semdb.database.landmark_rows import load_gravity
from semdb.database.scene_reading import sighting_boxes
from semdb.database.store import Store
from semdb.geometry import invert_pose
from semdb.landmarks.boxes import turned_box, upright_axes
from semdb.landmarks.evidence import name_probabilities
from semdb.localization.landmark_kernels import TAIL, edges_off, predict
from semdb.localization.landmark_pose import MapLandmarks, unit_boxes
from semdb.types import Camera, FloatArray, Int64Array

CONFIRMED = "confirmed"
SHRUNK = 0.92  # the box about a box's corners is larger than the thing that fills it: where keyframes do not tell
SHRINKING = (0.84, 0.88, 0.92, 0.96, 1.0)
EDGE, LEAST_EDGE, MOST_EDGE = 0.06, 0.03, 0.08  # share of a side, by which edges are off: where unknown, and its bounds
MEDIAN = 0.816  # of what is off by Student's distribution of two degrees of freedom
LOOSER = 2.0  # in other images than keyframes, which landmarks are made from
LEAST_SIGHTINGS = 20
STRANGERS = 5.0  # things of an image that are no landmark, where it does not show the map
QUALITY = 0.8  # of what is found in images like the keyframes, what is found in others
SEEN_BOUNDS = (0.1, 0.9)
MILLION = 1_000_000


@dataclass(frozen=True, slots=True, eq=False)
class SightingBoxes:
    """Boxes of what shows landmarks in keyframes of one camera, by which is known how far boxes are off."""

    landmark: Int64Array  # [n] id
    keyframe: Int64Array  # [n] row of the keyframes' poses
    boxes: FloatArray  # [n, 4] pixels, the last inside


def read_map_landmarks(
    store: Store, map_id: int, keyframe_ids: Sequence[int], poses: FloatArray
) -> MapLandmarks | None:
    """Those of a map whose keyframes, ids ascending, have `poses` ``[k, 4, 4]``; None where none is confirmed.

    A damaged row is left out: `semdb status` and `semdb find` tell of it. Raises CodecError for a damaged gravity.
    """
    gravity, cameras = load_gravity(store.engine, map_id), store.cameras(map_id)
    if gravity is None or not cameras:
        return None
    confusions: dict[str, dict[str, int]] = {}
    for found in store.class_confusions(map_id):
        confusions.setdefault(found.category, {})[found.other] = found.weight
    known, _ = load_landmarks(store.engine, map_id, lambda _: None)
    landmark, keyframe, boxes = sighting_boxes(store.engine, map_id, cameras[0])
    ids = np.array(keyframe_ids, np.int64)
    row = np.minimum(np.searchsorted(ids, keyframe), max(len(ids) - 1, 0))
    there = ids[row] == keyframe if len(ids) else np.zeros(len(row), np.bool_)
    seen = SightingBoxes(landmark[there], row[there], boxes[there])
    return map_landmarks(known, poses, np.array(gravity.up), cameras[0], confusions, seen)


def map_landmarks(
    found: Sequence[StoredLandmark],
    poses: FloatArray,
    up: FloatArray,
    camera: Camera,
    confusions: Mapping[str, Mapping[str, int]],
    seen: SightingBoxes | None = None,
) -> MapLandmarks | None:
    """The confirmed ones of `found`, with keyframes' `poses` ``[k, 4, 4]`` that `camera` took; None without any.

    By `seen` it is known how much smaller than the boxes about landmarks' boxes those of a detector are, and how far
    these are off.

    How likely one is found where it lies in an image is read off the keyframes: of those in which it lies, the share
    that shows it, whatever hides it in the others.
    """
    known = [item for item in found if item.state == CONFIRMED]
    if not known or not len(poses):
        return None
    names = sorted({name for item in known for name in item.evidence} | {item.category for item in known})
    classes = {name: number for number, name in enumerate(names)}
    boxes = [turned_box(np.array(item.position), np.array(item.size), item.yaw, up) for item in known]
    corners = np.stack([box.corners for box in boxes])
    centres = np.stack([box.centre for box in boxes])
    cameras = np.ascontiguousarray(np.stack([invert_pose(pose) for pose in poses]))
    frame = unit_boxes(camera, np.array([[-0.5, -0.5, camera.width - 0.5, camera.height - 0.5]]))[0]
    rows = {item.id: row for row, item in enumerate(known)}
    shrunk, edge = SHRUNK, EDGE
    if seen is not None:
        shrunk, edge = _edges(rows, corners, centres, cameras, camera, frame, seen)
    corners = centres[:, None] + shrunk * (corners - centres[:, None])
    box = np.empty(4)
    inside = [sum(predict(c, m, pose, frame, box) for pose in cameras) for c, m in zip(corners, centres, strict=True)]
    shown = np.array([item.keyframes for item in known])
    return MapLandmarks(
        classes=classes,
        corners=corners,
        centres=centres,
        sizes=np.array([item.size for item in known]),
        names=_name_ratios(known, classes, confusions),
        seen=QUALITY * np.clip((shown + 0.5) / (np.array(inside) + 1), *SEEN_BOUNDS),
        cameras=cameras,
        level=np.ascontiguousarray(upright_axes(up)),
        edge=edge,
    )


def _edges(
    rows: Mapping[int, int],
    corners: FloatArray,
    centres: FloatArray,
    cameras: FloatArray,
    camera: Camera,
    frame: FloatArray,
    seen: SightingBoxes,
) -> tuple[float, float]:
    """How much smaller boxes are than those about `corners`, and the share of their sides by which edges are off."""
    row = np.array([rows.get(one, -1) for one in seen.landmark.tolist()], np.int64)
    of = np.flatnonzero(row >= 0)
    if len(of) < LEAST_SIGHTINGS:
        return SHRUNK, EDGE
    plane, found = unit_boxes(camera, seen.boxes[of] + np.array([-0.5, -0.5, 0.5, 0.5])), []
    for shrunk in SHRINKING:
        off = np.empty((len(of), 4))
        edges_off(corners, centres, cameras, frame, row[of], seen.keyframe[of], plane, shrunk, off)
        known = np.abs(off[np.isfinite(off)])
        if len(known) < LEAST_SIGHTINGS:
            return SHRUNK, EDGE
        scale = max(float(np.median(known)) / MEDIAN, 1e-3)
        unlikely = np.log(scale) + (TAIL + 1) / 2 * np.log1p((known / scale) ** 2 / TAIL).mean()
        found.append((round(float(unlikely), 6), shrunk, scale))
    _, shrunk, scale = min(found)
    return shrunk, float(np.clip(LOOSER * scale, LEAST_EDGE, MOST_EDGE))


def _name_ratios(
    known: Sequence[StoredLandmark], classes: Mapping[str, int], confusions: Mapping[str, Mapping[str, int]]
) -> FloatArray:
    """Logarithms ``[l, c]``: how much likelier a name is of a landmark than of a stranger."""
    mixed = np.zeros((len(classes), len(classes)))
    for name, others in confusions.items():
        for other, weight in others.items():
            if name in classes and other in classes:
                mixed[classes[name], classes[other]] = weight / MILLION
    evidence, count = np.zeros((len(known), len(classes))), np.ones(len(classes))
    for row, item in enumerate(known):
        for name, share in item.evidence.items():
            evidence[row, classes[name]] = share
        count[classes[item.category]] += item.keyframes
    total = evidence.sum(axis=1, keepdims=True)
    evidence = np.where(total > 0, evidence / np.where(total > 0, total, 1), 1 / len(classes))
    given = evidence @ name_probabilities(len(classes), mixed)
    return np.ascontiguousarray(np.log(given) - np.log(count / count.sum()) - np.log(STRANGERS))
