"""OpenCV's ORB."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.perception.features.opencv import check_image, extract_opencv, feature_info
from semdb.types import BoolArray, Features, FloatArray, ImageArray, IntArray, ModelInfo

SCALE_FACTOR = 1.2
BORDER = 31  # pixels along the sides where OpenCV's ORB finds nothing


class OrbFeatures:
    """256-bit ORB, uint8 [n, 32]. Source: Rublee et al., ORB: an efficient alternative to SIFT or SURF (ICCV 2011)."""

    def __init__(self, max_keypoints: int = 1500) -> None:
        self._max_keypoints = max_keypoints
        self._orb = cv2.ORB.create(nfeatures=max_keypoints, scaleFactor=SCALE_FACTOR)
        self._info = feature_info("orb", max_keypoints=max_keypoints, scale_factor=SCALE_FACTOR)

    @property
    def info(self) -> ModelInfo:
        return self._info

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        """The strongest keypoints of a uint8 `grey` [H, W], those on `mask` [H, W] where there is one.

        Raises ModelError when image or mask are not of this kind.
        """
        check_image("orb", grey, mask)
        height, width = grey.shape
        if min(height, width) <= 2 * BORDER:  # nothing can be found, and OpenCV fails on a level without pixels
            grey = grey[:0]

        def position(xy: FloatArray, octave: IntArray) -> FloatArray:
            # OpenCV multiplies by the nominal scale only; a level is a resized image of a whole number of pixels,
            # whose pixel edges, not centres, align with the image
            scale = (SCALE_FACTOR**octave)[:, None]
            full = np.array([width, height])
            level = np.rint(full / scale)
            return np.asarray((xy / scale + 0.5) * full / level - 0.5)

        return extract_opencv(self._orb, grey, mask, self._max_keypoints, np.zeros((0, 32), np.uint8), position)
