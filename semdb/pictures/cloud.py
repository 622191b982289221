"""The coloured points of a map, for viewers: from depth images where there are any, else from keypoints."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from semdb.errors import CodecError
from semdb.geometry import back_project, transform_points
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

FARTHEST_M = 8.0  # what sensors of rooms say beyond is mostly noise
STEPS = 65_535
HEAD = 32  # bytes before the points of what viewers get
FEWEST_STEP_M = 0.005

Colours = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points of a map, metres with colours, in an order of which every beginning is spread evenly."""

    points: Float32Array  # [n, 3]
    colours: Colours  # [n, 3] RGB
    keyframes: int  # of which they are

    def packed(self) -> bytes:
        """The points as viewers get them: see docs/service.md."""
        count = len(self.points)
        low = self.points.min(axis=0) if count else np.zeros(3, np.float32)
        high = self.points.max(axis=0) if count else np.zeros(3, np.float32)
        step = np.maximum((high - low) / STEPS, np.float32(1e-9)).astype(np.float32)
        grid = np.clip(np.round((self.points - low) / step), 0, STEPS).astype("<u2")
        head = np.array([count, self.keyframes], "<u4").tobytes() + np.concatenate([low, step]).astype("<f4").tobytes()
        return bytes(head + grid.tobytes() + self.colours.tobytes())

    @classmethod
    def unpacked(cls, data: bytes) -> Cloud:
        """The points of `packed`, each on the step that it was put on. Raises CodecError for what is none of it."""
        if len(data) < HEAD or len(data) != HEAD + 9 * int(np.frombuffer(data, "<u4", 1)[0]):
            raise CodecError("these are no points as a service sends them")
        count, keyframes = (int(value) for value in np.frombuffer(data, "<u4", 2))
        low, step = np.frombuffer(data, "<f4", 6, 8).reshape(2, 3)
        grid = np.frombuffer(data, "<u2", 3 * count, HEAD).reshape(count, 3)
        colours = np.frombuffer(data, np.uint8, 3 * count, HEAD + 6 * count).reshape(count, 3)
        return cls((low + grid * step).astype(np.float32), colours, keyframes)


def points_of_depth(
    image: ImageArray, depth: Float32Array, camera: Camera, world_from_camera: FloatArray, most: int
) -> tuple[Float32Array, Colours]:
    """Up to `most` points ``[n, 3]`` of a depth image ``[H, W]`` (metres, NaN where there is none), with colours."""
    step = max(1, int(np.ceil(np.sqrt(depth.size / max(1, most)))))
    rows, columns = (
        axis.ravel() for axis in np.mgrid[step // 2 : depth.shape[0] : step, step // 2 : depth.shape[1] : step]
    )
    metres = depth[rows, columns]
    good = np.isfinite(metres) & (metres > 0) & (metres < FARTHEST_M)
    rows, columns, metres = rows[good], columns[good], metres[good]
    points = transform_points(world_from_camera, back_project(camera, np.stack([columns, rows], axis=1), metres))
    return points.astype(np.float32), image[rows, columns]


def points_of_keypoints(
    image: ImageArray, xy: Float32Array, points: Float32Array, world_from_camera: FloatArray
) -> tuple[Float32Array, Colours]:
    """Keypoints ``[n, 2]`` that have a place ``[n, 3]`` in the camera's frame (NaN: none), moved into the map."""
    good = np.isfinite(points).all(axis=1)
    pixels = np.round(xy[good]).astype(np.int64)
    columns = np.clip(pixels[:, 0], 0, image.shape[1] - 1)
    rows = np.clip(pixels[:, 1], 0, image.shape[0] - 1)
    return transform_points(world_from_camera, points[good]).astype(np.float32), image[rows, columns]


def cloud_of(parts: Iterable[tuple[Float32Array, Colours]], most: int) -> Cloud:
    """One cloud of at most `most` points: one for each cube of a grid, as fine as that number allows.

    The same parts give the same cloud.
    """
    given = [part for part in parts if len(part[0])]
    if not given:
        return Cloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), 0)
    points = np.concatenate([part[0] for part in given])
    colours = np.concatenate([part[1] for part in given])
    finite = np.isfinite(points).all(axis=1)
    points, colours = points[finite], colours[finite]
    size = FEWEST_STEP_M
    kept = _one_a_cube(points, size)
    while len(kept) > most:
        size *= max(1.1, (len(kept) / most) ** 0.5)
        kept = kept[_one_a_cube(points[kept], size)]
    order = np.random.default_rng(0).permutation(len(kept))
    return Cloud(points[kept][order], colours[kept][order], len(given))


def _one_a_cube(points: Float32Array, size: float) -> npt.NDArray[np.int64]:
    """Which points are the first ones of their cubes of `size` metres."""
    cubes = np.floor(points / size).astype(np.int64)
    cubes -= cubes.min(axis=0)
    spans = cubes.max(axis=0) + 1
    keys = (cubes[:, 0] * spans[1] + cubes[:, 1]) * spans[2] + cubes[:, 2]
    return np.sort(np.unique(keys, return_index=True)[1])


def spread(poses: FloatArray, most: int) -> list[int]:
    """Up to `most` of poses ``[n, 4, 4]`` that lie apart: each the farthest from those before it."""
    count = len(poses)
    if count <= most:
        return list(range(count))
    features = np.concatenate([poses[:, :3, 3], poses[:, :3, 2]], axis=1)
    chosen = [0]
    away = np.linalg.norm(features - features[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(np.argmax(away)))
        away = np.minimum(away, np.linalg.norm(features - features[chosen[-1]], axis=1))
    return sorted(chosen)
