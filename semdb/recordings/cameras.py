"""Intrinsics of the known data sets, ``camera.json`` and the text of ``--camera``."""

from __future__ import annotations

import math
import re

from semdb.errors import UsageError
from semdb.recordings.camera_files import CAMERA_FILE
from semdb.types import Camera

# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats: calibrations of the three Kinects; k1, k2, p1, p2, k3.
TUM_CAMERAS = {
    "freiburg1": Camera(640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": Camera(640, 480, 520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6),
}
ROS_DEFAULT = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
# Published with fy = -480 for a camera frame with y up; the reader turns the poses and keeps fy positive.
ICL_NUIM = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
SEVEN_SCENES_COLOR = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
SEVEN_SCENES_DEPTH = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)

TUM_DEPTH_SCALE = 5000.0
SEVEN_SCENES_DEPTH_SCALE = 1000.0


def tum_camera(folder_name: str) -> tuple[Camera, str | None]:
    """The camera that a TUM folder name stands for, and a note when it names none."""
    match = re.search(r"(?:freiburg|fr)([123])(?![0-9])", folder_name.lower())
    if match:
        return TUM_CAMERAS[f"freiburg{match.group(1)}"], None
    note = (
        f"the folder name {folder_name!r} names none of freiburg1, freiburg2 and freiburg3, no {CAMERA_FILE}: "
        "using ROS' default intrinsics 525,525,319.5,239.5; give --camera if the camera is another one"
    )
    return ROS_DEFAULT, note


def parse_camera(text: str, width: int = 0, height: int = 0) -> Camera:
    """A camera from ``fx,fy,cx,cy[,k1,k2,p1,p2[,k3]]`` (pixels, and OpenCV's distortion coefficients).

    `width` and `height` of 0 mean the size of the images it is used with (see `with_size`).
    Raises UsageError for anything but 4, 8 or 9 finite numbers with positive focal lengths.
    """
    usage = "--camera takes fx,fy,cx,cy or fx,fy,cx,cy,k1,k2,p1,p2,k3"
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError as error:
        raise UsageError(f"{usage}; {text!r} has something that is no number") from error
    if len(numbers) not in (4, 8, 9):
        raise UsageError(f"{usage}; {text!r} has {len(numbers)} numbers")
    if not all(math.isfinite(number) for number in numbers):
        raise UsageError(f"{usage}; {text!r} has a number that is not finite")
    fx, fy, cx, cy = numbers[:4]
    if fx <= 0 or fy <= 0:
        raise UsageError(
            f"--camera {text!r}: fx and fy must be positive (for ICL-NUIM give 480 for fy: its reader turns the poses)"
        )
    return Camera(width, height, fx, fy, cx, cy, tuple(numbers[4:]))


def with_size(camera: Camera, size: tuple[int, int]) -> Camera:
    """`camera` with its size filled in from (width, height) where it has none."""
    if camera.width and camera.height:
        return camera
    return Camera(size[0], size[1], camera.fx, camera.fy, camera.cx, camera.cy, camera.distortion)
