"""SURF against what OpenCV's own implementation found on real images, and its kernels' cache."""

from __future__ import annotations

import logging
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semdb import compiled
from semdb.perception.features.surf import SURF


@pytest.mark.shared
@pytest.mark.parametrize("frame", [0, 160, 500, 660])
def test_same_keypoints_and_descriptors_as_opencv(shared_dir: Path, frame: int) -> None:
    reference = np.load(shared_dir / "reference" / "surf_redkitchen.npz")
    keypoints, descriptors = reference[f"kp_{frame:06d}"], reference[f"desc_{frame:06d}"]
    folder = shared_dir / "recordings" / "7scenes_redkitchen" / "seq-01"
    image = cv2.imread(str(folder / f"frame-{frame:06d}.color.jpg"), cv2.IMREAD_GRAYSCALE)
    found = SURF(hessian_threshold=100).extract(image)
    distance = np.linalg.norm(keypoints[:, None, :2] - found.xy[None], axis=2)
    scale = np.maximum(keypoints[:, None, 2] / found.size[None], found.size[None] / keypoints[:, None, 2])
    cost = distance + 10 * (scale - 1)
    cost[(distance > 2) | (scale > 1.3) | (keypoints[:, None, 6] != found.laplacian[None])] = np.inf
    nearest = cost.argmin(axis=1)
    same = np.isfinite(cost[np.arange(len(keypoints)), nearest])
    assert same.mean() >= 0.99
    assert np.isinf(cost.min(axis=0)).mean() <= 0.02
    turn = np.abs((found.angle[nearest] - keypoints[:, 3] + 180) % 360 - 180)[same]
    assert (turn < 5).mean() >= 0.99
    cosine = np.einsum("ij,ij->i", found.descriptors[nearest], descriptors)[same]
    assert np.median(cosine) >= 0.9995
    assert cosine.mean() >= 0.999


def test_import_loads_no_compiler() -> None:
    program = "import sys, semdb.perception.features.surf; print('numba' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "False"


def double(x: int) -> int:
    return 2 * x


def triple(x: int) -> int:
    return 3 * x


def test_kernel_without_a_cache_folder_works_and_says_so(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    njit: Callable[..., Any] = compiled.numba.njit

    def no_folder(function: Callable[..., Any], **options: Any) -> Any:
        if options.get("cache"):
            raise RuntimeError(f"cannot cache function {function.__name__!r}: no locator available")
        return njit(function, **options)

    monkeypatch.setattr(compiled.numba, "njit", no_folder)
    compiled._warn_uncached.cache_clear()
    with caplog.at_level(logging.WARNING):
        functions = [compiled.kernel(double), compiled.kernel(triple)]
    assert [f(21) for f in functions] == [42, 63]
    assert len(caplog.records) == 1
    assert "NUMBA_CACHE_DIR" in caplog.text


def test_named_cache_folder_that_cannot_be_written_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    file = tmp_path / "file"
    file.write_text("in the way")
    monkeypatch.setattr(compiled.numba.config, "CACHE_DIR", str(file / "cache"))
    with caplog.at_level(logging.WARNING):
        assert compiled.kernel(double)(4) == 8
    assert str(file / "cache") in caplog.text
