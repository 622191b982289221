"""Place embeddings by a network in ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.perception.encoders.crops import config_of, crop_named, square
from semdb.perception.model_files import GPU_BATCH, OnnxModel, canonical_json, resolve_onnx
from semdb.settings import Settings
from semdb.types import Float32Array, ImageArray, ModelInfo


class OnnxEncoder:
    """A network ``[B, 3, 224, 224]`` RGB 0..1 to ``embedding`` ``[B, d]``, on a square of the image."""

    def __init__(self, spec: str, settings: Settings) -> None:
        path = resolve_onnx(spec, settings)
        self._model = OnnxModel(path, settings.threads, ("embedding",), settings.device)
        self._crop = crop_named(settings.encoder_crop)
        config = canonical_json(config_of(self._crop))
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
        (embedding,) = self._model.run(np.concatenate([square(image, self._crop) for image in images]))
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
