"""Keypoints of another feature than the one that described an image, on the same objects and at the same depth."""

from __future__ import annotations

from collections.abc import Collection, Sequence

from semdb.perception.detections import DetectionRules
from semdb.perception.lifting import lift
from semdb.perception.objects import assign_to_objects
from semdb.perception.protocols import FeatureExtractor
from semdb.types import BoolArray, Camera, Float32Array, ImageArray, Keypoints


def find_keypoints(
    extractor: FeatureExtractor,
    camera: Camera,
    grey: ImageArray,
    depth: Float32Array | None,
    objects: Sequence[tuple[str, BoolArray]],
    dynamic: Collection[str] = (),
) -> Keypoints:
    """What `extractor` finds in `grey` ``[H, W]`` with `depth` ``[H, W]``, not sorted by object.

    `objects` are class and mask ``[H, W]``; nothing lies on those of `dynamic` classes. Raises ModelError.
    """
    still = DetectionRules(dynamic=tuple(dynamic), masks=None).still_of(objects)
    features = extractor.extract(grey, still)
    owner = assign_to_objects(features.xy, [mask for _, mask in objects])
    return Keypoints(features, owner, lift(camera, depth, features.xy))
