"""Poses of a recording made better by structure from motion, to see how far its own can be trusted.

Given poses come from a depth tracker or from motion capture; images show them to be off by millimetres to
centimetres. Bundle adjustment of all images and their depth (pycolmap) gives poses that agree with the pixels. They
are brought back to the given world frame by one similarity, so that only what varies from frame to frame differs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from semdb.errors import RecordingError
from semdb.evaluation.baselines import points_at
from semdb.evaluation.colmap import HALF_PIXEL, PosedImages, SiftExtractor, SiftImage, image_points
from semdb.evaluation.rgbd_bundle import adjust
from semdb.evaluation.rolling_shutter import readout_step, unrolled
from semdb.geometry import pose_distances, pose_error, pose_from, project_to_so3
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ImageArray

ROUNDS = 3  # of triangulation with the poses so far and bundle adjustment
NEAREST = 4  # pairs of every frame with those nearest in pose
SPREAD = 8  # and with others at growing distance
FARTHEST = 3.0  # of `pose_distances`: what is farther apart hardly sees the same
MIN_POINTS = 30  # 3D points that a frame must see for its pose to count as refined

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """`world_from_camera` ``[n, 4, 4]`` in the given world frame; where not `refined` ``[n]``, the given pose.

    `scale` is what the reconstruction was multiplied by: near 1 where depth and given poses agree on the metre.
    `readout_s` is the time from the first row of an image to the last that the images agree best with.
    `given_px` and `refined_px` are mean reprojection errors of points triangulated with the poses of each.
    """

    world_from_camera: FloatArray
    refined: BoolArray
    scale: float
    readout_s: float
    points: int
    given_px: float
    refined_px: float


@dataclass(frozen=True, slots=True)
class Disagreement:
    """How far the given poses are from the refined ones, over the refined frames, and between neighbours in time.

    `scale`, `readout_s`, `given_px` and `refined_px` are those of the `Refinement`.
    """

    frames: int
    refined: int
    median_translation_m: float
    p90_translation_m: float
    max_translation_m: float
    median_rotation_deg: float
    p90_rotation_deg: float
    max_rotation_deg: float
    median_step_translation_m: float | None  # of the motion from one refined frame to the next
    median_step_rotation_deg: float | None
    scale: float
    readout_s: float
    given_px: float
    refined_px: float


def choose_pairs(world_from_camera: FloatArray) -> list[tuple[int, int]]:
    """Pairs of positions to match: each frame with the 4 nearest in pose and 8 more at growing distance."""
    pairs = set()
    for i, pose in enumerate(world_from_camera):
        distance = pose_distances(pose, world_from_camera)
        order = [int(j) for j in np.argsort(distance, kind="stable") if j != i and distance[j] < FARTHEST]
        rest = order[NEAREST:]
        chosen = order[:NEAREST]
        if rest:
            chosen += [rest[k] for k in np.unique(np.linspace(0, len(rest) - 1, SPREAD).round().astype(int))]
        pairs |= {(min(i, j), max(i, j)) for j in chosen}
    return sorted(pairs)


def align_poses(poses: FloatArray, reference: FloatArray) -> tuple[FloatArray, float]:
    """`poses` ``[n, 4, 4]`` moved by one similarity onto `reference` ``[n, 4, 4]``, and its scale.

    The rotation is the mean of the rotations from frame to frame (chordal mean), which also serves where the camera
    hardly moves; scale and translation are then least squares of the camera centres.
    """
    turns = reference[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
    rotation = project_to_so3(turns.sum(axis=0))
    centres = poses[:, :3, 3] @ rotation.T
    middle, target = centres.mean(axis=0), reference[:, :3, 3].mean(axis=0)
    spread = float(((centres - middle) ** 2).sum())
    scale = float(((centres - middle) * (reference[:, :3, 3] - target)).sum()) / spread if spread > 1e-12 else 1.0
    moved = np.stack(
        [
            pose_from(rotation @ pose[:3, :3], scale * (centre - middle) + target)
            for pose, centre in zip(poses, centres, strict=True)
        ]
    )
    return moved, scale


def refine_poses(
    cameras: Sequence[Camera],
    frames: Callable[[int], tuple[ImageArray, Float32Array | None]],
    given: FloatArray,
    rates: FloatArray,
    *,
    name: str = "",
    progress: Progress | None = None,
) -> Refinement:
    """Bundle adjustment of all frames from their `given` poses ``[n, 4, 4]``.

    `rates` ``[n, 3]`` is how the camera turns in each frame, in radians a second in its own frame (zeros: it stands
    still, or nobody knows): keypoints are taken as at the time of the middle row, see `rolling_shutter`.
    `frames` gives image ``[H, W, 3]`` and depth ``[H, W]`` (or None) at a position. Cameras stay as they are: only
    poses and points move. Raises ModelError without pycolmap and RecordingError where fewer than three frames see
    enough common points.
    """
    described, measured = _describe(cameras, frames, len(given), name, progress)
    posed, points = PosedImages(cameras, described), measured
    posed.match(choose_pairs(given), lambda done, total: _tell(progress, f"matching {name}", done, total))
    poses, readout_s = given, 0.0
    errors = []
    for done in range(ROUNDS + 1):
        model = posed.triangulate(poses)
        found = int(model.num_points3D())
        if found < MIN_POINTS:
            raise _nothing_common(name, found)
        errors.append(float(model.compute_mean_reprojection_error()))
        if done < ROUNDS:
            readout_s += readout_step(model, described, posed, rates, readout_s)
            posed.images, points = _unrolled(described, measured, cameras, rates, readout_s)
            poses = adjust(model, posed, points)
        _tell(progress, f"bundle adjustment of {name}", done + 1, ROUNDS + 1)
    refined = np.array([len(image_points(model, i + 1)[0]) for i in range(len(given))]) >= MIN_POINTS
    if refined.sum() < 3:
        raise _nothing_common(name, found)
    aligned, scale = align_poses(poses[refined], given[refined])
    result = given.copy()
    result[refined] = aligned
    return Refinement(result, refined, scale, readout_s, found, errors[0], errors[-1])


def _describe(
    cameras: Sequence[Camera],
    frames: Callable[[int], tuple[ImageArray, Float32Array | None]],
    count: int,
    name: str,
    progress: Progress | None,
) -> tuple[list[SiftImage], list[FloatArray]]:
    """SIFT of all frames, and the camera-frame points ``[k, 3]`` of its keypoints from depth."""
    extractor = SiftExtractor()
    described, points = [], []
    for i in range(count):
        image, depth = frames(i)
        described.append(extractor.extract(image))
        xy = (described[-1].xy - HALF_PIXEL).astype(np.float32)
        points.append(np.full((len(xy), 3), np.nan) if depth is None else points_at(xy, depth, cameras[i]))
        _tell(progress, f"SIFT of {name}", i + 1, count)
    return described, points


def _unrolled(
    described: Sequence[SiftImage],
    points: Sequence[FloatArray],
    cameras: Sequence[Camera],
    rates: FloatArray,
    readout_s: float,
) -> tuple[list[SiftImage], list[FloatArray]]:
    """Keypoints of all images, and their points, as at the time of the middle row."""
    images, moved = [], []
    for i, image in enumerate(described):
        xy, local = unrolled(image.xy, points[i], cameras[i], rates[i], readout_s)
        images.append(replace(image, xy=xy))
        moved.append(local)
    return images, moved


def disagreement(given: FloatArray, refinement: Refinement) -> Disagreement:
    """Figures of the difference between the `given` poses ``[n, 4, 4]`` (in order of time) and the refined ones."""
    rows = np.flatnonzero(refinement.refined)
    better = refinement.world_from_camera
    errors = np.array([pose_error(given[i], better[i]) for i in rows])
    steps = np.array(
        [
            pose_error(np.linalg.inv(given[i]) @ given[j], np.linalg.inv(better[i]) @ better[j])
            for i, j in pairwise(rows)
        ]
    )
    metres, degrees = errors[:, 0], errors[:, 1]
    return Disagreement(
        frames=len(given),
        refined=len(rows),
        median_translation_m=float(np.median(metres)),
        p90_translation_m=float(np.percentile(metres, 90)),
        max_translation_m=float(metres.max()),
        median_rotation_deg=float(np.median(degrees)),
        p90_rotation_deg=float(np.percentile(degrees, 90)),
        max_rotation_deg=float(degrees.max()),
        median_step_translation_m=float(np.median(steps[:, 0])) if len(steps) else None,
        median_step_rotation_deg=float(np.median(steps[:, 1])) if len(steps) else None,
        scale=refinement.scale,
        readout_s=refinement.readout_s,
        given_px=refinement.given_px,
        refined_px=refinement.refined_px,
    )


def _nothing_common(name: str, points: int) -> RecordingError:
    return RecordingError(
        f"{name}: its poses cannot be refined: structure from motion found {points} points that its frames have in "
        "common; use --truth given"
    )


def _tell(progress: Progress | None, what: str, done: int, total: int) -> None:
    if progress is not None:
        progress(what, done, total)
