"""Procedural textures: pure functions of a numpy Generator. All are uint8 RGB with sides that are powers of two."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np

from semdb.types import Float32Array, ImageArray

Colour = tuple[float, float, float]  # 0..255
Rng = np.random.Generator


def noise(
    rng: Rng, height: int, width: int, cells: tuple[float, float], octaves: int, gain: float = 0.55
) -> Float32Array:
    """Tileable fractal noise ``[height, width]`` with mean 0 and standard deviation 1.

    `cells` are those of the coarsest octave (down, across), rounded to powers of two. Each octave doubles them and is
    `gain` times weaker.
    """
    total = np.zeros((height, width), np.float32)
    weight = 1.0
    rows, cols = cells
    for _ in range(octaves):
        r, c = (2 ** max(round(np.log2(n)), 0) for n in (rows, cols))
        if r > height or c > width:
            break
        # cells are powers of two as are the sides, so a border of 2 cells comes out as whole pixels to cut off
        grid = np.pad(rng.random((r, c), dtype=np.float32), 2, mode="wrap")
        dy, dx = height // r, width // c
        big = cv2.resize(grid, ((c + 4) * dx, (r + 4) * dy), interpolation=cv2.INTER_CUBIC)
        total += weight * big[2 * dy : 2 * dy + height, 2 * dx : 2 * dx + width]
        weight *= gain
        rows, cols = rows * 2, cols * 2
    return np.asarray((total - total.mean()) / max(float(total.std()), 1e-6), np.float32)


def to_image(values: Float32Array) -> ImageArray:
    """`values` clipped to uint8."""
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def tinted(colour: Colour, *layers: Float32Array) -> Float32Array:
    """`colour` times 1 + each layer ``[H, W]``: float32 ``[H, W, 3]``."""
    image = np.ones((*layers[0].shape, 3), np.float32) * np.asarray(colour, np.float32)
    for layer in layers:
        image *= (1 + layer)[..., None]
    return image


def random_colour(rng: Rng, low: float = 40, high: float = 225, saturation: float = 0.8) -> Colour:
    """A colour between two levels; `saturation` 0 is grey."""
    c = rng.uniform(low, high, 3)
    c = c.mean() + saturation * (c - c.mean())
    return float(c[0]), float(c[1]), float(c[2])


def wall_colour(rng: Rng) -> Colour:
    """What people paint walls and doors with: light, and close to white, cream, sage, sky or rose."""
    tones = ((232, 226, 212), (226, 214, 190), (204, 214, 196), (198, 212, 222), (226, 204, 196), (214, 210, 204))
    base = np.asarray(tones[int(rng.integers(len(tones)))]) + rng.uniform(-9, 9, 3)
    return float(base[0]), float(base[1]), float(base[2])


def cloth_colour(rng: Rng) -> Colour:
    """Muted colours of upholstery and paintwork."""
    tones = (
        (96, 110, 128),
        (150, 84, 66),
        (88, 112, 88),
        (176, 158, 128),
        (112, 88, 104),
        (66, 78, 92),
        (182, 140, 70),
    )
    base = np.asarray(tones[int(rng.integers(len(tones)))]) * rng.uniform(0.85, 1.15) + rng.uniform(-12, 12, 3)
    return float(base[0]), float(base[1]), float(base[2])


def shift(colour: Colour, factor: float) -> Colour:
    """`colour` made darker (below 1) or lighter."""
    return tuple(float(min(max(c * factor, 0), 255)) for c in colour)  # type: ignore[return-value]


def wood(rng: Rng, colour: Colour, size: int = 512) -> ImageArray:
    """Grain along u, with rings and pores."""
    bend = noise(rng, size, size, (3, 1), 4)
    v = np.linspace(0, 1, size, dtype=np.float32)[:, None]
    rings = np.sin(2 * np.pi * (6 * v + 0.55 * bend)).astype(np.float32)
    pores = noise(rng, size, size, (size // 8, 6), 3, 0.8)
    streak = noise(rng, size, size, (24, 2), 3)
    dark = np.minimum(pores + 1.2, 0) * 0.16
    return to_image(tinted(colour, 0.07 * rings, 0.07 * streak, 0.04 * pores + dark, 0.05 * bend))


def planks(rng: Rng, colour: Colour, rows: int = 22, size: int = 2048) -> ImageArray:
    """A whole floor of boards, each cut from another place of the wood and stained another way."""
    base = wood(rng, colour, 1024).astype(np.float32)
    floor = np.zeros((size, size, 3), np.float32)
    edges = np.linspace(0, size, rows + 1).astype(int)
    for y0, y1 in pairwise(edges):
        x = -int(rng.integers(0, 500))
        while x < size:
            length = int(rng.integers(330, 620))
            a, b = max(x, 0), min(x + length, size)
            if b > a:
                oy, ox = int(rng.integers(0, 1024 - (y1 - y0))), int(rng.integers(0, 1024 - (b - a)))
                board = base[oy : oy + y1 - y0, ox : ox + b - a] * rng.uniform(0.78, 1.14)
                floor[y0:y1, a:b] = board * (1 + rng.uniform(-0.03, 0.03, 3))
                floor[y0:y1, b - 2 : b] *= 0.5
                for _ in range(int(rng.integers(0, 3))):
                    _knot(rng, floor[y0:y1, a:b])
            x += length
        floor[y0 : y0 + 2] *= 0.5
    wear = noise(rng, size, size, (5, 5), 7, 0.7)
    return to_image(floor * (1 + 0.06 * wear)[..., None])


def _knot(rng: Rng, board: Float32Array) -> None:
    """Darkens an elliptic knot of `board` in place."""
    h, w = board.shape[:2]
    y, x = np.mgrid[0:h, 0:w].astype(np.float32)
    r = rng.uniform(4, 11)
    d = np.hypot((x - rng.uniform(0, w)) / (1.7 * r), (y - rng.uniform(0, h)) / r)
    board *= (1 - 0.45 * np.exp(-d * d) * (0.7 + 0.3 * np.cos(9 * d)))[..., None]


def plaster(rng: Rng, colour: Colour, height: int = 1024, width: int = 2048) -> ImageArray:
    """A painted wall: faint roller marks, smudges and a few scuffs and nail holes."""
    broad, fine = noise(rng, height, width, (3, 6), 4), noise(rng, height, width, (128, 256), 3)
    image = tinted(colour, 0.018 * broad, 0.012 * fine)
    for _ in range(70):
        x, y = int(rng.integers(0, width)), int(rng.integers(0, height))
        shade = float(rng.uniform(0.72, 0.95))
        size = (int(rng.integers(1, 9)), int(rng.integers(1, 4)))
        cv2.ellipse(image, (x, y), size, float(rng.uniform(0, 180)), 0, 360, shift(colour, shade), -1, cv2.LINE_AA)
    return to_image(image)


def wallpaper(rng: Rng, colour: Colour, height: int = 1024, width: int = 2048) -> ImageArray:
    """Stripes and flowers on a grid, hand-printed: no two flowers are quite alike, and the paper has aged."""
    image = tinted(colour, 0.02 * noise(rng, height, width, (64, 128), 3))
    ink, second = shift(colour, float(rng.uniform(0.6, 0.82))), random_colour(rng, 120, 235, 0.5)
    step = int(rng.choice([64, 96, 128]))
    if rng.random() < 0.6:
        for x in range(0, width, step):
            cv2.line(image, (x, 0), (x, height), shift(colour, 0.86), int(step * 0.3), cv2.LINE_AA)
    petals = int(rng.integers(4, 8))
    for row, y in enumerate(range(step // 2, height, step)):
        for x in range(step // 2 + (row % 2) * step // 2, width, step):
            _flower(rng, image, (x, y), step * 0.3, petals, ink, second)
    age = noise(rng, height, width, (4, 8), 7, 0.75)
    return to_image(image * (1 + 0.035 * age)[..., None])


def _flower(
    rng: Rng, image: Float32Array, at: tuple[int, int], r: float, petals: int, ink: Colour, second: Colour
) -> None:
    turn = rng.uniform(0, 360)
    for k in range(petals):
        a = np.radians(turn + 360 * k / petals)
        length = r * rng.uniform(0.75, 1.1)
        centre = (int(at[0] + 0.55 * length * np.cos(a)), int(at[1] + 0.55 * length * np.sin(a)))
        axes = (max(int(0.5 * length), 1), max(int(0.2 * r), 1))
        cv2.ellipse(
            image, centre, axes, float(np.degrees(a)), 0, 360, shift(ink, rng.uniform(0.85, 1.2)), -1, cv2.LINE_AA
        )
    cv2.circle(image, at, max(int(r * 0.24), 1), second, -1, cv2.LINE_AA)


def bricks(rng: Rng, colour: Colour, height: int = 1024, width: int = 2048) -> ImageArray:
    """A brick wall; each brick has its own colour and wear."""
    image = tinted((196, 190, 180), 0.05 * noise(rng, height, width, (128, 256), 3))
    bh, bw = 32, 96
    for row, y in enumerate(range(0, height, bh)):
        for x in range(-bw + (row % 2) * bw // 2, width, bw):
            c = np.asarray(shift(colour, float(rng.uniform(0.65, 1.2)))) + rng.uniform(-14, 14, 3)
            a, b = (x + 3 + int(rng.integers(0, 3)), y + 3), (x + bw - 2, y + bh - 2 - int(rng.integers(0, 2)))
            cv2.rectangle(image, a, b, tuple(float(v) for v in c), -1)
    rough = noise(rng, height, width, (48, 96), 5, 0.8)
    return to_image(image * (1 + 0.09 * rough)[..., None])


def tiles(rng: Rng, colour: Colour, size: int = 2048, count: int = 14) -> ImageArray:
    """Marbled floor tiles with joints."""
    vein = np.minimum(np.abs(noise(rng, size, size, (9, 9), 7, 0.6)), np.float32(0.8))
    image = tinted(colour, np.asarray(0.13 * vein - 0.1, np.float32), 0.03 * noise(rng, size, size, (256, 256), 2))
    edges = np.linspace(0, size, count + 1).astype(int)
    for y0, y1 in pairwise(edges):
        for x0, x1 in pairwise(edges):
            image[y0:y1, x0:x1] *= rng.uniform(0.86, 1.08)
            image[y0 : y0 + 3, x0:x1] *= 0.62
            image[y0:y1, x0 : x0 + 3] *= 0.62
    return to_image(image)


def rug(rng: Rng, height: int = 512, width: int = 1024) -> ImageArray:
    """A woven rug: borders and rows of diamonds, with uneven dye and a pile."""
    ground, ink, third = cloth_colour(rng), cloth_colour(rng), random_colour(rng, 150, 235, 0.4)
    image = np.ones((height, width, 3), np.float32) * np.asarray(ground, np.float32)
    for k, inset in enumerate((14, 34, 58)):
        colour = (ink, third, ink)[k]
        cv2.rectangle(image, (inset, inset), (width - inset, height - inset), colour, 8 - 2 * k)
    for y in range(100, height - 80, 64):
        for x in range(100, width - 80, 64):
            r = int(rng.integers(16, 29))
            diamond = np.array([[x - r, y], [x, y - r], [x + r, y], [x, y + r]], np.int32)
            cv2.fillPoly(image, [diamond], shift(ink if rng.random() < 0.6 else third, float(rng.uniform(0.75, 1.2))))
            cv2.circle(image, (x, y), max(r // 3, 2), cloth_colour(rng), -1)
    pile = noise(rng, height, width, (height // 4, width // 4), 2)
    return to_image(image * (1 + 0.1 * pile + 0.07 * noise(rng, height, width, (6, 12), 5))[..., None])


def fabric(rng: Rng, colour: Colour, pattern: str = "plain", size: int = 512) -> ImageArray:
    """Cloth with a weave; `pattern` is plain, check, dots, stripes or leaves."""
    image = np.ones((size, size, 3), np.float32) * np.asarray(colour, np.float32)
    ink = random_colour(rng, 60, 225, 0.6)
    if pattern == "check":
        for x in range(0, size, 64):
            image[:, x : x + 26] = 0.55 * image[:, x : x + 26] + 0.45 * np.asarray(ink, np.float32)
            image[x : x + 26] = 0.55 * image[x : x + 26] + 0.45 * np.asarray(ink, np.float32)
            image[x + 40 : x + 44] *= 0.7
    elif pattern == "stripes":
        for x in range(0, size, 32):
            image[:, x : x + int(rng.integers(6, 22))] = shift(ink, float(rng.uniform(0.7, 1.2)))
    elif pattern == "dots":
        for _ in range(150):
            at = (int(rng.integers(0, size)), int(rng.integers(0, size)))
            cv2.circle(image, at, int(rng.integers(4, 17)), shift(ink, float(rng.uniform(0.7, 1.2))), -1, cv2.LINE_AA)
    elif pattern == "leaves":
        for _ in range(110):
            at = (int(rng.integers(0, size)), int(rng.integers(0, size)))
            leaf = shift(ink if rng.random() < 0.7 else cloth_colour(rng), float(rng.uniform(0.6, 1.2)))
            axes = (int(rng.integers(10, 34)), int(rng.integers(3, 10)))
            cv2.ellipse(image, at, axes, float(rng.uniform(0, 180)), 0, 360, leaf, -1, cv2.LINE_AA)
    weave, fold = noise(rng, size, size, (size // 3, size // 3), 1), noise(rng, size, size, (5, 5), 5, 0.6)
    return to_image(image * (1 + 0.09 * weave + 0.07 * fold)[..., None])


def speckle(rng: Rng, colour: Colour, contrast: float = 0.05, size: int = 256) -> ImageArray:
    """Plastic, metal, ceramic or paint: nearly plain."""
    return to_image(tinted(colour, contrast * noise(rng, size, size, (4, 4), 6, 0.7)))


def vessel(rng: Rng, colour: Colour, size: int = 256) -> ImageArray:
    """Glazed ceramic with painted bands and blots, for cups, vases, bowls and pots."""
    image = np.ones((size, size, 3), np.float32) * np.asarray(colour, np.float32)
    ink = random_colour(rng, 30, 230)
    for _ in range(int(rng.integers(1, 5))):
        y = int(rng.integers(10, size - 10))
        cv2.line(image, (0, y), (size, y), shift(ink, float(rng.uniform(0.6, 1.2))), int(rng.integers(2, 16)))
    for _ in range(int(rng.integers(5, 40))):
        at = (int(rng.integers(0, size)), int(rng.integers(0, size)))
        axes = (int(rng.integers(3, 18)), int(rng.integers(3, 18)))
        cv2.ellipse(image, at, axes, float(rng.uniform(0, 180)), 0, 360, random_colour(rng), -1, cv2.LINE_AA)
    return to_image(image * (1 + 0.03 * noise(rng, size, size, (4, 4), 5))[..., None])


PATTERNS = ("plain", "check", "dots", "stripes", "leaves")
Painter = Callable[[Rng], ImageArray]
