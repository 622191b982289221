"""Textures with content: paintings, book covers, screens, labels, posters and the like."""

from __future__ import annotations

import cv2
import numpy as np

from semdb.recordings.synthetic.textures import Colour, Rng, noise, random_colour, shift, tinted, to_image
from semdb.types import Float32Array, ImageArray

_GRID = np.random.default_rng(20).random((40, 9)).argsort(axis=1)[:, :4]  # 40 made-up letters of four points each


def letter(image: Float32Array, k: int, x: float, y: float, w: float, h: float, colour: Colour, thickness: int) -> None:
    """Draws made-up letter `k` in a box. Own strokes: OpenCV's fonts differ from one version to the next."""
    cells = _GRID[k % len(_GRID)]
    points = np.stack([x + w * (cells % 3) / 2, y + h * (cells // 3) / 2], axis=1)
    cv2.polylines(image, [np.rint(points).astype(np.int32)], False, colour, thickness)


def write(
    rng: Rng, image: Float32Array, x: int, y: int, width: int, height: int, colour: Colour, words: int = 1
) -> None:
    """Writes made-up words in a box of `image`, in place."""
    lengths = rng.integers(3, 9, words)
    step = min(width / (int(lengths.sum()) + words - 1), 0.7 * height)
    thickness = max(round(0.16 * step / 0.7), 1)
    at = float(x)
    for length in lengths:
        for k in rng.integers(0, len(_GRID), length):
            letter(image, int(k), at, y + 0.12 * height, 0.7 * step, min(0.76 * height, 2 * step), colour, thickness)
            at += step
        at += step


def _blank(colour: Colour, height: int, width: int) -> Float32Array:
    return np.ones((height, width, 3), np.float32) * np.asarray(colour, np.float32)


def landscape(rng: Rng, height: int = 512, width: int = 512) -> ImageArray:
    """Sky with clouds and sun, ridges one behind the other, trees and houses."""
    skies = (((96, 146, 206), (206, 222, 236)), ((120, 110, 150), (242, 190, 140)), ((150, 170, 186), (226, 228, 226)))
    chosen = skies[int(rng.integers(len(skies)))]
    top, low = np.asarray(chosen[0]) + rng.uniform(-15, 15, 3), np.asarray(chosen[1]) + rng.uniform(-12, 12, 3)
    y = np.linspace(0, 1, height, dtype=np.float32)[:, None, None]
    image = np.broadcast_to((1 - y) * top + y * low, (height, width, 3)).astype(np.float32)
    image = np.ascontiguousarray(image + 24 * np.maximum(noise(rng, height, width, (4, 3), 6), 0)[..., None])
    cv2.circle(
        image, (int(rng.integers(width)), int(height * rng.uniform(0.1, 0.3))), 34, (250, 240, 190), -1, cv2.LINE_AA
    )
    grounds = ((86, 118, 70), (128, 116, 78), (96, 104, 110), (150, 130, 96))
    ground = np.asarray(grounds[int(rng.integers(len(grounds)))]) + rng.uniform(-14, 14, 3)
    rough = noise(rng, height, width, (24, 24), 5, 0.8)
    for k in range(5):
        line = height * (0.35 + 0.13 * k) + 0.07 * height * noise(rng, 1, width, (1, 3 + k), 6)[0]
        below = np.arange(height, dtype=np.float32)[:, None] > line[None]
        colour = ground * (1.25 - 0.16 * k) + (4 - k) * 12
        image = np.where(below[..., None], colour * (1 + 0.12 * rough)[..., None], image).astype(np.float32)
        for _ in range(int(rng.integers(6, 16))):
            x = int(rng.integers(width))
            _tree_or_house(rng, image, x, int(line[x]), int(height * (0.02 + 0.02 * k)), k)
    return to_image(image)


def _tree_or_house(rng: Rng, image: Float32Array, x: int, y: int, s: int, k: int) -> None:
    s = max(s, 4)
    if rng.random() < 0.3:
        wall = random_colour(rng, 150, 240, 0.4)
        cv2.rectangle(image, (x - s, y - s), (x + s, y + s // 2), wall, -1)
        roof = np.array([[x - s - 3, y - s], [x, y - 2 * s], [x + s + 3, y - s]], np.int32)
        cv2.fillPoly(image, [roof], shift(random_colour(rng, 60, 180), 0.8), cv2.LINE_AA)
        cv2.rectangle(image, (x - s // 2, y - s // 2), (x - s // 4, y), shift(wall, 0.4), -1)
        return
    leaf = shift((60, 120, 50), float(rng.uniform(0.5, 1.3)))
    cv2.line(image, (x, y + s // 2), (x, y - s), (70, 50, 35), max(s // 6, 1))
    for _ in range(5):
        at = (x + int(rng.integers(-s, s)) // 2, y - s + int(rng.integers(-s, s)) // 2)
        cv2.circle(
            image, at, int(s * rng.uniform(0.3, 0.6)), shift(leaf, float(rng.uniform(0.7, 1.3))), -1, cv2.LINE_AA
        )


def abstract(rng: Rng, height: int = 512, width: int = 512) -> ImageArray:
    """Overlapping polygons, discs and strokes."""
    image = _blank(random_colour(rng, 150, 240, 0.4), height, width)
    tones = [random_colour(rng, 20, 240) for _ in range(6)]
    for _ in range(int(rng.integers(35, 75))):
        at = np.array([rng.integers(width), rng.integers(height)])
        size, colour = (
            int(height * rng.uniform(0.02, 0.22)),
            shift(tones[int(rng.integers(6))], float(rng.uniform(0.8, 1.2))),
        )
        style = rng.random()
        if style < 0.4:
            corners = (at + rng.integers(-size, size + 1, (int(rng.integers(3, 6)), 2))).astype(np.int32)
            cv2.fillPoly(image, [corners], colour, cv2.LINE_AA)
        elif style < 0.7:
            cv2.circle(image, (int(at[0]), int(at[1])), size // 2 + 2, colour, int(rng.choice([-1, 3, 7])), cv2.LINE_AA)
        else:
            end = at + rng.integers(-2 * size, 2 * size + 1, 2)
            line = ((int(at[0]), int(at[1])), (int(end[0]), int(end[1])))
            cv2.line(image, line[0], line[1], colour, int(rng.integers(2, 14)), cv2.LINE_AA)
    return to_image(image * (1 + 0.06 * noise(rng, height, width, (64, 64), 3, 0.9))[..., None])


def portrait(rng: Rng, height: int = 512, width: int = 512) -> ImageArray:
    """Painterly strokes that follow a swirl: a close-up of flowers, or weather."""
    flow = noise(rng, height, width, (2, 2), 3)
    hue = noise(rng, height, width, (3, 3), 4)
    a, b, c = (np.asarray(random_colour(rng, 20, 245), np.float32) for _ in range(3))
    mix = 1 / (1 + np.exp(-2.5 * hue))[..., None]
    image = np.asarray(a * mix + b * (1 - mix), np.float32)
    for _ in range(900):
        x, y = int(rng.integers(width)), int(rng.integers(height))
        angle, length = float(flow[y, x]) * 2.2, rng.uniform(8, 26)
        end = (int(x + length * np.cos(angle)), int(y + length * np.sin(angle)))
        colour = image[y, x] * rng.uniform(0.7, 1.35) + c * rng.uniform(0, 0.25)
        cv2.line(image, (x, y), end, tuple(float(v) for v in colour), int(rng.integers(2, 6)), cv2.LINE_AA)
    return to_image(image)


def poster(rng: Rng, height: int = 512, width: int = 512) -> ImageArray:
    """A picture with a title and small print."""
    image = _blank(random_colour(rng, 150, 245), height, width)
    art = landscape(rng, height, width) if rng.random() < 0.5 else abstract(rng, height, width)
    box = slice(int(0.2 * height), int(0.78 * height)), slice(int(0.08 * width), int(0.92 * width))
    image[box] = art[box]
    ink = random_colour(rng, 10, 90)
    write(rng, image, int(0.08 * width), int(0.03 * height), int(0.84 * width), int(0.14 * height), ink, 2)
    for k in range(4):
        y = int((0.81 + 0.04 * k) * height)
        write(rng, image, int(0.08 * width), y, int(0.8 * width), int(0.035 * height), shift(ink, 1.3), 6)
    return to_image(image)


def painting(rng: Rng) -> ImageArray:
    """One of the four kinds of pictures."""
    kinds = (landscape, abstract, portrait, poster)
    return kinds[int(rng.integers(len(kinds)))](rng)


def book(rng: Rng) -> ImageArray:
    """Left half: the spine, to be read upwards on a standing book. Right half: the cover."""
    colour, ink = random_colour(rng, 30, 230), random_colour(rng, 150, 250)
    if sum(colour) > 400:
        ink = shift(ink, 0.25)
    strip = _blank(colour, 128, 256)
    for x in rng.integers(8, 248, int(rng.integers(1, 4))):
        cv2.line(strip, (int(x), 0), (int(x), 128), shift(ink, float(rng.uniform(0.6, 1.1))), int(rng.integers(2, 9)))
    write(rng, strip, int(rng.integers(14, 40)), 30, 170, 64, ink, int(rng.integers(1, 3)))
    cover = _blank(colour, 256, 128)
    write(rng, cover, 8, 16, 112, 34, ink, 1)
    write(rng, cover, 8, 226, 100, 18, ink, 2)
    cover[70:210, 14:114] = cv2.resize(
        abstract(rng, 256, 256) if rng.random() < 0.6 else landscape(rng, 256, 256), (100, 140)
    )
    image = np.concatenate([cv2.rotate(strip, cv2.ROTATE_90_COUNTERCLOCKWISE), cover], axis=1)
    return to_image(image * (1 + 0.05 * noise(rng, 256, 256, (32, 32), 4, 0.8))[..., None])


def pages(rng: Rng) -> ImageArray:
    """The edge of a book's pages."""
    lines = noise(rng, 128, 128, (64, 1), 1)
    return to_image(tinted((225, 216, 192), 0.1 * lines))


def screen(rng: Rng, height: int = 256, width: int = 512) -> ImageArray:
    """A desktop: windows with text and pictures."""
    image = landscape(rng, height, width).astype(np.float32) * 0.8
    for _ in range(int(rng.integers(2, 4))):
        w, h = int(width * rng.uniform(0.3, 0.55)), int(height * rng.uniform(0.4, 0.7))
        x, y = int(rng.integers(8, width - w - 8)), int(rng.integers(8, height - h - 12))
        paper = (245.0, 245.0, 242.0) if rng.random() < 0.6 else (34.0, 38.0, 46.0)
        image[y : y + h, x : x + w] = paper
        cv2.rectangle(image, (x, y), (x + w, y + 10), random_colour(rng, 60, 200), -1)
        for line in range(y + 16, y + h - 8, 9):
            ink = shift(paper, 0.2) if paper[0] > 99 else random_colour(rng, 120, 240)
            indent = int(rng.integers(0, 4)) * 8
            write(
                rng, image, x + 6 + indent, line, int((w - 46) * rng.uniform(0.5, 1)), 8, ink, int(rng.integers(2, 6))
            )
    return to_image(image)


def keyboard(rng: Rng, height: int = 128, width: int = 512) -> ImageArray:
    """Keys in rows, with letters."""
    image = _blank((38, 38, 42), height, width)
    key = shift((215, 215, 210), 1.0) if rng.random() < 0.5 else (70.0, 70.0, 76.0)
    ink = (30.0, 30.0, 30.0) if key[0] > 100 else (230.0, 230.0, 230.0)
    for row in range(5):
        x = 6
        while x < width - 30:
            w = int(rng.choice([26, 26, 26, 26, 40, 60]))
            cv2.rectangle(image, (x, 5 + 24 * row), (min(x + w - 4, width - 6), 24 + 24 * row), key, -1)
            letter(image, int(rng.integers(40)), x + 5, 9 + 24 * row, 7, 10, ink, 1)
            x += w
    return to_image(image)


def clock_face(rng: Rng, size: int = 256) -> ImageArray:
    """Dial, numbers and hands."""
    image, c = _blank((240, 238, 228), size, size), size // 2
    ink = shift(random_colour(rng, 10, 100), 0.7)
    cv2.circle(image, (c, c), int(0.48 * size), random_colour(rng, 30, 160), 12, cv2.LINE_AA)
    for hour in range(12):
        a = np.radians(30 * (hour + 1) - 90)
        x, y = c + 0.36 * size * np.cos(a), c + 0.36 * size * np.sin(a)
        letter(image, hour, x - 7, y - 10, 14, 20, ink, 2)
    for length, thickness in ((0.2, 7), (0.31, 4)):
        a = rng.uniform(0, 2 * np.pi)
        end = (int(c + length * size * np.cos(a)), int(c + length * size * np.sin(a)))
        cv2.line(image, (c, c), end, ink, thickness, cv2.LINE_AA)
    return to_image(image)


def label(rng: Rng, glass: Colour, size: int = 256) -> ImageArray:
    """A bottle's side, with a label around most of it."""
    image = tinted(glass, 0.06 * noise(rng, size, size, (3, 6), 5))
    paper, ink = random_colour(rng, 140, 245), random_colour(rng, 10, 110)
    y0, y1 = int(size * 0.3), int(size * 0.85)
    image[y0:y1, 10 : size - 10] = paper
    for k in range(2):
        x = 14 + k * size // 2
        write(rng, image, x, y0 + 8, size // 2 - 26, 44, ink, 1)
        cv2.circle(image, (x + 50, y0 + 82), 24, random_colour(rng), -1, cv2.LINE_AA)
        for line in range(3):
            write(rng, image, x, y0 + 108 + 9 * line, size // 2 - 30, 9, ink, 3)
    return to_image(image)


def door_of_fridge(rng: Rng, height: int = 1024, width: int = 512) -> ImageArray:
    """White enamel with notes, photographs and magnets."""
    image = tinted((226, 227, 224), 0.015 * noise(rng, height, width, (6, 3), 6))
    for _ in range(int(rng.integers(6, 11))):
        w, h = int(rng.integers(60, 130)), int(rng.integers(60, 130))
        x, y = int(rng.integers(20, width - w - 20)), int(rng.integers(40, int(height * 0.6)))
        if rng.random() < 0.5:
            image[y : y + h, x : x + w] = cv2.resize(painting(rng), (w, h), interpolation=cv2.INTER_AREA)
        else:
            image[y : y + h, x : x + w] = random_colour(rng, 180, 252)
            for line in range(y + 14, y + h - 12, 13):
                write(rng, image, x + 6, line, int((w - 14) * rng.uniform(0.6, 1)), 12, (50, 50, 70), 3)
        cv2.circle(image, (x + w // 2, y + 4), 8, random_colour(rng), -1, cv2.LINE_AA)
    cv2.line(image, (0, int(height * 0.68)), (width, int(height * 0.68)), (120, 120, 120), 6)
    return to_image(image)


def panelled(
    rng: Rng,
    colour: Colour,
    height: int = 1024,
    width: int = 512,
    rows: int = 2,
    cols: int = 2,
    knobs: bool = True,
) -> ImageArray:
    """A door or a cupboard's front: framed panels in painted wood."""
    grain = noise(rng, height, width, (4, 48), 4, 0.8)
    image = tinted(colour, 0.05 * grain, 0.02 * noise(rng, height, width, (4, 4), 6))
    for r in range(rows):
        for c in range(cols):
            x0, x1 = int((c + 0.13) * width / cols), int((c + 0.87) * width / cols)
            y0, y1 = int((r + 0.1) * height / rows), int((r + 0.9) * height / rows)
            cv2.rectangle(image, (x0, y0), (x1, y1), shift(colour, 0.7), 5)
            cv2.rectangle(image, (x0 + 9, y0 + 9), (x1 - 9, y1 - 9), shift(colour, 1.12), 3)
            if knobs:
                cv2.circle(image, (x1 - 18, (y0 + y1) // 2), 9, (90, 80, 60), -1, cv2.LINE_AA)
    return to_image(image)


def window(rng: Rng, height: int = 512, width: int = 512) -> ImageArray:
    """What is seen through a window: a bright landscape behind bars."""
    image = landscape(rng, height, width).astype(np.float32) * 0.6 + 100
    for k in range(3):
        x, y = int(k * (width - 1) / 2), int(k * (height - 1) / 2)
        cv2.line(image, (x, 0), (x, height), (236, 234, 228), 26)
        cv2.line(image, (0, y), (width, y), (236, 234, 228), 20)
    return to_image(image)
