"""One frame as tracking sees it, and why a frame says nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from semdb.localization.views import ClassNumbers, View, make_view
from semdb.perception.lifting import lift
from semdb.perception.protocols import FeatureExtractor
from semdb.trajectory.depth_views import DepthView, depth_view
from semdb.trajectory.options import FrameOptions
from semdb.trajectory.surface_views import SurfaceView, surface_view
from semdb.types import Camera, Features, Float32Array, ImageArray, Keypoints

SHARP_RANK = 250

ReadFrame = Callable[[int], tuple[ImageArray, Float32Array | None]]


@dataclass(frozen=True, slots=True, eq=False)
class SeenFrame:
    """A frame that can be placed. `position` counts the frames of the recording from 0."""

    position: int
    time_s: float
    image: ImageArray  # [H, W, 3]
    view: View
    sharpness: float  # falls as the image gets blurred
    depth: DepthView | None
    whole_depth: Float32Array | None = None  # [H, W]

    @property
    def with_depth(self) -> int:
        """How many keypoints have a 3D point."""
        return int(np.count_nonzero(np.isfinite(self.view.points[:, 2])))

    def surface_view(self) -> SurfaceView | None:
        """What its surfaces are made of; None without depth."""
        return surface_view(self.view.camera, self.whole_depth, self.view.grey)


@dataclass(frozen=True, slots=True)
class EmptyFrame:
    """A frame that shows too little to be placed, and why."""

    position: int
    reason: str


def see(
    position: int,
    time_s: float,
    image: ImageArray,
    depth: Float32Array | None,
    camera: Camera,
    features: FeatureExtractor,
    options: FrameOptions,
) -> SeenFrame | EmptyFrame:
    """Local features of an RGB `image` ``[H, W, 3]`` with 3D points from `depth` ``[H, W]`` metres."""
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
    found = features.extract(grey)
    if len(found) < options.least_keypoints:
        return EmptyFrame(position, _why_empty(grey, len(found), options))
    points = lift(camera, depth, found.xy)
    keypoints = Keypoints(found, np.full(len(found), -1, np.int32), points)
    view = make_view(camera, keypoints, (), ClassNumbers(), grey=grey)
    return SeenFrame(position, time_s, image, view, _sharpness(found), depth_view(camera, depth), depth)


def _sharpness(features: Features) -> float:
    """The response of the keypoint of rank `SHARP_RANK`, 0 where there are fewer: blur takes it away."""
    ordered = np.sort(features.response)[::-1]
    return float(ordered[SHARP_RANK]) if len(ordered) > SHARP_RANK else 0.0


def _why_empty(grey: ImageArray, keypoints: int, options: FrameOptions) -> str:
    if float(np.percentile(grey, 95)) < options.dark:
        return f"too dark: 95 of 100 pixels are below {options.dark:g} of 255"
    if float(grey.std()) < options.plain:
        return "shows nothing: the image is of one grey"
    return f"blurred or plain: {keypoints} keypoints"
