from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from semdb.errors import FrameError, ModelError, UsageError
from semdb.geometry import project
from semdb.perception.describe import Describer, describer_from_specs
from semdb.perception.detectors import load_detector
from semdb.perception.encoders import load_encoder
from semdb.perception.objects import assign_to_objects, object_geometry, sort_by_object
from semdb.settings import Settings
from semdb.types import (
    BoolArray,
    Camera,
    Description,
    Detection,
    Features,
    ImageArray,
    InstanceMasks,
    ModelInfo,
)

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
SETTINGS = Settings(threads=1)


class GridFeatures:
    """A feature on every tenth pixel, described by the grey value there."""

    info = ModelInfo("features", "grid", "")

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        v, u = (grid.ravel() for grid in np.mgrid[5 : grey.shape[0] : 10, 5 : grey.shape[1] : 10])
        n = len(u)
        return Features(
            xy=np.column_stack([u, v]).astype(np.float32),
            size=np.arange(n, dtype=np.float32),
            angle=np.full(n, -1, dtype=np.float32),
            response=np.ones(n, dtype=np.float32),
            laplacian=np.zeros(n, dtype=np.int8),
            descriptors=grey[v, u][:, None],
        )


def rectangle(x: int, y: int, width: int, height: int) -> np.ndarray:
    mask = np.zeros((120, 160), dtype=bool)
    mask[y : y + height, x : x + width] = True
    return mask


def detection(mask: np.ndarray, category: str = "cup") -> Detection:
    return Detection(category, 0.9, np.array([0, 0, 1, 1], dtype=np.float32), mask)


def describer() -> Describer:
    return Describer(load_detector("recorded", SETTINGS), load_encoder("gist", SETTINGS), GridFeatures())


def scene() -> tuple[np.ndarray, np.ndarray, InstanceMasks]:
    """A table that fills the lower half at 2 m with a cup on it at 1 m, before a wall at 4 m."""
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (120, 160, 3), dtype=np.uint8)
    labels = np.zeros((120, 160), dtype=np.uint16)
    depth = np.full((120, 160), 4, dtype=np.float32)
    labels[60:], depth[60:] = 1, 2
    labels[70:100, 40:70], depth[70:100, 40:70] = 2, 1
    return image, depth, InstanceMasks(labels, {1: "dining table", 2: "cup"})


def test_the_smallest_mask_wins() -> None:
    table, cup, spoon = rectangle(0, 40, 160, 80), rectangle(50, 50, 20, 20), rectangle(60, 60, 5, 5)
    xy = np.array([[10, 10], [10, 60], [55, 55], [61, 61], [75, 60]], dtype=np.float32)
    assert assign_to_objects(xy, [table, cup, spoon]).tolist() == [-1, 0, 1, 2, 0]
    assert assign_to_objects(xy, [spoon, cup, table]).tolist() == [-1, 2, 1, 0, 2]


def test_of_equal_masks_the_first_wins() -> None:
    mask = rectangle(50, 50, 20, 20)
    assert assign_to_objects(np.array([[55, 55]], dtype=np.float32), [mask, mask.copy()]).tolist() == [0]


def test_positions_are_rounded_to_pixels_and_stay_inside() -> None:
    mask = rectangle(50, 50, 20, 20)
    xy = np.array([[49.6, 55], [49.4, 55], [69.4, 69.4], [69.6, 55], [-3, 400]], dtype=np.float32)
    owner = assign_to_objects(xy, [mask])
    assert owner.tolist() == [0, -1, 0, -1, -1]
    assert owner.dtype == np.int32


def test_no_objects_and_no_keypoints() -> None:
    assert assign_to_objects(np.zeros((2, 2), dtype=np.float32), []).tolist() == [-1, -1]
    assert assign_to_objects(np.zeros((0, 2), dtype=np.float32), [rectangle(0, 0, 5, 5)]).shape == (0,)


def test_objects_come_first_and_the_order_within_stays() -> None:
    features = GridFeatures().extract(np.zeros((30, 30), dtype=np.uint8))
    owner = np.array([-1, 2, 0, -1, 2, 0, 1, -1, 0], dtype=np.int32)
    ordered, index = sort_by_object(features, owner)
    assert index.tolist() == [0, 0, 0, 1, 2, 2, -1, -1, -1]
    assert ordered.size.tolist() == [2, 5, 8, 6, 1, 4, 0, 3, 7]
    np.testing.assert_array_equal(ordered.xy, features.xy[[2, 5, 8, 6, 1, 4, 0, 3, 7]])


def test_object_geometry_of_a_board() -> None:
    """A board of 60x40 pixels at 2 m, a tenth of whose mask hangs over a wall at 5 m."""
    depth = np.full((120, 160), 5, dtype=np.float32)
    depth[40:80, 50:110] = 2
    geometry = object_geometry(CAMERA, depth, detection(rectangle(46, 40, 64, 40)))
    assert geometry.pixel_area == 64 * 40
    np.testing.assert_allclose(geometry.centroid, [0, 0, 2], atol=0.05)
    width, height = 2 * 60 / 130, 2 * 40 / 130
    np.testing.assert_allclose(geometry.extent, [0.9 * width, 0.9 * height, 0], atol=0.1)


def test_object_geometry_without_depth() -> None:
    board = detection(rectangle(50, 40, 60, 40))
    for depth in (None, np.full((120, 160), np.nan, dtype=np.float32), np.zeros((120, 160), dtype=np.float32)):
        geometry = object_geometry(CAMERA, depth, board)
        assert geometry.pixel_area == 2400
        assert np.isnan(geometry.centroid).all()
        assert np.isnan(geometry.extent).all()


def test_object_geometry_of_a_thin_object_at_the_rim() -> None:
    depth = np.full((120, 160), 1.3, dtype=np.float32)
    geometry = object_geometry(CAMERA, depth, detection(rectangle(0, 0, 160, 2)))
    np.testing.assert_allclose(geometry.centroid, [0, -59 / 130 * 1.3, 1.3], atol=1e-6)


def test_description_of_a_scene() -> None:
    image, depth, instances = scene()
    found = describer().describe(image, depth, CAMERA, instances)
    assert found.category_counts == {"dining table": 1, "cup": 1}
    index = found.keypoints.object_index
    # 192 features: 96 on the wall, 9 on the cup, the others on the table
    assert [int((index == k).sum()) for k in (0, 1, -1)] == [87, 9, 96]
    assert (np.diff(np.where(index < 0, 99, index)) >= 0).all()
    expected = np.select([index == 1, index == 0], [1.0, 2.0], 4.0)
    z = found.keypoints.points[:, 2]
    lifted = np.isfinite(z)
    assert lifted.mean() > 0.95
    np.testing.assert_allclose(z[lifted], expected[lifted], rtol=1e-6)
    np.testing.assert_allclose([g.centroid[2] for g in found.geometry], [2, 1], rtol=1e-6)
    assert [model.role for model in found.models] == ["detector", "encoder", "features"]
    assert found.models == describer().models
    assert set(found.timing_ms) == {"detect", "encode", "features"}
    np.testing.assert_array_equal(found.cnn_vector, load_encoder("gist", SETTINGS).encode(image))


def test_features_see_the_grey_of_an_rgb_image() -> None:
    image = np.zeros((120, 160, 3), dtype=np.uint8)
    image[..., 0] = 200  # red: 0.299 of 200; were it taken for blue, 0.114
    found = describer().describe(image, None, CAMERA, scene()[2])
    assert set(found.keypoints.features.descriptors.ravel().tolist()) == {60}


def test_without_depth_all_points_are_missing() -> None:
    image, _, instances = scene()
    found = describer().describe(image, None, CAMERA, instances)
    assert found.keypoints.points.shape == (192, 3)
    assert np.isnan(found.keypoints.points).all()
    assert np.isnan(found.geometry[0].centroid).all()


def test_sizes_must_agree() -> None:
    image, depth, instances = scene()
    with pytest.raises(FrameError, match=r"depth image is 80x60 but the image is 160x120"):
        describer().describe(image, depth[::2, ::2], CAMERA, instances)
    with pytest.raises(FrameError, match=r"image is 160x120 but its camera is 640x480"):
        describer().describe(image, depth, Camera(640, 480, 525, 525, 319.5, 239.5), instances)


def test_recorded_needs_masks() -> None:
    image, depth, _ = scene()
    with pytest.raises(UsageError, match="brings no masks"):
        describer().describe(image, depth, CAMERA)


def test_an_image_without_objects_or_keypoints() -> None:
    image, labels = np.full((120, 160, 3), 90, dtype=np.uint8), np.zeros((120, 160), dtype=np.uint16)
    one = describer_from_specs("recorded", "gist", "surf", SETTINGS)
    found = one.describe(image, np.ones((120, 160), dtype=np.float32), CAMERA, InstanceMasks(labels, {}))
    assert found.detections == ()
    assert len(found.keypoints) == 0
    assert found.keypoints.points.shape == (0, 3)
    assert found.cnn_vector.shape == (560,)


@pytest.mark.parametrize(("features", "width"), [("surf", 64), ("sift", 128), ("orb", 32)])
def test_describer_from_specs(features: str, width: int) -> None:
    image, depth, instances = scene()
    one = describer_from_specs("recorded", "gist", features, SETTINGS)
    found = one.describe(image, depth, CAMERA, instances)
    assert [model.name for model in one.models[:2]] == ["recorded", "gist"]
    assert one.models[2].role == "features"
    assert found.models == one.models
    points, xy = found.keypoints.points, found.keypoints.features.xy
    assert found.keypoints.features.descriptors.shape == (len(found.keypoints), width)
    lifted = np.isfinite(points[:, 2])
    assert lifted.sum() > 30
    np.testing.assert_allclose(project(CAMERA, points[lifted]), xy[lifted], atol=1e-3)
    owner = assign_to_objects(xy, [d.mask for d in found.detections])
    np.testing.assert_array_equal(found.keypoints.object_index, owner)


def test_describer_from_specs_names_what_is_wrong() -> None:
    with pytest.raises(ModelError, match=r"no model file at /nowhere/m\.onnx"):
        describer_from_specs("onnx:/nowhere/m.onnx", "gist", "surf", SETTINGS)
    with pytest.raises(UsageError, match="no encoder 'auto'"):
        describer_from_specs("recorded", "auto", "surf", SETTINGS)


def assert_same(first: Description, second: Description) -> None:
    np.testing.assert_array_equal(first.cnn_vector, second.cnn_vector)
    np.testing.assert_array_equal(first.keypoints.object_index, second.keypoints.object_index)
    np.testing.assert_array_equal(first.keypoints.points, second.keypoints.points)
    for name in ("xy", "size", "angle", "response", "laplacian", "descriptors"):
        one_side, other_side = getattr(first.keypoints.features, name), getattr(second.keypoints.features, name)
        np.testing.assert_array_equal(one_side, other_side)
    assert [(d.category, d.score) for d in first.detections] == [(d.category, d.score) for d in second.detections]
    for one, other in zip(first.detections, second.detections, strict=True):
        np.testing.assert_array_equal(one.mask, other.mask)
    for a, b in zip(first.geometry, second.geometry, strict=True):
        np.testing.assert_array_equal(a.centroid, b.centroid)


@pytest.mark.shared
def test_real_frames_are_described_alike_with_any_threads(shared_dir: Path) -> None:
    models = shared_dir / "models"
    camera = Camera(640, 480, 525, 525, 319.5, 239.5)

    def make(threads: int) -> Describer:
        specs = f"onnx:{models}/mask_rcnn_2go.onnx", f"onnx:{models}/squeezenet_places365.onnx", "surf"
        return describer_from_specs(*specs, Settings(threads=threads))

    alone, together = make(1), make(2)
    assert alone.models == together.models
    scene_dir = shared_dir / "recordings" / "7scenes_redkitchen" / "seq-01"
    for number in (0, 500):
        image = cv2.imread(str(scene_dir / f"frame-{number:06d}.color.jpg"))[..., ::-1].copy()
        depth = cv2.imread(str(scene_dir / f"frame-{number:06d}.depth.png"), cv2.IMREAD_UNCHANGED) / np.float32(1000)
        depth[(depth == 0) | (depth > 60)] = np.nan
        first, second = alone.describe(image, depth, camera), together.describe(image, depth, camera)
        assert_same(first, second)
        assert "dining table" in first.category_counts
        assert (first.keypoints.object_index >= 0).sum() > 500
        assert 0.6 < np.isfinite(first.keypoints.points[:, 2]).mean() < 1
        table = [d.category for d in first.detections].index("dining table")
        assert 0.5 < first.geometry[table].centroid[2] < 4
