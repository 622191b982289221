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
FEW = 600  # keypoints of an image, below which weak ones count too,
WEAK_THRESHOLD = 15.0  # from this determinant of the Hessian on


class SurfFeatures:
    """64-d SURF, float32 of unit length. `threads` work on one image; they do not change the result.

    With `weak` an image of few keypoints gives weak ones too; others give the same, to the bit.
    """

    def __init__(
        self, hessian_threshold: float = 100.0, max_keypoints: int = 1500, threads: int = 1, weak: bool = False
    ) -> None:
        self._surf, self._weak = (
            SURF(
                threshold,
                window_sigma=WINDOW_SIGMA,
                smoothing=SMOOTHING,
                max_keypoints=max_keypoints,
                threads=threads,
            )
            for threshold in (hessian_threshold, min(hessian_threshold, WEAK_THRESHOLD))
        )
        self._few = FEW if weak else 0
        adaptive = {"few": FEW, "weak_threshold": self._weak.hessian_threshold} if weak else {}
        self._info = feature_info(
            "surf:weak" if weak else "surf",
            extended=False,
            hessian_threshold=self._surf.hessian_threshold,
            max_keypoints=max_keypoints,
            n_octave_layers=self._surf.n_octave_layers,
            n_octaves=self._surf.n_octaves,
            smoothing=SMOOTHING,
            upright=False,
            window_sigma=WINDOW_SIGMA,
            **adaptive,
        )

    @property
    def info(self) -> ModelInfo:
        return self._info

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        """The strongest keypoints of a uint8 `grey` [H, W], those on `mask` [H, W] where there is one.

        Raises ModelError when image or mask are not of this kind.
        """
        check_image("surf", grey, mask)
        if not grey.size:
            return self._surf.extract(np.zeros((1, 1), np.uint8))
        found = self._surf.extract(grey, mask)
        return found if len(found) >= self._few else self._weak.extract(grey, mask)
