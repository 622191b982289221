"""What is kept of the image files of a keyframe: all, a smaller colour image, or grey values alone."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.recordings.images import decode_color, decode_color_grey, header_of
from semdb.types import ImageArray

ORIGINAL, JPEG, NONE = KINDS = ("original", "jpeg", "none")
JPEG_QUALITY = 90
GREY_QUALITY = 40


def kept_images(rgb: bytes, depth: bytes | None, keep: str, name: str) -> tuple[bytes, bytes | None]:
    """The colour and the depth file that are stored of `rgb` and `depth`.

    ``original``: both as they are. ``jpeg``: colour that is no JPEG becomes one where that is smaller, depth stays.
    ``none``: a grey JPEG of the same size, by which patches are aligned to a fraction of a pixel, and no depth. Raises
    FrameError for what cannot be read.
    """
    if keep == ORIGINAL:
        return rgb, depth
    header = header_of(rgb, name)
    if keep == JPEG:
        if header.kind == "jpeg":
            return rgb, depth
        return min(rgb, as_jpeg(decode_color(rgb, name)[:, :, ::-1], JPEG_QUALITY), key=len), depth
    if header.kind == "jpeg" and header.channels == 1:
        return rgb, None
    return min(rgb, as_jpeg(decode_color_grey(rgb, name), GREY_QUALITY), key=len), None


def as_jpeg(pixels: ImageArray, quality: int) -> bytes:
    """An image ``[H, W]`` or ``[H, W, 3]`` (BGR), uint8, as a JPEG file."""
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data)
