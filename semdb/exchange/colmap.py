"""A model of COLMAP as text, with images, 3D points and the pixels that see them: for hloc, pycolmap, nerfstudio.

Pixels are half a pixel further than semdb's, whose first pixel's centre is (0, 0). One unit is one metre, which a line
of ``cameras.txt`` says.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from semdb.errors import CodecError
from semdb.exchange.source import ExportOptions, MapSource, decoded, new_folder, suffix_of
from semdb.exchange.tracks import Tracks, View, find_tracks
from semdb.geometry import invert_pose, quat_wxyz_from_rotation, transform_points
from semdb.types import Camera, Float32Array, Int64Array

HALF = 0.5
METRIC = "# 1 unit is 1 metre"
VIEWS_KEPT = 64


def write_colmap(source: MapSource, out: Path, options: ExportOptions) -> str:
    """``sparse/0/{cameras,images,points3D}.txt`` and ``images/``."""
    model = new_folder(out) / "sparse" / "0"
    model.mkdir(parents=True)
    cameras = {camera: i for i, camera in enumerate(sorted({head.camera for head in source.heads}, key=str), 1)}
    lines = ["# Camera list: CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", METRIC]
    lines += [f"{number} {camera_line(camera)}" for camera, number in cameras.items()]
    (model / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    names = _write_images(source, out / "images")
    tracks, counts = _tracks(source)
    _write_image_list(source, model / "images.txt", cameras, names, tracks, counts)
    _write_points(source, model / "points3D.txt", tracks)
    error = f", mean reprojection error {tracks.error.mean():.2f} px of 640" if len(tracks.points) else ""
    return (
        f"{len(source.heads)} images of {len(cameras)} cameras, {len(tracks.points)} points with {len(tracks.point)} "
        f"observations{error}"
    )


def camera_line(camera: Camera) -> str:
    """Model and parameters of a camera as COLMAP has them."""
    numbers = [camera.fx, camera.fy, camera.cx + HALF, camera.cy + HALF]
    name = "PINHOLE"
    if any(camera.distortion):
        k1, k2, p1, p2, k3 = (*camera.distortion, *([0.0] * 5))[:5]
        name, numbers = "OPENCV", [*numbers, k1, k2, p1, p2]
        if k3:
            name, numbers = "FULL_OPENCV", [*numbers, k3, 0.0, 0.0, 0.0]
    return " ".join([name, str(camera.width), str(camera.height), *(repr(float(value)) for value in numbers)])


def _write_images(source: MapSource, folder: Path) -> list[str]:
    names = []
    for done, head in enumerate(source.heads, 1):
        stored = source.image(head.id)
        name = source.file_name(head, suffix_of(stored.rgb_format))
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(stored.rgb)
        names.append(name)
        source.tell("writing images of", done)
    return names


def _tracks(source: MapSource) -> tuple[Tracks, list[int]]:
    """Tracks over all keyframes, and how many keypoints each keyframe has."""
    counts = [len(keyframe.keypoints) for keyframe in source.keyframes(descriptors=False)]

    widths: dict[int, int] = {}  # of descriptors, and a keyframe that has them

    @lru_cache(maxsize=VIEWS_KEPT)
    def view_of(index: int) -> View:
        view, key = load_view(source, index), source.heads[index].id
        if len(view.xy):
            widths.setdefault(view.descriptors.shape[1], key)
        if len(widths) > 1:
            each = ", ".join(f"{width} numbers in keyframe {of}" for width, of in widths.items())
            raise CodecError(f"descriptors.data of one map differ: {each}; delete what is damaged")
        return view

    poses = np.stack([head.world_from_camera for head in source.heads])
    return find_tracks(poses, counts, view_of, lambda done: source.tell("joining points of", done)), counts


def load_view(source: MapSource, index: int) -> View:
    """The keypoints of a keyframe; refined points take the place of measured ones."""
    head = source.heads[index]
    [keyframe] = source.store.load_keyframes([head.id])
    features = keyframe.keypoints.features
    points = keyframe.keypoints.points.astype(np.float64)
    refined = source.refined([head.id]).get(head.id)
    if refined is not None and len(refined) == len(points):
        better = np.isfinite(refined[:, :3]).all(axis=1)
        points[better] = refined[better, :3]
    described: Float32Array = np.asarray(features.descriptors, dtype=np.float32)  # of unit length below, bytes as well
    norm = np.linalg.norm(described, axis=1, keepdims=True)
    described = described / np.maximum(norm, 1e-12)
    world = transform_points(head.world_from_camera, points)
    return View(head.camera, head.world_from_camera, features.xy.astype(np.float64), described, world)


def _write_image_list(
    source: MapSource, path: Path, cameras: dict[Camera, int], names: list[str], tracks: Tracks, counts: list[int]
) -> None:
    order = np.argsort(tracks.view, kind="stable")
    starts = np.searchsorted(tracks.view[order], np.arange(len(source.heads) + 1))
    with path.open("w", encoding="utf-8") as file:
        file.write(
            "# Image list: IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, then POINTS2D[] X, Y, POINT3D_ID\n"
        )
        keyframes = source.keyframes(descriptors=False)
        for index, (head, keyframe) in enumerate(zip(source.heads, keyframes, strict=True)):
            pose = invert_pose(head.world_from_camera)
            numbers = (*quat_wxyz_from_rotation(pose[:3, :3]), *pose[:3, 3])
            text = " ".join(repr(float(value)) for value in numbers)
            file.write(f"{index + 1} {text} {cameras[head.camera]} {names[index]}\n")
            own = order[starts[index] : starts[index + 1]]
            point_of = np.full(counts[index], -1, np.int64)
            point_of[tracks.keypoint[own]] = tracks.point[own] + 1
            xy = keyframe.keypoints.features.xy.tolist()
            seen = zip(xy, point_of.tolist(), strict=True)
            file.write(" ".join(f"{x + HALF:.3f} {y + HALF:.3f} {point}" for (x, y), point in seen))
            file.write("\n")
            source.tell("exporting", index + 1)


def _write_points(source: MapSource, path: Path, tracks: Tracks) -> None:
    colours = _colours(source, tracks)
    starts = np.searchsorted(tracks.point, np.arange(len(tracks.points) + 1))
    with path.open("w", encoding="utf-8") as file:
        file.write("# 3D point list: POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n")
        for index, (point, error) in enumerate(zip(tracks.points.tolist(), tracks.error.tolist(), strict=True)):
            rows = slice(starts[index], starts[index + 1])
            seen = zip(tracks.view[rows].tolist(), tracks.keypoint[rows].tolist(), strict=True)
            track = " ".join(f"{view + 1} {keypoint}" for view, keypoint in seen)
            x, y, z = point
            r, g, b = colours[index]
            file.write(f"{index + 1} {x:.6f} {y:.6f} {z:.6f} {r} {g} {b} {error:.4f} {track}\n")


def _colours(source: MapSource, tracks: Tracks) -> Int64Array:
    """RGB ``[t, 3]`` of each point, of the pixel of its first observation."""
    colours = np.zeros((len(tracks.points), 3), np.int64)
    _, first = np.unique(tracks.point, return_index=True)
    for view in np.unique(tracks.view[first]).tolist():
        rows = first[tracks.view[first] == view]
        head = source.heads[view]
        image = decoded(source.image(head.id), head)[0]
        [keyframe] = source.store.load_keyframes([head.id], descriptors=False)
        xy = np.rint(keyframe.keypoints.features.xy[tracks.keypoint[rows]]).astype(int)
        xy = np.clip(xy, 0, (head.camera.width - 1, head.camera.height - 1))
        colours[tracks.point[rows]] = image[xy[:, 1], xy[:, 0]]
    return colours
