"""What ROS messages of images and cameras hold, as arrays: raw, compressed and compressedDepth images, camera_info.

Sources: sensor_msgs (Image, CompressedImage, CameraInfo, image_encodings), REP 118 (16UC1 is millimetres, 32FC1 metres
with NaN), image_transport_plugins' compressedDepth (a header of 12 bytes, then PNG or RVL; 32FC1 as inverse depth).
"""

from __future__ import annotations

import struct
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError
from semdb.recordings.base import RawColor, RawDepth
from semdb.recordings.images import decode_gray
from semdb.recordings.lens import Lens
from semdb.recordings.own_depth import as_raw
from semdb.recordings.rvl import decode_rvl
from semdb.shown import number
from semdb.types import Float32Array

MILLIMETRES = 1000.0
COMPRESSED_HEADER = struct.Struct("<iff")
RVL_HEADER = struct.Struct("<II")
LARGEST_SIDE = 16384
BAYER = {  # OpenCV names a pattern by the pixels of its second row and column
    "bayer_rggb8": cv2.COLOR_BayerBG2RGB,
    "bayer_bggr8": cv2.COLOR_BayerRG2RGB,
    "bayer_gbrg8": cv2.COLOR_BayerGR2RGB,
    "bayer_grbg8": cv2.COLOR_BayerGB2RGB,
}
TO_RGB = {
    "rgb8": None,
    "8UC3": cv2.COLOR_BGR2RGB,
    "bgr8": cv2.COLOR_BGR2RGB,
    "rgba8": cv2.COLOR_RGBA2RGB,
    "bgra8": cv2.COLOR_BGRA2RGB,
    "8UC4": cv2.COLOR_BGRA2RGB,
    "mono8": cv2.COLOR_GRAY2RGB,
    "8UC1": cv2.COLOR_GRAY2RGB,
    "yuv422": cv2.COLOR_YUV2RGB_UYVY,
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuv422_yuy2": cv2.COLOR_YUV2RGB_YUY2,
    "yuyv": cv2.COLOR_YUV2RGB_YUY2,
    **BAYER,
}
DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1")
_CHANNELS = {
    "rgb8": 3,
    "8UC3": 3,
    "bgr8": 3,
    "rgba8": 4,
    "bgra8": 4,
    "8UC4": 4,
    "yuv422": 2,
    "uyvy": 2,
    "yuv422_yuy2": 2,
    "yuyv": 2,
}


def is_compressed(message: Any) -> bool:
    """Whether a message is a CompressedImage."""
    return hasattr(message, "format")


def encoding_of(message: Any) -> str:
    """The encoding of an image: of a compressed one that before the semicolon of its format."""
    text = message.format if is_compressed(message) else message.encoding
    return str(text).split(";")[0].strip()


def is_depth(message: Any, topic: str) -> bool:
    """Whether an image holds depth."""
    if is_compressed(message) and ("compressedDepth" in str(message.format) or topic.endswith("compressedDepth")):
        return True
    return encoding_of(message) in DEPTH_ENCODINGS


def color_of(message: Any, name: str) -> RawColor:
    """The colour image: a compressed one as the file that it is. `name` is for messages. Raises FrameError."""
    if is_compressed(message):
        return RawColor(file=bytes(message.data))
    encoding = str(message.encoding)
    if encoding not in TO_RGB:
        raise FrameError(f"{name}: colour of encoding {encoding!r} cannot be read; known are {', '.join(TO_RGB)}")
    channels = _CHANNELS.get(encoding, 1)
    pixels = _pixels(message, name, np.dtype(np.uint8), channels)
    code = TO_RGB[encoding]
    if encoding in BAYER and min(pixels.shape[:2]) < 2:
        raise FrameError(f"{name}: is too small for a Bayer pattern")
    try:
        rgb = pixels if code is None else cv2.cvtColor(pixels, code)
    except cv2.error as error:
        raise FrameError(f"{name}: cannot be converted from {encoding}: {error.err}") from error
    return RawColor(pixels=np.ascontiguousarray(rgb, dtype=np.uint8))


def depth_of(message: Any, name: str, scale: float | None) -> RawDepth:
    """Depth as the message has it, not registered. `scale` overrides the units a metre of whole numbers.

    Raises FrameError.
    """
    units = MILLIMETRES if scale is None else scale
    if is_compressed(message):
        return _compressed_depth(bytes(message.data), str(message.format), name, units)
    encoding = str(message.encoding)
    if encoding == "32FC1":
        return as_raw(_pixels(message, name, np.dtype(np.float32), 1))
    if encoding not in DEPTH_ENCODINGS:
        raise FrameError(
            f"{name}: depth of encoding {encoding!r} cannot be read; known are {', '.join(DEPTH_ENCODINGS)}"
        )
    return RawDepth(_pixels(message, name, np.dtype(np.uint16), 1), units)


def lens_of(info: Any, *, rectified: bool) -> Lens:
    """The lens of a CameraInfo; of its projection without distortion where images are `rectified`.

    Raises ValueError with the reason.
    """
    matrix, coefficients = (
        getattr(info, a, None) if hasattr(info, a) else getattr(info, b) for a, b in (("K", "k"), ("D", "d"))
    )
    k = np.asarray(matrix, dtype=np.float64).reshape(3, 3)
    d = np.asarray(coefficients, dtype=np.float64).ravel()
    if rectified:
        p = np.asarray(info.P if hasattr(info, "P") else info.p, dtype=np.float64).reshape(3, 4)
        if np.isfinite(p).all() and p[0, 0] > 0 and p[1, 1] > 0:
            k, d = p[:, :3], np.zeros(0)
    width, height = int(info.width), int(info.height)
    binning = max(1, int(info.binning_x)), max(1, int(info.binning_y))
    roi = info.roi
    left, top = int(roi.x_offset), int(roi.y_offset)
    if roi.width and roi.height:
        width, height = int(roi.width), int(roi.height)
    width, height = width // binning[0], height // binning[1]
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]
    if not (np.isfinite([fx, fy, cx, cy]).all() and np.isfinite(d).all()):
        raise ValueError("has a number that is not finite")
    if fx <= 0 or fy <= 0 or not 0 < width <= LARGEST_SIDE or not 0 < height <= LARGEST_SIDE:
        raise ValueError(
            f"makes no sense: {width}x{height}, fx {number(fx)}, fy {number(fy)} (an uncalibrated camera has zeros)"
        )
    fx, cx = fx / binning[0], (cx - left + 0.5) / binning[0] - 0.5
    fy, cy = fy / binning[1], (cy - top + 0.5) / binning[1] - 0.5
    name = str(info.distortion_model).strip().lower()
    if not d.any() or name in ("", "none"):
        return Lens(width, height, float(fx), float(fy), float(cx), float(cy))
    if name in ("equidistant", "fisheye", "kannala_brandt", "kannala brandt4"):
        if d.size < 4:
            raise ValueError(f"has {d.size} coefficients of an equidistant lens, which needs 4")
        model, d = "fisheye", d[:4]
    elif name in (
        "plumb_bob",
        "rational_polynomial",
        "brown conrady",
        "modified_brown_conrady",
        "modified brown conrady",
    ):
        model, d = "radial", d[:8]
    else:
        raise ValueError(f"has the distortion model {info.distortion_model!r}, which is not known; give --camera")
    return Lens(width, height, float(fx), float(fy), float(cx), float(cy), model, tuple(float(value) for value in d))


def _pixels(message: Any, name: str, kind: np.dtype[Any], channels: int) -> npt.NDArray[Any]:
    """The values ``[H, W]`` or ``[H, W, channels]`` of a raw image, rows cut to their length. Raises FrameError."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    row = width * channels * kind.itemsize
    data = np.frombuffer(bytes(message.data), np.uint8) if not isinstance(message.data, np.ndarray) else message.data
    step = step or row
    if not 0 < width <= LARGEST_SIDE or not 0 < height <= LARGEST_SIDE or step < row:
        raise FrameError(f"{name}: says that it has {width}x{height} pixels of {step} bytes a row")
    if data.size < step * (height - 1) + row:
        raise FrameError(f"{name}: has {data.size} bytes, but {width}x{height} pixels need {step * height}")
    full = np.zeros(step * height, np.uint8)
    count = min(data.size, full.size)
    full[:count] = data.reshape(-1).view(np.uint8)[:count]
    rows = np.ascontiguousarray(full.reshape(height, step)[:, :row])
    order: Literal["<", ">"] = ">" if message.is_bigendian and kind.itemsize > 1 else "<"
    values = rows.view(kind.newbyteorder(order)).astype(kind)
    return values if channels == 1 else values.reshape(height, width, channels)


def _compressed_depth(data: bytes, form: str, name: str, units: float) -> RawDepth:
    if "compressedDepth" not in form and data[:4] == b"\x89PNG":
        values = decode_gray(data, name)  # a 16-bit PNG by the plain transport
        if values.dtype != np.uint16:
            raise FrameError(f"{name}: is a depth image of 8 bits")
        return RawDepth(values, units, data)
    if len(data) < COMPRESSED_HEADER.size + RVL_HEADER.size:
        raise FrameError(f"{name}: has only {len(data)} bytes")
    _, quant_a, quant_b = COMPRESSED_HEADER.unpack_from(data)
    body = data[COMPRESSED_HEADER.size :]
    png = None
    if body.startswith(b"\x89PNG"):
        png = body
        values = decode_gray(body, name)
        if values.dtype != np.uint16:
            raise FrameError(f"{name}: is a depth image of 8 bits")
    else:
        columns, rows = RVL_HEADER.unpack_from(body)
        try:
            values = decode_rvl(body[RVL_HEADER.size :], columns, rows)
        except ValueError as error:
            raise FrameError(f"{name}: {error}") from error
    if form.split(";", maxsplit=1)[0].strip() == "32FC1":
        return as_raw(_from_inverse(values, quant_a, quant_b))
    return RawDepth(values, units, png)


def _from_inverse(values: npt.NDArray[np.uint16], quant_a: float, quant_b: float) -> Float32Array:
    """Metres of quantised inverse depth; NaN for 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(quant_a) / (values.astype(np.float32) - np.float32(quant_b))
    return np.where(values > 0, depth, np.float32(np.nan))
