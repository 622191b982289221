"""Depth of a depth camera as the colour camera beside it would see it; `REGISTRATIONS` knows such pairs by name.

Neighbouring depth pixels of one surface are joined to triangles, which are moved into the colour camera and
rasterised with a z-buffer. Against moving single pixels this leaves no cracks through which the background
could show, needs no filling afterwards, and gives the depth at the centre of each colour pixel (linear in 1/z,
exact on planes) instead of that of a pixel up to half a pixel away. Pixels at depth steps join no triangle across
the step, so no surface is invented between foreground and background; what the depth camera did not see is NaN.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from semdb.errors import FrameError
from semdb.geometry import back_project, invert_pose, normalized_to_pixels, pose_from, project_to_so3
from semdb.recordings.cameras import SEVEN_SCENES_DEPTH
from semdb.recordings.images import decode_depth
from semdb.types import Camera, Float32Array, FloatArray

REGISTRATION_7SCENES = "7scenes"
# The depth-to-colour calibration that ACE's set-up of 7-Scenes uses, its rotation made exact; metres.
COLOR_FROM_DEPTH = pose_from(
    project_to_so3(
        [
            [0.99996518, 0.00267651, -0.0079041],
            [-0.00274093, 0.99996303, -0.00815045],
            [0.00788199, 0.00817183, 0.99993555],
        ]
    ),
    [-0.02555894, 0.00010110, 0.00203183],
)
DEPTH_FROM_COLOR = invert_pose(COLOR_FROM_DEPTH)
# Neighbours further apart than this share of their depth are two surfaces: a Kinect's step is below 1.5 % of the
# depth up to 5 m, a floor seen at 10 degrees changes by 1 % a pixel.
MAX_STEP = 0.03
BAND = 64  # rows at a time: what is computed of them stays in the processor's cache


@dataclass(frozen=True, slots=True)
class Registration:
    """How depth files of one pair of cameras are brought to the colour image: `size` (width, height) of the files."""

    size: tuple[int, int]
    register: Callable[[Float32Array, Camera], Float32Array]


def depth_size(camera: Camera, registration: str) -> tuple[int, int]:
    """Width and height that depth files must have: of the depth camera where one registers, else of `camera`."""
    found = REGISTRATIONS.get(registration)
    return (camera.width, camera.height) if found is None else found.size


def register_depth(depth: Float32Array, registration: str, camera: Camera) -> Float32Array:
    """Depth as `decode_depth` gives it, registered to the colour `camera` as `registration` names ("" does nothing).

    Raises FrameError for a registration of another version.
    """
    if registration == "":
        return depth
    if registration not in REGISTRATIONS:
        known = ", ".join(map(repr, ("", *REGISTRATIONS)))
        raise FrameError(f"unknown depth registration {registration!r}; known are {known}")
    return REGISTRATIONS[registration].register(depth, camera)


def decode_registered_depth(
    data: bytes, name: str, depth_scale: float, registration: str, camera: Camera
) -> Float32Array:
    """Depth ``[H, W]`` metres (NaN invalid) of a file as recorded, registered to the colour `camera`.

    Raises FrameError naming `name`, also for a file of another size than the one that `registration` takes.
    """
    depth = decode_depth(data, name, depth_scale, depth_size(camera, registration))
    return register_depth(depth, registration, camera)


def register_seven_scenes(depth: Float32Array, camera: Camera) -> Float32Array:
    """Depth ``[480, 640]`` metres of the depth camera (NaN invalid) as seen by the colour `camera` ``[H, W]``."""
    return register_to(depth, SEVEN_SCENES_DEPTH, COLOR_FROM_DEPTH, camera)


def register_to(
    depth: Float32Array, source: Camera, color_from_depth: FloatArray, camera: Camera, max_step: float = MAX_STEP
) -> Float32Array:
    """Depth ``[h, w]`` metres of the camera `source` (NaN invalid) as the colour `camera` sees it, ``[H, W]``.

    `color_from_depth` ``[4, 4]`` is the pose of the depth camera in the colour camera. The two may differ in
    resolution: what lies between the centres of neighbouring depth pixels is interpolated, linear in 1/z, where they
    are one surface, that is within `max_step` of their depth.
    """
    from semdb.recordings.registration_kernels import invert, rasterise, transform  # numba: half a second to import

    shift = color_from_depth[:3, 3].astype(np.float32)
    rays = _rotated_rays(source, color_from_depth[:3, :3].tobytes())
    distorted = any(camera.distortion)
    lens = (1.0, 1.0, 0.0, 0.0) if distorted else (camera.fx, camera.fy, camera.cx, camera.cy)
    fx, fy, cx, cy = (np.float32(number) for number in lens)
    depth = np.ascontiguousarray(depth, dtype=np.float32)
    nearest = np.zeros((camera.height, camera.width), dtype=np.float32)  # 1/z, 0 is nothing
    for top in range(0, len(depth) - 1, BAND):
        part = depth[top : top + BAND + 1]
        u, v, inverse_z, known = np.empty((4, *part.shape), dtype=np.float32)
        transform(part, rays[top : top + BAND + 1], shift, fx, fy, cx, cy, u, v, inverse_z, known)
        if distorted:
            pixels = normalized_to_pixels(camera, np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
            u = pixels[:, 0].reshape(part.shape).astype(np.float32)
            v = pixels[:, 1].reshape(part.shape).astype(np.float32)
        rasterise(known, u, v, inverse_z, np.float32(max_step), nearest)
    invert(nearest)
    return nearest


@lru_cache(maxsize=4)
def _rotated_rays(camera: Camera, rotation: bytes) -> Float32Array:  # [h, 3, w]
    """Directions of the depth camera's pixels at z = 1, turned into the colour camera by `rotation`'s float64."""
    turn = np.frombuffer(rotation).reshape(3, 3)
    v, u = np.mgrid[: camera.height, : camera.width]
    rays = back_project(camera, np.column_stack([u.ravel(), v.ravel()]), np.ones(u.size))
    turned = (rays @ turn.T).reshape(camera.height, camera.width, 3)
    return np.ascontiguousarray(turned.transpose(0, 2, 1), dtype=np.float32)


REGISTRATIONS = {
    REGISTRATION_7SCENES: Registration((SEVEN_SCENES_DEPTH.width, SEVEN_SCENES_DEPTH.height), register_seven_scenes)
}
