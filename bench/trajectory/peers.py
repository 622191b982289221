"""RGB-D odometry of OpenCV and of Open3D: each frame against the one before it, from where that one stood."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from semdb.geometry import invert_pose
from semdb.recordings.base import FrameEntry, Recording
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

FARTHEST_M = 6.0  # of depth that they take

Step = Callable[["Pair", FloatArray], FloatArray | None]  # current_from_previous, or None


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """Two frames as a pinhole camera sees them: images ``[H, W, 3]``, depths ``[H, W]`` metres, 0 without."""

    camera: Camera
    previous: tuple[ImageArray, Float32Array]
    current: tuple[ImageArray, Float32Array]


def undistorted(camera: Camera, image: ImageArray, depth: Float32Array) -> tuple[ImageArray, Float32Array]:
    """Both as a camera without distortion sees them, and 0 where depth is missing: what the peers expect."""
    filled = np.nan_to_num(depth, nan=0.0).astype(np.float32)
    if not any(camera.distortion):
        return image, filled
    matrix, size = camera.matrix, (camera.width, camera.height)
    maps = cv2.initUndistortRectifyMap(matrix, np.array(camera.distortion), None, matrix, size, cv2.CV_32FC1)
    seen = cv2.remap(image, *maps, cv2.INTER_LINEAR)
    return np.asarray(seen, np.uint8), np.asarray(cv2.remap(filled, *maps, cv2.INTER_NEAREST), np.float32)


def track(
    recording: Recording, entries: Sequence[FrameEntry], step: Step
) -> tuple[list[FloatArray | None], float, float]:
    """Poses (None where a step failed: the next goes on from there), and seconds per frame of wall and of processor
    time, decoding left out.
    """
    poses: list[FloatArray | None] = [np.eye(4)]
    pose, motion, spent, cpu = np.eye(4), np.eye(4), 0.0, 0.0
    before: tuple[ImageArray, Float32Array] | None = None
    for entry in entries:
        depth = recording.read_depth(entry)
        assert depth is not None
        now = undistorted(recording.camera, recording.read_image(entry), depth)
        if before is not None:
            started, began = time.perf_counter(), time.process_time()
            found = step(Pair(recording.camera, before, now), motion)
            spent += time.perf_counter() - started
            cpu += time.process_time() - began
            motion = np.eye(4) if found is None else found
            pose = pose @ invert_pose(motion)
            poses.append(None if found is None else pose)
        before = now
    return poses, spent / max(len(entries), 1), cpu / max(len(entries), 1)


def opencv_step() -> Step:
    """`cv2.Odometry`, colour and depth."""
    settings = cv2.OdometrySettings()
    tracker: Any = None
    size: tuple[int, int] | None = None

    def step(pair: Pair, _motion: FloatArray) -> FloatArray | None:
        nonlocal tracker, size
        if tracker is None or size != (pair.camera.width, pair.camera.height):
            size = (pair.camera.width, pair.camera.height)
            settings.setCameraMatrix(pair.camera.matrix.astype(np.float32))
            settings.setMaxDepth(FARTHEST_M)
            tracker = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
        frames = []
        for image, depth in (pair.previous, pair.current):
            grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
            known = depth > 0
            frames.append(cv2.OdometryFrame(np.where(known, depth, np.nan).astype(np.float32), grey))
            tracker.prepareFrame(frames[-1])
        try:
            good, found = tracker.compute(frames[0], frames[1])
        except cv2.error:
            return None
        matrix = np.asarray(found, np.float64)
        return matrix if good and matrix.shape == (4, 4) and np.isfinite(matrix).all() else None

    return step


def open3d_step() -> Step | None:
    """Open3D's `compute_rgbd_odometry` (hybrid) from no motion; None where it is not installed.

    From the motion of the step before it ends metres farther off where one step failed.
    """
    try:
        import open3d
    except (ImportError, OSError):
        return None
    odometry = open3d.pipelines.odometry
    option = odometry.OdometryOption(depth_max=FARTHEST_M)

    def rgbd(image: ImageArray, depth: Float32Array) -> Any:
        return open3d.geometry.RGBDImage.create_from_color_and_depth(
            open3d.geometry.Image(np.ascontiguousarray(image)),
            open3d.geometry.Image(np.ascontiguousarray(depth)),
            depth_scale=1.0,
            depth_trunc=FARTHEST_M,
            convert_rgb_to_intensity=True,
        )

    def step(pair: Pair, _motion: FloatArray) -> FloatArray | None:
        camera = pair.camera
        intrinsic = open3d.camera.PinholeCameraIntrinsic(
            camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        )
        good, found, _ = odometry.compute_rgbd_odometry(
            rgbd(*pair.previous), rgbd(*pair.current), intrinsic, np.eye(4),
            odometry.RGBDOdometryJacobianFromHybridTerm(), option,
        )  # fmt: skip
        return np.asarray(found, np.float64) if good else None

    return step
