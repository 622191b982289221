"""What the fine step needs of a query and of a keyframe: arrays, with what can be computed once computed once."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from semdb.byte_descriptors import to_bytes
from semdb.geometry import invert_pose, pixels_to_normalized, transform_points
from semdb.localization.matching import BACKGROUND
from semdb.types import Camera, Float32Array, FloatArray, ImageArray, IntArray, Keypoints, PoseErrors


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Keypoints of one image. `xy` are normalised undistorted coordinates, `classes` numbers shared by all views.

    Keypoints that a strongly distorted lens leaves without a ray are gone; `source` ``[n]`` are the indexes in
    the `Keypoints` that the rest came from.
    """

    camera: Camera
    seen_xy: Float32Array  # [n, 2] pixels, as seen
    xy: FloatArray  # [n, 2]
    size: Float32Array  # [n] pixels
    descriptors: npt.NDArray[np.generic]  # [n, d] float32, int8 (byte_descriptors), or uint8 of bits
    classes: IntArray  # [n], -1 in the background
    signs: npt.NDArray[np.int8]  # [n] of the Laplacian, 0 where the feature has none
    points: Float32Array  # [n, 3] camera frame, NaN where there is no depth
    source: IntArray  # [n]
    grey: ImageArray | None = None  # [H, W] the image, where it is at hand
    looser: Float32Array | None = None  # [n] how many times the sensor's noise the depth of `points` has; None: once
    inverse_depth: Float32Array | None = None  # [h, w] 1/m of the small image of `likeness`, where it is at hand

    def __len__(self) -> int:
        return len(self.xy)

    @property
    def focal(self) -> float:
        return (self.camera.fx + self.camera.fy) / 2

    @property
    def image_row(self) -> FloatArray:
        """When each keypoint was read out ``[n]``: -0.5 in the top row of the image, 0.5 in the last."""
        return (self.seen_xy[:, 1].astype(np.float64) + 0.5) / self.camera.height - 0.5


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeView:
    """A view with a pose; only keypoints that have a 3D point."""

    keyframe_id: int
    view: View
    world_from_camera: FloatArray
    camera_from_world: FloatArray
    world_points: FloatArray  # [n, 3]
    pose_sigma: tuple[float, float] | None = None  # how sure the pose is, along an axis: metres, radians
    pose_errors: PoseErrors | None = None  # how far the poses of its recording are off its images, where measured


def in_kind_of(keyframes: Sequence[KeyframeView], query: View) -> View:
    """`query` with descriptors of bytes where those of a keyframe are, so that it is rounded once and not for each."""
    if query.descriptors.dtype != np.float32 or all(one.view.descriptors.dtype != np.int8 for one in keyframes):
        return query
    small = to_bytes(query.descriptors)
    return query if small is None else replace(query, descriptors=small)


class ClassNumbers:
    """Numbers class names in the order in which they are first asked for, by any thread."""

    def __init__(self) -> None:
        self._numbers: dict[str, int] = {}
        self._next = itertools.count()

    def of(self, name: str) -> int:
        known = self._numbers.get(name)
        return self._numbers.setdefault(name, next(self._next)) if known is None else known


def make_view(
    camera: Camera,
    keypoints: Keypoints,
    object_categories: Sequence[str],
    numbers: ClassNumbers,
    *,
    with_points_only: bool = False,
    grey: ImageArray | None = None,
    looser: Float32Array | None = None,
) -> View:
    """The view of `keypoints`, whose object ``i`` is of class ``object_categories[i]``; `looser` is of all of them."""
    features = keypoints.features
    table = np.array([*(numbers.of(name) for name in object_categories), BACKGROUND], np.int32)
    xy = pixels_to_normalized(camera, features.xy)
    usable = np.isfinite(xy).all(axis=1)
    if with_points_only:
        usable &= np.isfinite(keypoints.points).all(axis=1)
    keep = np.flatnonzero(usable)
    return View(
        camera=camera,
        seen_xy=features.xy[keep],
        xy=xy[keep],
        size=features.size[keep],
        descriptors=features.descriptors[keep],
        classes=table[keypoints.object_index[keep]],  # -1 takes the last entry: the background
        signs=features.laplacian[keep],
        points=keypoints.points[keep],
        source=keep.astype(np.int32),
        grey=grey,
        looser=None if looser is None else looser[keep],
    )


def make_keyframe_view(
    keyframe_id: int,
    camera: Camera,
    world_from_camera: FloatArray,
    keypoints: Keypoints,
    object_categories: Sequence[str],
    numbers: ClassNumbers,
    grey: ImageArray | None = None,
    looser: Float32Array | None = None,
    covariance: FloatArray | None = None,
) -> KeyframeView:
    """The view of a stored keyframe, with its points moved to the world; `covariance` ``[6, 6]`` is of its pose."""
    view = make_view(camera, keypoints, object_categories, numbers, with_points_only=True, grey=grey, looser=looser)
    return KeyframeView(
        keyframe_id=keyframe_id,
        view=view,
        world_from_camera=world_from_camera,
        camera_from_world=invert_pose(world_from_camera),
        world_points=transform_points(world_from_camera, view.points),
        pose_sigma=None if covariance is None else _sigma_of(covariance),
    )


def _sigma_of(covariance: FloatArray) -> tuple[float, float]:
    """Standard deviations along an axis of translation and of rotation."""
    place, turn = (float(np.sqrt(np.trace(covariance[part, part]) / 3)) for part in (slice(0, 3), slice(3, 6)))
    return place, turn
