"""kapture 1.1: sensors, trajectories, images and depth as raw float32 of a map's keyframes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from semdb.exchange.source import ExportOptions, MapSource, decoded, new_folder, suffix_of
from semdb.geometry import invert_pose, quat_wxyz_from_rotation
from semdb.types import Camera

HEAD = "# kapture format: 1.1\n"


def write_kapture(source: MapSource, out: Path, options: ExportOptions) -> str:
    """Times are the positions of keyframes in the export: kapture's have no unit, and some keyframes have none."""
    sensors = new_folder(out) / "sensors"
    data = sensors / "records_data"
    data.mkdir(parents=True)
    cameras = sorted({head.camera for head in source.heads}, key=str)
    number = {camera: i for i, camera in enumerate(cameras)}
    with_depth = 0
    with (
        (sensors / "trajectories.txt").open("w", encoding="utf-8") as trajectories,
        (sensors / "records_camera.txt").open("w", encoding="utf-8") as images,
        (sensors / "records_depth.txt").open("w", encoding="utf-8") as depths,
    ):
        for file, columns in (
            (trajectories, "# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz\n"),
            (images, "# timestamp, device_id, image_path\n"),
            (depths, "# timestamp, device_id, depth_map_path\n"),
        ):
            file.write(HEAD + columns)
        for time, head in enumerate(source.heads):
            stored = source.image(head.id)
            name = source.file_name(head, suffix_of(stored.rgb_format))
            path = data / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(stored.rgb)
            pose = invert_pose(head.world_from_camera)
            numbers = (*quat_wxyz_from_rotation(pose[:3, :3]), *pose[:3, 3])
            device = number[head.camera]
            for sensor in (f"camera{device}", f"depth{device}"):
                trajectories.write(f"{time}, {sensor}, {', '.join(repr(float(value)) for value in numbers)}\n")
            images.write(f"{time}, camera{device}, {name}\n")
            depth = decoded(stored, head)[1] if stored.depth is not None else None
            if depth is not None:
                raw = np.nan_to_num(depth, nan=0.0).astype("<f4")
                depth_name = source.file_name(head, ".depth")
                (data / depth_name).write_bytes(raw.tobytes())
                depths.write(f"{time}, depth{device}, {depth_name}\n")
                with_depth += 1
            source.tell("exporting", time + 1)
    _write_sensors(sensors, cameras, with_depth > 0)
    if not with_depth:
        (sensors / "records_depth.txt").unlink()
    return f"{len(source.heads)} images of {len(cameras)} cameras, {with_depth} with depth"


def _write_sensors(folder: Path, cameras: list[Camera], with_depth: bool) -> None:
    lines, rigs = [HEAD, "# sensor_id, name, sensor_type, [sensor_params]+\n"], [HEAD]
    rigs.append("# rig_id, sensor_id, qw, qx, qy, qz, tx, ty, tz\n")
    for i, camera in enumerate(cameras):
        for kind in ("camera", "depth") if with_depth else ("camera",):
            lines.append(f"{kind}{i}, {kind}{i}, {kind}, {_model(camera)}\n")
            rigs.append(f"rig{i}, {kind}{i}, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0\n")
    (folder / "sensors.txt").write_text("".join(lines), encoding="utf-8")
    (folder / "rigs.txt").write_text("".join(rigs), encoding="utf-8")


def _model(camera: Camera) -> str:
    numbers = [camera.fx, camera.fy, camera.cx, camera.cy]
    name = "PINHOLE"
    if any(camera.distortion):
        k1, k2, p1, p2, k3 = (*camera.distortion, *([0.0] * 5))[:5]
        name, numbers = "FULL_OPENCV", [*numbers, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0]
    return ", ".join([name, str(camera.width), str(camera.height), *(repr(float(value)) for value in numbers)])
