"""Place embeddings by a network in ONNX Runtime."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import ModelError
from semdb.perception.encoders.crops import config_of, crop_named, squares
from semdb.perception.model_files import GPU_BATCH, OnnxModel, canonical_json, resolve_onnx
from semdb.settings import Settings
from semdb.types import Float32Array, ImageArray, ModelInfo


class OnnxEncoder:
    """A network ``[B, 3, 224, 224]`` RGB 0..1 to ``embedding`` ``[B, d]``, on one square of the image or several."""

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
        shown = np.concatenate([squares(image, self._crop) for image in images])
        at_once = self._model.takes_batches or len(shown) == 1
        embedding = self._embedded(shown) if at_once else np.concatenate([self._embedded(one[None]) for one in shown])
        return pooled(embedding, len(images), self._model.path)

    def _embedded(self, shown: Float32Array) -> npt.NDArray[np.floating[Any]]:
        (embedding,) = self._model.run(shown)
        if embedding.ndim != 2 or embedding.shape[0] != len(shown):
            count, wanted = "one image" if len(shown) == 1 else f"{len(shown)} images", f"[{len(shown)}, d]"
            raise ModelError(f"{self._model.path}: embedding is {embedding.shape} for {count}; wanted is {wanted}")
        found: npt.NDArray[np.floating[Any]] = embedding
        return found


def unit_vector(embedding: npt.NDArray[np.floating[Any]], path: Path) -> Float32Array:
    """`embedding` ``[d]`` at length 1, float32. Raises ModelError naming `path` when it is zero or not finite."""
    vector = embedding.astype(np.float64)
    norm = float(np.linalg.norm(vector))
    if not np.isfinite(norm) or norm == 0:
        raise ModelError(f"{path} gave an embedding that is zero or not finite: the file is damaged")
    unit: Float32Array = (vector / norm).astype(np.float32)
    return unit


def pooled(rows: npt.NDArray[np.floating[Any]], images: int, path: Path) -> Float32Array:
    """The vectors ``[images, d]`` of embeddings ``[images * n, d]`` of n squares of each image: means of unit vectors.

    Raises ModelError naming `path` as `unit_vector` does.
    """
    units = np.stack([unit_vector(row, path) for row in rows])
    if len(units) == images:
        return units
    return np.stack([unit_vector(mean, path) for mean in units.reshape(images, -1, units.shape[1]).mean(axis=1)])
