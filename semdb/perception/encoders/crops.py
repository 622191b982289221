"""What of an image a place network is shown: a square of 224 pixels, cut out of it or made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np

from semdb.types import Float32Array, ImageArray

SIDE = 224
CENTRE, HEIGHT, SQUASHED, PADDED = "centre", "height", "squashed", "padded"
DEFAULT = CENTRE  # of new maps
_LARGER = 256  # pixels of the short side, of which the oldest crop takes the middle
_GREY = 124  # of what is beside a padded image


def config_of(crop: str) -> dict[str, Any]:
    """What the provenance of vectors has of a crop. That of the first versions has no name."""
    return {"crop": SIDE, "short_side": _LARGER} if crop == CENTRE else {"crop": SIDE, "view": crop}


def crop_of(config: Mapping[str, Any]) -> str | None:
    """The crop that a configuration names; None where it has none (`gist` sees the whole image)."""
    return str(config["view"]) if "view" in config else CENTRE if "crop" in config else None


def square(image: ImageArray, crop: str) -> Float32Array:
    """The square that `crop` makes of an RGB `image` ``[H, W, 3]``, float32 ``[1, 3, 224, 224]`` from 0 to 1."""
    shown = CROPS[crop](image).transpose(2, 0, 1)[None]
    return np.ascontiguousarray(shown, dtype=np.float32) / np.float32(255)


def crop_named(wanted: str) -> str:
    """The crop of a setting, where ``auto`` is that of new maps."""
    return DEFAULT if wanted == "auto" else wanted


def _resized(image: ImageArray, short_side: int) -> ImageArray:
    ratio = short_side / min(image.shape[:2])
    width, height = (max(short_side, round(n * ratio)) for n in (image.shape[1], image.shape[0]))
    return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _centre(image: ImageArray) -> ImageArray:
    resized = _resized(image, _LARGER)
    y, x = resized.shape[0] // 2 - SIDE // 2, resized.shape[1] // 2 - SIDE // 2
    return resized[y : y + SIDE, x : x + SIDE]


def _height(image: ImageArray) -> ImageArray:
    resized = _resized(image, SIDE)
    y, x = (resized.shape[0] - SIDE) // 2, (resized.shape[1] - SIDE) // 2
    return resized[y : y + SIDE, x : x + SIDE]


def _squashed(image: ImageArray) -> ImageArray:
    return np.asarray(cv2.resize(image, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


def _padded(image: ImageArray) -> ImageArray:
    ratio = SIDE / max(image.shape[:2])
    width, height = (max(1, round(n * ratio)) for n in (image.shape[1], image.shape[0]))
    shown = np.full((SIDE, SIDE, 3), _GREY, np.uint8)
    y, x = (SIDE - height) // 2, (SIDE - width) // 2
    shown[y : y + height, x : x + width] = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
    return shown


CROPS: Mapping[str, Callable[[ImageArray], ImageArray]] = {
    CENTRE: _centre,
    HEIGHT: _height,
    SQUASHED: _squashed,
    PADDED: _padded,
}
