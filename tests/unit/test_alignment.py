"""Patches aligned to a fraction of a pixel, on images whose shift is known."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semdb.localization.alignment_kernels import align_patches
from semdb.types import FloatArray, ImageArray


def texture(seed: int, size: int = 240) -> FloatArray:
    """Smooth blobs, grey values about 128."""
    noise = np.random.default_rng(seed).normal(size=(size, size))
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.5)
    return np.asarray(128 + 40 * smooth / smooth.std())


def warped(
    image: FloatArray, matrix: FloatArray, shift: FloatArray, gain: float = 1.0, offset: float = 0.0
) -> ImageArray:
    """An image that shows at ``matrix @ p + shift`` what `image` shows at p."""
    whole = np.column_stack([matrix, shift])
    moved = cv2.warpAffine(image, whole, image.shape[::-1], flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    return np.asarray(np.clip(np.rint(moved * gain + offset), 0, 255), np.uint8)


def align(
    first: FloatArray,
    second: ImageArray,
    matrix: FloatArray,
    shift: FloatArray,
    wrong_by: float = 0.0,
    step: float = 1.0,
) -> tuple[FloatArray, FloatArray]:
    """Errors ``[n, 2]`` in pixels of a grid of points, and likenesses ``[n]``."""
    at = np.stack(np.meshgrid(np.arange(60.3, 180, 20), np.arange(60.7, 180, 20)), axis=-1).reshape(-1, 2)
    truth = at @ matrix.T + shift
    random = np.random.default_rng(0)
    guess = truth + random.uniform(-1, 1, truth.shape) * wrong_by
    found, likeness = np.zeros_like(at), np.empty(len(at))
    template = np.asarray(np.clip(np.rint(first), 0, 255), np.uint8)
    warps, steps = np.tile(matrix, (len(at), 1, 1)), np.full(len(at), step)
    align_patches(template, second, at, warps, steps, guess, found, likeness)
    return found - truth, likeness


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 1000),
    angle=st.floats(-0.5, 0.5),
    scale=st.floats(0.75, 1.3),
    shift=st.tuples(st.floats(-3, 3), st.floats(-3, 3)),
    gain=st.floats(0.7, 1.2),
)
def test_shift_is_found_to_a_twentieth_of_a_pixel(
    seed: int, angle: float, scale: float, shift: tuple[float, float], gain: float
) -> None:
    image = texture(seed)
    turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    moved = np.array([120.0, 120.0]) - turn @ [120.0, 120.0] + shift
    errors, likeness = align(image, warped(image, turn, moved, gain, 10.0), turn, moved, wrong_by=0.8)
    good = likeness > 0.9
    assert good.mean() > 0.9
    assert np.median(np.hypot(*errors[good].T)) < 0.05


@pytest.mark.parametrize("step", [1.0, 1.7, 2.5])
def test_larger_patches_too(step: float) -> None:
    image = texture(3)
    shift = np.array([1.3, -0.6])
    errors, likeness = align(image, warped(image, np.eye(2), shift), np.eye(2), shift, wrong_by=1.0, step=step)
    good = likeness > 0.9
    assert good.mean() > 0.8
    assert np.median(np.hypot(*errors[good].T)) < 0.05


def test_a_warp_that_is_a_little_wrong_does_not_move_the_patch() -> None:
    """As of a slanted surface that was taken to face the camera: 15 % narrower than assumed."""
    image = texture(5)
    slanted = np.diag([0.85, 1.0])
    shift = np.array([18.0, 0.4])
    at_wrong_warp = warped(image, slanted, shift)
    at = np.stack(np.meshgrid(np.arange(60.3, 180, 20), np.arange(60.7, 180, 20)), axis=-1).reshape(-1, 2)
    truth = at @ slanted.T + shift
    found, likeness = np.zeros_like(at), np.empty(len(at))
    template = np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)
    align_patches(
        template, at_wrong_warp, at, np.tile(np.eye(2), (len(at), 1, 1)), np.ones(len(at)), truth, found, likeness
    )
    good = likeness > 0.9
    assert good.mean() > 0.4
    assert np.median(np.hypot(*(found - truth)[good].T)) < 0.25


def test_what_cannot_be_aligned_is_not() -> None:
    image = texture(7)
    flat = np.full((240, 240), 90, np.uint8)
    _, likeness = align(image, flat, np.eye(2), np.zeros(2))
    assert (likeness < 0.9).all()
    _, likeness = align(flat.astype(np.float64), flat, np.eye(2), np.zeros(2))
    assert (likeness == -1).all()
    _, likeness = align(image, warped(image, np.eye(2), np.zeros(2)), np.eye(2), np.array([300.0, 0.0]))
    assert (likeness == -1).all()  # outside of the image
    other = np.asarray(np.clip(texture(8), 0, 255), np.uint8)
    _, likeness = align(image, other, np.eye(2), np.zeros(2))
    assert (likeness > 0.9).mean() < 0.1


@pytest.mark.long
def test_a_process_that_compiles_gives_the_bits_of_one_that_loads(tmp_path: Path) -> None:
    code = (
        "import cv2, numpy as np; from semdb.localization.alignment_kernels import align_patches;"
        "rng = np.random.default_rng(0); n = 200;"
        "image = cv2.GaussianBlur(rng.integers(0, 256, (240, 320), np.uint8), (0, 0), 2.0);"
        "at = rng.uniform(40, 200, (n, 2)); found, alike = np.zeros((n, 2)), np.zeros(n);"
        "warp = np.eye(2) + rng.normal(0, 0.05, (n, 2, 2));"
        "other = np.roll(image, 1, axis=1);"
        "align_patches(image, other, at, warp, rng.uniform(0.8, 1.5, n), at + 1.3, found, alike);"
        "print(int((alike > 0.5).sum()), found.tobytes().hex())"
    )
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    )
    assert int(first.split()[0]) > 50
    assert first == second
