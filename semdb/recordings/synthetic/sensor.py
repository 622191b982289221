"""What a real sensor and real light add to an exact view: noise, motion blur, a change of the lighting."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.geometry import invert_pose
from semdb.recordings.synthetic.textures import to_image
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

BASELINE = 0.075  # metres, of a structured-light sensor
DISPARITY_STEP = 1 / 8  # pixels at a width of 640
BLUR_TAPS = 9


def _rays(camera: Camera) -> tuple[Float32Array, Float32Array]:
    """The rays of all pixels: x and y, with z = 1."""
    x = (np.arange(camera.width, dtype=np.float32) - camera.cx) / camera.fx
    y = (np.arange(camera.height, dtype=np.float32) - camera.cy) / camera.fy
    return np.broadcast_to(x, (camera.height, camera.width)), np.broadcast_to(y[:, None], (camera.height, camera.width))


def motion_blur(
    image: ImageArray, depth: Float32Array, camera: Camera, pose: FloatArray, following: FloatArray, shutter: float
) -> ImageArray:
    """Averages `image` along the paths of its points while the camera moves from `pose` towards `following`.

    The exposure is centred on `pose`, so that pose and depth stay true; `shutter` is its share of the frame time.
    """
    relative = (invert_pose(following) @ pose).astype(np.float32)
    x, y = _rays(camera)
    points = np.stack([x * depth, y * depth, depth], axis=-1) @ relative[:3, :3].T + relative[:3, 3]
    z = np.maximum(points[..., 2], 0.05)
    u, v = camera.fx * points[..., 0] / z + camera.cx, camera.fy * points[..., 1] / z + camera.cy
    here_u, here_v = camera.fx * x + camera.cx, camera.fy * y + camera.cy
    du, dv = (u - here_u) * shutter, (v - here_v) * shutter
    total = np.zeros(image.shape, np.float32)
    for k in range(BLUR_TAPS):
        s = (k + 0.5) / BLUR_TAPS - 0.5
        map_u, map_v = (here_u + s * du).astype(np.float32), (here_v + s * dv).astype(np.float32)
        total += cv2.remap(image, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(np.rint(total / BLUR_TAPS), np.uint8)


def change_light(
    image: ImageArray, depth: Float32Array, camera: Camera, pose: FloatArray, strength: float, seed: int, index: int
) -> ImageArray:
    """Another time of day: gain and colour cast of the recording, more light on one side of the room, slow flicker."""
    rng = np.random.default_rng([seed, 4])
    gain = 2.0 ** (strength * rng.uniform(0.35, 0.8) * rng.choice([-1.0, 1.0]))
    cast = 1 + strength * rng.uniform(-0.16, 0.16, 3)
    side, phase = rng.uniform(0, 2 * np.pi, 2)
    flicker = 1 + 0.12 * strength * np.sin(2 * np.pi * index / 45 + phase)
    # a linear gradient over the room, evaluated at each pixel's point in the world
    x, y = _rays(camera)
    axis = np.array([np.cos(side), np.sin(side), 0.0])
    in_camera = (pose[:3, :3].T @ axis).astype(np.float32)
    along = (x * in_camera[0] + y * in_camera[1] + in_camera[2]) * depth + np.float32(axis @ pose[:3, 3])
    gradient = np.clip(1 + 0.16 * strength * along, 0.3, 2.0)
    lit = image * (gradient * np.float32(gain * flicker))[..., None] * cast.astype(np.float32)
    return to_image(lit)


def noisy_image(image: ImageArray, rng: np.random.Generator) -> ImageArray:
    """Shot and read noise, slightly correlated between pixels as after demosaicing."""
    noise = rng.standard_normal(image.shape, dtype=np.float32)
    noise = 1.6 * cv2.GaussianBlur(noise, (3, 3), 0.5)
    level = np.sqrt(2.2 + 0.035 * image.astype(np.float32))
    return to_image(image + noise * level)


def noisy_depth(depth: Float32Array, camera: Camera, rng: np.random.Generator) -> Float32Array:
    """Depth of a structured-light sensor: axial noise growing with z^2, quantised disparity, holes.

    Axial noise follows 1.2 mm + 1.9 mm (z - 0.4 m)^2 (Nguyen, Izadi and Lovell, 3DIMPVT 2012); no depth below 0.4 m
    and above 7 m, in patches at depth edges and where the surface is seen at a grazing angle.
    """
    h, w = depth.shape
    scale = w / 640
    draws = rng.standard_normal((h, w), dtype=np.float32)
    sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    z = np.maximum(depth + sigma * draws, 0.05)
    unit = np.float32(camera.fx * BASELINE / (DISPARITY_STEP * scale))
    z = unit / np.maximum(np.rint(unit / z), 1)
    holes = (depth < 0.4) | (depth > 7.0)
    patches = cv2.GaussianBlur(rng.random((h, w), dtype=np.float32), (0, 0), max(1.2 * scale, 0.6))
    rank = (patches - patches.mean()) / max(float(patches.std()), 1e-6)
    low, high = cv2.erode(depth, np.ones((3, 3), np.uint8)), cv2.dilate(depth, np.ones((3, 3), np.uint8))
    edge = (high - low > 0.04 + 0.03 * low).astype(np.uint8)
    holes |= (cv2.dilate(edge, np.ones((3, 3), np.uint8)) > 0) & (rank > -0.5)
    # slope of inverse depth is linear on a plane: the angle between ray and surface follows from it
    inverse = 1 / np.maximum(depth, 0.05)
    gx, gy = cv2.Sobel(inverse, cv2.CV_32F, 1, 0, scale=1 / 8), cv2.Sobel(inverse, cv2.CV_32F, 0, 1, scale=1 / 8)
    x, y = _rays(camera)
    nx, ny = gx * camera.fx, gy * camera.fy
    nz = inverse - nx * x - ny * y
    cosine = inverse / np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1))
    holes |= (cosine < 0.22) & (rank > (cosine - 0.12) * 15)
    return np.where(holes, 0, z).astype(np.float32)
