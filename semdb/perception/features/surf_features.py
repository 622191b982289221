"""SURF as the local feature of descriptions: `semdb.perception.features.surf` with provenance."""

from __future__ import annotations

import numpy as np

from semdb.perception.features.opencv import check_image, feature_info
from semdb.perception.features.surf import SURF
from semdb.types import BoolArray, Features, ImageArray, ModelInfo

# OpenCV weighs the window of a descriptor with 3.3 cells, which leaves little of its rim, and takes gradients from
# means of one cell. These gave a quarter more inliers between frames far apart (`docs/surf.md`).
WINDOW_SIGMA = 6.5
SMOOTHING = 2.0


class SurfFeatures:
    """64-d SURF, float32 of unit length. `threads` work on one image; they do not change the result."""

    def __init__(self, hessian_threshold: float = 100.0, max_keypoints: int = 1500, threads: int = 1) -> None:
        self._surf = SURF(
            hessian_threshold,
            window_sigma=WINDOW_SIGMA,
            smoothing=SMOOTHING,
            max_keypoints=max_keypoints,
            threads=threads,
        )
        self._info = feature_info(
            "surf",
            extended=False,
            hessian_threshold=self._surf.hessian_threshold,
            max_keypoints=max_keypoints,
            n_octave_layers=self._surf.n_octave_layers,
            n_octaves=self._surf.n_octaves,
            smoothing=SMOOTHING,
            upright=False,
            window_sigma=WINDOW_SIGMA,
        )

    @property
    def info(self) -> ModelInfo:
        return self._info

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        """The strongest keypoints of a uint8 `grey` [H, W], those on `mask` [H, W] where there is one.

        Raises ModelError when image or mask are not of this kind.
        """
        check_image("surf", grey, mask)
        return self._surf.extract(grey, mask) if grey.size else self._surf.extract(np.zeros((1, 1), np.uint8))
