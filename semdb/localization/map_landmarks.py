"""The confirmed landmarks of a map as images are matched with them, read once and kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from semdb.database.landmark_reading import StoredLandmark, load_landmarks
from semdb.database.landmark_rows import load_gravity
from semdb.database.store import Store
from semdb.geometry import invert_pose
from semdb.landmarks.boxes import turned_box, upright_axes
from semdb.landmarks.evidence import name_probabilities
from semdb.localization.landmark_kernels import predict
from semdb.localization.landmark_pose import MapLandmarks
from semdb.types import Camera, FloatArray

CONFIRMED = "confirmed"
SHRUNK = 0.92  # the box about a box's corners is larger than the thing that fills it
STRANGERS = 5.0  # things of an image that are no landmark, where it does not show the map
QUALITY = 0.8  # of what is found in images like the keyframes, what is found in others
SEEN_BOUNDS = (0.1, 0.9)
MILLION = 1_000_000


def read_map_landmarks(store: Store, map_id: int, poses: FloatArray) -> MapLandmarks | None:
    """Those of a map whose keyframes have `poses` ``[k, 4, 4]``; None where none is confirmed.

    A damaged row is left out: `semdb status` and `semdb find` tell of it. Raises CodecError for a damaged gravity.
    """
    gravity, cameras = load_gravity(store.engine, map_id), store.cameras(map_id)
    if gravity is None or not cameras:
        return None
    confusions: dict[str, dict[str, int]] = {}
    for found in store.class_confusions(map_id):
        confusions.setdefault(found.category, {})[found.other] = found.weight
    known, _ = load_landmarks(store.engine, map_id, lambda _: None)
    return map_landmarks(known, poses, np.array(gravity.up), cameras[0], confusions)


def map_landmarks(
    found: Sequence[StoredLandmark],
    poses: FloatArray,
    up: FloatArray,
    camera: Camera,
    confusions: Mapping[str, Mapping[str, int]],
) -> MapLandmarks | None:
    """The confirmed ones of `found`, with keyframes' `poses` ``[k, 4, 4]`` that `camera` took; None without any.

    How likely one is found where it lies in an image is read off the keyframes: of those in which it lies, the share
    that shows it, whatever hides it in the others.
    """
    known = [item for item in found if item.state == CONFIRMED]
    if not known or not len(poses):
        return None
    names = sorted({name for item in known for name in item.evidence} | {item.category for item in known})
    classes = {name: number for number, name in enumerate(names)}
    boxes = [turned_box(np.array(item.position), np.array(item.size), item.yaw, up) for item in known]
    corners = np.stack([box.centre + SHRUNK * (box.corners - box.centre) for box in boxes])
    centres = np.stack([box.centre for box in boxes])
    cameras = np.ascontiguousarray(np.stack([invert_pose(pose) for pose in poses]))
    frame = np.array([-camera.cx, -camera.cy, camera.width - camera.cx, camera.height - camera.cy])
    frame /= np.array([camera.fx, camera.fy, camera.fx, camera.fy])
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
    )


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
