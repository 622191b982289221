"""The reference that knows the right keyframes: an upper bound for retrieval, with plain SIFT as the fine step."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
import poselib

from semdb.errors import FrameError, UsageError
from semdb.geometry import back_project, pixels_to_normalized, pose_distances, pose_from, transform_points
from semdb.types import Camera, Candidate, Float32Array, FloatArray, Frame, ImageArray, Localization, ModelInfo, Verdict

STAGE_TRUE_POSE = "true-pose"

NEIGHBOURS = 5
SIFT_KEYPOINTS = 1500
RATIO = 0.85
MIN_INLIERS = 12
MAX_REPROJECTION_ERROR_PX = 3.0
MAX_DEPTH_STEP = 0.05  # of the depth: a larger spread around a keypoint is the edge of something


def nearest_in_pose(pose: FloatArray, poses: FloatArray, count: int = NEIGHBOURS) -> list[int]:
    """Positions of the `count` of `poses` ``[n, 4, 4]`` nearest to `pose`, nearest first (see `pose_distances`)."""
    return [int(i) for i in np.argsort(pose_distances(pose, poses), kind="stable")[:count]]


def root_sift(image: ImageArray) -> tuple[Float32Array, Float32Array]:
    """At most 1500 SIFT keypoints ``[n, 2]`` and RootSIFT descriptors ``[n, 128]`` of an RGB image ``[H, W, 3]``.

    RootSIFT (Arandjelovic and Zisserman, CVPR 2012): the square root of the L1-normalised descriptor.
    """
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.SIFT.create(nfeatures=SIFT_KEYPOINTS).detectAndCompute(grey, None)
    if descriptors is None or len(keypoints) == 0:
        return np.empty((0, 2), np.float32), np.empty((0, 128), np.float32)
    xy = np.array([keypoint.pt for keypoint in keypoints], dtype=np.float32)
    shares = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-12)
    return xy, np.sqrt(shares).astype(np.float32)


def points_at(xy: Float32Array, depth: Float32Array, camera: Camera) -> FloatArray:
    """Camera-frame points ``[n, 3]`` of pixels ``[n, 2]`` from depth ``[H, W]``; NaN without depth or at its edges."""
    columns = np.clip(np.rint(xy[:, 0]).astype(int), 1, depth.shape[1] - 2)
    rows = np.clip(np.rint(xy[:, 1]).astype(int), 1, depth.shape[0] - 2)
    around = np.stack([depth[rows + dy, columns + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    centre = depth[rows, columns]
    with np.errstate(invalid="ignore"):
        spread = np.fmax.reduce(around) - np.fmin.reduce(around)
        good = np.isfinite(centre) & (centre > 0) & (spread <= MAX_DEPTH_STEP * centre)
    return back_project(camera, xy, np.where(good, centre, np.nan))


def ratio_matches(query: Float32Array, keyframe: Float32Array) -> npt.NDArray[np.intp]:
    """Pairs ``[m, 2]`` (query row, keyframe row) whose nearest descriptor is at most 0.85 of the second nearest."""
    if len(query) == 0 or len(keyframe) < 2:
        return np.empty((0, 2), np.intp)
    # unit vectors: squared distance = 2 - 2 cosine
    squared = np.maximum(2.0 - 2.0 * (query @ keyframe.T), 0.0)
    two = np.argpartition(squared, 1, axis=1)[:, :2]
    values = np.take_along_axis(squared, two, axis=1)
    order = np.argsort(values, axis=1)
    two, values = np.take_along_axis(two, order, axis=1), np.take_along_axis(values, order, axis=1)
    rows = np.flatnonzero(values[:, 0] <= RATIO**2 * values[:, 1])
    return np.column_stack([rows, two[rows, 0]])


def estimate_pose(
    camera: Camera, xy: Float32Array, points: FloatArray
) -> tuple[FloatArray | None, npt.NDArray[np.bool_]]:
    """``world_from_camera`` (None if there is none) by LO-RANSAC, and which pairs ``[m]`` agree with it.

    `xy` ``[m, 2]`` are pixels as seen; they are undistorted here. `points` ``[m, 3]`` are in the world.
    """
    focal = float(np.sqrt(camera.fx * camera.fy))
    normalized = pixels_to_normalized(camera, xy)
    usable = np.isfinite(normalized).all(axis=1) & np.isfinite(points).all(axis=1)
    inliers = np.zeros(len(xy), dtype=np.bool_)
    if usable.sum() < 4:
        return None, inliers
    pinhole = {"model": "SIMPLE_PINHOLE", "width": camera.width, "height": camera.height, "params": [focal, 0.0, 0.0]}
    pose, info = poselib.estimate_absolute_pose(
        normalized[usable] * focal, points[usable], pinhole, {"max_reproj_error": MAX_REPROJECTION_ERROR_PX}, {}
    )
    inliers[np.flatnonzero(usable)] = info["inliers"]
    rotation = np.asarray(pose.R).T  # poselib gives camera_from_world
    estimate = pose_from(rotation, -rotation @ np.asarray(pose.t))
    return (estimate if np.isfinite(estimate).all() and inliers.any() else None), inliers


@dataclass(frozen=True, slots=True, eq=False)
class _Keyframe:
    recording: str
    index: int
    pose: FloatArray  # [4, 4] world_from_camera
    xy: Float32Array  # [n, 2] pixels as seen
    descriptors: Float32Array  # [n, 128]
    points: FloatArray  # [n, 3] world


class SiftReference:
    """Method `sift-reference`: the five keyframes nearest in *true* pose, SIFT, joined pairs, LO-RANSAC.

    It is told the true pose of the query to choose keyframes, so retrieval is perfect; the pose itself is
    estimated from pixels alone. Keyframes are described once, when the object is made. `keyframes` are (name of
    the recording, frame), and may be lazy. Keyframes without a pose or depth cannot serve and raise FrameError;
    no keyframe at all raises UsageError.
    """

    models = (
        ModelInfo("features", "sift", "", f'{{"descriptor":"RootSIFT","nfeatures":{SIFT_KEYPOINTS},"ratio":{RATIO}}}'),
    )

    def __init__(
        self,
        keyframes: Iterable[tuple[str, Frame]],
        *,
        map_name: str = "",
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self._map_name = map_name
        self._keyframes: list[_Keyframe] = []
        total = len(keyframes) if isinstance(keyframes, Sequence) else 0
        for number, (name, frame) in enumerate(keyframes, start=1):
            self._keyframes.append(_describe_keyframe(name, frame))
            if progress is not None:
                progress(number, max(total, number))
        if not self._keyframes:
            raise UsageError("sift-reference needs at least one keyframe")
        self.poses = np.stack([keyframe.pose for keyframe in self._keyframes])

    def __len__(self) -> int:
        """How many keyframes it has."""
        return len(self._keyframes)

    @property
    def names(self) -> list[tuple[str, int]]:
        """Recording and frame index of every keyframe."""
        return [(keyframe.recording, keyframe.index) for keyframe in self._keyframes]

    def localize(self, frame: Frame) -> Localization:
        """The pose of `frame`, or verdict `failed` below 12 inliers. There is no confidence (NaN) or covariance.

        Ids of candidates are positions among the keyframes. Raises FrameError when `frame` has no true pose to
        choose by.
        """
        if frame.world_from_camera is None:
            raise FrameError(f"{frame.name}: sift-reference chooses keyframes by the true pose, and there is none")
        started = time.perf_counter()
        xy, descriptors = root_sift(frame.image)
        described = time.perf_counter()
        positions = nearest_in_pose(frame.world_from_camera, self.poses)
        chosen = [self._keyframes[i] for i in positions]
        pairs = [ratio_matches(descriptors, keyframe.descriptors) for keyframe in chosen]
        rows = np.concatenate([pair[:, 0] for pair in pairs])
        owners = np.repeat(np.arange(len(chosen)), [len(pair) for pair in pairs])
        keyframe_xy = np.concatenate([k.xy[pair[:, 1]] for k, pair in zip(chosen, pairs, strict=True)])
        points = np.concatenate([k.points[pair[:, 1]] for k, pair in zip(chosen, pairs, strict=True)])
        matched = time.perf_counter()
        pose, inliers = estimate_pose(frame.camera, xy[rows], points)
        solved = time.perf_counter()
        counts = np.bincount(owners[inliers], minlength=len(chosen))
        best = int(np.argmax(counts))
        shown = inliers & (owners == best)
        found = pose is not None and int(inliers.sum()) >= MIN_INLIERS
        return Localization(
            verdict=Verdict.LOCALIZED if found else Verdict.FAILED,
            map_name=self._map_name,
            world_from_camera=pose if found else None,
            covariance=None,
            confidence=float("nan"),
            inliers=int(inliers.sum()),
            stage=STAGE_TRUE_POSE,
            candidates=tuple(
                Candidate(position, keyframe.recording, keyframe.index, float("nan"), float("nan"), int(count))
                for position, keyframe, count in zip(positions, chosen, counts, strict=True)
            ),
            ranked_share=0.0,
            keyframes_matched=len(chosen),
            reason=f"{int(inliers.sum())} inliers of {len(rows)} pairs; {MIN_INLIERS} are needed",
            timing_ms={
                "features": 1e3 * (described - started),
                "match": 1e3 * (matched - described),
                "pose": 1e3 * (solved - matched),
                "total": 1e3 * (solved - started),
            },
            best_keyframe_id=positions[best],
            query_xy=xy[rows][shown],
            keyframe_xy=keyframe_xy[shown],
        )


def _describe_keyframe(recording: str, frame: Frame) -> _Keyframe:
    if frame.world_from_camera is None or frame.depth is None:
        missing = "pose" if frame.world_from_camera is None else "depth"
        raise FrameError(f"{frame.name}: a keyframe of sift-reference needs a {missing}, and this frame has none")
    xy, descriptors = root_sift(frame.image)
    points = points_at(xy, frame.depth, frame.camera)
    good = np.isfinite(points).all(axis=1)
    world = transform_points(frame.world_from_camera, points[good])
    return _Keyframe(recording, frame.index, frame.world_from_camera, xy[good], descriptors[good], world)
