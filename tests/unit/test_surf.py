"""Properties of SURF on patterns whose geometry is known."""

from __future__ import annotations

import os
import signal
import time
import warnings
from concurrent.futures import ThreadPoolExecutor

import cv2
import numpy as np
import pytest

from semdb.errors import UsageError
from semdb.perception.features.surf import SURF
from semdb.types import Features, ImageArray
from tests.unit.surf_patterns import HEIGHT, WIDTH, agreement, random_pattern, render

PATTERN = random_pattern()
FIELDS = ("xy", "size", "angle", "response", "laplacian", "descriptors")


@pytest.fixture(scope="module")
def image() -> ImageArray:
    return render(PATTERN)


@pytest.fixture(scope="module")
def noise() -> ImageArray:
    rng = np.random.default_rng(3)
    return cv2.GaussianBlur(rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8), (0, 0), 1.5)


def assert_equal(first: Features, second: Features) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)


def taken(features: Features, chosen: np.ndarray) -> Features:
    return Features(*(getattr(features, name)[chosen] for name in FIELDS))


@pytest.mark.parametrize("angle", [7.0, 30.0, 45.0, 62.0, 133.0, 215.0, 301.0])
def test_rotation(image: ImageArray, angle: float) -> None:
    found = agreement(SURF().extract(image), SURF().extract(render(PATTERN, angle)), angle)
    assert found.compared >= 30
    assert found.repeated >= 0.9
    assert found.place < 0.5
    assert found.turn < 15
    assert found.matched >= 0.75


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_quarter_turns_change_nothing_but_the_angle(image: ImageArray, quarters: int) -> None:
    found = agreement(SURF().extract(image), SURF().extract(render(PATTERN, 90.0 * quarters)), 90.0 * quarters)
    assert (found.repeated, found.matched) == (1.0, 1.0)
    assert found.place < 0.01
    assert found.turn < 0.1


@pytest.mark.parametrize("scale", [0.5, 0.62, 0.8, 1.25, 1.6, 2.0])
def test_scale(image: ImageArray, scale: float) -> None:
    found = agreement(SURF().extract(image), SURF().extract(render(PATTERN, scale=scale)), scale=scale)
    assert found.compared >= 10
    assert found.repeated >= 0.75
    assert found.place < 0.5
    assert found.turn < 10
    assert found.matched >= 0.8


@pytest.mark.parametrize(("blur", "repeated", "matched"), [(0.7, 0.95, 0.95), (1.0, 0.9, 0.85), (2.0, 0.8, 0.7)])
def test_blur(image: ImageArray, blur: float, repeated: float, matched: float) -> None:
    found = agreement(SURF().extract(image), SURF().extract(render(PATTERN, blur=blur)))
    assert found.repeated >= repeated
    assert found.place < 0.5
    assert found.matched >= matched


def test_brightness_changes_nothing() -> None:
    image = cv2.convertScaleAbs(render(PATTERN), alpha=0.5, beta=20)
    dark, bright = SURF().extract(image), SURF().extract(image + np.uint8(80))
    assert len(dark) > 40
    for name in ("xy", "size", "angle", "response", "laplacian"):
        np.testing.assert_array_equal(getattr(dark, name), getattr(bright, name), err_msg=name)
    np.testing.assert_allclose(dark.descriptors, bright.descriptors, atol=2e-4)


def test_contrast_changes_only_the_response(image: ImageArray) -> None:
    weaker = cv2.convertScaleAbs(image, alpha=0.6, beta=30)
    full, half = SURF(300).extract(image), SURF(100).extract(weaker)  # the Hessian goes with the square of contrast
    found = agreement(full, half)
    assert found.repeated >= 0.98
    assert found.place < 0.1
    assert found.turn < 1
    assert found.matched >= 0.95


@pytest.mark.parametrize("octaves", [1, 4])
def test_translation_moves_the_keypoints(image: ImageArray, octaves: int) -> None:
    step = 1 << (octaves - 1)  # the coarsest octave samples every so many pixels
    dx, dy = 3 * step, 2 * step
    wide = cv2.copyMakeBorder(image, 0, 40, 0, 40, cv2.BORDER_REFLECT)
    first = SURF(n_octaves=octaves).extract(np.ascontiguousarray(wide[:HEIGHT, :WIDTH]))
    second = SURF(n_octaves=octaves).extract(np.ascontiguousarray(wide[dy : dy + HEIGHT, dx : dx + WIDTH]))
    reach = 20 * 1.2 / 9 * first.size  # of window and filters
    low, high = first.xy.min(axis=1) - reach, np.array([WIDTH, HEIGHT]) - first.xy - reach[:, None]
    inside = (low > max(dx, dy)) & (high > 0).all(axis=1)
    assert inside.sum() >= 10
    for k in np.flatnonzero(inside):
        there = np.flatnonzero((np.abs(second.xy - (first.xy[k] - (dx, dy))) < 1e-4).all(axis=1))
        assert first.response[k] in second.response[there]
        twin = there[second.response[there] == first.response[k]][0]
        assert second.angle[twin] == pytest.approx(first.angle[k], abs=1e-3)
        assert float(second.descriptors[twin] @ first.descriptors[k]) > 0.99999


def test_blobs_are_found_where_they_are() -> None:
    y, x = np.mgrid[:120, :160].astype(np.float64)
    for cx, cy, sign in ((70.0, 60.0, 1), (70.3, 60.6, -1), (81.75, 50.5, 1)):
        blob = 128 + sign * 90 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 32)
        found = SURF().extract(np.rint(blob).astype(np.uint8))
        assert np.abs(found.xy[0] - (cx, cy)).max() < 0.05
        assert found.laplacian[0] == -sign


def test_descriptors_are_unit_vectors(noise: ImageArray) -> None:
    for extended, width in ((False, 64), (True, 128)):
        found = SURF(extended=extended).extract(noise)
        assert found.descriptors.shape == (len(found), width)
        assert found.descriptors.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(found.descriptors, axis=1), 1, atol=1e-5)


def test_extended_descriptor_splits_the_sums_of_the_short_one(noise: ImageArray) -> None:
    short = SURF().extract(noise).descriptors.reshape(-1, 16, 4)
    split = SURF(extended=True).extract(noise).descriptors.reshape(-1, 16, 8)
    joined = np.stack(
        [
            split[..., 0] + split[..., 2],
            split[..., 4] + split[..., 6],
            split[..., 1] + split[..., 3],
            split[..., 5] + split[..., 7],
        ],
        axis=2,
    )
    joined /= np.linalg.norm(joined, axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(joined, short, atol=1e-5)


def test_upright_measures_no_angle(noise: ImageArray) -> None:
    upright, turned = SURF(upright=True).extract(noise), SURF().extract(noise)
    assert set(upright.angle.tolist()) == {270.0}
    assert len(upright) >= len(turned)
    straight = np.abs(turned.angle - 270) < 1
    twins = [k for k in np.flatnonzero(straight) if (upright.xy == turned.xy[k]).all(axis=1).any()]
    assert len(twins) >= 2
    for k in twins:
        same = np.flatnonzero((upright.xy == turned.xy[k]).all(axis=1))[0]
        assert float(upright.descriptors[same] @ turned.descriptors[k]) > 0.99


@pytest.mark.parametrize("shape", [(1, 1), (1, 20), (20, 1), (5, 7), (9, 9), (16, 16), (20, 20), (33, 9), (40, 21)])
def test_tiny_images(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    found = SURF(0).extract(rng.integers(0, 256, shape, dtype=np.uint8))
    assert found.descriptors.shape == (len(found), 64)
    assert len(found) == 0 or min(shape) >= 21
    assert SURF(0).extract(np.zeros(shape, np.uint8)).xy.shape == (0, 2)


@pytest.mark.parametrize("shape", [(479, 641), (101, 333), (517, 33), (64, 1023)])
def test_odd_sizes(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(2)
    image = cv2.GaussianBlur(rng.integers(0, 256, shape, dtype=np.uint8), (0, 0), 1.2)
    found = SURF().extract(image)
    assert len(found) > 20
    assert (found.xy > 0).all()
    assert (found.xy < np.array(shape[::-1]) - 1).all()
    flipped = SURF(n_octaves=1).extract(np.ascontiguousarray(image[:, ::-1]))
    straight = SURF(n_octaves=1).extract(image)
    mirrored = np.sort(shape[1] - 1 - flipped.xy[:, 0])
    np.testing.assert_allclose(mirrored, np.sort(straight.xy[:, 0]), atol=1e-3)


def test_constant_image() -> None:
    for grey in (0, 100, 255):
        found = SURF(0).extract(np.full((200, 300), grey, np.uint8))
        assert len(found) == 0
        assert found.descriptors.shape == (0, 64)


def test_huge_image(image: ImageArray) -> None:
    """The sums of a white image of 4000x3000 do not fit into 32 bits; the keypoints do not notice."""
    huge = np.full((3000, 4000), 255, np.uint8)
    alone = np.full((HEIGHT + 800, WIDTH + 800), 255, np.uint8)
    alone[400 : 400 + HEIGHT, 400 : 400 + WIDTH] = image
    y, x = 3000 - alone.shape[0], 4000 - alone.shape[1]
    huge[y:, x:] = alone
    expected, found = SURF().extract(alone), SURF().extract(huge)
    assert len(expected) > 80
    assert len(found) == len(expected)
    np.testing.assert_allclose(found.xy - (x, y), expected.xy, atol=5e-4)
    np.testing.assert_array_equal(found.response, expected.response)
    assert (np.einsum("ij,ij->i", found.descriptors, expected.descriptors) > 0.9999).all()


def test_layout_of_the_image_does_not_matter(image: ImageArray) -> None:
    expected = SURF().extract(image)
    readonly = image.copy()
    readonly.setflags(write=False)
    wide = np.zeros((HEIGHT, 2 * WIDTH), np.uint8)
    wide[:, ::2] = image
    for same in (readonly, wide[:, ::2], np.asfortranarray(image), image[::-1][::-1]):
        assert_equal(SURF().extract(same), expected)


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_do_not_change_a_bit(noise: ImageArray, threads: int) -> None:
    assert_equal(SURF(threads=threads).extract(noise), SURF().extract(noise))


def test_calls_from_several_threads(image: ImageArray, noise: ImageArray) -> None:
    surf = SURF(threads=2)
    images = [image, noise, np.ascontiguousarray(noise[:100, :130]), image.T.copy()] * 3
    expected = [SURF().extract(each) for each in images]
    with ThreadPoolExecutor(4) as pool:
        for found, right in zip(pool.map(surf.extract, images), expected, strict=True):
            assert_equal(found, right)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_makes_its_own_threads(noise: ImageArray) -> None:
    surf = SURF(threads=2)
    expected = len(surf.extract(noise))
    with warnings.catch_warnings(action="ignore", category=DeprecationWarning):
        child = os.fork()
    if child == 0:
        os._exit(0 if len(surf.extract(noise)) == expected else 1)
    for _ in range(200):
        process, status = os.waitpid(child, os.WNOHANG)
        if process:
            break
        time.sleep(0.05)
    else:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        pytest.fail("the forked process hangs")
    assert status == 0


@pytest.mark.parametrize("seed", range(4))
def test_region_gives_what_the_whole_image_has_there(noise: ImageArray, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    for _ in range(seed + 1):
        y, x = rng.integers(0, HEIGHT - 40), rng.integers(0, WIDTH - 40)
        mask[y : y + rng.integers(10, 120), x : x + rng.integers(10, 120)] = True
    mask &= rng.random(mask.shape) < (1.0 if seed % 2 else 0.7)  # ragged masks too
    whole = SURF().extract(noise)
    column, row = np.floor(whole.xy + 0.5).astype(int).T
    inside = np.flatnonzero(mask[row, column])
    assert len(inside) >= 5
    for threads in (1, 2):
        assert_equal(SURF(threads=threads).extract(noise, mask), taken(whole, inside))


def test_window_and_smoothing_change_only_the_descriptor(noise: ImageArray) -> None:
    wide, usual = SURF(window_sigma=6.5, smoothing=2.0, threads=2), SURF()
    first, second = wide.extract(noise), usual.extract(noise)
    for name in ("xy", "size", "angle", "response", "laplacian"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name), err_msg=name)
    cosine = np.einsum("ij,ij->i", first.descriptors, second.descriptors)
    assert 0.8 < np.median(cosine) < 0.99
    mask = np.zeros(noise.shape, bool)
    mask[60:160, 100:220] = True
    column, row = np.floor(first.xy + 0.5).astype(int).T
    assert_equal(wide.extract(noise, mask), taken(first, np.flatnonzero(mask[row, column])))


def test_full_and_empty_region(noise: ImageArray) -> None:
    assert_equal(SURF().extract(noise, np.full(noise.shape, 255, np.uint8)), SURF().extract(noise))
    assert len(SURF().extract(noise, np.zeros(noise.shape, np.uint8))) == 0


def test_max_keypoints_keeps_the_strongest(noise: ImageArray) -> None:
    everything = SURF().extract(noise)
    assert (np.diff(everything.response) <= 0).all()
    some = SURF(max_keypoints=30).extract(noise)
    assert 25 <= len(some) <= 30  # those whose angle cannot be measured are gone
    assert_equal(some, taken(everything, np.arange(len(some))))


def test_threshold_is_the_least_response(noise: ImageArray) -> None:
    low, high = SURF(100).extract(noise), SURF(2000).extract(noise)
    assert high.response.min() > 2000
    assert_equal(high, taken(low, np.flatnonzero(low.response > 2000)))


def test_opencv_calls(noise: ImageArray) -> None:
    surf = SURF(n_octaves=3)
    keypoints, descriptors = surf.detectAndCompute(noise, None)
    found = surf.extract(noise)
    np.testing.assert_array_equal(descriptors, found.descriptors)
    np.testing.assert_array_equal(cv2.KeyPoint.convert(keypoints), found.xy)
    assert [k.class_id for k in keypoints] == found.laplacian.tolist()
    assert {k.octave for k in keypoints} == {0, 1, 2}
    assert [k.pt for k in surf.detect(noise)] == [k.pt for k in keypoints]
    again, same = surf.compute(noise, keypoints[::-1])
    assert [k.angle for k in again] == [k.angle for k in keypoints[::-1]]
    same = same[::-1]
    np.testing.assert_array_equal(same, descriptors)
    none, nothing = surf.compute(noise, ())
    assert none == ()
    assert nothing.shape == (0, 64)
    assert (surf.descriptorSize(), SURF(extended=True).descriptorSize()) == (64, 128)
    matches = cv2.BFMatcher(surf.defaultNorm()).match(descriptors, same)
    assert all(m.queryIdx == m.trainIdx for m in matches)


@pytest.mark.parametrize(
    ("image", "mask"),
    [
        (np.zeros((20, 20, 3), np.uint8), None),
        (np.zeros((20, 20), np.float32), None),
        (np.zeros((0, 20), np.uint8), None),
        (np.zeros((20, 20), np.uint8), np.zeros((20, 21), np.uint8)),
    ],
    ids=["colour", "float", "empty", "mask"],
)
def test_what_is_no_grey_image_is_refused(image: ImageArray, mask: np.ndarray | None) -> None:
    with pytest.raises(UsageError, match="SURF"):
        SURF().extract(image, mask)


@pytest.mark.parametrize(
    "parameters",
    [
        {"hessian_threshold": -1},
        {"hessian_threshold": float("nan")},
        {"n_octaves": 0},
        {"n_octave_layers": 0},
        {"max_keypoints": -1},
        {"threads": 0},
        {"window_sigma": 0.5},
        {"smoothing": 0.0},
    ],
)
def test_parameters_out_of_range_are_refused(parameters: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(parameters))):
        SURF(**parameters)  # type: ignore[arg-type]
