"""Arrays that a program gives: taken as they are meant, or refused with what to do."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from semdb.errors import FrameError, SemdbError, UsageError
from semdb.recordings.arrays import as_camera, as_depth, as_image, as_pose, check_depth_scale
from semdb.recordings.images import decode_depth, encode_16bit
from semdb.types import Camera

SIZE = (32, 24)  # width, height
COLOUR = np.arange(24 * 32 * 3, dtype=np.uint8).reshape(24, 32, 3)
METRES = np.linspace(0.5, 4.0, 24 * 32, dtype=np.float32).reshape(24, 32)


def test_a_colour_image_is_taken_as_it_is() -> None:
    assert np.shares_memory(as_image(COLOUR, "a"), COLOUR)


@pytest.mark.parametrize("grey", [COLOUR[..., 0], COLOUR[..., :1]])
def test_grey_becomes_three_equal_channels(grey: np.ndarray) -> None:
    found = as_image(grey, "a")
    assert found.shape == (24, 32, 3)
    assert found.flags.c_contiguous
    for channel in range(3):
        np.testing.assert_array_equal(found[..., channel], COLOUR[..., 0])


def test_transparency_is_dropped_and_views_are_copied() -> None:
    rgba = np.dstack([COLOUR, np.full((24, 32), 7, np.uint8)])
    for given_, wanted in ((rgba, COLOUR), (COLOUR[..., ::-1], COLOUR[..., ::-1]), (COLOUR[::-1], COLOUR[::-1])):
        found = as_image(given_, "a")
        np.testing.assert_array_equal(found, wanted)
        assert found.flags.c_contiguous


class OfAnotherLibrary:
    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        return COLOUR


class OnAnotherDevice:
    def __array__(self, dtype: Any = None, copy: Any = None) -> np.ndarray:
        raise TypeError("can't convert cuda:0 device type tensor to numpy")


def test_what_numpy_can_read_is_an_array() -> None:
    np.testing.assert_array_equal(as_image(OfAnotherLibrary(), "a"), COLOUR)
    with pytest.raises(FrameError, match="frame 3: an image as a NumPy array is needed: can't convert cuda:0"):
        as_image(OnAnotherDevice(), "frame 3")


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (COLOUR / np.float32(255), r"float32: of values from 0 to 1 give \(255 \* image\)\.round\(\)"),
        (COLOUR.astype(np.float64), r"float64: give image\.clip\(0, 255\)\.round\(\)\.astype\('uint8'\)"),
        (np.full((24, 32), np.nan, np.float32), "float32"),
        (COLOUR.astype(np.uint16), r"uint16: is it depth\? That goes to depth="),
        (COLOUR.astype(np.int64), r"int64: give image\.astype\('uint8'\)"),
        (COLOUR > 3, "bool: a mask is no image"),
        (
            np.moveaxis(COLOUR, -1, 0),
            r"\[3, 24, 32\]: move the channels to the end with numpy.moveaxis\(image, 0, -1\)",
        ),
        (COLOUR[None], r"\[1, 24, 32, 3\]"),
        (np.zeros((24, 32, 2), np.uint8), r"\[24, 32, 2\]"),
        (np.zeros(24, np.uint8), r"\[24\]"),
        (np.zeros((0, 32, 3), np.uint8), "is empty"),
        (np.zeros((5, 200, 3), np.uint8), "200x5 pixels; at least 16x16"),
        (np.array([["a", "b"]]), "not ndarray"),
        (np.array([{}, {}]), "NumPy array is needed"),
        (COLOUR.astype(np.complex64), "NumPy array is needed"),
        (None, "not NoneType"),
        (17, "not int"),
        ({"image": 1}, "not dict"),
    ],
)
def test_other_images_are_refused_with_what_to_do(image: Any, words: str) -> None:
    with pytest.raises(FrameError, match=words) as caught:
        as_image(image, "frame 3")
    assert str(caught.value).startswith("frame 3: ")


def test_depth_in_metres_keeps_its_values() -> None:
    for dtype in (np.float32, np.float64):
        found = as_depth(METRES.astype(dtype), "d", SIZE)
        np.testing.assert_array_equal(found, METRES)
        assert found.dtype == np.float32
    np.testing.assert_allclose(as_depth(METRES.astype(np.float16), "d", SIZE), METRES, rtol=1e-3)
    np.testing.assert_array_equal(as_depth(METRES[..., None], "d", SIZE), METRES)
    np.testing.assert_array_equal(as_depth(METRES.T.copy().T, "d", SIZE), METRES)  # not contiguous


@pytest.mark.parametrize(("scale", "dtype"), [(1000, np.uint16), (5000, np.uint16), (1000, np.int32), (1e6, np.int64)])
def test_integers_have_a_scale(scale: float, dtype: Any) -> None:
    raw = np.rint(METRES.astype(np.float64) * scale).astype(dtype)
    found = as_depth(raw, "d", SIZE, scale)
    np.testing.assert_allclose(found, METRES, atol=0.6 / scale)
    with pytest.raises(FrameError, match=r"depth_scale=, units per metre \(1000 for millimetres, 5000 for TUM"):
        as_depth(raw, "d", SIZE)


@given(some.arrays(np.uint16, (24, 32)), st.sampled_from([1000.0, 5000.0, 999.5]))
def test_sixteen_bits_are_what_a_file_of_them_is(raw: np.ndarray, scale: float) -> None:
    """To the bit: an image that is asked with an array has the answer of the same one from files."""
    from_file = decode_depth(encode_16bit(raw), "d", scale, SIZE)
    if np.isfinite(from_file).any() and not 0.02 <= np.nanmedian(from_file) <= 100:
        with pytest.raises(FrameError, match="cannot be metres"):
            as_depth(raw, "d", SIZE, scale)
    else:
        np.testing.assert_array_equal(as_depth(raw, "d", SIZE, scale), from_file)


def test_what_is_no_measurement_is_nan() -> None:
    depth = METRES.copy()
    depth[0, :5] = np.nan, np.inf, -np.inf, 0, -1
    found = as_depth(depth, "d", SIZE)
    assert np.isnan(found[0, :5]).all()
    np.testing.assert_array_equal(found[1:], METRES[1:])
    masked = np.ma.masked_array(METRES, mask=METRES > 2)
    found = as_depth(masked, "d", SIZE)
    np.testing.assert_array_equal(np.isnan(found), METRES > 2)
    raw = np.full((24, 32), 1500, np.uint16)
    raw[0, :2] = 0, 65535
    found = as_depth(raw, "d", SIZE, 1000)
    assert np.isnan(found[0, :2]).all()
    assert found[1, 1] == pytest.approx(1.5)
    assert np.isnan(as_depth(np.zeros((24, 32), np.float32), "d", SIZE)).all()  # an image in which nothing was measured


@pytest.mark.parametrize(
    ("depth", "scale", "words"),
    [
        (
            METRES * 1000,
            None,
            r"beyond 2250 m, which cannot be metres: .* depth_scale=, units per metre \(1000 for mill",
        ),
        (METRES, 5000, r"beyond 0\.00045 m, which cannot be metres: check depth_scale=5000"),
        (METRES[:, :-1], None, r"shape \[24, 31\], but the image is 32x24, so \[24, 32\] is needed"),
        (METRES.T, None, r"shape \[32, 24\]"),
        (METRES[..., None].repeat(3, axis=2), None, r"shape \[24, 32, 3\]"),
        (METRES > 1, None, "this is bool"),
        (METRES.astype(np.complex64), None, "NumPy array is needed"),
        (np.zeros((0, 0)), None, "is empty"),
        (None, None, "not NoneType"),
    ],
)
def test_other_depth_is_refused(depth: Any, scale: float | None, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        as_depth(depth, "d", SIZE, scale)


@pytest.mark.parametrize("scale", [0, -1, np.nan, np.inf, "much", [1]])
def test_a_scale_that_is_none_is_refused(scale: Any) -> None:
    with pytest.raises(UsageError, match="a positive number of units per metre"):
        check_depth_scale(scale)


def test_cameras() -> None:
    wanted = Camera(640, 480, 525.0, 524.0, 319.5, 239.5)
    matrix = np.array([[525, 0, 319.5], [0, 524, 239.5], [0, 0, 1]])
    for value in ((525, 524, 319.5, 239.5), [525, 524, 319.5, 239.5], "525,524,319.5,239.5", matrix, wanted):
        assert as_camera(value, (640, 480)) == wanted
    assert as_camera(Camera(320, 240, 1, 1, 1, 1), (640, 480)).width == 320  # its own size wins
    assert as_camera(np.arange(1.0, 10.0)).distortion == (5.0, 6.0, 7.0, 8.0, 9.0)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ((525, 525, 320), "this has 3 numbers"),
        ((525, 525, 320, 240, 0.1), "this has 5 numbers"),
        ((), "this has 0 numbers"),
        (("a", 525, 320, 240), "takes a Camera"),
        ({"fx": 525}, "takes a Camera"),
        ((0, 525, 320, 240), "must be positive"),
        ((525, -525, 320, 240), "must be positive"),
        ((525, 525, np.nan, 240), "not finite"),
        (Camera(640, 480, np.inf, 525, 320, 240), "not finite"),
        (np.eye(4), r"has the shape \[4, 4\]"),
        (np.array([[525, 1, 320], [0, 525, 240], [0, 0, 1.0]]), "a matrix"),
        ("1,2,x,4", "no number"),
    ],
)
def test_what_is_no_camera_is_refused(value: Any, words: str) -> None:
    with pytest.raises(UsageError, match=words):
        as_camera(value)


def test_a_pose_is_projected_to_a_rotation() -> None:
    turned = np.eye(4)
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    turned[:3, 3] = 1, 2, 3
    given_ = turned.astype(np.float32)
    given_[:3] *= 1.0001
    found = as_pose(given_, "p")
    np.testing.assert_allclose(found[:3, :3].T @ found[:3, :3], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(found, turned, atol=3e-4)


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        (np.eye(3), r"shape \[3, 3\]"),
        (np.full((4, 4), np.nan), "not finite; where there is no pose give None"),
        (np.diag([1, 1, -1, 1]), "no rigid motion"),
        (np.diag([1000, 1000, 1000, 1]), "no rigid motion in metres"),
        (np.eye(4) + np.eye(4)[::-1], "no rigid motion"),
        ("x", "NumPy array is needed"),
    ],
)
def test_what_is_no_pose_is_refused(pose: Any, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        as_pose(pose, "p")


@given(
    st.one_of(
        some.arrays(
            st.one_of(some.scalar_dtypes(), st.just(np.dtype(object))), some.array_shapes(max_dims=4, max_side=20)
        ),
        st.none(),
        st.text(max_size=5),
        st.lists(st.integers(), max_size=5),
    ),
    st.one_of(st.none(), st.floats()),
)
def test_nothing_but_semdbs_own_errors(value: Any, scale: float | None) -> None:
    """Whatever is given: an array as promised, or an error that says what to do."""
    for take in (
        lambda: as_image(value, "x"),
        lambda: as_depth(value, "x", (20, 16), scale),
        lambda: as_camera(value),
        lambda: as_pose(value, "x"),
    ):
        with contextlib.suppress(SemdbError):
            found = take()
            assert isinstance(found, Camera) or found.flags.c_contiguous
