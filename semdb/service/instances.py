"""Images that bring object masks of their own, for maps whose detector is `recorded`."""

from __future__ import annotations

import json

import numpy as np

from semdb.errors import FrameError, UsageError
from semdb.recordings.arrays import as_camera
from semdb.recordings.images import decode_color, decode_depth, decode_gray, header_of
from semdb.recordings.intrinsics import depth_scale_problem
from semdb.service.middleware import check_depth
from semdb.service.problems import Problem
from semdb.storable_names import name_problem
from semdb.types import Frame, InstanceMasks

MOST_CATEGORIES = 65_535


def frame_with(
    image: bytes,
    depth: bytes | None,
    instances: bytes,
    categories: str,
    *,
    camera: str | None,
    depth_scale: float | None,
    name: str,
) -> Frame:
    """The image as a frame with masks: `instances` a PNG of labels, `categories` JSON of a class for each of them.

    Raises Problem 422, FrameError, UsageError.
    """
    if camera is None:
        raise Problem(422, "an image with instances needs its camera: fx,fy,cx,cy")
    pixels = decode_color(image, name)
    size = (pixels.shape[1], pixels.shape[0])
    metres = None
    if depth is not None:
        if depth_scale is None:
            raise Problem(422, "depth needs depth_scale, units per metre")
        if (problem := depth_scale_problem(depth_scale)) is not None:
            raise UsageError(problem)
        metres = decode_depth(depth, f"depth of {name}", depth_scale, size)
    masks = InstanceMasks(_labels(instances, size), _categories(categories))
    # the library checks every frame that it is asked about: `make_frame` would do that a second time
    return Frame(0, name, None, pixels, metres, as_camera(camera, size), None, instances=masks)


def _labels(data: bytes, size: tuple[int, int]) -> np.ndarray[tuple[int, ...], np.dtype[np.uint16]]:
    header = header_of(data, "instances")
    if header.kind != "png" or header.channels != 1 or header.size != size:
        raise FrameError(f"instances: a PNG of one channel and of the image's size {size[0]}x{size[1]} is needed")
    return np.asarray(decode_gray(data, "instances"), np.uint16)


def _categories(text: str) -> dict[int, str]:
    check_depth(text.encode())
    try:
        found = {int(label): str(category) for label, category in json.loads(text).items()}
    except (ValueError, AttributeError, RecursionError):
        raise Problem(422, 'categories: JSON of a class for each label is needed, {"1": "chair"}') from None
    for label, category in found.items():
        if not 0 < label <= MOST_CATEGORIES or name_problem(category) is not None:
            raise Problem(422, f"categories: {label}: {category!r} is no label and class")
    return found
