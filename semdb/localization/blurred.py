"""Keyframes as a query would see them that motion has blurred: their images are blurred alike, and described anew.

A blurred image has none of the keypoints of a sharp one, but those of the sharp one blurred alike. So the keyframe is
blurred and not the query sharpened: that would need what the motion has destroyed.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.database.store import Store
from semdb.errors import CodecError, FrameError, NotFoundError
from semdb.localization.views import ClassNumbers, KeyframeView, View, make_keyframe_view, make_view
from semdb.perception.lifting import lift
from semdb.perception.protocols import FeatureExtractor
from semdb.perception.quality import blurred_like
from semdb.recordings.registration import decode_registered_depth
from semdb.threads import each
from semdb.types import BoolArray, Camera, Description, Float32Array, ImageArray, Keypoints, ModelInfo

Blur = tuple[float, float]  # length in pixels and direction in degrees (`semdb.perception.quality.motion_blur`)


@dataclass(frozen=True, slots=True)
class BlurOptions:
    """Where keypoints do not convince and motion has blurred the query."""

    keyframes: int = 5  # that are blurred alike
    least_peak: float = 0.12  # of `motion_blur`: less than to be told of, since what is not there gains no keypoints
    hessian_threshold: float = 15.0  # of SURF, on both images: blurred ones have little contrast


def extractor_for(models: Sequence[ModelInfo], options: BlurOptions) -> FeatureExtractor | None:
    """What describes blurred images of a map; None where its local feature is none that is known to gain.

    On one thread: work that is spread over the pool of threads must not wait for others of the pool.
    """
    info = next((info for info in models if info.role == "features"), None)
    if info is None or info.name not in ("surf", "surf:weak"):
        return None
    from semdb.perception.features.surf_features import SurfFeatures

    most = json.loads(info.config).get("max_keypoints", 1500)
    return SurfFeatures(options.hessian_threshold, max_keypoints=int(most))


def blurred_query(
    description: Description, grey: ImageArray, extractor: FeatureExtractor, numbers: ClassNumbers
) -> View:
    """The query, `grey` ``[H, W]``, with the keypoints of a lower threshold, none of them on what moves."""
    moving = [d.mask for d in description.detections if d.category in description.dynamic and d.mask.size]
    still: BoolArray | None = ~np.any(moving, axis=0) if moving else None
    keypoints = _keypoints(grey, description.camera, description.depth, extractor, still)
    return make_view(description.camera, keypoints, (), numbers, grey=grey)


class BlurredKeyframes:
    """Views of keyframes of a map blurred like one query. Made for it alone."""

    def __init__(self, store: Store, extractor: FeatureExtractor, blur: Blur, numbers: ClassNumbers) -> None:
        self.extractor = extractor
        self._store = store
        self._blur = blur
        self._numbers = numbers

    def views(self, keyframes: Sequence[KeyframeView], threads: int) -> list[KeyframeView]:
        """Those of `keyframes` that have an image and depth, blurred; the others are left out."""
        found: Sequence[KeyframeView | None] = each(self._view, keyframes, threads)
        return [view for view in found if view is not None]

    def _view(self, known: KeyframeView) -> KeyframeView | None:
        depth = None if known.view.grey is None else self._depth(known)
        if known.view.grey is None or depth is None:
            return None
        grey, camera = blurred_like(known.view.grey, self._blur), known.view.camera
        keypoints = _keypoints(grey, camera, depth, self.extractor, None)
        made = make_keyframe_view(
            known.keyframe_id, camera, known.world_from_camera, keypoints, (), self._numbers, grey
        )
        return replace(made, pose_sigma=known.pose_sigma, pose_errors=known.pose_errors)

    def _depth(self, known: KeyframeView) -> Float32Array | None:
        name = f"keyframe_images.depth of keyframe {known.keyframe_id}"
        try:
            files = self._store.load_image(known.keyframe_id)
            if files.depth is None or files.depth_scale is None:
                return None
            return decode_registered_depth(
                files.depth, name, files.depth_scale, files.depth_registration, known.view.camera
            )
        except NotFoundError:  # deleted a moment ago
            return None
        except (FrameError, CodecError) as error:
            self._store.left_out(known.keyframe_id, CodecError(str(error)))
            return None


def _keypoints(
    grey: ImageArray, camera: Camera, depth: Float32Array | None, extractor: FeatureExtractor, still: BoolArray | None
) -> Keypoints:
    features = extractor.extract(grey, still)
    return Keypoints(features, np.full(len(features), -1, np.int32), lift(camera, depth, features.xy))
