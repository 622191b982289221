"""The local features behind their protocol."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from semdb.errors import ModelError, UsageError
from semdb.perception.features import KNOWN, load_features
from semdb.settings import Settings
from semdb.types import Features, ImageArray

LAYOUT = {"surf": (np.float32, 64), "sift": (np.float32, 128), "orb": (np.uint8, 32)}
FIELDS = ("xy", "size", "angle", "response", "laplacian", "descriptors")


@pytest.fixture(scope="module")
def image() -> ImageArray:
    rng = np.random.default_rng(5)
    coarse = cv2.resize(rng.integers(0, 256, (60, 80), dtype=np.uint8), (320, 240), interpolation=cv2.INTER_CUBIC)
    return cv2.GaussianBlur(coarse, (0, 0), 1.0)


def settings(**values: int) -> Settings:
    return Settings(**values)  # type: ignore[arg-type]


def assert_layout(spec: str, features: Features) -> None:
    dtype, width = LAYOUT[spec]
    n = len(features)
    assert features.xy.shape == (n, 2)
    assert features.descriptors.shape == (n, width)
    assert features.descriptors.dtype == dtype
    for name in ("size", "angle", "response", "laplacian"):
        assert getattr(features, name).shape == (n,)
    for name in ("xy", "size", "angle", "response"):
        assert getattr(features, name).dtype == np.float32
    assert features.laplacian.dtype == np.int8


@pytest.mark.parametrize("spec", KNOWN)
def test_features_of_a_textured_image(spec: str, image: ImageArray) -> None:
    features = load_features(spec, settings()).extract(image)
    assert len(features) > 100
    assert_layout(spec, features)
    assert (np.diff(features.response) <= 0).all()
    assert (features.size > 0).all()
    assert ((features.angle >= 0) & (features.angle <= 360)).all()
    assert (features.xy >= 0).all()
    assert (features.xy <= (319, 239)).all()
    if spec != "orb":
        np.testing.assert_allclose(np.linalg.norm(features.descriptors, axis=1), 1, atol=1e-5)
    assert set(features.laplacian.tolist()) == ({-1, 1} if spec == "surf" else {0})


@pytest.mark.parametrize("spec", KNOWN)
def test_images_without_texture_have_no_features(spec: str) -> None:
    extractor = load_features(spec, settings())
    for shape in ((240, 320), (1, 1), (7, 5), (0, 0), (0, 12)):
        features = extractor.extract(np.full(shape, 90, np.uint8))
        assert len(features) == 0
        assert_layout(spec, features)


@pytest.mark.parametrize("spec", KNOWN)
def test_max_keypoints_keeps_the_strongest(spec: str, image: ImageArray) -> None:
    many, few = (
        load_features(spec, settings()).extract(image),
        load_features(spec, settings(max_keypoints=60)).extract(image),
    )
    assert 50 <= len(few) <= 60
    if spec != "orb":  # ORB shares the number out over its scales
        np.testing.assert_array_equal(few.response, many.response[: len(few)])


@pytest.mark.parametrize("spec", KNOWN)
def test_extracting_again_gives_the_same(spec: str, image: ImageArray) -> None:
    extractor = load_features(spec, settings(max_keypoints=200))
    first, second = extractor.extract(image), load_features(spec, settings(max_keypoints=200)).extract(image.copy())
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


@pytest.mark.parametrize("spec", KNOWN)
def test_mask_keeps_the_strongest_on_it(spec: str, image: ImageArray) -> None:
    mask = np.zeros(image.shape, bool)
    mask[60:180, 90:250] = True
    features = load_features(spec, settings(max_keypoints=60)).extract(image, mask)
    column, row = np.floor(features.xy + 0.5).astype(int).T
    # ORB masks its coarse scales in their own pixels
    loose = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0 if spec == "orb" else mask
    assert loose[row, column].all()
    assert 50 <= len(features) <= 60
    assert len(load_features(spec, settings()).extract(image, np.zeros(image.shape, bool))) == 0


@pytest.mark.parametrize("spec", KNOWN)
def test_centre_of_the_first_pixel_is_zero(spec: str, image: ImageArray) -> None:
    """Keypoints of the mirrored image are the mirrored keypoints: x becomes width - 1 - x, with no shift."""
    extractor = load_features(spec, settings(max_keypoints=400))
    straight, mirrored = extractor.extract(image), extractor.extract(np.ascontiguousarray(image[:, ::-1]))
    there = np.array([319, 0]) + mirrored.xy * np.array([-1, 1])
    offset = straight.xy[:, None] - there[None]
    offset[np.abs(straight.size[:, None] - mirrored.size[None]) > 0.2 * straight.size[:, None]] = np.inf
    nearest = np.abs(offset).sum(axis=2).argmin(axis=1)
    best = offset[np.arange(len(straight)), nearest]
    close = np.abs(best).max(axis=1) < 0.6
    assert close.mean() > 0.9
    assert np.abs(best[close].mean(axis=0)).max() < 0.02


@pytest.mark.parametrize("spec", ["surf", "sift"])
def test_positions_of_blobs(spec: str) -> None:
    y, x = np.mgrid[:120, :160].astype(np.float64)
    for cx, cy in ((70.0, 60.0), (70.3, 60.6), (81.75, 50.5)):
        blob = 128 + 90 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 32)
        features = load_features(spec, settings()).extract(np.rint(blob).astype(np.uint8))
        assert np.abs(features.xy[0] - (cx, cy)).max() < 0.05


@pytest.mark.parametrize("spec", KNOWN)
def test_info_names_what_changes_the_output(spec: str) -> None:
    info = load_features(spec, settings(max_keypoints=321)).info
    assert (info.role, info.name, info.sha256) == ("features", spec, "")
    config = json.loads(info.config)
    assert config["max_keypoints"] == 321
    assert info.config == json.dumps(config, sort_keys=True, separators=(",", ":"))
    assert load_features(spec, settings(max_keypoints=321, threads=1)).info == info


def test_threads_do_not_change_surf(image: ImageArray) -> None:
    one, two = (load_features("surf", settings(threads=n)).extract(image) for n in (1, 2))
    np.testing.assert_array_equal(one.descriptors, two.descriptors)
    np.testing.assert_array_equal(one.xy, two.xy)


@pytest.mark.parametrize("spec", KNOWN)
def test_what_is_no_grey_image_is_refused(spec: str) -> None:
    extractor = load_features(spec, settings())
    with pytest.raises(ModelError, match=f"{spec}.*uint8"):
        extractor.extract(np.zeros((20, 20, 3), np.uint8))
    with pytest.raises(ModelError, match=f"{spec}.*float"):
        extractor.extract(np.zeros((20, 20), np.float32))  # type: ignore[arg-type]
    with pytest.raises(ModelError, match=f"{spec}.*mask"):
        extractor.extract(np.zeros((20, 20), np.uint8), np.zeros((20, 30), bool))


def test_unknown_spec_names_the_known_ones() -> None:
    with pytest.raises(UsageError, match="surf, sift, orb, surf:weak and onnx:FILE"):
        load_features("brisk", settings())


def test_weak_keypoints_count_only_where_others_are_few() -> None:
    usual, weak = load_features("surf", Settings()), load_features("surf:weak", Settings())
    assert usual.info != weak.info
    assert '"few":600' in weak.info.config
    random = np.random.default_rng(0)
    rich = cv2.GaussianBlur(random.integers(0, 255, (480, 640), np.uint8), (0, 0), 2)
    one, two = usual.extract(rich), weak.extract(rich)
    assert len(one) >= 600
    assert np.array_equal(one.xy, two.xy)
    assert np.array_equal(one.descriptors, two.descriptors)
    plain = np.rint(100 + (rich - rich.mean()) * 0.12).astype(np.uint8)
    few, more = usual.extract(plain), weak.extract(plain)
    assert len(few) < 600
    assert len(more) > len(few)
    assert np.array_equal(more.xy[: len(few)], few.xy)
