"""What spoils an image: blur, darkness, a hand before the lens; and images that show no place at all. Deterministic."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semdb.recordings.synthetic import textures
from semdb.types import BoolArray, Camera, Float32Array, ImageArray, InstanceMasks

Rng = np.random.Generator


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """An image with what must be known of it. `instances` where the recording brings masks; `depth` in metres."""

    image: ImageArray
    camera: Camera
    instances: InstanceMasks | None
    depth: Float32Array | None = None


def _noise(rng: Rng, shape: tuple[int, ...], sigma: float) -> Float32Array:
    """Smooth noise of unit variance."""
    rough = rng.standard_normal(shape, dtype=np.float32)
    smooth = np.asarray(cv2.GaussianBlur(rough, (0, 0), sigma), np.float32)
    return smooth / max(float(smooth.std()), 1e-6)


def _bytes(image: Float32Array) -> ImageArray:
    return np.asarray(np.clip(np.rint(image), 0, 255), np.uint8)


def _without(picture: Picture, image: ImageArray, hidden: BoolArray | None, kept: float, rng: Rng) -> Picture:
    """`picture` with another image; masks are gone where it is hidden, and of every object with chance 1 - `kept`."""
    if picture.instances is None:
        return replace(picture, image=image)
    labels = picture.instances.labels.copy()
    if hidden is not None:
        labels[hidden] = 0
    for label in np.unique(labels):
        if rng.random() > kept:
            labels[labels == label] = 0
    return Picture(image, picture.camera, InstanceMasks(labels, picture.instances.categories))


def blurred(picture: Picture, rng: Rng, length: int) -> Picture:
    """Motion over `length` pixels in one direction while the shutter was open, and out of focus a little."""
    kernel = np.zeros((length, length), np.float32)
    angle, middle = rng.uniform(0, np.pi), (length - 1) / 2
    for s in np.linspace(-middle, middle, 4 * length):
        kernel[round(middle + s * np.sin(angle)), round(middle + s * np.cos(angle))] += 1
    image = cv2.filter2D(picture.image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)
    return _without(picture, np.asarray(cv2.GaussianBlur(image, (0, 0), 1.0), np.uint8), None, 0.6, rng)


def darkened(picture: Picture, rng: Rng, gain: float) -> Picture:
    """So little light that a few grey levels are left, with the noise of the sensor."""
    image = picture.image.astype(np.float32) * gain
    noise = rng.standard_normal(image.shape, dtype=np.float32) * np.sqrt(1.5 + 0.3 * image)
    return _without(picture, _bytes(image + noise), None, 0.4, rng)


def behind_a_hand(picture: Picture, rng: Rng, share: float = 0.5) -> Picture:
    """Something skin-coloured with grain and folds covers about `share` of the image from one side."""
    height, width = picture.image.shape[:2]
    angle = rng.uniform(0, 2 * np.pi)
    y, x = np.mgrid[:height, :width].astype(np.float32)
    along = (x / width - 0.5) * np.cos(angle) + (y / height - 0.5) * np.sin(angle)
    fingers = 0.12 * np.sin(14 * ((x / width) * np.sin(angle) - (y / height) * np.cos(angle)) + rng.uniform(0, 6))
    edge = along + fingers + 0.05 * _noise(rng, (height, width), 25.0)
    hidden = np.asarray(edge > np.quantile(edge, 1 - share), np.bool_)
    skin = np.array([196, 142, 116], np.float32) * rng.uniform(0.5, 1.1)
    shade = 1 + 0.12 * _noise(rng, (height, width), 40.0) + 0.05 * _noise(rng, (height, width), 4.0)
    grain = 1 + 0.03 * _noise(rng, (height, width), 1.0)
    hand = skin * (shade * grain)[..., None]
    soft = cv2.GaussianBlur(hidden.astype(np.float32), (0, 0), 2.5)[..., None]
    image = _bytes(soft * hand + (1 - soft) * picture.image)
    return _without(picture, image, hidden, 1.0, rng)


def close_up(picture: Picture, label: int, zoom: float = 2.0) -> Picture:
    """The part of the image about an object, as a lens of longer focal length shows it (same size in pixels)."""
    assert picture.instances is not None
    camera = picture.camera
    rows, columns = np.nonzero(picture.instances.labels == label)
    width, height = round(camera.width / zoom), round(camera.height / zoom)
    x = int(np.clip(columns.mean() - width / 2, 0, camera.width - width))
    y = int(np.clip(rows.mean() - height / 2, 0, camera.height - height))
    size = (camera.width, camera.height)
    image = cv2.resize(picture.image[y : y + height, x : x + width], size, interpolation=cv2.INTER_CUBIC)
    cut = np.ascontiguousarray(picture.instances.labels[y : y + height, x : x + width])
    labels = np.asarray(cv2.resize(cut, size, interpolation=cv2.INTER_NEAREST), np.uint16)
    lens = Camera(
        *size,
        camera.fx * zoom,
        camera.fy * zoom,
        (camera.cx - x + 0.5) * zoom - 0.5,
        (camera.cy - y + 0.5) * zoom - 0.5,
    )
    return Picture(np.asarray(image, np.uint8), lens, InstanceMasks(labels, picture.instances.categories))


SPOILED: dict[str, tuple[Callable[[Picture, Rng], Picture], ...]] = {
    "blur": (lambda p, r: blurred(p, r, 15), lambda p, r: blurred(p, r, 31)),
    "darkness": (lambda p, r: darkened(p, r, 0.1), lambda p, r: darkened(p, r, 0.04)),
    "hand": (behind_a_hand, lambda p, r: behind_a_hand(p, r, 0.65)),
}


def no_place(camera: Camera, seed: int) -> list[ImageArray]:
    """Images of nothing: noise of four kinds, flat and gently shaded walls, brick, wallpaper, wood and tiles."""
    rng = np.random.default_rng([seed, 7])
    height, width = camera.height, camera.width
    found = [np.asarray(rng.integers(0, 256, (height, width, 3)), np.uint8)]
    found += [_bytes(128 + 50 * _noise(rng, (height, width, 3), sigma)) for sigma in (1.5, 4.0, 12.0)]
    flat = np.full((height, width, 3), 200, np.float32)
    found.append(_bytes(flat + rng.standard_normal(flat.shape, dtype=np.float32)))
    slope = np.linspace(0.6, 1.1, width, dtype=np.float32)[:, None]
    found.append(_bytes(flat * slope + 1.5 * rng.standard_normal(flat.shape, dtype=np.float32)))
    walls = (
        textures.plaster(rng, textures.wall_colour(rng)),
        textures.bricks(rng, (172, 96, 74)),
        textures.wallpaper(rng, textures.wall_colour(rng)),
        textures.planks(rng, (150, 104, 66)),
        textures.tiles(rng, textures.shift(textures.wall_colour(rng), 0.8)),
    )
    for wall in walls:
        scale = max(width / wall.shape[1], height / wall.shape[0])
        size = (max(width, round(wall.shape[1] * scale)), max(height, round(wall.shape[0] * scale)))
        found.append(np.ascontiguousarray(cv2.resize(wall, size, interpolation=cv2.INTER_AREA)[:height, :width]))
    return found
