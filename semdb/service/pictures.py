"""Small pictures, as pages take them."""

from __future__ import annotations

from semdb.recordings.images import decode_color

QUALITY = 85


def small(data: bytes, name: str, width: int) -> bytes:
    """An image at most `width` pixels wide, as a JPEG file. Raises FrameError."""
    import cv2

    image = decode_color(data, name)
    if image.shape[1] > width:
        height = max(1, round(image.shape[0] * width / image.shape[1]))
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return bytes(cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1])
