"""What an image lacks, measured: motion blur with direction and length, light; and what is done about it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semdb.localization.blurred import BlurOptions
from semdb.perception.quality import (
    blurred_like,
    complaint_of,
    image_quality,
    motion_blur,
    motion_kernel,
    stretch_of,
    stretched,
)


def scene(seed: int = 0) -> np.ndarray:
    """Shapes of all sizes with edges, as rooms have, and a sensor's noise."""
    rng = np.random.default_rng(seed)
    image = np.full((480, 640), 120, np.uint8)
    for _ in range(400):
        x, y = rng.integers(0, 640), rng.integers(0, 480)
        size = int(5 + 60 * rng.random() ** 3)
        shade = int(rng.integers(0, 256))
        points = np.array([x, y]) + rng.integers(-size, size + 1, (5, 2))
        cv2.fillPoly(image, [points.astype(np.int32)], shade)
    noisy = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 1.5, image.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("degrees", [0, 22.5, 45, 90, 112.5, 160])
@pytest.mark.parametrize("length", [12, 23, 35])
def test_motion_is_found_with_its_length_and_direction(length: int, degrees: float) -> None:
    found = motion_blur(blurred_like(scene(), (length, degrees)))
    assert found is not None
    assert found[0] == pytest.approx(length, abs=1.0)
    off = abs(found[1] - degrees) % 180
    assert min(off, 180 - off) < 4


@pytest.mark.parametrize("seed", range(4))
def test_no_motion_is_found_where_there_is_none(seed: int) -> None:
    for image in (scene(seed), cv2.GaussianBlur(scene(seed), (0, 0), 3), np.full((480, 640), 90, np.uint8)):
        assert motion_blur(image) is None
    noise = np.random.default_rng(seed).integers(0, 256, (480, 640)).astype(np.uint8)
    assert motion_blur(noise) is None
    assert motion_blur(scene(seed)[:120]) is None  # too small to say


@pytest.mark.parametrize("seed", [1, 2, 6, 9])
def test_motion_that_plain_images_hardly_show_is_looked_for_but_not_told_of(seed: int) -> None:
    rng = np.random.default_rng(seed)
    image = np.full((480, 640), 150, np.uint8)
    for _ in range(60):
        x, y = rng.integers(0, 640), rng.integers(0, 480)
        size = int(rng.integers(10, 120))
        points = np.array([x, y]) + rng.integers(-size, size + 1, (5, 2))
        cv2.fillPoly(image, [points.astype(np.int32)], int(rng.integers(110, 190)))
    sharp = cv2.GaussianBlur(image, (0, 0), 0.7)
    noise = np.random.default_rng(seed).normal(0, 1, image.shape)
    moved, still = (np.clip(seen + noise, 0, 255).astype(np.uint8) for seen in (blurred_like(sharp, (23, 45.0)), sharp))
    least = BlurOptions().least_peak
    assert motion_blur(moved) is None
    assert motion_blur(moved, least) == (pytest.approx(23, abs=1), pytest.approx(45, abs=3))
    assert motion_blur(still, least) is None


def test_motion_is_found_in_small_images() -> None:
    small = blurred_like(cv2.resize(scene(), (320, 240), interpolation=cv2.INTER_AREA), (15, 60))
    found = motion_blur(small)
    assert found is not None
    assert found == (pytest.approx(15, abs=1), pytest.approx(60, abs=5))


def test_a_kernel_is_the_motion() -> None:
    kernel = motion_kernel(9.0, 0.0)
    assert kernel.sum() == pytest.approx(1.0)
    y, x = (np.arange(size) - size // 2 for size in kernel.shape)
    assert float((kernel * x).sum()) == pytest.approx(0, abs=1e-5)
    assert float((kernel * x**2).sum()) == pytest.approx(9**2 / 12, rel=0.1)
    assert float((kernel * y[:, None] ** 2).sum()) == pytest.approx(0, abs=1e-5)
    np.testing.assert_allclose(motion_kernel(9.0, 90.0), kernel.T, atol=1e-5)


def test_what_has_contrast_is_not_stretched() -> None:
    image = scene()
    assert stretch_of(image) is None
    dark = (image * 0.2).astype(np.uint8)
    stretch = stretch_of(dark)
    assert stretch is not None
    light = stretched(dark, stretch)
    assert np.percentile(light, 95) - np.percentile(light, 5) > 150
    assert stretch_of(np.full((480, 640), 40, np.uint8)) is None  # there is nothing in it
    colour = np.dstack([dark] * 3)
    np.testing.assert_array_equal(stretched(colour, stretch)[:, :, 1], light)


def test_quality_is_that_of_the_image_as_it_was_seen() -> None:
    dark = (scene() * 0.2).astype(np.uint8)
    stretch = stretch_of(dark)
    assert stretch is not None
    seen, known = image_quality(dark), image_quality(stretched(dark, stretch), stretch)
    assert known.exposure == pytest.approx(seen.exposure, abs=0.01)
    assert known.contrast == pytest.approx(seen.contrast, abs=0.01)
    assert known.sharpness == pytest.approx(seen.sharpness, rel=0.2)
    sharp, soft = image_quality(scene()), image_quality(blurred_like(scene(), (23, 30)))
    assert sharp.sharpness > 3 * soft.sharpness


def test_a_complaint_names_what_is_wrong() -> None:
    assert complaint_of(image_quality(scene())) == ""
    dark = complaint_of(image_quality((scene() * 0.2).astype(np.uint8)))
    assert dark.startswith("the image is dark: its grey values span ")
    blurred = complaint_of(image_quality(blurred_like(scene(), (23, 90))))
    assert blurred == "the image is blurred by motion: 23 pixels at 90 deg"
