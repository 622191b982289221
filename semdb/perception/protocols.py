"""What a detector, an encoder and a local feature must be to take part in a description.

An implementation is one file in `detectors`, `encoders` or `features` that satisfies a protocol here and is found
by its spec string. Objects must be safe to call from several threads, one call at a time per object.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

from semdb.types import BoolArray, Detection, Features, Float32Array, ImageArray, InstanceMasks, ModelInfo


class Detector(Protocol):
    """Finds objects in an image."""

    @property
    def info(self) -> ModelInfo: ...

    @property
    def classes(self) -> tuple[str, ...] | None:
        """The names of its classes, or None where every recording brings its own, and exact masks."""
        ...

    def detect(self, image: ImageArray, instances: InstanceMasks | None) -> tuple[Detection, ...]:
        """Objects of an RGB `image` ``[H, W, 3]``, by descending score; masks are ``[H, W]`` and never empty.

        After them may come `weak` ones, without masks: down to which score is part of `info`. `instances` are the
        masks that came with the image, for the detector that takes them; others ignore them.
        Raises ModelError when the model fails on the image.
        """
        ...


@runtime_checkable
class BatchDetector(Detector, Protocol):
    """A detector that takes several images at once."""

    @property
    def best_batch(self) -> int:
        """With how many images at once it is fastest where it runs."""
        ...

    def detect_batch(self, images: Sequence[ImageArray]) -> list[tuple[Detection, ...]]:
        """What `detect` finds in each of `images`, within rounding. Raises ModelError."""
        ...


class Encoder(Protocol):
    """Turns an image into one vector; the cosine of two vectors says how alike two places look."""

    @property
    def info(self) -> ModelInfo: ...

    def encode(self, image: ImageArray) -> Float32Array:
        """L2-normalised vector ``[d]`` of an RGB `image` ``[H, W, 3]``; `d` is fixed for an encoder.

        Raises ModelError when the model fails on the image.
        """
        ...


@runtime_checkable
class BatchEncoder(Encoder, Protocol):
    """An encoder that takes several images at once."""

    @property
    def best_batch(self) -> int:
        """With how many images at once it is fastest where it runs."""
        ...

    def encode_batch(self, images: Sequence[ImageArray]) -> Float32Array:
        """The vectors ``[n, d]`` of `images`, each as `encode` gives it, within rounding. Raises ModelError."""
        ...


class FeatureExtractor(Protocol):
    """Finds and describes local features."""

    @property
    def info(self) -> ModelInfo: ...

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        """Local features of a `grey` image ``[H, W]``, only where `mask` ``[H, W]`` is true when there is one."""
        ...
