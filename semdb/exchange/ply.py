"""A coloured cloud of the keyframes' depth, thinned by voxels, as binary PLY: a voxel keeps the first point in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, UsageError
from semdb.exchange.source import ExportOptions, MapSource, decoded, new_file
from semdb.geometry import back_project, transform_points
from semdb.types import BoolArray, Camera, Float32Array, FloatArray, ImageArray

VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
SMALLEST_M = 0.001  # of a voxel: 21 bits an axis reach a kilometre then
LATE = 50_000  # numbers at least before they are sorted in among all
EDGES = np.array(
    [[0, 1], [1, 2], [2, 3], [3, 0], [4, 5], [5, 6], [6, 7], [7, 4], [0, 4], [1, 5], [2, 6], [3, 7]], np.int64
)  # of a box, by its corners
COUNT_DIGITS = 12  # of the number of points, which is known at the end only


def write_ply(source: MapSource, out: Path, options: ExportOptions) -> str:
    """Points of all keyframes that have depth. What is in memory are the voxels that have a point, 8 bytes each.

    Raises UsageError where no keyframe has depth.
    """
    if not SMALLEST_M <= options.voxel_m < np.inf:
        raise UsageError(f"--voxel must be {SMALLEST_M:g} metres or more, but is {options.voxel_m:g}")
    if not options.max_depth_m > 0:
        raise UsageError(f"--max-depth must be positive, but is {options.max_depth_m:g}")
    seen = _Seen()
    count = without = 0
    with new_file(out).open("wb") as file:
        boxes = _boxes(source) if options.landmarks else []
        file.write(_header(0, source.name, len(boxes)))
        for done, head in enumerate(source.heads, 1):
            try:
                image, depth = decoded(source.image(head.id), head)
            except FrameError:
                depth = None
            if depth is None:
                without += 1
            else:
                points, colours = cloud(image, depth, head.camera, head.world_from_camera, options)
                keys = voxels(points, options.voxel_m)
                keys, first = np.unique(keys, return_index=True)
                chosen = np.sort(first[seen.add(keys)])
                rows = np.empty(len(chosen), VERTEX)
                for axis, name in enumerate("xyz"):
                    rows[name] = points[chosen, axis]
                for channel, name in enumerate(("red", "green", "blue")):
                    rows[name] = colours[chosen, channel]
                file.write(rows.tobytes())
                count += len(chosen)
            source.tell("exporting", done)
        file.write(b"".join(corners.tobytes() for corners in boxes))
        file.write(b"".join((EDGES + count + 8 * k).astype("<i4").tobytes() for k in range(len(boxes))))
        file.seek(0)
        file.write(_header(count + 8 * len(boxes), source.name, len(boxes)))
    if not count:
        out.unlink()
        raise UsageError(f"no keyframe of the map {source.name!r} has depth: there are no points to export")
    note = f", {without} keyframes without depth" if without else ""
    drawn = f", {len(boxes)} boxes of landmarks" if options.landmarks else ""
    return f"{count} points, one in {options.voxel_m * 100:g} cm{drawn}{note}"


def _boxes(source: MapSource) -> list[npt.NDArray[np.void]]:
    """The corners of the boxes of landmarks that are not gone, eight rows of `VERTEX` each, in their classes' colours.

    Raises UsageError where the map has none.
    """
    import hashlib

    from semdb.database.landmark_reading import load_landmarks
    from semdb.database.landmark_rows import load_gravity
    from semdb.exchange.landmarks import box_of

    things, _ = load_landmarks(source.store.engine, source.map_id, source.store.say)
    gravity = load_gravity(source.store.engine, source.map_id)
    up = np.array((0.0, 0.0, 1.0) if gravity is None else gravity.up)
    found = []
    for thing in things:
        if thing.state == "gone":
            continue
        rows = np.empty(8, VERTEX)
        for axis, column in zip("xyz", box_of(thing, up).corners.T, strict=True):
            rows[axis] = column
        colour = hashlib.sha256(thing.category.encode("utf-8", "surrogatepass")).digest()
        for channel, name in enumerate(("red", "green", "blue")):
            rows[name] = 64 + colour[channel] // 2
        found.append(rows)
    if not found:
        raise UsageError(f"the map {source.name!r} has no landmarks: run semdb refine first")
    return found


class _Seen:
    """Numbers that were there before. The latest are kept apart, so that few are sorted anew for each keyframe."""

    def __init__(self) -> None:
        self._old, self._late = np.empty(0, np.uint64), np.empty(0, np.uint64)

    def add(self, keys: npt.NDArray[np.uint64]) -> BoolArray:
        """Which of ascending, different `keys` ``[n]`` were not there; now they are."""
        new = ~(_among(keys, self._old) | _among(keys, self._late))
        self._late = np.union1d(self._late, keys[new])
        if len(self._late) > max(LATE, len(self._old) // 4):
            self._old, self._late = np.union1d(self._old, self._late), self._late[:0]
        return new


def _among(keys: npt.NDArray[np.uint64], known: npt.NDArray[np.uint64]) -> BoolArray:
    """Which of `keys` are in the ascending `known`."""
    if not len(known):
        return np.zeros(len(keys), np.bool_)
    place = np.minimum(np.searchsorted(known, keys), len(known) - 1)
    return np.asarray(known[place] == keys)


def cloud(
    image: ImageArray, depth: Float32Array, camera: Camera, world_from_camera: FloatArray, options: ExportOptions
) -> tuple[FloatArray, npt.NDArray[np.uint8]]:
    """World points ``[n, 3]`` and colours ``[n, 3]`` of every `stride`-th pixel with depth within reach."""
    half = options.stride // 2
    rows, columns = np.mgrid[half : camera.height : options.stride, half : camera.width : options.stride]
    z = depth[rows, columns]
    with np.errstate(invalid="ignore"):
        known = (z > 0) & (z <= options.max_depth_m)
    pixels = np.column_stack([columns[known], rows[known]])
    points = back_project(camera, pixels, z[known])
    good = np.isfinite(points).all(axis=1)
    return transform_points(world_from_camera, points[good]), image[pixels[good, 1], pixels[good, 0]]


def voxels(points: FloatArray, size: float) -> npt.NDArray[np.uint64]:
    """A number ``[n]`` for the voxel of each point, 21 bits an axis."""
    cells = np.floor(points / size).astype(np.int64) + (1 << 20)
    cells = np.clip(cells, 0, (1 << 21) - 1).astype(np.uint64)
    return np.asarray((cells[:, 0] << np.uint64(42)) | (cells[:, 1] << np.uint64(21)) | cells[:, 2])


def _header(count: int, name: str, boxes: int = 0) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment semdb map {name.encode('ascii', 'backslashreplace').decode()[:200]}, metres".replace("\n", " "),
        f"element vertex {count:0{COUNT_DIGITS}d}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {channel}" for channel in ("red", "green", "blue")),
        *((f"element edge {12 * boxes}", "property int vertex1", "property int vertex2") if boxes else ()),
        "end_header\n",
    ]
    return "\n".join(lines).encode()
