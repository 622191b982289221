"""Queries larger than the map's images come at the map's scale: the same rays, fewer pixels, bounded memory."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semdb.errors import FrameError, UsageError
from semdb.geometry import pixels_to_normalized
from semdb.localization.query_image import QueryImage, QueryReader, at_scale
from semdb.localization.query_scale import reduced_camera, reduction_of, smaller_values, times_finer
from semdb.recordings import decode_color
from semdb.types import Camera, InstanceMasks

MAP = Camera(64, 48, 50.0, 50.0, 31.5, 23.5)
LENS = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)


def larger(times: float, distortion: tuple[float, ...] = ()) -> Camera:
    width, height = round(64 * times), round(48 * times)
    return Camera(width, height, 50 * times, 50 * times, (width - 1) / 2, (height - 1) / 2, distortion)


def scene(camera: Camera, seed: int = 0) -> np.ndarray:
    """An image ``[H, W, 3]`` uint8 of a smooth function of the rays of a camera."""
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = pixels_to_normalized(camera, np.column_stack([u.ravel(), v.ravel()])).T
    waves = np.stack([np.sin(9 * x + 5 * y + seed), np.sin(7 * y - 4 * x), np.cos(8 * x * y + 6 * x)], axis=1)
    return np.rint(127 + 120 * waves).astype(np.uint8).reshape(camera.height, camera.width, 3)


def query(camera: Camera) -> QueryImage:
    v, u = np.mgrid[: camera.height, : camera.width]
    depth = (1 + u / camera.width + v / camera.height).astype(np.float32)
    labels = (1 + (u > camera.width / 2)).astype(np.uint16)
    return QueryImage("q", scene(camera), camera, depth, InstanceMasks(labels, {1: "cup", 2: "bed"}), None)


def reader(camera: Camera, said: list[str] | None = None) -> QueryReader:
    return QueryReader(camera=camera, known=lambda: [MAP], say=(said if said is not None else []).append)


@pytest.mark.parametrize(
    ("camera", "times"),
    [
        (MAP, 1.0),
        (larger(0.5), 1.0),
        (Camera(64, 48, 400.0, 400.0, 31.5, 23.5), 1.0),  # as many pixels, of a smaller angle
        (larger(1.05), 1.0),
        (Camera(128, 96, 50.0, 50.0, 63.5, 47.5), 1.0),  # more pixels, of a larger angle: as fine as the map
        (larger(1.25), 1.25),
        (larger(6.25), 6.25),
        (Camera(48 * 4, 64 * 4, 200.0, 200.0, 95.5, 127.5), 4.0),  # upright
    ],
)
def test_how_much_finer_a_query_is_than_the_map(camera: Camera, times: float) -> None:
    assert times_finer(camera, [MAP]) == pytest.approx(times)


def test_the_finest_camera_of_a_map_counts() -> None:
    assert times_finer(larger(6), [MAP, larger(2)]) == pytest.approx(3)
    assert times_finer(larger(6), []) == 1.0


@pytest.mark.parametrize(("times", "reduction"), [(1.0, 1), (1.9, 1), (2.0, 2), (3.9, 2), (6.25, 4), (8.0, 8), (99, 8)])
def test_reductions_leave_something_to_do(times: float, reduction: int) -> None:
    assert reduction_of(times) == reduction


@given(st.integers(17, 400), st.integers(17, 400), st.sampled_from([2, 4, 8]))
def test_a_reduced_camera_sees_the_same_rays(width: int, height: int, reduction: int) -> None:
    camera = Camera(width, height, 80.0, 90.0, width / 2.2, height / 1.9)
    small = reduced_camera(camera, reduction)
    assert (small.width, small.height) == (-(-width // reduction), -(-height // reduction))
    pixel = np.array([[1.0, 2.0]])  # its centre is that of a block of pixels
    block = pixel * reduction + (reduction - 1) / 2
    np.testing.assert_allclose(pixels_to_normalized(small, pixel), pixels_to_normalized(camera, block), atol=1e-12)


@pytest.mark.parametrize("times", [1.25, 2.0, 3.3, 6.25])
@pytest.mark.parametrize("distortion", [(), LENS])
def test_a_smaller_query_shows_what_its_camera_sees(times: float, distortion: tuple[float, ...]) -> None:
    large = query(larger(times * 2, distortion))
    small = at_scale(large, times * 2)
    assert (small.camera.width, small.camera.height) == (64, 48)
    assert small.image.shape == (48, 64, 3)
    assert np.abs(small.image.astype(int) - scene(small.camera)).mean() < 2.5
    assert small.depth is not None
    assert large.depth is not None
    v, u = np.mgrid[:48, :64]
    np.testing.assert_allclose(small.depth, 1 + (u + 0.5) / 64 + (v + 0.5) / 48, atol=0.03)
    assert set(np.unique(small.depth)) <= set(np.unique(large.depth))  # values, no means
    assert small.instances is not None
    np.testing.assert_array_equal(small.instances.labels, 1 + (u >= 32))
    assert small.instances.categories == {1: "cup", 2: "bed"}


def test_a_query_of_a_normal_size_is_not_touched(tmp_path: Path) -> None:
    one = query(MAP)
    assert at_scale(one, 1) is one
    said: list[str] = []
    found = reader(MAP, said).read(one.image)
    assert np.shares_memory(found.image, one.image)
    assert found.camera == MAP
    assert said == []
    cv2.imwrite(str(tmp_path / "a.png"), one.image[..., ::-1])
    np.testing.assert_array_equal(reader(MAP, said).read(tmp_path / "a.png").image, one.image)
    assert said == []


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("times", [2.0, 6.25, 9.7])
def test_files_come_at_the_scale_of_the_map(tmp_path: Path, suffix: str, times: float) -> None:
    camera = larger(times)
    path = tmp_path / f"photo{suffix}"
    cv2.imwrite(str(path), scene(camera)[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])
    depth = np.rint(1000 * np.ones((camera.height, camera.width))).astype(np.uint16)
    depth[:, camera.width // 2 :] = 2000
    cv2.imwrite(str(tmp_path / "depth.png"), depth)
    said: list[str] = []
    own = QueryReader(camera=Camera(0, 0, camera.fx, camera.fy, camera.cx, camera.cy), known=lambda: [MAP],
                      depth_scale=1000, say=said.append)  # fmt: skip
    found = own.read(path, tmp_path / "depth.png")
    assert abs(found.camera.width - 64) <= 1
    assert np.abs(found.image.astype(int) - scene(found.camera)).mean() < 4
    assert found.depth is not None
    middle = found.camera.width / 2
    np.testing.assert_array_equal(found.depth[:, : int(middle) - 1], 1)
    np.testing.assert_array_equal(found.depth[:, int(middle) + 1 :], 2)
    assert said == [
        f"{path} ({camera.width}x{camera.height}) is localized at {found.camera.width}x{found.camera.height}, the "
        "scale of the map's images"
    ]


def test_bytes_and_arrays_come_at_the_scale_of_the_map() -> None:
    camera = larger(4)
    image = scene(camera)
    data = bytes(cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95])[1])
    for given_image in (image, data):
        found = reader(camera).read(given_image)
        assert (found.camera.width, found.camera.height) == (64, 48)
        assert np.abs(found.image.astype(int) - scene(found.camera)).mean() < 3


def test_a_jpeg_of_200_megapixels_is_read_and_one_without_end_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []

    def watched(data: bytes, name: str, reduce: int = 1) -> np.ndarray:
        image = decode_color(data, name, reduce)
        sizes.append(image.size)
        return image

    monkeypatch.setattr("semdb.localization.query_image.decode_color", watched)
    flat = np.full((1530, 2040), 128, np.uint8)  # decoded once at full size to be made here, so not larger
    data = bytes(cv2.imencode(".jpg", flat)[1])
    camera = Camera(2040, 1530, 1600.0, 1600.0, 1020.0, 765.0)
    assert reader(camera).read(data).camera.width == 64
    assert sizes == [255 * 192 * 3]  # an eighth each way
    at = data.index(b"\xff\xc0")
    for width, height in ((16_320, 12_240), (65_500, 65_500)):
        bomb = data[: at + 5] + height.to_bytes(2, "big") + width.to_bytes(2, "big") + data[at + 9 :]
        wide = Camera(width, height, 0.8 * width, 0.8 * width, width / 2, height / 2)
        if width * height > 1 << 28:
            with pytest.raises(FrameError, match=r"is too large: 65500x65500 pixels, at most 268 million"):
                reader(wide).read(bomb)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        (Camera(0, 0, 0.78, 1.04, 0.49, 0.49), "divided by the image's size they would be 49.92,49.92"),
        (Camera(0, 0, 50.0, 50.0, 64.0, 23.5), "the principal point .* is not inside the images of 64x48"),
        (Camera(0, 0, 50.0, 50.0, 31.5, 23.5, (-1.0, 0, 0, 0)), "folds"),
    ],
)
def test_impossible_cameras_of_queries_are_refused(camera: Camera, message: str) -> None:
    with pytest.raises(FrameError, match=rf"q: its camera makes no sense: .*{message}"):
        reader(camera).read(scene(MAP), name="q")


def test_what_is_unlikely_or_shows_nothing_is_said(tmp_path: Path) -> None:
    said: list[str] = []
    reader(Camera(0, 0, 50.0, 50.0, 50.0, 23.5), said).read(np.zeros((48, 64, 3), np.uint8), name="q")
    assert "is far from the centre" in said[0]
    assert said[1] == "q: the colour image is nearly black"


def test_a_depth_image_in_the_place_of_the_image_is_named(tmp_path: Path) -> None:
    said: list[str] = []
    cv2.imwrite(str(tmp_path / "d.png"), (1000 + np.arange(48 * 64) % 977).reshape(48, 64).astype(np.uint16))
    reader(MAP, said).read(str(tmp_path / "d.png"))
    assert said == [
        f"{tmp_path / 'd.png'} has one channel of 16 bits, as depth images have; it is taken for a grey image"
    ]


def test_impossible_depth_scales_are_usage_errors(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "d.png"), np.ones((48, 64), np.uint16))
    own = QueryReader(camera=MAP, known=lambda: [MAP], depth_scale=0.001)
    with pytest.raises(UsageError, match="1000 units per metre"):
        own.read(scene(MAP), tmp_path / "d.png")


def test_depth_is_found_where_a_reduced_image_has_its_pixels() -> None:
    values = np.arange(17 * 23, dtype=np.float32).reshape(17, 23)
    small = smaller_values(values, Camera(6, 5, 1, 1, 0, 0), reduction=4)
    np.testing.assert_array_equal(small[0], values[2, [2, 6, 10, 14, 18, 22]])
    assert small[4, 5] == values[16, 22]  # the last ones stand for fewer
