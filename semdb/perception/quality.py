"""How good an image is: sharpness, light, contrast, and motion blur with its direction and length.

Motion at an even speed leaves zeros in the spectrum at multiples of 1 / length across its direction, and so a
negative peak of the cepstrum at that length in that direction (Rom, IEEE Trans. Information Theory 21, 1975). It
stands out from what else is at that distance from the middle; images without blur have none.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from semdb.types import Float32Array, ImageArray, ImageQuality, IntArray

DARK = 80.0  # grey values between the 5th and 95th percentile below which contrast is stretched; ordinary ones have 120
BLOCK = 256  # pixels of a side of the pieces whose spectra are averaged
SMALLEST = 160  # pixels of a side of an image in which motion is looked for
SHORTEST, LONGEST = 6.0, 50.0  # pixels of motion that are looked for
EXACT = 2**24  # float32 counts up to here
LEAST_PEAK = 0.3  # of depth times height over its surroundings; images of the recordings without blur reach 0.27


def contrast_range(grey: ImageArray) -> tuple[float, float, float, float]:
    """The 1st, 5th, 95th and 99th percentile of `grey` uint8 ``[H, W]``."""
    if grey.size <= EXACT:  # counts are float32
        counts = (
            cv2.calcHist([np.ascontiguousarray(grey)], [0], None, [256], [0, 256]).reshape(-1).cumsum(dtype=np.int64)
        )
    else:
        counts = np.bincount(grey.reshape(-1), minlength=256).cumsum()
    found = np.searchsorted(counts, np.array([0.01, 0.05, 0.95, 0.99]) * counts[-1])
    low, fifth, other, high = map(float, found)
    return low, fifth, other, high


def stretch_of(grey: ImageArray) -> tuple[float, float] | None:
    """The grey values that are to become 0 and 255 where the image has little contrast; None where it has enough.

    Detectors of keypoints, objects and places have absolute thresholds: they see nothing in the dark.
    """
    low, fifth, other, high = contrast_range(grey)
    if other - fifth >= DARK or high - low < 2:
        return None
    return low, high


def stretched(image: ImageArray, stretch: tuple[float, float]) -> ImageArray:
    """`image` uint8 with the values of `stretch` at 0 and 255."""
    low, high = stretch
    table = np.clip(np.rint((np.arange(256) - low) * (255 / (high - low))), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(image, table), np.uint8)


def with_contrast(image: ImageArray) -> tuple[ImageArray, tuple[float, float] | None]:
    """`image` uint8, RGB ``[H, W, 3]`` or grey ``[H, W]``, as whatever describes it is shown it, and its stretch."""
    stretch = stretch_of(image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8))
    return (image if stretch is None else stretched(image, stretch)), stretch


def image_quality(grey: ImageArray, stretch: tuple[float, float] | None = None) -> ImageQuality:
    """The quality of `grey` uint8 ``[H, W]``, which `stretch` was made of, where it is not the image as it was seen."""
    _, fifth, other, _ = contrast_range(grey)
    sharpness, mean = sharpness_of(grey), float(grey.mean())
    if stretch is not None:
        scale = (stretch[1] - stretch[0]) / 255
        sharpness, mean, fifth, other = sharpness * scale**2, stretch[0] + mean * scale, fifth * scale, other * scale
    blur = motion_blur(grey)
    length, degrees = (0.0, 0.0) if blur is None else blur
    return ImageQuality(sharpness, mean / 255, (other - fifth) / 255, length, degrees)


def sharpness_of(grey: ImageArray) -> float:
    """Mean squared gradient (Sobel, grey values per pixel): Tenengrad."""
    x, y = (cv2.Sobel(grey, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    return float(cv2.norm(x, cv2.NORM_L2SQR) + cv2.norm(y, cv2.NORM_L2SQR)) / max(grey.size, 1)


def motion_blur(grey: ImageArray, least_peak: float = LEAST_PEAK) -> tuple[float, float] | None:
    """Length (pixels) and direction (degrees from x towards y, 0 to 180) of motion blur; None where there is none.

    `least_peak` is how far it has to stand out: plain images have little that could show it.
    """
    if min(grey.shape) < SMALLEST:
        return None
    cepstrum = _cepstrum(grey.astype(np.float32))
    rings, radius = _rings()
    values = cepstrum.reshape(-1)
    at = int(np.argmin(np.where(radius > 0, values, np.inf)))
    middle, spread = _ring_statistics(values, rings[int(radius[at])])
    peak = -float(values[at])
    if not spread > 0 or peak * (peak + middle) / spread < least_peak:
        return None
    y, x = _finest(cepstrum, *divmod(at, BLOCK))
    return float(np.hypot(x, y)), float(np.degrees(np.arctan2(y, x)) % 180)


def complaint_of(quality: ImageQuality) -> str:
    """What is wrong with an image, for people; empty where nothing is."""
    found = []
    if quality.contrast * 255 < DARK:
        what = "dark" if quality.exposure < 0.35 else "without contrast"
        found.append(f"the image is {what}: its grey values span {quality.contrast * 255:.0f} of 255")
    if quality.blur_px > 0:
        found.append(f"the image is blurred by motion: {quality.blur_px:.0f} pixels at {quality.blur_deg:.0f} deg")
    return "; ".join(found)


def motion_kernel(length: float, degrees: float) -> Float32Array:
    """What motion of `length` pixels in a direction does to a point: float32 ``[k, k]``, k odd, its sum 1."""
    half = int(np.ceil(length / 2)) + 1
    along = np.linspace(-length / 2, length / 2, 8 * max(1, round(length)) + 1)
    x, y = along * np.cos(np.radians(degrees)) + half, along * np.sin(np.radians(degrees)) + half
    kernel = np.zeros((2 * half + 2, 2 * half + 2), np.float32)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    for down in (0, 1):
        for right in (0, 1):
            weight = (1 - np.abs(x - left - right)) * (1 - np.abs(y - top - down))
            np.add.at(kernel, (top + down, left + right), weight)
    kernel = kernel[:-1, :-1]
    return np.asarray(kernel / kernel.sum(), np.float32)


def blurred_like(grey: ImageArray, blur: tuple[float, float]) -> ImageArray:
    """`grey` uint8 ``[H, W]`` as motion of this length and direction would have shown it."""
    return np.asarray(cv2.filter2D(grey, -1, motion_kernel(*blur), borderType=cv2.BORDER_REPLICATE), np.uint8)


def _cepstrum(grey: Float32Array) -> Float32Array:
    """Of the mean power of pieces of the image, ``[256, 256]`` with the middle at (128, 128)."""
    height, width = grey.shape
    high, wide = min(height, BLOCK), min(width, BLOCK)
    window = np.outer(np.hanning(high), np.hanning(wide)).astype(np.float32)
    rows, columns = (_starts(size) for size in (height, width))
    power = np.zeros((BLOCK, BLOCK), np.float32)
    for top in rows.tolist():
        for left in columns.tolist():
            piece = grey[top : top + BLOCK, left : left + BLOCK]
            padded = np.zeros((BLOCK, BLOCK), np.float32)
            padded[:high, :wide] = (piece - piece.mean()) * window
            spectrum = cv2.dft(padded, flags=cv2.DFT_COMPLEX_OUTPUT)
            power += (spectrum**2).sum(axis=2)
    log = np.log(power / (len(rows) * len(columns)) + 1)
    found = cv2.dft(log, flags=cv2.DFT_COMPLEX_OUTPUT | cv2.DFT_SCALE)[:, :, 0]
    return np.asarray(cv2.GaussianBlur(np.fft.fftshift(found), (0, 0), 0.7), np.float32)


def _starts(size: int) -> IntArray:
    """Where pieces of a side of `size` pixels begin."""
    count = 1 if size <= BLOCK else 2 + (size > 2 * BLOCK)
    return np.asarray(np.linspace(0, max(size - BLOCK, 0), count), np.int32)


@lru_cache(maxsize=1)
def _rings() -> tuple[dict[int, IntArray], IntArray]:
    """Places of the cepstrum by whole distance from the middle, and that distance, 0 where nothing is looked for."""
    y, x = np.mgrid[-BLOCK // 2 : BLOCK // 2, -BLOCK // 2 : BLOCK // 2]
    distance = np.hypot(y, x).reshape(-1)
    looked = (distance >= SHORTEST) & (distance <= LONGEST)
    whole = np.where(looked, distance, 0).astype(np.int32)
    return {k: np.flatnonzero(distance.astype(int) == k).astype(np.int32) for k in range(int(LONGEST) + 1)}, whole


def _ring_statistics(values: Float32Array, ring: IntArray) -> tuple[float, float]:
    middle = float(np.median(values[ring]))
    return middle, 1.4826 * float(np.median(np.abs(values[ring] - middle)))


def _finest(cepstrum: Float32Array, row: int, column: int) -> tuple[float, float]:
    """The minimum to a fraction of a pixel, from the middle."""
    found = []
    for at, line in ((row, cepstrum[:, column]), (column, cepstrum[row])):
        before, here, after = (float(v) for v in line[at - 1 : at + 2])
        bend = before - 2 * here + after
        found.append(at - BLOCK // 2 + (0.5 * (before - after) / bend if bend > 0 else 0.0))
    return found[0], found[1]
