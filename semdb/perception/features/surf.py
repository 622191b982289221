"""SURF (Speeded-Up Robust Features) on numpy arrays, compiled with numba, made to be usable on its own.

    from semdb.perception.features.surf import SURF

    keypoints, descriptors = SURF(hessian_threshold=100).detectAndCompute(grey, None)

Source: Bay, Ess, Tuytelaars, Van Gool, Speeded-Up Robust Features (CVIU 2008). Parameters, their defaults and the
results are those of OpenCV's implementation (`docs/surf.md` compares them); the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import UsageError
from semdb.types import BoolArray, Features, Float32Array, ImageArray

MASK_TILE = 16  # sample rows that share their columns to look at, when there is a mask
MIN_CHUNK = 64  # keypoints that are worth a task of their own


class SURF:
    """Detector and descriptor with the calls of a `cv2.Feature2D`. Immutable; safe to call from several threads.

    `hessian_threshold`: least determinant of the Hessian of a keypoint. `n_octaves`, `n_octave_layers`: how many
    doublings of the scale, how many scales in each. `extended`: 128 instead of 64 numbers per descriptor. `upright`:
    do not measure the orientation (all angles are 270, as OpenCV has them). `max_keypoints`: keep the
    strongest by response, 0 for all. `threads`: how many threads one call uses; they do not change a bit of the result.

    Raises UsageError for parameters out of range.
    """

    def __init__(
        self,
        hessian_threshold: float = 100,
        n_octaves: int = 4,
        n_octave_layers: int = 3,
        extended: bool = False,
        upright: bool = False,
        *,
        max_keypoints: int = 0,
        threads: int = 1,
    ) -> None:
        if not hessian_threshold >= 0 or not np.isfinite(hessian_threshold):
            raise UsageError(f"SURF: hessian_threshold is {hessian_threshold}, it must be 0 or more")
        if not 1 <= n_octaves <= 8 or not 1 <= n_octave_layers <= 16:
            raise UsageError(
                f"SURF: n_octaves is {n_octaves} and n_octave_layers {n_octave_layers}, they must be 1 to 8 and 1 to 16"
            )
        if max_keypoints < 0 or threads < 1:
            raise UsageError(f"SURF: max_keypoints is {max_keypoints} (0 or more), threads is {threads} (1 or more)")
        self.hessian_threshold = float(hessian_threshold)
        self.n_octaves = int(n_octaves)
        self.n_octave_layers = int(n_octave_layers)
        self.extended = bool(extended)
        self.upright = bool(upright)
        self.max_keypoints = int(max_keypoints)
        self.threads = int(threads)
        self._pool: ThreadPoolExecutor | None = None
        self._pool_lock = threading.Lock()
        largest = (9 + 6 * (self.n_octave_layers + 1)) << (self.n_octaves - 1)
        step = 1 << (self.n_octaves - 1)
        self._pad = -(-(int(largest * 0.6 / 9) + 3) // step) * step  # room for the largest cell of a descriptor

    def extract(self, image: ImageArray, mask: npt.NDArray[Any] | None = None) -> Features:
        """Keypoints and descriptors of a grey uint8 `image` [H, W], strongest first.

        With a `mask` [H, W], those whose centre lies on a pixel that is not zero: exactly the ones that the whole image
        has there, but only there is looked for them. Raises UsageError when image or mask are not of this kind.
        """
        sums, candidates = self._detect(image, mask)
        return self._describe(sums, candidates, image.shape, described=True)

    def detectAndCompute(  # noqa: N802
        self, image: ImageArray, mask: npt.NDArray[Any] | None = None
    ) -> tuple[tuple[cv2.KeyPoint, ...], Float32Array]:
        """Like `extract`: OpenCV keypoints (`class_id` holds the sign of the Laplacian) and float32 [n, 64 or 128]."""
        sums, candidates = self._detect(image, mask)
        features = self._describe(sums, candidates, image.shape, described=True)
        return _keypoints(features), features.descriptors.astype(np.float32, copy=False)

    def detect(self, image: ImageArray, mask: npt.NDArray[Any] | None = None) -> tuple[cv2.KeyPoint, ...]:
        """The keypoints of `detectAndCompute`, without descriptors."""
        sums, candidates = self._detect(image, mask)
        return _keypoints(self._describe(sums, candidates, image.shape, described=False))

    def compute(
        self, image: ImageArray, keypoints: Sequence[cv2.KeyPoint]
    ) -> tuple[tuple[cv2.KeyPoint, ...], Float32Array]:
        """Descriptors of given keypoints, with their angles measured anew.

        Keypoints whose orientation cannot be measured, too near to the border, are left out.
        """
        rows = [(*k.pt, k.size, k.response, max(k.octave, 0), k.class_id) for k in keypoints]
        candidates = np.array(rows, dtype=np.float32).reshape(-1, 6)
        features = self._describe(self._integral(_checked(image)), candidates, image.shape, described=True)
        return _keypoints(features), features.descriptors.astype(np.float32, copy=False)

    def descriptorSize(self) -> int:  # noqa: N802
        return 128 if self.extended else 64

    def descriptorType(self) -> int:  # noqa: N802
        return int(cv2.CV_32F)

    def defaultNorm(self) -> int:  # noqa: N802
        return int(cv2.NORM_L2)

    def empty(self) -> bool:
        return False

    def _integral(self, image: ImageArray) -> npt.NDArray[np.int32]:
        from semdb.perception.features._surf_detect import integral

        pad = self._pad
        padded = cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
        sums = np.empty((padded.shape[0] + 1, padded.shape[1] + 1), np.int32)
        integral(padded, sums)
        return sums

    def _detect(self, image: ImageArray, mask: npt.NDArray[Any] | None) -> tuple[npt.NDArray[np.int32], Float32Array]:
        """Padded integral image and candidates [n, 6], strongest first; ties in order of octave, row, layer, column."""
        from semdb.perception.features._surf_detect import COLUMNS, deinterleave

        image = _checked(image)
        height, width = image.shape
        region = None if mask is None else _checked_mask(mask, image.shape)
        if min(height, width) < 9 or (region is not None and not region.any()):
            return np.zeros((1, 1), np.int32), np.zeros((0, COLUMNS), np.float32)
        sums = self._integral(image)
        tasks: list[Callable[[], Float32Array]] = []
        for octave in range(self.n_octaves):
            step = 1 << octave
            if min(height, width) < (9 + 6 * 2) << octave:
                break
            if step == 1:
                phases = sums[:, None, :]
            else:
                columns = (self._pad + width) // step + 1
                phases = np.empty((sums.shape[0], step, columns), np.int32)
                deinterleave(sums, phases)
            tasks += self._octave_tasks(phases, image.shape, octave, region)
        found = self._run(tasks)
        candidates = np.concatenate(found) if found else np.zeros((0, COLUMNS), np.float32)
        if region is not None:
            x = np.clip(np.floor(candidates[:, 0] + 0.5).astype(np.intp), 0, width - 1)
            y = np.clip(np.floor(candidates[:, 1] + 0.5).astype(np.intp), 0, height - 1)
            candidates = candidates[region[y, x]]
        order = np.argsort(-candidates[:, 3], kind="stable")
        return sums, candidates[order[: self.max_keypoints or None]]

    def _octave_tasks(
        self, phases: npt.NDArray[np.int32], shape: tuple[int, int], octave: int, region: BoolArray | None
    ) -> list[Callable[[], Float32Array]]:
        from semdb.perception.features._surf_detect import COLUMNS, find_maxima

        height, width = shape
        step = 1 << octave
        rows, columns = height // step, width // step

        def search(first: int, last: int, spans: npt.NDArray[np.int64]) -> Float32Array:
            capacity = 64 + (last - first) * columns // 64
            while True:
                out = np.empty((capacity, COLUMNS), np.float32)
                count = find_maxima(
                    phases, self._pad, height, width, octave, self.n_octave_layers,
                    np.float32(self.hessian_threshold), first, last, spans, out,
                )  # fmt: skip
                if count <= capacity:
                    return out[:count]
                capacity = count

        if region is None:
            everywhere = np.array([[0, columns]], np.int64)
            bounds = np.linspace(0, rows, self.threads + 1).astype(int).tolist()
            bands = [(a, b, everywhere) for a, b in pairwise(bounds) if a < b]
        else:
            bands = _mask_bands(region, step, rows, columns)
        return [lambda a=a, b=b, s=s: search(a, b, s) for a, b, s in bands]  # type: ignore[misc]

    def _describe(
        self, sums: npt.NDArray[np.int32], candidates: Float32Array, shape: tuple[int, ...], *, described: bool
    ) -> Features:
        n = len(candidates)
        angles = np.empty(n, np.float32)
        descriptors = np.empty((n if described else 0, self.descriptorSize()), np.float32)
        if n:
            from semdb.perception.features import _surf_describe as kernels

            weights = (
                kernels.gaussian(2 * kernels.ORIENTATION_RADIUS + 1, kernels.ORIENTATION_SIGMA),
                kernels.gaussian(kernels.GRID, kernels.DESCRIPTOR_SIGMA),
            )

            def run(start: int, stop: int) -> None:
                kernels.describe(
                    sums, self._pad, shape[0], shape[1], candidates, self.upright, self.extended,
                    *weights, start, stop, angles, descriptors,
                )  # fmt: skip

            chunks = max(1, min(self.threads, n // MIN_CHUNK))
            bounds = np.linspace(0, n, chunks + 1).astype(int).tolist()
            self._run([lambda a=a, b=b: run(a, b) for a, b in pairwise(bounds)])  # type: ignore[misc]
        keep = angles >= 0
        if not keep.all():
            candidates, angles = candidates[keep], angles[keep]
            descriptors = descriptors[keep] if described else descriptors
        return Features(
            xy=np.ascontiguousarray(candidates[:, :2]),
            size=candidates[:, 2].copy(),
            angle=angles,
            response=candidates[:, 3].copy(),
            laplacian=candidates[:, 5].astype(np.int8),
            descriptors=descriptors,
        )

    def _run(self, tasks: Sequence[Callable[[], Any]]) -> list[Any]:
        if self.threads == 1 or len(tasks) < 2:
            return [task() for task in tasks]
        with self._pool_lock:
            if self._pool is None:
                self._pool = ThreadPoolExecutor(self.threads, thread_name_prefix="surf")
        return [future.result() for future in [self._pool.submit(task) for task in tasks]]


def _checked(image: ImageArray) -> ImageArray:
    if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype != np.uint8 or image.size == 0:
        what = f"{image.dtype} {image.shape}" if isinstance(image, np.ndarray) else type(image).__name__
        raise UsageError(
            f"SURF takes one grey image, uint8 [H, W], not {what}; cv2.cvtColor makes one of a colour image"
        )
    return image


def _checked_mask(mask: npt.NDArray[Any], shape: tuple[int, ...]) -> BoolArray:
    if not isinstance(mask, np.ndarray) or mask.shape != shape:
        what = mask.shape if isinstance(mask, np.ndarray) else type(mask).__name__
        raise UsageError(f"SURF: the mask must have the shape of the image, {shape}, not {what}")
    return np.asarray(mask != 0)


def _mask_bands(region: BoolArray, step: int, rows: int, columns: int) -> list[tuple[int, int, npt.NDArray[np.int64]]]:
    """(first row, last row, column spans [k, 2]) in samples of `step` pixels, enough for every keypoint in the region.

    A keypoint lies up to one and a half samples from the sample that found it.
    """
    reach = 2 * step + 1
    wide = cv2.dilate(region.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    bands = []
    for first in range(0, rows, MASK_TILE):
        last = min(first + MASK_TILE, rows)
        used = wide[first * step : last * step].any(axis=0)[: columns * step].reshape(columns, step).any(axis=1)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], used.view(np.int8), [0]))))
        if len(edges):
            bands.append((first, last, _merged(edges.reshape(-1, 2))))
    return bands


def _merged(spans: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Spans with less than 16 samples between them become one."""
    gap = spans[1:, 0] - spans[:-1, 1] >= 16
    starts = spans[np.concatenate(([True], gap)), 0]
    stops = spans[np.concatenate((gap, [True])), 1]
    return np.stack((starts, stops), axis=1).astype(np.int64)


def _keypoints(features: Features) -> tuple[cv2.KeyPoint, ...]:
    return tuple(
        cv2.KeyPoint(float(x), float(y), float(size), float(angle), float(response), 0, int(sign))
        for (x, y), size, angle, response, sign in zip(
            features.xy, features.size, features.angle, features.response, features.laplacian, strict=True
        )
    )
