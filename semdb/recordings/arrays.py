"""Images, depth, cameras and poses that a program has in memory: taken as they are meant, or refused with what to do.

What can be told from an array is checked here, so that nothing behind it meets another dtype, shape or unit. What
cannot be told is BGR: it is a colour image like any other, and one that localizes badly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from semdb.errors import FrameError, UsageError
from semdb.geometry import pose_from, project_to_so3
from semdb.recordings.cameras import parse_camera, with_size
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

CameraLike = Camera | str | Sequence[float] | npt.NDArray[Any]
ROTATION_TOLERANCE = 0.02  # of the entries of R^T R: what single precision and rounded text leave is far below
EXACT = 1e-12  # of the same: a rotation already
NEAREST_M, FARTHEST_M = 0.02, 100.0  # the median of a depth image that is in metres lies between
SMALLEST = 16  # pixels: a side below holds no feature


def as_image(value: Any, name: str) -> ImageArray:
    """An RGB image uint8 ``[H, W, 3]``, contiguous, from a colour, grey (``[H, W]``) or RGBA array of uint8.

    Grey values become three equal channels and transparency is dropped, as of image files. `name` is for messages.
    Raises FrameError for any other dtype or shape.
    """
    array = _array(value, name, "an image")
    if array.dtype != np.uint8:
        raise FrameError(
            f"{name}: an image has values of uint8 from 0 to 255, this has {array.dtype}: {_to_bytes(array)}"
        )
    if array.ndim == 2:
        array = array[:, :, None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4):
        first = array.ndim == 3 and array.shape[0] in (1, 3, 4)
        hint = ": move the channels to the end with numpy.moveaxis(image, 0, -1)" if first else ""
        raise FrameError(f"{name}: an image has the shape [H, W, 3] or [H, W], this has {list(np.shape(value))}{hint}")
    height, width = array.shape[:2]
    if min(height, width) < SMALLEST:
        raise FrameError(f"{name}: an image of {width}x{height} pixels; at least {SMALLEST}x{SMALLEST} are needed")
    colour = np.repeat(array, 3, axis=2) if array.shape[2] == 1 else array[:, :, :3]
    return np.ascontiguousarray(colour)


def as_depth(value: Any, name: str, size: tuple[int, int], depth_scale: float | None = None) -> Float32Array:
    """Depth float32 ``[H, W]`` in metres, NaN where nothing was measured, of `size` (width, height).

    Floats are metres, or `depth_scale` units per metre where that is given; integers need it. Zero, negative, infinite
    and masked values, NaN, and 65535 of uint16 are no measurement. Raises FrameError for any other dtype or shape, and
    where the median cannot be one in metres; UsageError for a scale that is none.
    """
    scale = check_depth_scale(depth_scale)
    masked = np.ma.getmaskarray(value) if isinstance(value, np.ma.MaskedArray) else None
    array = _array(value, name, "a depth image")
    whole = np.issubdtype(array.dtype, np.integer)
    if not whole and not np.issubdtype(array.dtype, np.floating):
        raise FrameError(
            f"{name}: depth is of floats in metres, or of integers with depth_scale=; this is {array.dtype}"
        )
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.shape != (size[1], size[0]):
        raise FrameError(
            f"{name}: depth has the shape {list(array.shape)}, but the image is {size[0]}x{size[1]}, so "
            f"[{size[1]}, {size[0]}] is needed: depth must be registered to the image and of its size"
        )
    if whole and scale is None:
        raise FrameError(
            f"{name}: depth of {array.dtype} has units that only you know: give depth_scale=, units per metre "
            "(1000 for millimetres, 5000 for TUM RGB-D)"
        )
    depth = _metres(array, scale)
    if masked is not None:
        depth[masked.reshape(depth.shape)] = np.nan
    _check_units(depth, name, scale)
    return depth


def check_depth_scale(depth_scale: float | None) -> float | None:
    """`depth_scale`, units per metre, as float. Raises UsageError unless it is None or a positive finite number."""
    if depth_scale is None:
        return None
    try:
        scale = float(depth_scale)
    except (TypeError, ValueError):
        scale = math.nan
    if not (math.isfinite(scale) and scale > 0):
        raise UsageError(f"depth_scale={depth_scale!r}: a positive number of units per metre is needed")
    return scale


def as_camera(value: CameraLike, size: tuple[int, int] = (0, 0)) -> Camera:
    """A camera from a `Camera`, from 4, 8 or 9 numbers ``fx, fy, cx, cy[, k1, k2, p1, p2[, k3]]``, their text, or a
    matrix ``[3, 3]``; `size` (width, height) is taken where it brings none.

    Raises UsageError for what is none.
    """
    if isinstance(value, Camera):
        numbers: Sequence[float] = (value.fx, value.fy, value.cx, value.cy, *value.distortion)
        _check_numbers(numbers, value, lengths=(4, 8, 9))
        return with_size(value, size)
    if isinstance(value, str):
        return with_size(parse_camera(value), size)
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "uif":
            raise TypeError
    except (TypeError, ValueError):
        raise UsageError(f"{_CAMERA}; this is {value!r}") from None
    if array.shape == (3, 3):
        if array[1, 0] or array[2, 0] or array[2, 1] or array[2, 2] != 1 or array[0, 1]:
            raise UsageError(f"camera={value!r}: a matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] is needed")
        array = array[[0, 1, 0, 1], [0, 1, 2, 2]]
    if array.ndim != 1:
        raise UsageError(f"{_CAMERA}; this has the shape {list(array.shape)}")
    found = [float(number) for number in array]
    _check_numbers(found, value, lengths=(4, 8, 9))
    fx, fy, cx, cy = found[:4]
    return Camera(*size, fx, fy, cx, cy, tuple(found[4:]))


def as_pose(value: Any, name: str) -> FloatArray:
    """A pose ``world_from_camera`` float64 ``[4, 4]``, its rotation projected to SO(3). Raises FrameError."""
    pose = _array(value, name, "a pose").astype(np.float64)
    if pose.shape != (4, 4):
        raise FrameError(f"{name}: a pose is a matrix world_from_camera [4, 4], this has the shape {list(pose.shape)}")
    if not np.isfinite(pose).all():
        raise FrameError(f"{name}: the pose has a number that is not finite; where there is no pose give None")
    rotation = pose[:3, :3]
    off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-6 or off > ROTATION_TOLERANCE or np.linalg.det(rotation) <= 0:
        raise FrameError(
            f"{name}: the pose is no rigid motion in metres (last row {pose[3].tolist()}, R^T R differs from the "
            f"identity by {off:.2g}): give world_from_camera, camera axes x right, y down, z forward"
        )
    if off <= EXACT:
        return pose  # as a reader gives it: not a bit is changed
    return pose_from(project_to_so3(rotation), pose[:3, 3])


_CAMERA = "camera= takes a Camera, fx, fy, cx, cy[, k1, k2, p1, p2[, k3]], or a matrix [3, 3]"


def _check_numbers(numbers: Sequence[float], value: object, lengths: tuple[int, ...]) -> None:
    if len(numbers) not in lengths:
        raise UsageError(f"{_CAMERA}; this has {len(numbers)} numbers")
    if not all(math.isfinite(number) for number in numbers):
        raise UsageError(f"camera={value!r} has a number that is not finite")
    if numbers[0] <= 0 or numbers[1] <= 0:
        raise UsageError(f"camera={value!r}: the focal lengths fx and fy are pixels and must be positive")


def _array(value: Any, name: str, what: str) -> npt.NDArray[Any]:
    """`value` as an array of numbers. Raises FrameError."""
    try:
        array = np.asarray(value)
    except Exception as error:  # whatever __array__ of another library raises, as of a tensor on a GPU
        raise FrameError(f"{name}: {what} as a NumPy array is needed: {error}") from error
    if array.dtype.kind not in "buif" or array.ndim == 0:
        raise FrameError(f"{name}: {what} as a NumPy array is needed, not {type(value).__name__}")
    if array.size == 0:
        raise FrameError(f"{name}: {what} with the shape {list(array.shape)} is empty")
    return array


def _to_bytes(array: npt.NDArray[Any]) -> str:
    """What to do about an image of another dtype."""
    if array.dtype == np.bool_:
        return "a mask is no image"
    if array.dtype == np.uint16:
        return "is it depth? That goes to depth=; of a 16-bit image give (image // 256).astype('uint8')"
    if np.issubdtype(array.dtype, np.floating):
        finite = array[np.isfinite(array)]
        if finite.size == array.size and finite.min() >= 0 and finite.max() <= 1:
            return "of values from 0 to 1 give (255 * image).round().astype('uint8')"
        return "give image.clip(0, 255).round().astype('uint8') where they are from 0 to 255"
    return "give image.astype('uint8') where they are from 0 to 255"


def _metres(array: npt.NDArray[Any], scale: float | None) -> Float32Array:
    if array.dtype == np.uint16 and scale is not None:
        from semdb.recordings._png_rows import scaled  # as of files, to the bit

        depth = np.empty(array.shape, np.float32)
        scaled(np.ascontiguousarray(array), np.float32(1.0 / scale), depth)  # type: ignore[no-untyped-call]
        return depth
    exact = array.astype(np.float64) / (scale or 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = exact.astype(np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def _check_units(depth: Float32Array, name: str, scale: float | None) -> None:
    known = depth[np.isfinite(depth)]
    if not known.size:
        return
    median = float(np.median(known))
    if NEAREST_M <= median <= FARTHEST_M:
        return
    if scale is None:
        guess = " (1000 for millimetres)" if median > FARTHEST_M else ""
        hint = f"where they are others give depth_scale=, units per metre{guess}"
    else:
        hint = f"check depth_scale={scale:g}, units per metre"
    raise FrameError(f"{name}: half of the depth is beyond {median:.6g} m, which cannot be metres: {hint}")
