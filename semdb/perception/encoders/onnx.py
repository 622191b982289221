"""Place embeddings by a network in ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.perception.model_files import GPU_BATCH, OnnxModel, canonical_json, resolve_onnx
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
        self.best_batch = GPU_BATCH if self._model.on_gpu and self._model.takes_batches else 1
        self.info = ModelInfo("encoder", f"onnx:{path.name}", self._model.sha256, config)

    def encode(self, image: ImageArray) -> Float32Array:
        """The L2-normalised embedding float32 ``[d]`` of an RGB `image` ``[H, W, 3]``.

        Raises ModelError when the network fails or its embedding is not ``[1, d]``, not finite or zero.
        """
        vector: Float32Array = self._run([image])[0]
        return vector

    def encode_batch(self, images: Sequence[ImageArray]) -> Float32Array:
        """The vectors of `images` (of any sizes) float32 ``[n, d]``, each as `encode` gives it, within rounding.

        Raises ModelError. A network that is made for one image at a time gets one at a time.
        """
        if self._model.takes_batches:
            return self._run(images)
        return np.concatenate([self._run([image]) for image in images])

    def _run(self, images: Sequence[ImageArray]) -> Float32Array:
        (embedding,) = self._model.run(np.concatenate([centre_batch(image) for image in images]))
        if embedding.ndim != 2 or embedding.shape[0] != len(images):
            count, wanted = "one image" if len(images) == 1 else f"{len(images)} images", f"[{len(images)}, d]"
            raise ModelError(f"{self._model.path}: embedding is {embedding.shape} for {count}; wanted is {wanted}")
        return np.stack([unit_vector(row, self._model.path) for row in embedding])


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
