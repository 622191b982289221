"""What the features share that OpenCV computes: calling them, cutting by response, packing into arrays."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.types import BoolArray, Features, FloatArray, ImageArray, IntArray, ModelInfo


def feature_info(name: str, **parameters: Any) -> ModelInfo:
    """Provenance of a local feature: all parameters that change what it finds."""
    config = json.dumps(parameters, sort_keys=True, separators=(",", ":"))
    return ModelInfo(role="features", name=name, sha256="", config=config)


def check_image(name: str, grey: ImageArray, mask: BoolArray | None) -> None:
    """Raises ModelError unless `grey` is uint8 [H, W] and `mask`, where given, of the same shape."""
    if grey.ndim != 2 or grey.dtype != np.uint8:
        raise ModelError(f"{name} takes a grey image, uint8 [H, W], not {grey.dtype} {grey.shape}")
    if mask is not None and mask.shape != grey.shape:
        raise ModelError(f"{name}: the mask is {mask.shape}, the image {grey.shape}; they must have the same shape")


def extract_opencv(
    feature: Any,
    grey: ImageArray,
    mask: BoolArray | None,
    max_keypoints: int,
    empty: npt.NDArray[Any],
    position: Callable[[FloatArray, IntArray], FloatArray] | None = None,
) -> Features:
    """Run a `cv2.Feature2D` and keep the `max_keypoints` strongest, equal ones by place (y, then x, size, angle).

    `empty` [0, d] has the dtype and width of the descriptors; `position` (xy [n, 2], octave [n]) -> xy corrects places.
    """
    flags = None if mask is None else np.ascontiguousarray(mask).view(np.uint8)
    keypoints: Sequence[Any] = ()
    descriptors = None
    if grey.size and (mask is None or mask.any()):
        keypoints, descriptors = feature.detectAndCompute(np.ascontiguousarray(grey), flags)
    rows = np.array([(*k.pt, k.size, k.angle, k.response, k.octave) for k in keypoints], np.float64).reshape(-1, 6)
    x, y, size, angle, response, octave = rows.T
    order = np.lexsort((angle, size, x, y, -response))[:max_keypoints]
    xy = rows[:, :2] if position is None else position(rows[:, :2], octave.astype(np.int32))
    return Features(
        xy=xy[order].astype(np.float32),
        size=size[order].astype(np.float32),
        angle=angle[order].astype(np.float32),
        response=response[order].astype(np.float32),
        laplacian=np.zeros(len(order), np.int8),
        descriptors=empty if descriptors is None else descriptors[order],
    )
