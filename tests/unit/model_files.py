"""Tiny models of COLMAP and data sets of kapture, of the same box-shaped room as `recording_miniatures`."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from semdb.geometry import invert_pose, quat_wxyz_from_rotation
from semdb.types import Camera, FloatArray
from tests.unit.recording_miniatures import SMALL, pose, render, write_image

UNIT_M = 0.5  # metres of a unit of the model


def write_colmap(
    folder: Path, n: int = 4, *, binary: bool = False, own_cameras: bool = False, metric: bool = False
) -> Path:
    """A model in ``sparse/0`` with images; with `own_cameras` each has its own focal length."""
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    unit = 1.0 if metric else UNIT_M
    cameras = {i + 1: _camera(i if own_cameras else 0) for i in range(n if own_cameras else 1)}
    images = []
    for i in range(n):
        camera_id = i + 1 if own_cameras else 1
        write_image(folder / "images" / "deep" / f"{i}.png", render(cameras[camera_id], pose(i))[0])
        moved = pose(i)
        moved[:3, 3] /= unit
        images.append((10 + i, invert_pose(moved), camera_id, f"deep/{i}.png"))
    write = _write_binary if binary else _write_text
    write(model, cameras, images, metric)
    return folder


def _camera(i: int) -> Camera:
    return Camera(SMALL.width, SMALL.height, SMALL.fx + i, SMALL.fy + i, SMALL.cx, SMALL.cy)


def _quat(matrix: FloatArray) -> list[float]:
    return [float(value) for value in quat_wxyz_from_rotation(matrix[:3, :3])]


def _write_text(model: Path, cameras: dict[int, Camera], images: list, metric: bool) -> None:
    lines = ["# Camera list", *(["# 1 unit is 1 metre"] if metric else [])]
    lines += [f"{i} PINHOLE {c.width} {c.height} {c.fx} {c.fy} {c.cx + 0.5} {c.cy + 0.5}" for i, c in cameras.items()]
    (model / "cameras.txt").write_text("\n".join(lines) + "\n")
    rows = ["# Image list"]
    for image_id, matrix, camera_id, name in images:
        numbers = " ".join(f"{value:.12g}" for value in (*_quat(matrix), *matrix[:3, 3]))
        rows += [f"{image_id} {numbers} {camera_id} {name}", "1.5 2.5 7 3.5 4.5 -1" if image_id % 2 else ""]
    (model / "images.txt").write_text("\n".join(rows) + "\n")
    (model / "points3D.txt").write_text("7 0 0 1 10 20 30 0.5 11 0\n8 0 0 2 1 2 3 1.5\n")


def _write_binary(model: Path, cameras: dict[int, Camera], images: list, metric: bool) -> None:
    parts = [struct.pack("<Q", len(cameras))]
    for i, c in cameras.items():
        parts.append(struct.pack("<IiQQ4d", i, 1, c.width, c.height, c.fx, c.fy, c.cx + 0.5, c.cy + 0.5))
    (model / "cameras.bin").write_bytes(b"".join(parts))
    parts = [struct.pack("<Q", len(images))]
    for image_id, matrix, camera_id, name in images:
        parts.append(struct.pack("<I7dI", image_id, *_quat(matrix), *matrix[:3, 3], camera_id) + name.encode() + b"\0")
        parts.append(struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.5, 2.5, 7 if image_id % 2 else -1, 3.5, 4.5, -1))
    (model / "images.bin").write_bytes(b"".join(parts))
    points = struct.pack("<Q", 2) + struct.pack("<Q3d3BdQII", 7, 0, 0, 1, 10, 20, 30, 0.5, 1, 11, 0)
    (model / "points3D.bin").write_bytes(points + struct.pack("<Q3d3BdQ", 8, 0, 0, 2, 1, 2, 3, 1.5, 0))


def write_kapture(folder: Path, n: int = 4, *, rig: bool = True, beside: bool = False) -> Path:
    """Colour and depth of one rig; with `beside` depth is of a sensor 3 cm to the right, else registered."""
    sensors, data = folder / "sensors", folder / "sensors" / "records_data"
    data.mkdir(parents=True)
    line = f"SIMPLE_PINHOLE, {SMALL.width}, {SMALL.height}, {SMALL.fx}, {SMALL.cx}, {SMALL.cy}"
    head = "# kapture format: 1.1\n"
    (sensors / "sensors.txt").write_text(f"{head}rgb, rgb, camera, {line}\nd, d, depth, {line}\nimu, imu, imu\n")
    rgb_from_rig = np.eye(4)
    rgb_from_rig[:3, 3] = 0.1, -0.2, 0.3
    d_from_rig = rgb_from_rig.copy()
    if beside:
        d_from_rig[0, 3] -= 0.03
    poses, rigs, images, depths = [head], [head], [head], [head]
    for name, matrix in (("rgb", rgb_from_rig), ("d", d_from_rig)):
        rigs.append("r, " + name + ", " + ", ".join(map(str, (*_quat(matrix), *matrix[:3, 3]))) + "\n")
    for i in range(n):
        rgb_from_world = invert_pose(pose(i))
        matrix, device = (invert_pose(rgb_from_rig) @ rgb_from_world, "r") if rig else (rgb_from_world, "rgb")
        poses.append(f"{i}, {device}, " + ", ".join(map(str, (*_quat(matrix), *matrix[:3, 3]))) + "\n")
        image, z = render(SMALL, pose(i))
        write_image(data / "cam" / f"{i}.png", image)
        if beside:
            z = render(SMALL, pose(i) @ rgb_from_rig @ invert_pose(d_from_rig))[1]
        (data / f"{i}.depth").write_bytes(z.astype("<f4").tobytes())
        images.append(f"{i}, rgb, cam/{i}.png\n")
        depths.append(f"{i}, d, {i}.depth\n")
    for name, lines in (("trajectories", poses), ("rigs", rigs), ("records_camera", images), ("records_depth", depths)):
        (sensors / f"{name}.txt").write_text("".join(lines))
    return folder
