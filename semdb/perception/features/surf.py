"""SURF (Speeded-Up Robust Features) on numpy arrays, compiled with numba, made to be usable on its own.

    from semdb.perception.features.surf import SURF

    keypoints, descriptors = SURF(hessian_threshold=100).detectAndCompute(grey, None)

Source: Bay, Ess, Tuytelaars, Van Gool, Speeded-Up Robust Features (CVIU 2008). Parameters, their defaults and the
results are those of OpenCV's implementation (`docs/surf.md` compares them); the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import UsageError
from semdb.perception.features._surf_levels import PART_COLUMNS, PART_ROWS, Level, level_keys, level_of, level_parts
from semdb.threads import each
from semdb.types import BoolArray, Features, Float32Array, ImageArray, IntArray

UPRIGHT_ANGLE = 270.0  # what OpenCV gives upright keypoints
MASK_TILE = 16  # sample rows that share their columns to look at, when there is a mask
MASK_REACH = 3  # samples around the mask that are looked at
SCRATCH_BYTES = 16 << 20  # larger arrays, of images above four megapixels, are not kept
MIN_CHUNK = 64  # keypoints that are worth a task of their own
_NO_SUMS = np.zeros((1, 1), np.int32)


class SURF:
    """Detector and descriptor with the calls of a `cv2.Feature2D`. Immutable; safe to call from several threads.

    `hessian_threshold`: least determinant of the Hessian of a keypoint. `n_octaves`, `n_octave_layers`: how many
    doublings of the scale, how many scales in each. `extended`: 128 instead of 64 numbers per descriptor. `upright`:
    do not measure the orientation (all angles are 270, as OpenCV has them).

    Not OpenCV's: `window_sigma`: width of the Gaussian that weighs the descriptor window, in cells, of which there are
    20 across it. `smoothing`: variance of the grey means that gradients are taken from, relative to that of a
    square cell. `max_keypoints`: keep the strongest by response, 0 for all. `threads`: how many threads one call uses;
    they do not change a bit of the result.

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
        window_sigma: float = 3.3,
        smoothing: float = 1.0,
        max_keypoints: int = 0,
        threads: int = 1,
    ) -> None:
        if not hessian_threshold >= 0 or not np.isfinite(hessian_threshold):
            raise UsageError(f"SURF: hessian_threshold is {hessian_threshold}, it must be 0 or more")
        if not 1 <= n_octaves <= 8 or not 1 <= n_octave_layers <= 16:
            raise UsageError(
                f"SURF: n_octaves is {n_octaves} and n_octave_layers {n_octave_layers}, they must be 1 to 8 and 1 to 16"
            )
        if not 1 <= window_sigma <= 100 or not 0.25 <= smoothing <= 8:
            raise UsageError(
                f"SURF: window_sigma is {window_sigma} and smoothing {smoothing}, they must be 1 to 100 and 0.25 to 8"
            )
        if max_keypoints < 0 or threads < 1:
            raise UsageError(f"SURF: max_keypoints is {max_keypoints} (0 or more), threads is {threads} (1 or more)")
        self.hessian_threshold = float(hessian_threshold)
        self.n_octaves = int(n_octaves)
        self.n_octave_layers = int(n_octave_layers)
        self.extended = bool(extended)
        self.upright = bool(upright)
        self.window_sigma = float(window_sigma)
        self.smoothing = float(smoothing)
        self.max_keypoints = int(max_keypoints)
        self.threads = int(threads)
        self._scratch = _Scratch()
        self._largest = (9 + 6 * (self.n_octave_layers + 1)) << (self.n_octaves - 1)

    def extract(self, image: ImageArray, mask: npt.NDArray[Any] | None = None) -> Features:
        """Keypoints and descriptors of a grey uint8 `image` [H, W], strongest first.

        With a `mask` [H, W], those whose centre lies on a pixel that is not zero: exactly the ones that the whole image
        has there, but only there is looked for them. Raises UsageError when image or mask are not of this kind.
        """
        return self._describe(*self._detect(image, mask), described=True)[0]

    def detectAndCompute(  # noqa: N802
        self, image: ImageArray, mask: npt.NDArray[Any] | None = None
    ) -> tuple[tuple[cv2.KeyPoint, ...], Float32Array]:
        """Like `extract`: OpenCV keypoints (`class_id` holds the sign of the Laplacian) and float32 [n, 64 or 128]."""
        features, octaves = self._describe(*self._detect(image, mask), described=True)
        return _keypoints(features, octaves), features.descriptors.astype(np.float32, copy=False)

    def detect(self, image: ImageArray, mask: npt.NDArray[Any] | None = None) -> tuple[cv2.KeyPoint, ...]:
        """The keypoints of `detectAndCompute`, without descriptors."""
        return _keypoints(*self._describe(*self._detect(image, mask), described=False))

    def compute(
        self, image: ImageArray, keypoints: Sequence[cv2.KeyPoint]
    ) -> tuple[tuple[cv2.KeyPoint, ...], Float32Array]:
        """Descriptors of given keypoints in their order, with their angles measured anew.

        Keypoints whose orientation cannot be measured, too near to the border, are left out.
        """
        rows = [(*k.pt, k.size, k.response, max(k.octave, 0), k.class_id) for k in keypoints]
        candidates = np.array(rows, dtype=np.float32).reshape(-1, 6)
        largest = max(self._largest, math.ceil(candidates[:, 2].max(initial=0)))
        order = np.arange(len(candidates))
        features, octaves = self._describe(self._integral(_checked(image), largest), candidates, order, described=True)
        return _keypoints(features, octaves), features.descriptors.astype(np.float32, copy=False)

    def descriptorSize(self) -> int:  # noqa: N802
        return 128 if self.extended else 64

    def descriptorType(self) -> int:  # noqa: N802
        return int(cv2.CV_32F)

    def defaultNorm(self) -> int:  # noqa: N802
        return int(cv2.NORM_L2)

    def empty(self) -> bool:
        return False

    def _level(self, key: int) -> Level:
        return level_of(key, self.smoothing)

    def _integral(self, image: ImageArray, largest: int) -> _Plane:
        from semdb.perception.features._surf_detect import integral

        step = 1 << (self.n_octaves - 1)
        pad = -(-self._level(int(level_keys(np.array([largest], np.float32))[0])).pad // step) * step
        height, width = image.shape
        padded = self._scratch.array("padded", (height + 2 * pad, width + 2 * pad), np.uint8)
        cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_REPLICATE, dst=padded)
        sums = self._scratch.array("sums", (height + 2 * pad + 1, width + 2 * pad + 1), np.int32)
        integral(padded, sums)
        return _Plane(sums, pad, height, width)

    def _detect(
        self, image: ImageArray, mask: npt.NDArray[Any] | None
    ) -> tuple[_Plane, Float32Array, npt.NDArray[np.intp]]:
        """Candidates [n, 6] in order of octave, row, layer, column, and the order in which they are strongest first."""
        from semdb.perception.features._surf_detect import COLUMNS

        image = _checked(image)
        height, width = image.shape
        region = None if mask is None else _checked_mask(mask, image.shape)
        if min(height, width) < 9 or (region is not None and not region.any()):
            return _Plane(_NO_SUMS, 0, height, width), np.zeros((0, COLUMNS), np.float32), np.zeros(0, np.intp)
        plane = self._integral(image, self._largest)
        tasks: list[Callable[[], Float32Array]] = []
        for octave in range(self.n_octaves):
            if min(height, width) >= (9 + 6 * 2) << octave:
                tasks += self._octave_tasks(plane, octave, region)
        found = self._run(tasks)
        candidates = np.concatenate(found) if found else np.zeros((0, COLUMNS), np.float32)
        if region is not None:
            x = np.clip(np.floor(candidates[:, 0] + 0.5).astype(np.intp), 0, width - 1)
            y = np.clip(np.floor(candidates[:, 1] + 0.5).astype(np.intp), 0, height - 1)
            candidates = candidates[region[y, x]]
        order = np.argsort(-candidates[:, 3], kind="stable")
        if 0 < self.max_keypoints < len(candidates):
            chosen = np.sort(order[: self.max_keypoints])
            candidates = candidates[chosen]
            order = np.argsort(-candidates[:, 3], kind="stable")
        return plane, candidates, order

    def _octave_tasks(self, plane: _Plane, octave: int, region: BoolArray | None) -> list[Callable[[], Float32Array]]:
        from semdb.perception.features._surf_detect import COLUMNS, deinterleave, find_maxima, offsets_read

        step = 1 << octave
        rows, columns = plane.height // step, plane.width // step
        phases = plane.sums[:, None, :]
        if step > 1:
            across = (plane.pad + plane.width) // step + 1
            phases = self._scratch.array(f"octave {octave}", (plane.sums.shape[0], step, across), np.int32)
            read = offsets_read(octave, self.n_octave_layers)
            deinterleave(plane.sums, plane.pad, plane.pad + plane.height + 1, read, phases)

        def search(first: int, last: int, spans: npt.NDArray[np.int64]) -> Float32Array:
            capacity = 64 + (last - first) * columns // 64
            while True:
                out = np.empty((capacity, COLUMNS), np.float32)
                count = find_maxima(
                    phases, plane.pad, plane.height, plane.width, octave, self.n_octave_layers,
                    np.float32(self.hessian_threshold), first, last, spans, out,
                )  # fmt: skip
                if count <= capacity:
                    return out[:count]
                capacity = count

        if region is not None:
            return [partial(search, *band) for band in _mask_bands(region, step, rows, columns)]
        everywhere = np.array([[0, columns]], np.int64)
        return [partial(search, a, b, everywhere) for a, b in _shares(rows, self.threads)]

    def _describe(
        self, plane: _Plane, candidates: Float32Array, order: npt.NDArray[np.intp], *, described: bool
    ) -> tuple[Features, IntArray]:
        """Features and octaves of the candidates in the order given, without those that have no orientation."""
        n = len(candidates)
        angles = np.full(n, UPRIGHT_ANGLE, np.float32)
        descriptors = np.empty((n if described else 0, self.descriptorSize()), np.float32)
        if n and not self.upright:
            self._orient(plane, candidates, angles)
        if n and described:
            self._run(self._descriptor_tasks(plane, candidates, angles, descriptors))
        order = order[angles[order] >= 0]
        candidates = candidates[order]
        features = Features(
            xy=candidates[:, :2].copy(),
            size=candidates[:, 2].copy(),
            angle=angles[order],
            response=candidates[:, 3].copy(),
            laplacian=candidates[:, 5].astype(np.int8),
            descriptors=descriptors[order] if described else descriptors,
        )
        return features, candidates[:, 4].astype(np.int32)

    def _orient(self, plane: _Plane, candidates: Float32Array, angles: Float32Array) -> None:
        from semdb.perception.features._surf_describe import orient, orientation_weights

        flat, pitch = plane.sums.reshape(-1), plane.sums.shape[1]
        weights = orientation_weights()

        def run(start: int, stop: int) -> None:
            orient(flat, pitch, plane.pad, plane.height, plane.width, candidates, weights, start, stop, angles)

        shares = _shares(len(candidates), min(self.threads, len(candidates) // MIN_CHUNK))
        self._run([partial(run, a, b) for a, b in shares])

    def _descriptor_tasks(
        self, plane: _Plane, candidates: Float32Array, angles: Float32Array, descriptors: Float32Array
    ) -> list[Callable[[], None]]:
        """Tasks that, level of smoothing by level, make its image and describe the keypoints of its sizes from it.

        One thread has one task, since a call costs as much as a small level.
        """
        from semdb.perception.features._surf_describe import describe_levels, descriptor_weights

        flat, pitch = plane.sums.reshape(-1), plane.sums.shape[1]
        weights = descriptor_weights(self.window_sigma)
        oriented = np.flatnonzero(angles >= 0)
        if not len(oriented):
            return []
        keys = level_keys(candidates[oriented, 2])
        order = np.argsort(keys, kind="stable")
        starts = np.flatnonzero(np.diff(keys[order], prepend=-2))
        bounds, keys = np.append(starts, len(order)), keys[order[starts]]
        order = oriented[order]
        extents = candidates[order, :3]  # x, y, size
        low, high = np.minimum.reduceat(extents, starts), np.maximum.reduceat(extents, starts)
        parts, edges = level_parts(keys, low, high, (plane.height, plane.width), self.smoothing)
        samples = parts[:, PART_ROWS] * parts[:, PART_COLUMNS]

        def run(first: int, last: int) -> None:
            grey = self._scratch.array("grey", (int(samples[first:last].max()),), np.float32)
            describe_levels(
                flat, pitch, plane.pad, parts[first:last], edges[first:last], bounds[first : last + 1], order, grey,
                candidates, angles, self.extended, weights, descriptors,
            )  # fmt: skip

        return [partial(run, a, b) for a, b in _shares(len(keys), 1 if self.threads == 1 else len(keys))]

    def _run(self, tasks: Sequence[Callable[[], Any]]) -> list[Any]:
        return each(lambda task: task(), tasks, self.threads)


@dataclass(frozen=True, slots=True, eq=False)
class _Plane:
    """Integral image of an image of `height` x `width` with `pad` pixels of its border repeated around it."""

    sums: npt.NDArray[np.int32]
    pad: int
    height: int
    width: int


class _Scratch(threading.local):
    """Arrays that a thread uses again at its next call: fresh memory costs more than what is computed in it."""

    def __init__(self) -> None:
        self._arrays: dict[str, npt.NDArray[Any]] = {}

    def array(self, name: str, shape: tuple[int, ...], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
        size = math.prod(shape)
        if size * np.dtype(dtype).itemsize > SCRATCH_BYTES:
            return np.empty(shape, dtype)
        held = self._arrays.get(name)
        if held is None or held.size < size:
            held = self._arrays[name] = np.empty(size, dtype)
        return held[:size].reshape(shape)


def _shares(n: int, parts: int) -> list[tuple[int, int]]:
    """0 to n in `parts` ranges of about the same length, at least one, none empty."""
    parts = max(parts, 1)
    bounds = [n * part // parts for part in range(parts + 1)]
    return [(a, b) for a, b in pairwise(bounds) if a < b]


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

    A sample lies in its block of pixels or in the next, and a keypoint within one sample and a half of its sample.
    """
    grid = region[: rows * step, : columns * step].astype(np.uint8) * np.uint8(255)
    while grid.shape[0] > rows:  # a mean over 2x2 pixels is above 0 where one of them is
        halved = cv2.resize(grid, (grid.shape[1] // 2, grid.shape[0] // 2), interpolation=cv2.INTER_AREA)
        grid = (halved > 0).astype(np.uint8) * np.uint8(255)
    wide = cv2.dilate(grid, np.ones((2 * MASK_REACH + 1, 2 * MASK_REACH + 1), np.uint8))
    starts = range(0, rows, MASK_TILE)
    wide = cv2.copyMakeBorder(wide, 0, len(starts) * MASK_TILE - rows, 0, 0, cv2.BORDER_CONSTANT, value=0)
    used = np.zeros((len(starts), columns + 2), np.int8)
    used[:, 1:-1] = wide.reshape(len(starts), MASK_TILE, columns).max(axis=1) > 0
    band, edge = np.nonzero(np.diff(used, axis=1))
    return [
        (starts[k], min(starts[k] + MASK_TILE, rows), _merged(edge[band == k].reshape(-1, 2)))
        for k in np.unique(band).tolist()
    ]


def _merged(spans: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Spans with less than 16 samples between them become one."""
    gap = spans[1:, 0] - spans[:-1, 1] >= 16
    starts = spans[np.concatenate(([True], gap)), 0]
    stops = spans[np.concatenate((gap, [True])), 1]
    return np.stack((starts, stops), axis=1).astype(np.int64)


def _keypoints(features: Features, octaves: IntArray) -> tuple[cv2.KeyPoint, ...]:
    columns = (features.xy[:, 0], features.xy[:, 1], features.size, features.angle, features.response)
    rows = zip(*(column.tolist() for column in (*columns, octaves, features.laplacian)), strict=True)
    return tuple(cv2.KeyPoint(*row) for row in rows)
