"""Baked light, culling and the call of the compiled renderer."""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt

from semdb.recordings.synthetic.scene import Int64Array, PackedScene
from semdb.types import Camera, Float32Array, FloatArray, ImageArray

AMBIENT_REACH = 0.9  # metres: nearer surfaces take away ambient light
DIRECTIONS = 32
LEAF = 4  # primitives
SOFT = 3.0  # texels of baked light
_EXPOSURE = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Lamp:
    """A rectangular light: `pose` with y as its normal, size in metres, linear colour."""

    pose: FloatArray
    width: float
    height: float
    colour: tuple[float, float, float]
    samples: tuple[int, int]


def _lamp_points(lamps: list[Lamp]) -> FloatArray:
    """Sample points ``[l, 9]``: position, normal, colour."""
    rows = []
    for lamp in lamps:
        nx, nz = lamp.samples
        for i in range(nx):
            for k in range(nz):
                local = [((i + 0.5) / nx - 0.5) * lamp.width, 0.0, ((k + 0.5) / nz - 0.5) * lamp.height]
                at = lamp.pose[:3, :3] @ local + lamp.pose[:3, 3]
                rows.append([*at, *lamp.pose[:3, 1], *(c / (nx * nz) for c in lamp.colour)])
    return np.array(rows, np.float64).reshape(-1, 9)


def _hemisphere(count: int) -> FloatArray:
    """Cosine-weighted directions about +z ``[count, 3]`` on a spiral."""
    k = np.arange(count) + 0.5
    r, angle = np.sqrt(k / count), k * 2.399963229728653
    return np.stack([r * np.cos(angle), r * np.sin(angle), np.sqrt(1 - r * r)], axis=1)


def _hierarchy(low: FloatArray, high: FloatArray) -> tuple[FloatArray, Int64Array, Int64Array]:
    """Bounding volume hierarchy by median splits: boxes ``[m, 6]``, links ``[m, 2]`` (first, count), order ``[n]``.

    A node with count 0 has its children at `first` and `first + 1`, others hold ``order[first : first + count]``.
    """
    order = np.arange(len(low))
    boxes: list[FloatArray] = [np.zeros(6)]
    links: list[tuple[int, int]] = [(0, 0)]
    todo = [(0, 0, len(low))]
    while todo:
        node, start, stop = todo.pop()
        ids = order[start:stop]
        boxes[node] = np.concatenate([low[ids].min(axis=0), high[ids].max(axis=0)])
        if stop - start <= LEAF:
            links[node] = (start, stop - start)
            continue
        centres = low[ids] + high[ids]
        axis = int(np.argmax(np.ptp(centres, axis=0)))
        order[start:stop] = ids[np.argsort(centres[:, axis], kind="stable")]
        middle, child = (start + stop) // 2, len(boxes)
        links[node] = (child, 0)
        boxes += [np.zeros(6), np.zeros(6)]
        links += [(0, 0), (0, 0)]
        todo += [(child, start, middle), (child + 1, middle, stop)]
    return np.array(boxes), np.array(links, np.int64), order.astype(np.int64)


def bake_light(scene: PackedScene, lamps: list[Lamp]) -> PackedScene:
    """`scene` with the light of `lamps`, their soft shadows and ambient occlusion. Depends on nothing that moves."""
    from semdb.recordings.synthetic import kernels_light

    boxes, links, order = _hierarchy(scene.corners.min(axis=1), scene.corners.max(axis=1))
    light = np.zeros(scene.light.shape, np.float64)
    world = (scene.kind, scene.rotation, scene.centre, scene.half, scene.top)
    mean = np.minimum(scene.mean, 1.0)
    directions = _hemisphere(DIRECTIONS)
    kernels_light.bake(
        boxes, links, order, world, scene.light_map, mean, _lamp_points(lamps), directions, AMBIENT_REACH, 0.85, light
    )
    # textures are kept as displayed (gamma 2.2), so light is brought to the same scale
    shown = (_EXPOSURE * light) ** (1 / 2.2)
    return replace(scene, light=shown.astype(np.float32))


def soften_light(scene: PackedScene) -> PackedScene:
    """`scene` with its baked light blurred on every face: what few directions leave of steps on it is no texture."""
    light = scene.light.copy()
    for offset, columns, rows in scene.light_map.reshape(-1, 3):
        if offset >= 0 and min(columns, rows) > 1:
            of_face = slice(offset, offset + columns * rows)
            face = np.ascontiguousarray(light[of_face].reshape(rows, columns, 3))
            soft = cv2.GaussianBlur(face, (0, 0), SOFT, borderType=cv2.BORDER_REFLECT)
            light[of_face] = soft.reshape(-1, 3)
    return replace(scene, light=light)


def _cull(scene: PackedScene, camera: Camera, pose: FloatArray, tile: int) -> tuple[Int64Array, Int64Array, FloatArray]:
    """Which primitives each tile of the image may show: ranges ``[rows, cols, 2]`` in ids, sorted by least depth.

    The third array ``[n, 5]`` holds least depth and the bounds of the rays, x0, x1, y0, y1, that can hit a primitive.
    """
    local = (scene.corners - pose[:3, 3]) @ pose[:3, :3]
    z = local[..., 2]
    rows, cols = -(-camera.height // tile), -(-camera.width // tile)
    zs = np.maximum(z, 0.02)
    crosses = (z.min(axis=1) < 0.02)[:, None]
    low = np.where(crosses, -np.inf, (local[..., :2] / zs[..., None]).min(axis=1))  # x, y of rays
    high = np.where(crosses, np.inf, (local[..., :2] / zs[..., None]).max(axis=1))
    margin = 1e-6
    near = np.column_stack([np.maximum(z.min(axis=1), 0), low[:, 0], high[:, 0], low[:, 1], high[:, 1]])
    near[:, [1, 3]] -= margin
    near[:, [2, 4]] += margin
    size = np.array([camera.width, camera.height])
    lens, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    first, last = np.clip(low * lens + middle - 1, -1, size), np.clip(high * lens + middle + 1, -1, size)
    seen = (z.max(axis=1) > 0) & (last >= 0).all(axis=1) & (first < size).all(axis=1)
    (c0, r0), (c1, r1) = (np.clip(e // tile, 0, [cols - 1, rows - 1]).T for e in (first, last))
    order = np.flatnonzero(seen)[np.argsort(near[seen, 0], kind="stable")]
    grid = np.zeros((rows, cols, len(order)), np.bool_)
    for k, i in enumerate(order):
        grid[int(r0[i]) : int(r1[i]) + 1, int(c0[i]) : int(c1[i]) + 1, k] = True
    counts = grid.sum(axis=2)
    stop = np.cumsum(counts.ravel()).reshape(rows, cols)
    tiles = np.stack([stop - counts, stop], axis=2).astype(np.int64)
    ids = np.broadcast_to(order, grid.shape)[grid].astype(np.int64)
    return tiles, ids, near


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What the renderer makes of one pose: all of the same pixel centres."""

    rgb: ImageArray  # [H, W, 3]
    depth: Float32Array  # [H, W] metres along z, 0 for none
    labels: npt.NDArray[np.uint16]  # [H, W]


def render_view(scene: PackedScene, camera: Camera, world_from_camera: FloatArray) -> View:
    """Renders `scene`, whose light is baked, for a pinhole `camera`. Releases the interpreter's lock while it works."""
    from semdb.recordings.synthetic import kernels

    tiles, ids, near = _cull(scene, camera, world_from_camera, kernels.TILE)
    origin = np.einsum("nij,nj->ni", scene.rotation, world_from_camera[:3, 3] - scene.centre)
    turn = np.ascontiguousarray(scene.rotation @ world_from_camera[:3, :3])
    rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
    depth = np.zeros((camera.height, camera.width))
    prims = np.full((camera.height, camera.width), -1, np.int32)
    solids = (scene.kind, scene.half, scene.top)
    looks = (scene.texture, scene.uv, scene.light_map, scene.tint, scene.texels, scene.table, scene.light)
    view = (tiles, ids, origin, turn, near, float(camera.fx), float(camera.cx), float(camera.cy), depth, prims)
    kernels.cast(*solids, *view)
    kernels.shade(*solids, *looks, *view, rgb)
    labels = np.where(prims >= 0, scene.label[np.maximum(prims, 0) // 8], 0).astype(np.uint16)
    return View(rgb, depth.astype(np.float32), labels)
