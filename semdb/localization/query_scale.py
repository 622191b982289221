"""Queries that are larger than the map's images are brought to the map's scale: keypoints are as fine as pixels are.

A photograph of 12 megapixels shows what an image of 640x480 shows, in keypoints of six times the size, which no
keyframe has. So it is made smaller until a pixel covers the angle that it covers in the map's images, intrinsics and
depth with it. Nothing else is touched: an image that is not larger than the map's is taken as it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from semdb.recordings.own_depth import resized
from semdb.types import Camera, ImageArray

LARGER = 1.1  # times as fine as the map: below, keypoints are found again all the same
REDUCTIONS = (8, 4, 2)  # that a JPEG is made smaller by while it is decoded


def times_finer(camera: Camera, known: Sequence[Camera]) -> float:
    """How many times finer than the finest of the map's cameras `known` a larger image of `camera` is; else 1.0."""
    # a camera of a damaged row says nothing of scale; what is damaged of it is said where its keyframes are read
    known = [other for other in known if other.fx * other.fy > 0 and math.isfinite(other.fx * other.fy)]
    if not known or camera.width * camera.height <= max(other.width * other.height for other in known):
        return 1.0
    finest = max(math.sqrt(other.fx * other.fy) for other in known)
    times = math.sqrt(camera.fx * camera.fy) / finest
    return times if times > LARGER else 1.0


def reduction_of(times: float) -> int:
    """How far a JPEG may be made smaller while it is decoded, where it is to be `times` smaller: 1, 2, 4 or 8."""
    return next((reduction for reduction in REDUCTIONS if reduction <= times), 1)


def reduced_camera(camera: Camera, reduction: int) -> Camera:
    """The camera of an image that was made `reduction` times smaller while it was decoded.

    Its last row and column may stand for fewer pixels than the others.
    """
    width, height = -(-camera.width // reduction), -(-camera.height // reduction)
    whole = Camera(width * reduction, height * reduction, camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)
    return resized(whole, width, height)


def smaller_camera(camera: Camera, times: float) -> Camera:
    """The camera of the image in `times` fewer rows and columns."""
    return resized(camera, max(1, round(camera.width / times)), max(1, round(camera.height / times)))


def smaller_image(image: ImageArray, camera: Camera) -> ImageArray:
    """The image ``[h, w, 3]`` of the size of `camera`, each pixel the mean of what it covers."""
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def smaller_values(
    values: npt.NDArray[np.generic], camera: Camera, reduction: int | None = None
) -> npt.NDArray[np.generic]:
    """Depth or labels ``[h, w]`` of the size of `camera`: values at the centres of its pixels, since means are none.

    `reduction` is by how much an image of the size of `values` was made smaller while it was decoded.
    """
    height, width = values.shape
    down, right = (height / camera.height, width / camera.width) if reduction is None else (reduction, reduction)
    rows = np.minimum(((np.arange(camera.height) + 0.5) * down).astype(int), height - 1)
    columns = np.minimum(((np.arange(camera.width) + 0.5) * right).astype(int), width - 1)
    return np.ascontiguousarray(values[np.ix_(rows, columns)])
