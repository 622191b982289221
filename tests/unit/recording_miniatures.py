"""Tiny recordings of every layout, rendered from a box-shaped room whose geometry is known exactly."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from semdb.geometry import back_project, invert_pose, pose_from, quat_wxyz_from_rotation, so3_exp
from semdb.recordings.cameras import SEVEN_SCENES_COLOR, SEVEN_SCENES_DEPTH
from semdb.recordings.registration import COLOR_FROM_DEPTH
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

SMALL = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
ROOM_LOW, ROOM_HIGH = np.array([-2.0, -1.5, -2.5]), np.array([2.2, 1.1, 2.7])


def pose(i: int) -> FloatArray:
    """A camera path inside the room that turns about all axes."""
    return pose_from(so3_exp([0.05 * i, 0.08 * i, -0.04 * i]), [0.05 * i, 0.03 * i, -0.02 * i])


def room_hits(origin: FloatArray, directions: FloatArray) -> FloatArray:
    """Ray parameters [n] at which rays from inside leave the room."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.maximum((ROOM_LOW - origin) / directions, (ROOM_HIGH - origin) / directions)
    return np.nanmin(np.where(directions == 0, np.inf, t), axis=1)


def colours(points: FloatArray) -> ImageArray:
    """Smooth RGB [n, 3] of world points."""
    waves = np.stack([np.sin(3 * points[:, 0] + 1), np.sin(4 * points[:, 1] + 2), np.sin(5 * points[:, 2])], axis=1)
    return np.asarray(127 + 100 * waves, dtype=np.uint8)


def render(camera: Camera, world_from_camera: FloatArray, flip_y: bool = False) -> tuple[ImageArray, Float32Array]:
    """Colour [H, W, 3] and depth [H, W] of the room; `flip_y` renders with fy negative (a camera with y up)."""
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    if flip_y:
        rays[:, 1] *= -1
    directions = rays @ world_from_camera[:3, :3].T
    depth = room_hits(world_from_camera[:3, 3], directions)  # rays have z = 1: the parameter is the depth
    points = world_from_camera[:3, 3] + directions * depth[:, None]
    shape = (camera.height, camera.width)
    return colours(points).reshape(*shape, 3), depth.reshape(shape).astype(np.float32)


def write_image(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(path.suffix, image if image.ndim == 2 else image[..., ::-1])
    assert ok
    path.write_bytes(data.tobytes())


def depth_units(depth: Float32Array, scale: float) -> np.ndarray:
    return np.rint(np.nan_to_num(depth) * scale).astype(np.uint16)


def pose_text(world_from_camera: FloatArray) -> str:
    w, x, y, z = quat_wxyz_from_rotation(world_from_camera[:3, :3])
    return " ".join(f"{value:.9f}" for value in (*world_from_camera[:3, 3], x, y, z, w))


def write_camera_json(folder: Path, camera: Camera, depth_scale: float = 5000.0) -> None:
    content = {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    content |= {"distortion": list(camera.distortion), "depth_scale": depth_scale}
    (folder / "camera.json").write_text(json.dumps(content))


def write_tum(folder: Path, n: int = 6, masks: bool = False, camera: Camera = SMALL, camera_json: bool = True) -> Path:
    """Colour at i * 0.1 s, depth 4 ms later, poses every 10 ms interpolable to the colour times."""
    folder.mkdir(parents=True, exist_ok=True)
    rgb, depth, truth = ["# color images"], ["# depth maps"], ["# ground truth trajectory"]
    for i in range(n):
        time, depth_time = f"{100 + i * 0.1:.6f}", f"{100 + i * 0.1 + 0.004:.6f}"
        image, z = render(camera, pose(i))
        write_image(folder / "rgb" / f"{time}.png", image)
        write_image(folder / "depth" / f"{depth_time}.png", depth_units(z, 5000))
        rgb.append(f"{time} rgb/{time}.png")
        depth.append(f"{depth_time} depth/{depth_time}.png")
        truth.append(f"{time} {pose_text(pose(i))}")
        if masks:
            labels = np.zeros(z.shape, np.uint16)
            labels[5:20, 5:20] = 1
            labels[25:40, 30:60] = 2
            write_image(folder / "masks" / f"{time}.png", labels)
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    (folder / "depth.txt").write_text("\n".join(depth) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    if masks:
        (folder / "masks" / "classes.json").write_text('{"1": "chair", "2": "cup"}')
    if camera_json:
        write_camera_json(folder, camera)
    return folder


def icl_pose(i: int) -> FloatArray:
    """A pose of the renderer's left-handed camera (y up) in its left-handed world."""
    return pose(i + 1)


def write_icl(folder: Path, n: int = 5, camera: Camera = SMALL) -> Path:
    """As the data set: rendered with negative fy in a left-handed world; no pose for frame 0."""
    (folder / "rgb").mkdir(parents=True)
    associations, truth = [], []
    for i in range(n):
        image, z = render(camera, icl_pose(i), flip_y=True)
        write_image(folder / "rgb" / f"{i}.png", image)
        write_image(folder / "depth" / f"{i}.png", depth_units(z, 5000))
        associations.append(f"{i} depth/{i}.png {i} rgb/{i}.png")
        if i > 0:
            truth.append(f"{i} {pose_text(icl_pose(i))}")
    (folder / "associations.txt").write_text("\n".join(associations) + "\n")
    (folder / "livingRoom1.gt.freiburg").write_text("\n".join(truth) + "\n")
    return folder


def write_povray(folder: Path, n: int = 4, unit: float = 0.01, camera: Camera = SMALL) -> Path:
    """As POV-Ray rendered the data set: distances along rays and cameras as text, in units of `unit` metres."""
    folder.mkdir(parents=True)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    stretch = np.linalg.norm(rays, axis=1).reshape(v.shape)
    for i in range(n):
        image, z = render(camera, icl_pose(i), flip_y=True)
        stem = f"scene_00_{i:04d}"
        write_image(folder / f"{stem}.png", image)
        distance = (z * stretch / unit).ravel()
        (folder / f"{stem}.depth").write_text(" ".join(f"{value:.6g}" for value in distance) + " \n")
        x, y, forward, place = icl_pose(i)[:3].T
        vectors = {
            "cam_pos": place / unit,
            "cam_dir": forward,
            "cam_up": y * camera.height / camera.fy,
            "cam_lookat": [0, 0, 1],
            "cam_sky": [0, 1, 0],
            "cam_right": x * camera.width / camera.fx,
            "cam_fpoint": [0, 0, 10],
        }
        lines = [f"{name:12} = [{', '.join(f'{value:.7g}' for value in vector)}]';" for name, vector in vectors.items()]
        (folder / f"{stem}.txt").write_text("\n".join([*lines, "cam_angle    = 90;"]) + "\n")
    return folder


def write_seven_scenes(folder: Path, n: int = 2, suffix: str = "png") -> Path:
    """Frames 0, 4, 8, ...; poses written are those of the depth camera, as in the data set."""
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(n):
        color_pose = pose(i)
        depth_pose = color_pose @ COLOR_FROM_DEPTH
        image, _ = render(SEVEN_SCENES_COLOR, color_pose)
        _, z = render(SEVEN_SCENES_DEPTH, depth_pose)
        stem = f"frame-{4 * i:06d}"
        write_image(folder / f"{stem}.color.{suffix}", image)
        raw = depth_units(z, 1000)
        raw[0, :5] = 65535
        write_image(folder / f"{stem}.depth.png", raw)
        np.savetxt(folder / f"{stem}.pose.txt", depth_pose)
    return folder


def moved_points(camera: Camera, depth: Float32Array, from_pose: FloatArray, to_pose: FloatArray) -> FloatArray:
    """All valid points of a depth image in the camera frame of another pose."""
    v, u = np.nonzero(np.isfinite(depth))
    points = back_project(camera, np.column_stack([u, v]), depth[v, u])
    relative = invert_pose(to_pose) @ from_pose
    return np.asarray(points @ relative[:3, :3].T + relative[:3, 3])


def depth_residuals(
    camera: Camera, first: Float32Array, first_pose: FloatArray, second: Float32Array, second_pose: FloatArray
) -> FloatArray:
    """Metres between points of `first` and the depth that `second` has where they fall."""
    points = moved_points(camera, first, first_pose, second_pose)
    points = points[points[:, 2] > 0.1]
    u = np.rint(camera.fx * points[:, 0] / points[:, 2] + camera.cx).astype(int)
    v = np.rint(camera.fy * points[:, 1] / points[:, 2] + camera.cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    residuals = np.abs(second[v[inside], u[inside]] - points[inside, 2])
    return np.asarray(residuals[np.isfinite(residuals)])
