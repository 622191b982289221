"""Learned local features by a network in ONNX Runtime."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.perception.features.opencv import check_image
from semdb.perception.model_files import OnnxModel, canonical_json, resolve_onnx
from semdb.settings import Settings
from semdb.types import BoolArray, Features, ImageArray, ModelInfo

SIZE_PX = 16.0  # networks give none; a patch of so many pixels is cut about a keypoint to align it
_OUTPUTS = ("keypoints", "scores", "descriptors")


class OnnxFeatures:
    """A network ``[1, 3, H, W]`` (the grey image three times, 0..1) to keypoints with float32 descriptors of any width.

    Its outputs are ``keypoints`` ``[N, 2]`` (x, y in pixels of the input, the centre of the top-left one (0, 0)),
    ``scores`` ``[N]`` and ``descriptors`` ``[N, d]``. Descriptors are compared by their cosine.
    """

    def __init__(self, spec: str, settings: Settings) -> None:
        path = resolve_onnx(spec, settings)
        self._model = OnnxModel(path, settings.threads, _OUTPUTS, settings.device)
        self._max_keypoints = settings.max_keypoints
        self._width = self._model.last_size("descriptors")
        config = canonical_json({"max_keypoints": settings.max_keypoints, "size_px": SIZE_PX})
        self.info = ModelInfo("features", f"onnx:{path.name}", self._model.sha256, config)

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        """The keypoints of a uint8 `grey` ``[H, W]`` with the best scores, on `mask` ``[H, W]`` where there is one.

        Raises ModelError when image or mask are not of this kind, and when the network fails or gives what is none.
        """
        check_image(self.info.name, grey, mask)
        if grey.size == 0:
            return _pack(np.zeros((0, 2)), np.zeros(0), np.zeros((0, self._width or 1)))
        plane = np.asarray(grey, np.float32) / np.float32(255)
        xy, scores, descriptors = self._model.run(np.ascontiguousarray(np.broadcast_to(plane, (1, 3, *grey.shape))))
        self._check(xy, scores, descriptors)
        height, width = grey.shape
        xy = np.clip(xy, 0, (width - 1, height - 1))
        norms = np.linalg.norm(descriptors.astype(np.float64), axis=1)
        keep = norms > 0
        if mask is not None:
            columns, rows = np.rint(xy).astype(np.intp).T
            keep &= mask[rows, columns]
        kept = np.flatnonzero(keep)
        order = kept[np.lexsort((xy[kept, 0], xy[kept, 1], -scores[kept]))][: self._max_keypoints]
        return _pack(xy[order], scores[order], descriptors[order] / norms[order, None])

    def _check(self, xy: npt.NDArray[Any], scores: npt.NDArray[Any], descriptors: npt.NDArray[Any]) -> None:
        """Raises ModelError unless the outputs are what they should be."""
        count = len(xy) if xy.ndim else 0
        if xy.shape != (count, 2) or scores.shape != (count,) or descriptors.shape[:1] != (count,):
            shapes = f"keypoints {xy.shape}, scores {scores.shape}, descriptors {descriptors.shape}"
            raise ModelError(f"{self._model.path} gave {shapes}; wanted are [N, 2], [N] and [N, d]")
        if descriptors.ndim != 2 or descriptors.shape[1] == 0:
            raise ModelError(f"{self._model.path} gave descriptors {descriptors.shape}; wanted are [N, d]")
        if not all(np.isfinite(values).all() for values in (xy, scores, descriptors)):
            raise ModelError(f"{self._model.path} gave keypoints that are not finite: the file is damaged")


def _pack(xy: npt.NDArray[Any], scores: npt.NDArray[Any], descriptors: npt.NDArray[Any]) -> Features:
    count = len(xy)
    return Features(
        xy=np.ascontiguousarray(xy, np.float32),
        size=np.full(count, SIZE_PX, np.float32),
        angle=np.zeros(count, np.float32),
        response=np.ascontiguousarray(scores, np.float32),
        laplacian=np.zeros(count, np.int8),
        descriptors=np.ascontiguousarray(descriptors, np.float32),
    )
