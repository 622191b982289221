"""Place embeddings by a network in ONNX Runtime."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.perception.model_files import OnnxModel, canonical_json, file_sha256, resolve_onnx
from semdb.settings import Settings
from semdb.types import Float32Array, ImageArray, ModelInfo

SHORT_SIDE = 256
CROP = 224


class OnnxEncoder:
    """A network ``[B, 3, 224, 224]`` RGB 0..1 to ``embedding`` ``[B, d]``, on the centre of the image."""

    def __init__(self, spec: str, settings: Settings) -> None:
        path = resolve_onnx(spec, settings)
        self._model = OnnxModel(path, settings.threads, ("embedding",), settings.device)
        config = canonical_json({"crop": CROP, "short_side": SHORT_SIDE})
        self.info = ModelInfo("encoder", f"onnx:{path.name}", file_sha256(path), config)

    def encode(self, image: ImageArray) -> Float32Array:
        """The L2-normalised embedding float32 ``[d]`` of an RGB `image` ``[H, W, 3]``.

        Raises ModelError when the network fails or its embedding is not ``[1, d]``, not finite or zero.
        """
        (embedding,) = self._model.run(centre_batch(image))
        if embedding.ndim != 2 or embedding.shape[0] != 1:
            raise ModelError(f"{self._model.path}: embedding is {embedding.shape} for one image; wanted is [1, d]")
        return unit_vector(embedding[0], self._model.path)


def unit_vector(embedding: npt.NDArray[np.floating[Any]], path: Path) -> Float32Array:
    """`embedding` ``[d]`` at length 1, float32. Raises ModelError naming `path` when it is zero or not finite."""
    vector = embedding.astype(np.float64)
    norm = float(np.linalg.norm(vector))
    if not np.isfinite(norm) or norm == 0:
        raise ModelError(f"{path} gave an embedding that is zero or not finite: the file is damaged")
    unit: Float32Array = (vector / norm).astype(np.float32)
    return unit


def centre_batch(image: ImageArray) -> Float32Array:
    """The centre of an RGB `image` as float32 ``[1, 3, 224, 224]``, its short side first resized to 256 pixels."""
    ratio = SHORT_SIDE / min(image.shape[:2])
    width, height = (max(SHORT_SIDE, round(n * ratio)) for n in (image.shape[1], image.shape[0]))
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    y, x = height // 2 - CROP // 2, width // 2 - CROP // 2
    crop = resized[y : y + CROP, x : x + CROP].transpose(2, 0, 1)[None]
    return np.ascontiguousarray(crop, dtype=np.float32) / np.float32(255)
