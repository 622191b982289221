"""A learned matcher of learned features, by a network in ONNX Runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError, UsageError
from semdb.perception.model_files import first_line, onnx_providers, onnx_sha256, resolve_onnx
from semdb.settings import Settings
from semdb.types import Float32Array, IntArray

_OPENED: dict[tuple[str, str, str], OnnxMatcher] = {}  # by file, hash and device: a process needs one of each

_INPUTS = ("keypoints0", "descriptors0", "size0", "keypoints1", "descriptors1", "size1")
_OUTPUTS = ("matches0", "scores0")
LEAST_KEYPOINTS = 2  # of an image; a network may not take fewer


def load_matcher(spec: str, settings: Settings) -> OnnxMatcher:
    """The matcher of a `spec`, opened once in a process.

    Raises UsageError for a spec that is none, ModelError where the file is missing or is no matcher.
    """
    if not spec.startswith("onnx:"):
        raise UsageError(f"no matcher {spec!r}: SEMDB_MATCHER is onnx:FILE, or not set")
    path = resolve_onnx(spec, settings)
    key = str(path.resolve()), onnx_sha256(path), settings.device
    if key not in _OPENED:
        _OPENED[key] = OnnxMatcher(path, settings.device)
    return _OPENED[key]


class OnnxMatcher:
    """A network that pairs the keypoints of two images, seeing all of both, as LightGlue does.

    Its inputs are ``keypoints0`` ``[M, 2]`` (pixels as seen), ``descriptors0`` ``[M, d]`` (unit length), ``size0``
    ``[2]`` (width, height), and the same with 1, all float32; its outputs ``matches0`` int64 ``[M]``, the keypoint of
    image 1 or -1, and ``scores0`` float32 ``[M]``, 0 to 1.
    """

    def __init__(self, path: Path, device: str = "cpu") -> None:
        """Raises ModelError where the file is no matcher."""
        import onnxruntime as ort

        self.path = path
        self.name = f"onnx:{path.name}"
        options = ort.SessionOptions()
        options.intra_op_num_threads = 1  # keyframes are matched side by side
        options.inter_op_num_threads = 1
        options.log_severity_level = 3
        providers = onnx_providers(device, ort.get_available_providers())
        try:
            self._session = ort.InferenceSession(str(self.path), options, providers=providers)
        except Exception as error:  # ONNX Runtime's exceptions share no base class
            raise ModelError(f"{self.path} cannot be opened as an ONNX model ({first_line(error)})") from error
        inputs, outputs = self._session.get_inputs(), [output.name for output in self._session.get_outputs()]
        wrong = {i.name for i in inputs} != set(_INPUTS) or not set(_OUTPUTS) <= set(outputs)
        if wrong or any(i.type != "tensor(float)" for i in inputs):
            found = ", ".join(f"{i.name}: {i.type}" for i in inputs)
            raise ModelError(
                f"{self.path} is no matcher: wanted are float inputs {', '.join(_INPUTS)} and outputs "
                f"{', '.join(_OUTPUTS)}, but it has {found} and {', '.join(outputs)}"
            )
        shape = next(i.shape for i in inputs if i.name == "descriptors0")
        self.width = (
            shape[-1] if shape and isinstance(shape[-1], int) else None
        )  # of descriptors, where the file says it

    def match(
        self,
        first_xy: Float32Array,
        first: npt.NDArray[np.generic],
        first_size: tuple[int, int],
        second_xy: Float32Array,
        second: npt.NDArray[np.generic],
        second_size: tuple[int, int],
    ) -> tuple[IntArray, IntArray]:
        """Indexes ``[k]`` in each image of the keypoints that are one; pixels ``[n, 2]``, descriptors ``[n, d]``.

        Raises UsageError where the network is made for other features, ModelError when it fails or gives nonsense.
        """
        self.check(first)
        if min(len(first), len(second)) < LEAST_KEYPOINTS:
            return np.zeros(0, np.int32), np.zeros(0, np.int32)
        given = (first_xy, first, first_size, second_xy, second, second_size)
        feed = {name: np.ascontiguousarray(value, np.float32) for name, value in zip(_INPUTS, given, strict=True)}
        try:
            (found,) = self._session.run([_OUTPUTS[0]], feed)
        except Exception as error:
            raise ModelError(
                f"{self.path} failed on {len(first)} and {len(second)} keypoints: {first_line(error)}"
            ) from error
        return self._pairs(found, len(first), len(second))

    def check(self, descriptors: npt.NDArray[np.generic]) -> None:
        """Raises UsageError where `descriptors` ``[n, d]`` are not what the network takes."""
        width = descriptors.shape[1]
        if descriptors.dtype == np.uint8 or (self.width is not None and width != self.width):
            theirs = f"{self.width} numbers" if self.width else "numbers"
            raise UsageError(
                f"SEMDB_MATCHER={self.name} compares descriptors of {theirs}, this map has {descriptors.dtype} of "
                f"{width}: name the matcher of the map's feature, or none"
            )

    def _pairs(self, found: Any, count: int, other: int) -> tuple[IntArray, IntArray]:
        if found.shape != (count,) or found.dtype.kind != "i" or found.max(initial=-1) >= other:
            most = found.max(initial=-1) if found.dtype.kind == "i" else found.dtype
            raise ModelError(
                f"{self.path} gave matches {found.shape} up to {most} for {count} and {other} keypoints; wanted is an "
                f"integer for each keypoint of the first image, -1 or one of the second: is it a matcher?"
            )
        one = np.flatnonzero(found >= 0)
        two = found[one]
        _, kept = np.unique(two, return_index=True)  # a keypoint is in one pair
        kept.sort()
        return one[kept].astype(np.int32), two[kept].astype(np.int32)
