"""What landmarks say of an image whose keypoints say nothing: the verdict `coarse`."""

from __future__ import annotations

import numpy as np

from semdb.localization.landmark_pose import (
    LandmarkPose,
    LandmarkPoseOptions,
    MapLandmarks,
    SeenThings,
    find_pose,
    things_of,
)
from semdb.types import Description, FloatArray

SAME_IOU = 0.5  # a sighting that covers a detection of its class this much is that detection


def landmark_pose(
    description: Description, landmarks: MapLandmarks | None, options: LandmarkPoseOptions
) -> LandmarkPose | None:
    """The best pose by `landmarks`, to be doubted; None where image or map show too little."""
    return None if landmarks is None else find_pose(things_in(description, landmarks, options), landmarks, options)


def things_in(description: Description, landmarks: MapLandmarks, options: LandmarkPoseOptions) -> SeenThings:
    """What an image shows of names that landmarks have.

    Weak detections count too, as much as they are sure; things that move do not.
    """
    found = [
        (one.category, one.box.astype(np.float64), one.score, geometry.centroid)
        for one, geometry in zip(description.detections, description.geometry, strict=True)
        if one.category not in description.dynamic
    ]
    kept = len(found)
    for seen in description.sightings or ():
        if seen.box is None or seen.category in description.dynamic:
            continue
        box = np.array(seen.box)
        if not any(name == seen.category and _iou(box, other) > SAME_IOU for name, other, _, _ in found[:kept]):
            found.append((seen.category, box, seen.score, np.full(3, np.nan)))
    return things_of(
        *(description.camera, [one[0] for one in found], np.array([one[1] for one in found]).reshape(-1, 4)),
        *(np.array([one[2] for one in found], np.float64), np.array([one[3] for one in found]).reshape(-1, 3)),
        *(landmarks, options),
    )


def _iou(one: FloatArray, other: FloatArray) -> float:
    low, high = np.maximum(one[:2], other[:2]), np.minimum(one[2:], other[2:])
    shared = float(np.prod(np.maximum(high - low + 1, 0)))
    return shared / float(np.prod(one[2:] - one[:2] + 1) + np.prod(other[2:] - other[:2] + 1) - shared)
