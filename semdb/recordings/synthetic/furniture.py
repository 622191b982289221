"""Furniture made of primitives.

Frames: x to the right, y to the front, z up; origin at the back or the centre of the base, as each says.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from semdb.recordings.synthetic import pictures, textures
from semdb.recordings.synthetic.scene import Material, Prim, Texture, ball, box, cylinder
from semdb.recordings.synthetic.textures import Colour, Rng, cloth_colour, random_colour, shift
from semdb.types import ImageArray


class Palette:
    """The materials of one room. Woods and fabrics are shared, so that furniture matches; pictures are unique."""

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        woods = ((158, 112, 70), (196, 158, 112), (110, 72, 46), (216, 190, 152), (140, 100, 76))
        chosen = rng.permutation(len(woods))
        grain = [textures.wood(rng, woods[k]) for k in chosen[:3]]
        upright = [Texture(np.ascontiguousarray(np.rot90(g))) for g in grain]
        self.wood = [Material(Texture(g), metres=0.7, upright=u) for g, u in zip(grain, upright, strict=True)]
        fabrics = [textures.fabric(rng, cloth_colour(rng), str(p)) for p in rng.permutation(textures.PATTERNS)]
        self.cloth = [self.repeat(f, 0.45) for f in fabrics]
        self.white = self.repeat(textures.speckle(rng, (222, 220, 214), 0.02), 0.5)
        self.dark = self.repeat(textures.speckle(rng, (44, 44, 48), 0.07), 0.5)
        self.metal = self.repeat(textures.speckle(rng, (150, 152, 156), 0.08), 0.4)
        self.paper = Material(Texture(pictures.pages(rng)))
        self.pots = [Material(Texture(textures.vessel(rng, random_colour(rng, 70, 235)))) for _ in range(7)]
        self.books = [Texture(pictures.book(rng), wrap=False) for _ in range(26)]
        self.bottles = [Material(Texture(pictures.label(rng, random_colour(rng, 30, 150)))) for _ in range(4)]
        leaf = textures.speckle(rng, (70 + 40 * rng.random(), 112 + 40 * rng.random(), 58), 0.22)
        self.leaf = Material(Texture(leaf))

    @staticmethod
    def repeat(image: ImageArray, metres: float) -> Material:
        """A repeating material, `metres` from one repetition to the next."""
        return Material(Texture(image), metres=metres)

    def once(self, painter: Callable[[Rng], ImageArray], emissive: bool = False) -> Material:
        """A picture made for one face."""
        return Material(Texture(painter(self.rng), wrap=False), emissive=emissive)

    def pick(self, materials: list[Material]) -> Material:
        """One of several, from another place of its texture when that repeats."""
        material = materials[int(self.rng.integers(len(materials)))]
        return material.moved(*self.rng.random(2)) if material.metres else material


def _legs(width: float, depth: float, height: float, thick: float, material: Material, y: float = 0.0) -> list[Prim]:
    x, d = (width - thick) / 2, (depth - thick) / 2
    return [box((sx * x, y + sy * d, 0), (thick, thick, height), material) for sx in (-1, 1) for sy in (-1, 1)]


def chair(p: Palette, wood: Material, seat: Material) -> list[Prim]:
    """Origin at the centre; its back is at -y."""
    prims = _legs(0.42, 0.42, 0.44, 0.04, wood)
    prims.append(box((0, 0, 0.43), (0.44, 0.44, 0.05), seat))
    prims += [box((x, -0.2, 0.48), (0.04, 0.04, 0.46), wood) for x in (-0.2, 0.2)]
    prims.append(box((0, -0.2, 0.62), (0.36, 0.03, 0.29), seat))
    return prims


def table(width: float, depth: float, height: float, wood: Material, top: Material | None = None) -> list[Prim]:
    """Origin at the centre."""
    prims = _legs(width - 0.08, depth - 0.08, height - 0.04, 0.06, wood)
    prims.append(box((0, 0, height - 0.04), (width, depth, 0.04), wood, top=top or wood))
    prims.append(box((0, 0, height - 0.11), (width - 0.16, depth - 0.16, 0.07), wood))
    return prims


def couch(p: Palette, cloth: Material, cushions: Material, width: float) -> list[Prim]:
    """Origin at the middle of its back."""
    prims = [box((0, 0.45, 0.06), (width, 0.88, 0.22), cloth), box((0, 0.12, 0.28), (width, 0.22, 0.54), cloth)]
    prims += [box((s * (width / 2 - 0.09), 0.47, 0.28), (0.18, 0.82, 0.32), cloth) for s in (-1, 1)]
    seats = 3 if width > 1.8 else 2
    seat = (width - 0.4) / seats
    for k in range(seats):
        x = -width / 2 + 0.2 + (k + 0.5) * seat
        prims.append(box((x, 0.54, 0.28), (seat - 0.02, 0.64, 0.15), cloth.moved(0.2 * k, 0.1)))
        if p.rng.random() < 0.75:
            turn = (-0.3, 0, float(p.rng.uniform(-0.3, 0.3)))
            prims.append(ball((x + p.rng.uniform(-0.08, 0.08), 0.37, 0.62), (0.22, 0.09, 0.21), cushions, turn))
    return prims


def bed(p: Palette, wood: Material, cover: Material, sheet: Material) -> list[Prim]:
    """Head at the back."""
    prims = [box((0, 1.02, 0.05), (1.46, 2.0, 0.25), wood), box((0, 0.03, 0), (1.5, 0.06, 1.0), wood)]
    prims += [box((0, 1.02, 0.3), (1.4, 1.94, 0.2), sheet), box((0, 1.35, 0.32), (1.48, 1.35, 0.21), cover)]
    prims += [ball((x, 0.34, 0.55), (0.31, 0.2, 0.11), sheet) for x in (-0.34, 0.34)]
    return prims


def cabinet(p: Palette, width: float, depth: float, height: float, wood: Material, doors: Material) -> list[Prim]:
    """A closed cupboard with a front of doors."""
    return [
        box((0, depth / 2, 0.06), (width, depth, height - 0.09), wood, front=doors),
        box((0, depth / 2, 0), (width - 0.06, depth - 0.06, 0.06), p.dark),
        box((0, depth / 2 + 0.01, height - 0.03), (width + 0.02, depth + 0.02, 0.03), wood),
    ]


def shelf(p: Palette, width: float, height: float, boards: int, wood: Material) -> list[Prim]:
    """An open bookcase, 0.32 m deep, with `boards` boards."""
    depth = 0.32
    prims = [box((s * (width / 2 - 0.015), depth / 2, 0), (0.03, depth, height), wood) for s in (-1, 1)]
    prims.append(box((0, 0.01, 0), (width, 0.02, height), wood))
    for k in range(boards):
        z = 0.05 + k * (height - 0.08) / (boards - 1)
        prims.append(box((0, depth / 2, z), (width - 0.06, depth, 0.03), wood))
    return prims


def refrigerator(p: Palette) -> list[Prim]:
    door = p.once(pictures.door_of_fridge)
    handle = box((-0.28, 0.7, 0.9), (0.025, 0.04, 0.5), p.metal)
    return [box((0, 0.34, 0.02), (0.7, 0.66, 1.76), p.white, front=door), handle]


def oven(p: Palette) -> list[Prim]:
    prims = [box((0, 0.3, 0), (0.6, 0.6, 0.88), p.white), box((0, 0.605, 0.2), (0.5, 0.02, 0.42), p.dark)]
    prims.append(cylinder((-0.22, 0.64, 0.68), 0.012, 0.44, p.metal, turn=(0, np.pi / 2, 0)))
    prims += [
        cylinder((x, 0.6, 0.79), 0.022, 0.025, p.dark, turn=(-np.pi / 2, 0, 0)) for x in np.linspace(-0.2, 0.2, 5)
    ]
    prims += [cylinder((x, y, 0.88), 0.09, 0.008, p.dark) for x in (-0.15, 0.15) for y in (0.16, 0.44)]
    return prims


def microwave(p: Palette) -> list[Prim]:
    body = p.white if p.rng.random() < 0.5 else p.metal
    return [
        box((0, 0, 0.01), (0.48, 0.34, 0.27), body),
        box((-0.06, 0.172, 0.04), (0.32, 0.006, 0.2), p.dark),
        box((0.17, 0.172, 0.04), (0.1, 0.006, 0.2), p.once(pictures.keyboard)),
    ]


def tv(p: Palette, width: float) -> list[Prim]:
    """A flat screen on a foot, showing a picture; origin at the centre."""
    screen = p.once(pictures.landscape if p.rng.random() < 0.6 else pictures.abstract, emissive=True)
    h = width * 0.58
    prims = [box((0, 0, 0), (width * 0.4, 0.18, 0.015), p.dark), box((0, 0, 0.01), (0.06, 0.04, 0.08), p.dark)]
    prims.append(box((0, 0, 0.08), (width, 0.05, h), p.dark))
    prims.append(box((0, 0.026, 0.1), (width - 0.04, 0.004, h - 0.04), p.dark, front=screen))
    return prims


def laptop(p: Palette) -> list[Prim]:
    body = p.metal if p.rng.random() < 0.6 else p.dark
    keys, screen = p.once(pictures.keyboard), p.once(pictures.screen, emissive=True)
    lid = box((0, -0.1, 0.015), (0.33, 0.008, 0.22), body, (0.3, 0, 0), front=screen)
    base = [box((0, 0, 0), (0.33, 0.23, 0.016), body), box((0, -0.02, 0.016), (0.29, 0.11, 0.002), body, top=keys)]
    return [*base, lid]


def keyboard(p: Palette) -> list[Prim]:
    return [box((0, 0, 0), (0.44, 0.14, 0.022), p.dark, top=p.once(pictures.keyboard))]


def mouse(p: Palette) -> list[Prim]:
    return [ball((0, 0, 0.012), (0.03, 0.055, 0.022), p.dark if p.rng.random() < 0.5 else p.white)]


def cup(p: Palette, glaze: Material) -> list[Prim]:
    turn = float(p.rng.uniform(0, 2 * np.pi))
    handle = box((0.052 * np.cos(turn), 0.052 * np.sin(turn), 0.025), (0.03, 0.012, 0.05), glaze, (0, 0, turn))
    return [cylinder((0, 0, 0), 0.034, 0.1, glaze, 0.043, (0, 0, turn), cap=p.dark), handle]


def bottle(p: Palette, side: Material) -> list[Prim]:
    turn = (0, 0, float(p.rng.uniform(0, 2 * np.pi)))
    body = cylinder((0, 0, 0), 0.042, 0.19, side, turn=turn, cap=p.dark)
    return [body, cylinder((0, 0, 0.19), 0.042, 0.05, p.dark, 0.016), cylinder((0, 0, 0.24), 0.016, 0.06, p.dark)]


def wine_glass(p: Palette) -> list[Prim]:
    red = Material(p.metal.texture, 0.4, tint=(0.75, 0.35, 0.4))
    prims = [cylinder((0, 0, 0), 0.036, 0.006, p.metal), cylinder((0, 0, 0.006), 0.005, 0.08, p.metal)]
    return [*prims, cylinder((0, 0, 0.085), 0.018, 0.09, red, 0.04, cap=p.dark)]


def bowl(p: Palette, glaze: Material) -> list[Prim]:
    return [cylinder((0, 0, 0), 0.06, 0.075, glaze, 0.13, (0, 0, float(p.rng.uniform(0, 6))), cap=p.dark)]


def fruit(p: Palette, colour: Colour) -> list[Prim]:
    skin = Material(Texture(textures.speckle(p.rng, colour, 0.14)))
    return [ball((0, 0, 0.037), (0.039, 0.039, 0.037), skin)]


def vase(p: Palette, glaze: Material) -> list[Prim]:
    """Belly, neck and a bunch of flowers."""
    prims = [cylinder((0, 0, 0), 0.05, 0.12, glaze, 0.085), cylinder((0, 0, 0.12), 0.085, 0.1, glaze, 0.035)]
    colour = random_colour(p.rng, 90, 245)
    petal = Material(Texture(textures.speckle(p.rng, colour, 0.2)))
    for _ in range(7):
        dx, dy = p.rng.uniform(-0.1, 0.1, 2)
        z = 0.22 + p.rng.uniform(0.06, 0.17)
        prims.append(cylinder((0, 0, 0.2), 0.004, z - 0.19, p.leaf, turn=(-dy / z * 2.6, dx / z * 2.6, 0)))
        prims.append(ball((dx, dy, z), (0.034, 0.034, 0.027), petal, tuple(p.rng.uniform(-0.6, 0.6, 3))))
    return prims


def plant(p: Palette, glaze: Material, size: float) -> list[Prim]:
    """A pot with leaves, `size` metres high."""
    r, h = 0.18 * size, 0.3 * size
    prims = [cylinder((0, 0, 0), 0.75 * r, h, glaze, r, cap=Material(p.leaf.texture, tint=(0.5, 0.35, 0.25)))]
    bushy = bool(p.rng.random() < 0.5)
    for k in range(44 if bushy else 22):
        yaw, lift = 2.4 * k + p.rng.uniform(-0.3, 0.3), p.rng.uniform(0.1, 1.3)
        length = size * (p.rng.uniform(0.06, 0.1) if bushy else p.rng.uniform(0.16, 0.26))
        z = h + size * p.rng.uniform(0.02, 0.55 if bushy else 0.4)
        reach = (
            size * p.rng.uniform(0.02, 0.2) * (1.3 - (z - h) / size) if bushy else 0.7 * length * np.cos(lift) + 0.02
        )
        rise = 0.2 * length if bushy else 0.7 * length * np.sin(lift)
        centre = (float(reach * np.cos(yaw)), float(reach * np.sin(yaw)), float(z + rise))
        shade = float(p.rng.uniform(0.65, 1.2))
        leaf = Material(p.leaf.texture, tint=(shade, shade, shade * 0.9))
        wide = 0.042 * size if bushy else 0.03 * size + 0.008
        prims.append(ball(centre, (float(length), wide, 0.006), leaf, _turn(float(yaw), float(lift))))
    prims.append(cylinder((0, 0, h), 0.015 * size, 0.5 * size, p.wood[0]))
    return prims


def _turn(yaw: float, lift: float) -> tuple[float, float, float]:
    """Rotation vector that lifts the x axis by `lift` and then turns it by `yaw`."""
    from scipy.spatial.transform import Rotation

    v = Rotation.from_euler("zy", [yaw, -lift]).as_rotvec()
    return float(v[0]), float(v[1]), float(v[2])


def standing_books(p: Palette, width: float) -> list[tuple[list[Prim], float]]:
    """Books side by side, spines to the front: each with the x of its centre, from 0 to `width`."""
    books: list[tuple[list[Prim], float]] = []
    x = 0.0
    while True:
        thick, high, deep = p.rng.uniform(0.018, 0.052), p.rng.uniform(0.17, 0.27), p.rng.uniform(0.14, 0.21)
        if x + thick > width:
            return books
        texture = p.books[int(p.rng.integers(len(p.books)))]
        spine, cover = Material(texture, rect=(0, 0, 0.5, 1)), Material(texture, rect=(0.5, 0, 0.5, 1))
        prim = box((0, deep / 2, 0), (thick, deep, high), cover, front=spine, top=p.paper, back=p.paper, bottom=p.paper)
        books.append(([prim], x + thick / 2))
        x += thick + 0.002


def lying_book(p: Palette) -> list[Prim]:
    texture = p.books[int(p.rng.integers(len(p.books)))]
    spine, cover = Material(texture, rect=(0, 0, 0.5, 1)), Material(texture, rect=(0.5, 0, 0.5, 1))
    size = (p.rng.uniform(0.14, 0.19), p.rng.uniform(0.2, 0.26), p.rng.uniform(0.02, 0.045))
    return [box((0, 0, 0), size, p.paper, top=cover, bottom=cover, left=spine)]


def remote(p: Palette) -> list[Prim]:
    return [box((0, 0, 0), (0.05, 0.18, 0.02), p.dark, top=p.once(pictures.keyboard))]


def cell_phone(p: Palette) -> list[Prim]:
    return [
        box((0, 0, 0), (0.075, 0.15, 0.009), p.dark, top=p.once(lambda r: pictures.screen(r, 256, 256), emissive=True))
    ]


def toaster(p: Palette) -> list[Prim]:
    slots = [box((0, y, 0.19), (0.2, 0.03, 0.004), p.dark) for y in (-0.035, 0.035)]
    return [box((0, 0, 0.01), (0.29, 0.17, 0.18), p.metal), *slots, box((0.15, 0, 0.1), (0.02, 0.04, 0.02), p.dark)]


def teddy_bear(p: Palette) -> list[Prim]:
    fur = Material(Texture(textures.speckle(p.rng, shift((176, 124, 76), float(p.rng.uniform(0.7, 1.25))), 0.16)))
    prims = [ball((0, 0, 0.13), (0.11, 0.09, 0.13), fur), ball((0, 0.01, 0.31), (0.085, 0.08, 0.08), fur)]
    prims += [ball((s * 0.065, 0, 0.38), (0.032, 0.018, 0.032), fur) for s in (-1, 1)]
    prims += [ball((s * 0.12, 0.05, 0.19), (0.075, 0.037, 0.037), fur, (0, 0.4 * s, 0.5 * s)) for s in (-1, 1)]
    prims += [ball((s * 0.075, 0.13, 0.045), (0.045, 0.1, 0.045), fur) for s in (-1, 1)]
    prims += [ball((s * 0.03, 0.083, 0.325), (0.01, 0.01, 0.01), p.dark) for s in (-1, 1)]
    return [*prims, ball((0, 0.085, 0.29), (0.035, 0.025, 0.025), p.white)]


def sports_ball(p: Palette) -> list[Prim]:
    skin = Material(Texture(textures.vessel(p.rng, random_colour(p.rng, 120, 240))))
    return [ball((0, 0, 0.12), (0.12, 0.12, 0.12), skin, tuple(p.rng.uniform(-1, 1, 3)))]


def suitcase(p: Palette) -> list[Prim]:
    shell = p.pick(p.cloth)
    prims = [box((0, 0, 0.05), (0.46, 0.25, 0.66), shell), box((0, 0.128, 0.2), (0.36, 0.01, 0.3), p.dark)]
    prims += [box((x, -0.08, 0.71), (0.02, 0.02, 0.26), p.metal) for x in (-0.1, 0.1)]
    prims += [ball((x, y, 0.03), (0.03, 0.02, 0.03), p.dark) for x in (-0.19, 0.19) for y in (-0.09, 0.09)]
    return [*prims, box((0, -0.08, 0.96), (0.24, 0.03, 0.03), p.dark)]


def backpack(p: Palette) -> list[Prim]:
    cloth, pocket = p.pick(p.cloth), p.pick(p.cloth)
    prims = [ball((0, 0, 0.24), (0.17, 0.13, 0.25), cloth), box((0, 0, 0), (0.3, 0.2, 0.28), cloth)]
    return [*prims, box((0, 0.11, 0.04), (0.22, 0.06, 0.17), pocket), box((0, 0, 0.47), (0.06, 0.02, 0.06), p.dark)]


def bench(p: Palette, wood: Material) -> list[Prim]:
    prims = _legs(1.16, 0.34, 0.42, 0.05, wood, 0.19)
    return [*prims, box((0, 0.19, 0.42), (1.2, 0.38, 0.045), wood)]


def clock(p: Palette) -> list[Prim]:
    """A wall clock: a disc that faces the front."""
    face = Material(Texture(pictures.clock_face(p.rng), wrap=False))
    return [cylinder((0, 0.0, 0), 0.17, 0.04, p.dark, turn=(-np.pi / 2, 0, 0), cap=face)]


def picture(p: Palette, width: float, height: float) -> list[Prim]:
    """A framed picture; its back touches y = 0, origin at the centre."""
    frame, art = p.pick(p.wood), p.once(pictures.painting)
    prims = [box((0, 0.012, -height / 2), (width, 0.024, height), frame)]
    return [*prims, box((0, 0.024, 0.04 - height / 2), (width - 0.08, 0.006, height - 0.08), p.white, front=art)]


def lamp(p: Palette, height: float) -> list[Prim]:
    """A standing lamp with a bright shade."""
    shade = Material(Texture(textures.fabric(p.rng, (244, 230, 196), "plain")), emissive=True)
    prims = [cylinder((0, 0, 0), 0.14, 0.03, p.dark), cylinder((0, 0, 0.03), 0.012, height - 0.3, p.metal)]
    return [*prims, cylinder((0, 0, height - 0.3), 0.2, 0.3, shade, 0.12)]
