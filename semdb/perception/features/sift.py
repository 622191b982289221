"""OpenCV's SIFT, its descriptors as RootSIFT."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from semdb.perception.features.opencv import check_image, extract_opencv, feature_info
from semdb.types import BoolArray, Features, ImageArray, ModelInfo


class SiftFeatures:
    """128-d RootSIFT, float32 of unit length.

    Source: Lowe, Distinctive Image Features from Scale-Invariant Keypoints (IJCV 2004); Arandjelovic and Zisserman,
    Three things everyone should know to improve object retrieval (CVPR 2012).
    """

    def __init__(self, max_keypoints: int = 1500) -> None:
        self._max_keypoints = max_keypoints
        # the default upscaling shifts every keypoint by a quarter of a pixel (measured); the precise one does not
        self._sift = cv2.SIFT.create(nfeatures=max_keypoints, enable_precise_upscale=True)
        # with a mask OpenCV cuts first and masks then: here all are found, and the cut comes last
        self._all = cv2.SIFT.create(nfeatures=0, enable_precise_upscale=True)
        self._info = feature_info("sift", max_keypoints=max_keypoints, precise_upscale=True, root=True)

    @property
    def info(self) -> ModelInfo:
        return self._info

    def extract(self, grey: ImageArray, mask: BoolArray | None = None) -> Features:
        """The strongest keypoints of a uint8 `grey` [H, W], those on `mask` [H, W] where there is one.

        Raises ModelError when image or mask are not of this kind.
        """
        check_image("sift", grey, mask)
        sift = self._sift if mask is None else self._all
        features = extract_opencv(sift, grey, mask, self._max_keypoints, np.zeros((0, 128), np.float32))
        sums = np.maximum(features.descriptors.sum(axis=1, keepdims=True), np.float32(1e-7))
        return replace(features, descriptors=np.sqrt(features.descriptors / sums, dtype=np.float32))
