"""Primitives with materials, and their packing into the arrays that the compiled renderer reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
import numpy.typing as npt

from semdb.geometry import pose_from, so3_exp, transform_points
from semdb.types import Float32Array, FloatArray, ImageArray

BOX, FRUSTUM, ELLIPSOID, ROOM = 0, 1, 2, 3  # as in kernels.py, which imports numba and is loaded only to render
MAX_LEVELS = 12
TEXEL = 0.08  # metres per texel of baked light
SMALL_RADIUS = 0.2  # metres: things up to that are small
BARE_GREY = np.array([196.0, 192.0, 186.0])
BARE_CONTRAST = 0.4
Int64Array = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """uint8 RGB image with sides that are powers of two; `wrap` repeats it, otherwise its border is continued."""

    image: ImageArray
    wrap: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class Material:
    """How a face looks. With `metres` the texture repeats at that size, else `rect` (u, v, du, dv) covers the face."""

    texture: Texture
    metres: float | None = None
    rect: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    emissive: bool = False
    upright: Texture | None = None  # taken instead by faces that are higher than wide: the grain of wood

    def moved(self, u: float, v: float) -> Material:
        """The same material from another place of its texture."""
        return replace(self, rect=(u, v, self.rect[2], self.rect[3]))


@dataclass(frozen=True, slots=True, eq=False)
class Prim:
    """A primitive in the frame of its object. `faces`: 6 of a box (+x, -x, +y, -y, +z, -z), else side, top, bottom."""

    kind: int
    pose: FloatArray  # [4, 4] metres
    half: tuple[float, float, float]
    top: float  # radius at the upper end of a frustum
    faces: tuple[Material, ...]  # 6


@dataclass(slots=True, eq=False)
class Item:
    """An object of the room (`category` None: part of the background) at `pose` ``[4, 4]`` in the world.

    `radius` is that of its footprint; `spot` the surface (and its host) on which it may be moved about.
    """

    category: str | None
    prims: list[Prim]
    pose: FloatArray
    radius: float = 0.1
    label: int = 0
    spot: Spot | None = None
    at: tuple[float, float] = (0.0, 0.0)
    is_picture: bool = False  # on a wall


def mirrored(items: Sequence[Item]) -> list[Item]:
    """`items` with every texture mirrored: the same shapes in the same colours, and yet nothing is the same."""
    known: dict[int, Texture] = {}

    def turn(texture: Texture) -> Texture:
        if id(texture) not in known:
            known[id(texture)] = replace(texture, image=np.ascontiguousarray(texture.image[:, ::-1]))
        return known[id(texture)]

    return _with_textures(items, turn)


def bare(items: Sequence[Item]) -> list[Item]:
    """As `plain`, without small things and other pictures, and in colours that differ little."""
    pictures = [item for item in items if item.is_picture]
    kept = [
        replace(item, prims=[]) if item in pictures[1:] or (item.category and item.radius <= SMALL_RADIUS) else item
        for item in items
    ]
    return plain(kept, contrast=BARE_CONTRAST)


def plain(items: Sequence[Item], contrast: float = 1.0) -> list[Item]:
    """`items` with every texture painted in its mean colour, but for those of the first picture on a wall.

    With less `contrast` (0..1) the colours are nearer to one grey.
    """
    pictures = [item for item in items if item.is_picture]
    kept = {id(face.texture) for item in pictures[:1] for prim in item.prims for face in prim.faces}
    known: dict[int, Texture] = {}

    def paint(texture: Texture) -> Texture:
        if id(texture) in kept:
            return texture
        if id(texture) not in known:
            mean = texture.image.reshape(-1, 3).mean(axis=0)
            colour = np.rint(BARE_GREY + contrast * (mean - BARE_GREY)).astype(np.uint8)
            known[id(texture)] = replace(texture, image=np.broadcast_to(colour, texture.image.shape).copy())
        return known[id(texture)]

    return _with_textures(items, paint)


def _with_textures(items: Sequence[Item], change: Callable[[Texture], Texture]) -> list[Item]:
    def look(material: Material) -> Material:
        upright = None if material.upright is None else change(material.upright)
        return replace(material, texture=change(material.texture), upright=upright)

    return [
        replace(item, prims=[replace(prim, faces=tuple(look(face) for face in prim.faces)) for prim in item.prims])
        for item in items
    ]


@dataclass(slots=True, eq=False)
class Spot:
    """A horizontal rectangle to put things on: `pose` of its centre, half sizes in metres."""

    pose: FloatArray
    half: tuple[float, float]
    items: list[Item] = field(default_factory=list)


def yaw_pose(x: float, y: float, z: float, yaw: float = 0.0) -> FloatArray:
    """A pose at (x, y, z), turned by `yaw` radians about z."""
    return pose_from(so3_exp([0, 0, yaw]), [x, y, z])


def box(
    at: Sequence[float], size: Sequence[float], material: Material, turn: Sequence[float] = (0, 0, 0), **faces: Material
) -> Prim:
    """A box with the centre of its base at `at`. `faces`: right, left, front, back, top, bottom (+x, -x, +y, ...)."""
    names = ("right", "left", "front", "back", "top", "bottom")
    rotation = so3_exp(turn)
    centre = np.asarray(at, np.float64) + rotation @ [0, 0, size[2] / 2]
    half = (size[0] / 2, size[1] / 2, size[2] / 2)
    return Prim(BOX, pose_from(rotation, centre), half, 0.0, tuple(faces.get(n, material) for n in names))


def cylinder(
    at: Sequence[float],
    radius: float,
    height: float,
    material: Material,
    top_radius: float | None = None,
    turn: Sequence[float] = (0, 0, 0),
    cap: Material | None = None,
) -> Prim:
    """A frustum with the centre of its base at `at`."""
    rotation = so3_exp(turn)
    centre = np.asarray(at, np.float64) + rotation @ [0, 0, height / 2]
    top = radius if top_radius is None else top_radius
    faces = (material, cap or material, *(material,) * 4)
    return Prim(FRUSTUM, pose_from(rotation, centre), (radius, radius, height / 2), top, faces)


def ball(
    centre: Sequence[float], radii: Sequence[float], material: Material, turn: Sequence[float] = (0, 0, 0)
) -> Prim:
    """An ellipsoid."""
    pose = pose_from(so3_exp(turn), np.asarray(centre, np.float64))
    return Prim(ELLIPSOID, pose, (radii[0], radii[1], radii[2]), 0.0, (material,) * 6)


@dataclass(frozen=True, slots=True, eq=False)
class PackedScene:
    """All primitives as arrays, `n` of them; `light` ``[texels, 3]`` is baked by `render.bake_light`."""

    kind: Int64Array  # [n]
    rotation: FloatArray  # [n, 3, 3] world to primitive
    centre: FloatArray  # [n, 3]
    half: FloatArray  # [n, 3]
    top: FloatArray  # [n]
    label: npt.NDArray[np.uint16]  # [n]
    corners: FloatArray  # [n, 8, 3] world, of the tightest box
    texture: Int64Array  # [n, 6]
    uv: FloatArray  # [n, 6, 4]
    light_map: Int64Array  # [n, 6, 3] offset (-1: emissive), columns, rows
    tint: FloatArray  # [n, 6, 3]
    mean: FloatArray  # [n, 6, 3] mean colour 0..1 of each face, for light that it reflects
    texels: ImageArray  # flat
    table: Int64Array  # [textures, 4 + MAX_LEVELS] width, height, levels, wrap, offset of each level
    light: Float32Array  # [texels, 3]


def _face_sizes(prim: Prim) -> list[tuple[float, float]]:
    """Width and height in metres of the six faces (those that do not exist: 0, 0)."""
    x, y, z = (2 * h for h in prim.half)
    if prim.kind in (BOX, ROOM):
        return [(y, z), (y, z), (x, z), (x, z), (x, y), (x, y)]
    if prim.kind == FRUSTUM:
        around = np.pi * (prim.half[0] + prim.top)
        return [(around, z), (2 * prim.top,) * 2, (x, x), (0, 0), (0, 0), (0, 0)]
    return [(np.pi * (x + y) / 2, np.pi * z / 2), (0, 0), (0, 0), (0, 0), (0, 0), (0, 0)]


def _pack_textures(textures: list[Texture]) -> tuple[ImageArray, Int64Array]:
    """Pyramids of all textures in one flat array, and the table that finds them."""
    table = np.zeros((len(textures), 4 + MAX_LEVELS), np.int64)
    parts: list[ImageArray] = []
    offset = 0
    for row, texture in zip(table, textures, strict=True):
        image = texture.image
        h, w = image.shape[:2]
        if w & (w - 1) or h & (h - 1) or w < 2 or h < 2:
            raise ValueError(f"texture of {w}x{h}: sides must be powers of two")
        levels = min(int(np.log2(min(w, h))) + 1, MAX_LEVELS)
        row[:4] = w, h, levels, texture.wrap
        for level in range(levels):
            row[4 + level] = offset
            parts.append(image.ravel())
            offset += image.size
            if level + 1 < levels:
                image = np.asarray(
                    cv2.resize(image, (image.shape[1] // 2, image.shape[0] // 2), interpolation=cv2.INTER_AREA),
                    np.uint8,
                ).reshape(image.shape[0] // 2, image.shape[1] // 2, 3)
    return np.concatenate(parts), table


def _corners(prim: Prim, pose: FloatArray) -> FloatArray:
    """World corners ``[8, 3]`` of the box about a primitive."""
    half = np.asarray(prim.half, np.float64)
    if prim.kind == FRUSTUM:
        half = np.array([max(half[0], prim.top)] * 2 + [half[2]])
    return transform_points(pose, np.array([[a, b, c] for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]) * half)


def pack(items: Sequence[Item]) -> PackedScene:
    """Packs the primitives of `items`; the baked light is still zero."""
    prims = [(prim, item.pose @ prim.pose, item.label) for item in items for prim in item.prims]
    n = len(prims)
    known: dict[int, int] = {}
    textures: list[Texture] = []
    index, uv = np.zeros((n, 6), np.int64), np.zeros((n, 6, 4))
    light_map, tint, mean = np.full((n, 6, 3), -1, np.int64), np.ones((n, 6, 3)), np.zeros((n, 6, 3))
    offset = 0
    for i, (prim, _, _) in enumerate(prims):
        for f, ((w, h), material) in enumerate(zip(_face_sizes(prim), prim.faces, strict=True)):
            if w <= 0:
                continue
            texture = material.upright if material.upright is not None and h > 1.5 * w else material.texture
            key = id(texture)
            if key not in known:
                known[key] = len(textures)
                textures.append(texture)
            index[i, f] = known[key]
            u, v, du, dv = material.rect
            ratio = texture.image.shape[1] / texture.image.shape[0]
            uv[i, f] = (u, v, w / material.metres / ratio, h / material.metres) if material.metres else (u, v, du, dv)
            tint[i, f] = material.tint
            if material.emissive:
                mean[i, f] = 1.0
                continue
            size = TEXEL if max(w, h) > 0.4 else TEXEL / 2
            columns, rows = int(np.clip(w / size, 2, 128)), int(np.clip(h / size, 2, 128))
            light_map[i, f] = offset, columns, rows
            offset += columns * rows
    texels, table = _pack_textures(textures)
    averages = np.array([t.image.reshape(-1, 3).mean(axis=0) / 255 for t in textures])
    mean = np.where(mean > 0, mean, averages[index] * tint) ** 2.2  # linear light
    return PackedScene(
        kind=np.array([p.kind for p, _, _ in prims], np.int64),
        rotation=np.array([pose[:3, :3].T for _, pose, _ in prims]),
        centre=np.array([pose[:3, 3] for _, pose, _ in prims]),
        half=np.array([p.half for p, _, _ in prims], np.float64),
        top=np.array([p.top for p, _, _ in prims], np.float64),
        label=np.array([label for _, _, label in prims], np.uint16),
        corners=np.array([_corners(prim, pose) for prim, pose, _ in prims]),
        texture=index,
        uv=uv,
        light_map=light_map,
        tint=tint,
        mean=mean,
        texels=texels,
        table=table,
        light=np.zeros((offset, 3), np.float32),
    )
