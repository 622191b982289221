"""Tiny recordings in the formats of phones and other tools, of the same box-shaped room as `recording_miniatures`."""

from __future__ import annotations

import json
import sqlite3
import struct
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from semdb.geometry import invert_pose, pose_from, quat_wxyz_from_rotation, so3_exp
from semdb.recordings.options import BACK
from semdb.recordings.own_depth import resized
from semdb.recordings.rvl import encode_rvl
from semdb.types import Camera, FloatArray
from tests.unit.recording_miniatures import depth_units, pose, render, write_image

PHONE = Camera(160, 120, 130.0, 130.0, 79.0, 60.5)  # colour; depth is 40x30
DEPTH = resized(PHONE, 40, 30)
UPRIGHT = Camera(90, 120, 100.0, 100.0, 44.0, 60.0)


def quat_xyzw(matrix: FloatArray) -> list[float]:
    w, x, y, z = (float(value) for value in quat_wxyz_from_rotation(matrix[:3, :3]))
    return [x, y, z, w]


def write_stray(folder: Path, n: int = 5) -> Path:
    """A video (lossy), depth in millimetres and confidence; the last column of depth is of low confidence."""
    folder.mkdir(parents=True)
    video = cv2.VideoWriter(str(folder / "rgb.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), 30, (PHONE.width, PHONE.height))
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for i in range(n):
        image, _ = render(PHONE, pose(i))
        _, z = render(DEPTH, pose(i))
        video.write(np.ascontiguousarray(image[..., ::-1]))
        write_image(folder / "depth" / f"{i:06d}.png", depth_units(z, 1000))
        confidence = np.full(z.shape, 2, np.uint8)
        confidence[:, -1] = 0
        write_image(folder / "confidence" / f"{i:06d}.png", confidence)
        x, y, depth = pose(i)[:3, 3]
        lines.append(
            ", ".join([f"{10 + i / 30:.6f}", f"{i:06d}", *(f"{v:.9f}" for v in (x, y, depth, *quat_xyzw(pose(i))))])
        )
    video.release()
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    matrix = [[PHONE.fx, 0, PHONE.cx], [0, PHONE.fy, PHONE.cy], [0, 0, 1]]
    (folder / "camera_matrix.csv").write_text("\n".join(", ".join(map(str, row)) for row in matrix) + "\n")
    return folder


def write_record3d(path: Path, n: int = 4, camera: Camera = PHONE, archive: bool = True) -> Path:
    """An archive ``.r3d`` (or its folder); focal lengths grow by a pixel a frame."""
    import lzfse

    folder = path if not archive else path.with_suffix(".unpacked")
    (folder / "rgbd").mkdir(parents=True)
    coefficients, poses = [], []
    small = resized(camera, camera.width // 2, camera.height // 2)
    for i in range(n):
        own = Camera(camera.width, camera.height, camera.fx + i, camera.fy + i, camera.cx, camera.cy)
        image, _ = render(own, pose(i))
        _, z = render(resized(own, small.width, small.height), pose(i))
        done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
        assert done
        (folder / "rgbd" / f"{i}.jpg").write_bytes(data.tobytes())
        (folder / "rgbd" / f"{i}.depth").write_bytes(lzfse.compress(z.astype("<f4").tobytes()))
        sure = np.full(z.shape, 2, np.uint8)
        sure[0] = 0
        (folder / "rgbd" / f"{i}.conf").write_bytes(lzfse.compress(sure.tobytes()))
        turned = pose(i) @ BACK
        poses.append([*quat_xyzw(turned), *map(float, turned[:3, 3])])
        coefficients.append([own.fx, own.fy, own.cx, own.cy])
    metadata = {
        "w": camera.width,
        "h": camera.height,
        "dw": small.width,
        "dh": small.height,
        "fps": 30,
        "K": [camera.fx, 0, 0, 0, camera.fy, 0, camera.cx, camera.cy, 1],
        "poses": poses,
        "perFrameIntrinsicCoeffs": coefficients,
    }
    (folder / "metadata").write_text(json.dumps(metadata))
    if not archive:
        return folder
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for file in sorted(folder.rglob("*")):
            if file.is_file():
                target.write(file, file.relative_to(folder).as_posix())
    return path


def write_polycam(folder: Path, n: int = 4, corrected: bool = True) -> Path:
    """Keyframes at 1000 s + i s; the cameras before the correction are 1 m off."""
    keyframes = folder / "keyframes"
    for i in range(n):
        stem = str(1_000_000_000 + i * 1_000_000)
        image, _ = render(PHONE, pose(i))
        _, z = render(DEPTH, pose(i))
        write_image(keyframes / "depth" / f"{stem}.png", depth_units(z, 1000))
        write_image(keyframes / "confidence" / f"{stem}.png", np.full(z.shape, 255, np.uint8))
        for kind in ("corrected_", "")[0 if corrected else 1 :]:
            write_image(keyframes / f"{kind}images" / f"{stem}.png", image)
            turned = pose(i) @ BACK
            if corrected and not kind:
                turned[0, 3] += 1
            content = {f"t_{r}{c}": float(turned[r, c]) for r in range(3) for c in range(4)}
            content |= {key: getattr(PHONE, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
            content |= {"blur_score": 100.0, "timestamp": int(stem)}
            (keyframes / f"{kind}cameras").mkdir(exist_ok=True)
            (keyframes / f"{kind}cameras" / f"{stem}.json").write_text(json.dumps(content))
    (keyframes / "images").mkdir(exist_ok=True)
    return folder


def write_sens(file: Path, n: int = 4, lost: int | None = None) -> Path:
    """Depth is of a camera of its own, 2 cm beside colour; the pose of frame `lost` is -inf."""
    file.parent.mkdir(parents=True, exist_ok=True)
    color_from_depth = np.eye(4)
    color_from_depth[0, 3] = 0.02
    parts = [struct.pack("<IQ", 4, 9), b"StructIO!"]
    for camera, extrinsic in ((PHONE, np.eye(4)), (DEPTH, color_from_depth)):
        intrinsic = np.eye(4)
        intrinsic[:3, :3] = camera.matrix
        parts += [intrinsic.astype("<f4").tobytes(), extrinsic.astype("<f4").tobytes()]
    parts.append(struct.pack("<iiIIIIfQ", 2, 1, PHONE.width, PHONE.height, DEPTH.width, DEPTH.height, 1000.0, n))
    for i in range(n):
        image, _ = render(PHONE, pose(i))
        _, z = render(DEPTH, pose(i) @ color_from_depth)
        done, data = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
        assert done
        packed = zlib.compress(depth_units(z, 1000).astype("<u2").tobytes())
        matrix = np.full((4, 4), -np.inf) if i == lost else pose(i)
        parts += [matrix.astype("<f4").tobytes(), struct.pack("<QQQQ", i * 33333, i * 33333, len(data), len(packed))]
        parts += [data.tobytes(), packed]
    file.write_bytes(b"".join(parts))
    return file


def write_scannet_folder(folder: Path, n: int = 4) -> Path:
    for i in range(n):
        image, _ = render(PHONE, pose(i))
        _, z = render(DEPTH, pose(i))
        write_image(folder / "color" / f"{i}.png", image)
        write_image(folder / "depth" / f"{i}.png", depth_units(z, 1000))
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / "pose" / f"{i}.txt", pose(i))
    (folder / "intrinsic").mkdir()
    for camera, name in ((PHONE, "color"), (DEPTH, "depth")):
        intrinsic = np.eye(4)
        intrinsic[:3, :3] = camera.matrix
        np.savetxt(folder / "intrinsic" / f"intrinsic_{name}.txt", intrinsic)
        np.savetxt(folder / "intrinsic" / f"extrinsic_{name}.txt", np.eye(4))
    return folder


def write_nice_slam(folder: Path, n: int = 4, camera: Camera = PHONE) -> Path:
    folder.mkdir(parents=True)
    lines = []
    for i in range(n):
        image, z = render(camera, pose(i))
        write_image(folder / "results" / f"frame{i:06d}.jpg", image)
        write_image(folder / "results" / f"depth{i:06d}.png", depth_units(z, 6553.5))
        lines.append(" ".join(f"{value:.12e}" for value in pose(i).ravel()))
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    content = {key: getattr(camera, key) for key in ("fx", "fy", "cx", "cy")} | {"w": camera.width, "h": camera.height}
    (folder.parent / "cam_params.json").write_text(json.dumps({"camera": content | {"scale": 6553.5}}))
    return folder


def write_redwood(folder: Path, n: int = 4, camera: Camera = PHONE) -> Path:
    blocks = []
    for i in range(n):
        image, z = render(camera, pose(i))
        write_image(folder / "color" / f"{i + 1:06d}.png", image)
        write_image(folder / "depth" / f"{i + 1:06d}.png", depth_units(z, 1000))
        rows = "\n".join(" ".join(f"{value:.10f}" for value in row) for row in pose(i))
        blocks.append(f"{i}\t{i}\t{i + 1}\n{rows}")
    (folder / "trajectory.log").write_text("\n".join(blocks) + "\n")
    matrix = camera.matrix.T.ravel().tolist()
    content = {"width": camera.width, "height": camera.height, "intrinsic_matrix": matrix}
    (folder / "intrinsic.json").write_text(json.dumps(content))
    return folder


def camera_from_world(world_from_camera: FloatArray) -> FloatArray:
    return np.asarray(invert_pose(world_from_camera))


@dataclass
class RtabmapPlan:
    """What is written into a database of RTAB-Map: poses of nodes are drifted odometry unless there are no others."""

    frames: int = 4
    depth: str = "rvl"  # rvl, png, float or none
    depth_factor: int = 1  # colour is so many times larger
    cameras: int = 1
    optimised: bool = True
    version: str = "0.23.8"
    calibration: str = "models"  # models, floats


BASE_FROM_CAMERA = np.array([[0.0, 0, 1, 0.1], [-1, 0, 0, 0.0], [0, -1, 0, 0.4], [0, 0, 0, 1]])


def rtabmap_camera_pose(i: int, part: int) -> FloatArray:
    """The second camera looks 0.3 rad to the side."""
    return pose(i) @ pose_from(so3_exp([0.0, 0.3 * part, 0.0]), [0.02 * part, 0.0, 0.0])


def write_rtabmap(path: Path, plan: RtabmapPlan | None = None, camera: Camera = PHONE) -> Path:
    plan = plan or RtabmapPlan()
    path.parent.mkdir(parents=True, exist_ok=True)
    connection = sqlite3.connect(path)
    connection.executescript(
        "CREATE TABLE Node (id INTEGER PRIMARY KEY, map_id INTEGER, weight INTEGER, stamp FLOAT, pose BLOB, "
        "label TEXT);"
        "CREATE TABLE Data (id INTEGER PRIMARY KEY, image BLOB, depth BLOB, calibration BLOB);"
        "CREATE TABLE Link (from_id INTEGER, to_id INTEGER, type INTEGER, information_matrix BLOB, transform BLOB);"
        "CREATE TABLE Feature (node_id INTEGER); CREATE TABLE Word (id INTEGER);"
        "CREATE TABLE Admin (version TEXT, opt_ids BLOB, opt_poses BLOB);"
    )
    bases = []
    for i in range(plan.frames):
        base = pose(i) @ invert_pose(BASE_FROM_CAMERA)
        bases.append(base)
        drifted = base.copy()
        drifted[0, 3] += 0.1 * i if plan.optimised else 0.0
        images, depths = [], []
        small = resized(camera, camera.width // plan.depth_factor, camera.height // plan.depth_factor)
        for part in range(plan.cameras):
            images.append(render(camera, rtabmap_camera_pose(i, part))[0])
            depths.append(render(small, rtabmap_camera_pose(i, part))[1])
        done, data = cv2.imencode(".jpg", np.hstack(images)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 98])
        assert done
        depth = None if plan.depth == "none" else _rtabmap_depth(np.hstack(depths), plan.depth)
        weight = -1 if i == 99 else 0
        connection.execute(
            "INSERT INTO Node VALUES (?, 0, ?, ?, ?, '')",
            (i + 1, weight, 100.0 + i, drifted[:3].astype("<f4").tobytes()),
        )
        calibration = b"".join(_rtabmap_calibration(plan, camera, part) for part in range(plan.cameras))
        connection.execute("INSERT INTO Data VALUES (?, ?, ?, ?)", (i + 1, data.tobytes(), depth, calibration))
    ids = poses = None
    if plan.optimised:
        ids = _rtabmap_matrix(np.arange(1, plan.frames + 1, dtype="<i4")[None], 4)
        poses = _rtabmap_matrix(np.stack([base[:3].ravel() for base in bases]).astype("<f4"), 5)
    connection.execute("INSERT INTO Admin VALUES (?, ?, ?)", (plan.version, ids, poses))
    connection.commit()
    connection.close()
    return path


def _rtabmap_matrix(values: np.ndarray, kind: int) -> bytes:
    return zlib.compress(values.tobytes()) + struct.pack("<3i", values.shape[0], values.shape[1], kind)


def _rtabmap_depth(z: np.ndarray, form: str) -> bytes:
    if form == "rvl":
        return b"DEPTHRVL" + struct.pack("<II", z.shape[1], z.shape[0]) + encode_rvl(depth_units(z, 1000))
    values = depth_units(z, 1000) if form == "png" else z.astype("<f4").view(np.uint8).reshape(*z.shape, 4)
    done, data = cv2.imencode(".png", values)
    assert done
    return data.tobytes()


def _rtabmap_calibration(plan: RtabmapPlan, camera: Camera, part: int) -> bytes:
    local = BASE_FROM_CAMERA @ invert_pose(pose(0)) @ rtabmap_camera_pose(0, part)
    floats = local[:3].astype("<f4").tobytes()
    if plan.calibration == "floats":
        head = struct.pack("<6f", camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
        return head + floats
    head = struct.pack("<11i", 0, 23, 8, 0, camera.width, camera.height, 9, 5, 9, 12, 12)
    projection = np.column_stack([camera.matrix, np.zeros(3)])
    parts = (camera.matrix, np.array([0.1, 0.2, 0, 0, 0]), np.eye(3), projection)
    return head + b"".join(np.ascontiguousarray(value, "<f8").tobytes() for value in parts) + floats
