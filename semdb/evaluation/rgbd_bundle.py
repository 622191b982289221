"""Bundle adjustment of RGB-D frames in pycolmap: depth becomes what a second camera beside the first would see.

Images alone leave the scale free and let a long trajectory bend where the lens is not quite known. A keypoint with
depth z is therefore also observed by a virtual camera of the same kind a baseline b to the right, at x - f b / z
(the stereo coordinate of ORB-SLAM2, Mur-Artal and Tardos, IEEE T-RO 2017). One pixel there is z^2 / (f b) metres of
depth, so that depth counts less the farther it is, as structured light measures it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from semdb.evaluation.colmap import HALF_PIXEL, PosedImages, load_pycolmap
from semdb.geometry import invert_pose
from semdb.types import Camera, FloatArray

BASELINE_M = 0.4  # at 2 m and 525 pixels focal length a pixel is 19 mm of depth
MAX_DISAGREEMENT_PX = 8.0  # between depth and a triangulated point: one of the two is wrong
MAX_ITERATIONS = 40


def adjust(model: Any, posed: PosedImages, points: Sequence[FloatArray]) -> FloatArray:
    """Poses ``[n, 4, 4]`` after adjusting all poses and points of `model`; cameras stay as they are.

    `model` is what `PosedImages.triangulate` made of `posed`. `points` are per image the camera-frame points
    ``[k, 3]`` of its keypoints from depth, NaN without. The first pose is held.
    """
    pycolmap = load_pycolmap()
    count = len(posed.images)
    stereo = _with_virtual_cameras(model, posed, points)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = False
    options.refine_principal_point = False
    options.refine_extra_params = False
    options.refine_sensor_from_rig = False
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 1.0
    options.ceres.solver_options.num_threads = 1
    options.ceres.solver_options.max_num_iterations = MAX_ITERATIONS
    options.ceres.solver_options.function_tolerance = 1e-6
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in stereo.images:
        config.add_image(image_id)
    config.set_constant_rig_from_world_pose(1)  # no more: the depth fixes the scale
    pycolmap.create_default_bundle_adjuster(options, config, stereo).solve()
    poses = np.tile(np.eye(4), (count, 1, 1))
    for i in range(count):
        poses[i, :3] = stereo.images[i + 1].cam_from_world().inverse().matrix()
    return poses


def virtual_pixels(camera: Camera, points: FloatArray) -> FloatArray:
    """Where the virtual camera sees camera-frame points ``[n, 3]``: pixels ``[n, 2]`` as COLMAP counts, undistorted."""
    with np.errstate(invalid="ignore", divide="ignore"):
        x = camera.fx * (points[:, 0] - BASELINE_M) / points[:, 2] + camera.cx + HALF_PIXEL
        y = camera.fy * points[:, 1] / points[:, 2] + camera.cy + HALF_PIXEL
    return np.column_stack([x, y])


def _with_virtual_cameras(model: Any, posed: PosedImages, points: Sequence[FloatArray]) -> Any:
    """A reconstruction of rigs: image i + 1 of the model, and image n + i + 1 of the virtual camera beside it."""
    pycolmap = load_pycolmap()
    count = len(posed.images)
    stereo = pycolmap.Reconstruction()
    numbers = {camera: i for i, camera in enumerate(dict.fromkeys(posed.cameras), start=1)}
    for camera, number in numbers.items():
        real = model.cameras[number]
        virtual = pycolmap.Camera(
            model="PINHOLE",
            width=camera.width,
            height=camera.height,
            params=[camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL],
            camera_id=len(numbers) + number,
        )
        stereo.add_camera(real)
        stereo.add_camera(virtual)
        rig = pycolmap.Rig(rig_id=number)
        rig.add_ref_sensor(real.sensor_id)
        beside = np.column_stack([np.eye(3), [-BASELINE_M, 0.0, 0.0]])
        rig.add_sensor(virtual.sensor_id, pycolmap.Rigid3d(beside))
        stereo.add_rig(rig)
    for i, camera in enumerate(posed.cameras):
        pixels = np.nan_to_num(virtual_pixels(camera, points[i]), nan=0.0, posinf=0.0, neginf=0.0)
        left = pycolmap.Image(name=f"{i:06d}", keypoints=posed.images[i].xy, camera_id=numbers[camera], image_id=i + 1)
        right = pycolmap.Image(
            name=f"{i:06d}-depth",
            keypoints=pixels,
            camera_id=len(numbers) + numbers[camera],
            image_id=count + i + 1,
        )
        frame = pycolmap.Frame(frame_id=i + 1, rig_id=numbers[camera])
        frame.add_data_id(left.data_id)
        frame.add_data_id(right.data_id)
        frame.rig_from_world = model.images[i + 1].cam_from_world()
        stereo.add_frame(frame)
        for image in (left, right):
            image.frame_id = i + 1
            stereo.add_image(image)
        stereo.register_frame(i + 1)
    _add_points(model, stereo, posed, points)
    return stereo


def _add_points(model: Any, stereo: Any, posed: PosedImages, points: Sequence[FloatArray]) -> None:
    pycolmap = load_pycolmap()
    count = len(posed.images)
    camera_from_world = [
        invert_pose(np.vstack([model.images[i + 1].cam_from_world().inverse().matrix(), [0, 0, 0, 1]]))
        for i in range(count)
    ]
    for point in model.points3D.values():
        track = pycolmap.Track()
        for element in point.track.elements:
            i, row = element.image_id - 1, element.point2D_idx
            track.add_element(i + 1, row)
            measured = points[i][row]
            if not np.isfinite(measured).all():
                continue
            local = camera_from_world[i][:3, :3] @ point.xyz + camera_from_world[i][:3, 3]
            focal = posed.cameras[i].fx
            if local[2] > 0 and abs(focal * BASELINE_M * (1 / local[2] - 1 / measured[2])) <= MAX_DISAGREEMENT_PX:
                track.add_element(count + i + 1, row)
        stereo.add_point3D(point.xyz, track, point.color)
