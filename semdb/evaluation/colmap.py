"""What the peer COLMAP does, by its own code (pycolmap): SIFT, verified matches, points from known poses.

pycolmap is optional (``semdb[dev]``) and is imported when it is first needed. COLMAP counts pixels from the corner
of the top-left pixel, semdb from its centre: keypoints and principal points are half a pixel larger in here.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.compiled import kernel
from semdb.errors import ModelError
from semdb.geometry import invert_pose
from semdb.types import Camera, Float32Array, FloatArray, ImageArray, IntArray

HALF_PIXEL = 0.5
MAX_RATIO = 0.8  # of the angles to the nearest and the second nearest descriptor: COLMAP's own default
MAX_ANGLE = 0.7  # radians, COLMAP's own default
MIN_PAIR_MATCHES = 15  # of two images, COLMAP's own default
MAX_DISTORTION = 10.0  # COLMAP's limit of 1 takes the calibration of TUM's freiburg1 (k3 1.16) for nonsense
SEED = 0

PairArray = npt.NDArray[np.uint32]


def load_pycolmap() -> ModuleType:
    """The module pycolmap. Raises ModelError that says how to install it."""
    os.environ.setdefault("GLOG_minloglevel", "2")
    try:
        import pycolmap
    except ImportError as error:
        raise ModelError(
            "method colmap and --truth refined need pycolmap, which is not installed: "
            "pip install 'pycolmap>=4.2,<5' (semdb[dev] brings it)"
        ) from error
    if not hasattr(pycolmap, "FeatureExtractor"):
        raise ModelError(f"pycolmap {pycolmap.__version__} is too old: pip install 'pycolmap>=4.2,<5'")
    pycolmap.logging.minloglevel = 2  # errors only: it would fill stderr
    return pycolmap  # type: ignore[no-any-return]


def colmap_camera(camera: Camera, camera_id: int = 1) -> Any:
    """A ``pycolmap.Camera``: PINHOLE without, FULL_OPENCV with distortion (k1 k2 p1 p2 k3)."""
    pycolmap = load_pycolmap()
    params = [camera.fx, camera.fy, camera.cx + HALF_PIXEL, camera.cy + HALF_PIXEL]
    model = "PINHOLE"
    if any(camera.distortion):
        model = "FULL_OPENCV"
        params += [*camera.distortion, *([0.0] * (8 - len(camera.distortion)))]
    return pycolmap.Camera(model=model, width=camera.width, height=camera.height, params=params, camera_id=camera_id)


@dataclass(frozen=True, slots=True, eq=False)
class SiftImage:
    """SIFT of one image: `xy` ``[n, 2]`` pixels in COLMAP's convention, unit RootSIFT descriptors ``[n, 128]``."""

    xy: FloatArray
    descriptors: Float32Array


class SiftExtractor:
    """COLMAP's SIFT with its default options, on one CPU thread."""

    def __init__(self) -> None:
        self._pycolmap = load_pycolmap()
        options = self._pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        options.num_threads = 1
        self._extractor = self._pycolmap.FeatureExtractor.create(options, self._pycolmap.Device.cpu)

    def extract(self, image: ImageArray) -> SiftImage:
        """SIFT of an RGB image ``[H, W, 3]``."""
        grey = np.ascontiguousarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
        keypoints, descriptors = self._extractor.extract(self._pycolmap.Bitmap.from_array(grey))
        xy = np.array([(point.x, point.y) for point in keypoints], dtype=np.float64).reshape(-1, 2)
        vectors = np.asarray(descriptors.data, dtype=np.float32).reshape(len(xy), 128)
        length = np.linalg.norm(vectors, axis=1, keepdims=True)
        return SiftImage(xy, np.asarray(vectors / np.maximum(length, 1e-12), dtype=np.float32))


@kernel
def _best_two(similarity, rows_best, rows_second, rows_at, columns_best, columns_second, columns_at):  # type: ignore[no-untyped-def]
    """The greatest and second greatest of every row and every column, and where the greatest is, in one pass."""
    for i in range(similarity.shape[0]):
        best, second, at = np.float32(-2.0), np.float32(-2.0), -1
        for j in range(similarity.shape[1]):
            value = similarity[i, j]
            if value > second:
                if value > best:
                    second, best, at = best, value, j
                else:
                    second = value
            if value > columns_second[j]:
                if value > columns_best[j]:
                    columns_second[j], columns_best[j], columns_at[j] = columns_best[j], value, i
                else:
                    columns_second[j] = value
        rows_best[i], rows_second[i], rows_at[i] = best, second, at


def _clear(best: Any, second: Any) -> npt.NDArray[np.bool_]:
    nearest = np.arccos(np.clip(best, -1, 1))
    return np.asarray((nearest <= MAX_ANGLE) & (nearest < MAX_RATIO * np.arccos(np.clip(second, -1, 1))))


def match_descriptors(first: Float32Array, second: Float32Array) -> PairArray:
    """Pairs ``[m, 2]`` that are nearest to each other and clearly nearer than the second nearest, both ways.

    `first` ``[n, d]`` and `second` ``[k, d]`` hold unit vectors. The rules and limits are those of COLMAP's own
    matcher: angles between descriptors, ratio 0.8, at most 0.7 rad, cross-checked.
    """
    n, k = len(first), len(second)
    if n < 2 or k < 2:
        return np.empty((0, 2), np.uint32)
    similarity = first @ second.T
    rows = [np.full(n, -2, np.float32), np.full(n, -2, np.float32), np.full(n, -1, np.int32)]
    columns = [np.full(k, -2, np.float32), np.full(k, -2, np.float32), np.full(k, -1, np.int32)]
    _best_two(similarity, *rows, *columns)
    good_rows, good_columns = _clear(rows[0], rows[1]), _clear(columns[0], columns[1])
    at = rows[2]
    chosen = np.flatnonzero(good_rows & good_columns[at] & (columns[2][at] == np.arange(n)))
    return np.column_stack([chosen, at[chosen]]).astype(np.uint32)


def verified_matches(
    camera: Any, first: SiftImage, second: SiftImage, second_camera: Any | None = None
) -> tuple[PairArray, Any]:
    """Pairs that agree with one geometry of two views, and that ``pycolmap.TwoViewGeometry``."""
    pycolmap = load_pycolmap()
    pairs = match_descriptors(first.descriptors, second.descriptors)
    if len(pairs) < MIN_PAIR_MATCHES:
        return np.empty((0, 2), np.uint32), None
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    geometry = pycolmap.estimate_calibrated_two_view_geometry(
        camera, first.xy, second_camera or camera, second.xy, pairs, options
    )
    inliers = np.asarray(geometry.inlier_matches, dtype=np.uint32).reshape(-1, 2)
    return (inliers, geometry) if len(inliers) >= MIN_PAIR_MATCHES else (np.empty((0, 2), np.uint32), None)


@dataclass(slots=True, eq=False)
class PosedImages:
    """Images with SIFT and known poses, and their verified pairs: what a reconstruction is made of."""

    cameras: Sequence[Camera]  # one per image
    images: Sequence[SiftImage]
    geometries: dict[tuple[int, int], Any] = field(default_factory=dict)

    def match(self, pairs: Iterable[tuple[int, int]], progress: Callable[[int, int], None] | None = None) -> None:
        """Matches and verifies `pairs` of positions."""
        wanted = list(pairs)
        known: dict[Camera, Any] = {camera: colmap_camera(camera) for camera in set(self.cameras)}
        for done, (a, b) in enumerate(wanted, start=1):
            _, geometry = verified_matches(
                known[self.cameras[a]], self.images[a], self.images[b], known[self.cameras[b]]
            )
            if geometry is not None:
                self.geometries[a, b] = geometry
            if progress is not None:
                progress(done, len(wanted))

    def triangulate(self, world_from_camera: FloatArray) -> Any:
        """A ``pycolmap.Reconstruction`` of the verified pairs with poses ``[n, 4, 4]`` held; image ids count from 1."""
        pycolmap = load_pycolmap()
        pycolmap.set_random_seed(SEED)
        with tempfile.TemporaryDirectory(prefix="semdb-colmap-") as folder:
            database_path = Path(folder) / "database.db"
            model = self._write(pycolmap, database_path, world_from_camera)
            options = pycolmap.IncrementalPipelineOptions()
            options.num_threads = 1
            options.random_seed = SEED
            options.extract_colors = False
            for part in (options, options.mapper, options.triangulation):
                part.max_extra_param = MAX_DISTORTION
            output = Path(folder) / "model"
            output.mkdir()
            return pycolmap.triangulate_points(model, database_path, folder, output, True, options)

    def _write(self, pycolmap: ModuleType, path: Path, world_from_camera: FloatArray) -> Any:
        """The same cameras and images into a database and a reconstruction, the pairs into the database."""
        model = pycolmap.Reconstruction()
        numbers = {camera: i for i, camera in enumerate(dict.fromkeys(self.cameras), start=1)}
        database = pycolmap.Database.open(path)
        try:
            for camera, number in numbers.items():
                model.add_camera_with_trivial_rig(colmap_camera(camera, number))
                database.write_camera(model.cameras[number], True)
                database.write_rig(model.rigs[number], True)
            for i, (camera, image) in enumerate(zip(self.cameras, self.images, strict=True), start=1):
                entry = pycolmap.Image(name=f"{i:06d}", keypoints=image.xy, camera_id=numbers[camera], image_id=i)
                camera_from_world = pycolmap.Rigid3d(invert_pose(world_from_camera[i - 1])[:3])
                model.add_image_with_trivial_frame(entry, camera_from_world)
                database.write_frame(model.frames[i], True)
                database.write_image(model.images[i], True)
                database.write_keypoints(i, image.xy.astype(np.float32))
            for (a, b), geometry in sorted(self.geometries.items()):
                database.write_two_view_geometry(a + 1, b + 1, geometry)
        finally:
            database.close()
        return model


def image_points(model: Any, image_id: int) -> tuple[IntArray, FloatArray]:
    """Which keypoints ``[m]`` of an image have a 3D point, and those points ``[m, 3]`` in the world."""
    rows, points = [], []
    for row, point in enumerate(model.images[image_id].points2D):
        if point.has_point3D():
            rows.append(row)
            points.append(model.points3D[point.point3D_id].xyz)
    return np.array(rows, dtype=np.int32), np.array(points, dtype=np.float64).reshape(-1, 3)
