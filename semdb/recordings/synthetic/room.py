"""A furnished room: which furniture, where it stands, what lies on it, and what a second visit finds moved."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from semdb.recordings.synthetic import furniture, pictures, textures
from semdb.recordings.synthetic.furniture import Palette
from semdb.recordings.synthetic.scene import ROOM, Item, Material, Prim, Spot, Texture, box, yaw_pose
from semdb.recordings.synthetic.small import SMALL, make_small
from semdb.recordings.synthetic.textures import Rng
from semdb.types import FloatArray

WALLS = ("+x", "-x", "+y", "-y")
_WALL_YAW = (np.pi / 2, -np.pi / 2, np.pi, 0.0)
Rect = tuple[float, float, float, float]  # x0, y0, x1, y1 in metres


@dataclass(slots=True, eq=False)
class Room:
    """World frame: origin in the middle of the floor, z up, metres."""

    size: tuple[float, float, float]
    clear: tuple[float, float]  # centre of the part of the floor that is kept free
    items: list[Item] = field(default_factory=list)
    solid: list[Rect] = field(default_factory=list)  # footprints
    wall_use: list[tuple[int, float, float, float, float]] = field(default_factory=list)  # wall, s0, s1, z0, z1
    windows: list[tuple[FloatArray, float, float]] = field(
        default_factory=list
    )  # pose (y into the room), width, height

    def classes(self) -> dict[int, str]:
        """Category of each label."""
        return {item.label: item.category for item in self.items if item.category is not None}

    def add(self, category: str | None, prims: list[Prim], pose: FloatArray, radius: float = 0.1) -> Item:
        """Adds an object; those with a category get the next label."""
        label = 1 + max((i.label for i in self.items), default=0) if category else 0
        self.items.append(Item(category, prims, pose, radius, label))
        return self.items[-1]

    def along_wall(self, wall: int, s: float, inset: float = 0.0, z: float = 0.0) -> FloatArray:
        """The pose at `s` along a wall (from its middle), `inset` metres from it, facing the room."""
        x, y = self.size[0] / 2 - inset, self.size[1] / 2 - inset
        at = ((x, s), (-x, -s), (-s, y), (s, -y))[wall]
        return yaw_pose(at[0], at[1], z, _WALL_YAW[wall])

    def wall_length(self, wall: int) -> float:
        return self.size[1] if wall < 2 else self.size[0]


def rect_of(pose: FloatArray, width: float, depth: float) -> Rect:
    """Footprint of what stands at `pose` with its back (y = 0) on it; `pose` is turned by quarter turns."""
    corners = pose[:2, :2] @ np.array([[-width / 2, width / 2], [0, depth]]) + pose[:2, 3:4]
    (x0, x1), (y0, y1) = np.sort(corners, axis=1)
    return float(x0), float(y0), float(x1), float(y1)


def overlaps(a: Rect, b: Rect, gap: float = 0.0) -> bool:
    """Whether two footprints are nearer than `gap`."""
    return a[0] < b[2] + gap and b[0] < a[2] + gap and a[1] < b[3] + gap and b[1] < a[3] + gap


def _disc_overlaps(rect: Rect, centre: tuple[float, float], radius: float) -> bool:
    dx = centre[0] - min(max(centre[0], rect[0]), rect[2])
    dy = centre[1] - min(max(centre[1], rect[1]), rect[3])
    return bool(np.hypot(dx, dy) < radius)


def build_room(room_seed: int, furniture_seed: int | None = None, desks: int = 0) -> Room:
    """The room of a seed, as a first visit finds it.

    With `furniture_seed` its furniture and pictures are those of another seed, with `desks` it has so many equal
    workplaces (as far as there is place) and no other furniture.
    """
    rng = np.random.default_rng([room_seed, 1])
    palette = Palette(rng)
    width, depth, height = rng.uniform(5.4, 6.6), rng.uniform(4.9, 5.9), rng.uniform(2.5, 2.8)
    corner = rng.choice([-1, 1], 2)
    room = Room((float(width), float(depth), float(height)), (float(-0.55 * corner[0]), float(-0.4 * corner[1])))
    _shell(room, palette, rng)
    _door_and_windows(room, palette, rng)
    if furniture_seed is not None:
        rng = np.random.default_rng([furniture_seed, 6])
        palette = Palette(rng)
    if desks:
        _equal_desks(room, palette, rng, desks)
        return room
    _dining(room, palette, rng, corner)
    chosen = [f for f in _FURNITURE if rng.random() < f.chance]
    for kind in chosen:
        _place(room, palette, rng, kind)
    _on_walls(room, palette, rng)
    return room


def _shell(room: Room, p: Palette, rng: Rng) -> None:
    """Floor, ceiling and four walls: wallpaper or bricks on some, paint on the others; a skirting board and a rug."""
    w, d, h = room.size
    tone = [textures.wall_colour(rng) for _ in range(3)]
    plain = [Material(Texture(textures.plaster(rng, tone[k]), wrap=False)) for k in range(2)]
    accent = textures.bricks(rng, (172, 96, 74)) if rng.random() < 0.3 else textures.wallpaper(rng, tone[2])
    paper = Material(Texture(accent, wrap=False))
    walls = [plain[0], plain[1], paper, plain[0]]
    order = rng.permutation(4)
    style = rng.random()
    if style < 0.6:
        floor = textures.planks(rng, ((150, 104, 66), (188, 148, 104), (112, 76, 52))[int(rng.integers(3))])
    elif style < 0.8:
        floor = textures.tiles(rng, textures.shift(textures.wall_colour(rng), 0.8))
    else:
        floor = np.tile(
            textures.fabric(rng, textures.shift(textures.cloth_colour(rng), 1.1), "leaves", 2048), (1, 1, 1)
        )
    ceiling = Material(Texture(textures.speckle(rng, (236, 234, 228), 0.012, 512)), metres=2.0)
    faces = (*(walls[k] for k in order), ceiling, Material(Texture(floor, wrap=False)))
    room.add(None, [Prim(ROOM, yaw_pose(0, 0, h / 2), (w / 2, d / 2, h / 2), 0.0, faces)], np.eye(4))
    skirting = []
    for wall in range(4):
        pose = room.along_wall(wall, 0.0)
        board = box((0, 0.008, 0), (room.wall_length(wall), 0.016, 0.09), p.white)
        skirting.append(Prim(board.kind, pose @ board.pose, board.half, 0.0, board.faces))
    room.add(None, skirting, np.eye(4))
    rug = Material(Texture(textures.rug(rng), wrap=False))
    turn = float(rng.choice([0, np.pi / 2]) + rng.uniform(-0.15, 0.15))
    rug_prim = box((0, 0, 0), (2.3, 1.5, 0.012), rug)
    room.add(None, [rug_prim], yaw_pose(room.clear[0] * 1.4, room.clear[1] * 1.4, 0, turn))
    lamp = Material(Texture(textures.speckle(rng, (255, 252, 240), 0.0)), emissive=True)
    room.add(None, [box((0, 0, h - 0.05), (1.2, 0.35, 0.05), p.white, bottom=lamp)], np.eye(4))


def _door_and_windows(room: Room, p: Palette, rng: Rng) -> None:
    walls = rng.permutation(4)
    door = p.once(lambda r: pictures.panelled(r, textures.wall_colour(r), rows=3, knobs=False))
    s = float(rng.uniform(-0.25, 0.25) * room.wall_length(walls[0]))
    pose = room.along_wall(int(walls[0]), s)
    frame = box((0, 0.02, 0), (1.0, 0.04, 2.08), p.white)
    room.add(None, [frame, box((0, 0.045, 0), (0.86, 0.02, 2.02), p.white, front=door)], pose)
    room.add(None, [cylinder_handle(p)], pose)
    room.wall_use.append((int(walls[0]), s - 0.5, s + 0.5, 0.0, 2.1))
    room.solid.append(rect_of(pose, 1.0, 0.05))
    for wall in walls[1 : 2 + int(rng.integers(1, 3))]:
        width, height, low = float(rng.uniform(1.1, 1.7)), float(rng.uniform(1.0, 1.25)), 0.98
        s = float(rng.uniform(-0.2, 0.2) * room.wall_length(wall))
        pose = room.along_wall(int(wall), s)
        view = p.once(pictures.window, emissive=True)
        prims = [box((0, 0.015, low), (width, 0.03, height), p.white, front=view)]
        prims.append(box((0, 0.07, low - 0.03), (width + 0.12, 0.14, 0.03), p.white))
        cloth = p.pick(p.cloth)
        prims += [box((k * (width / 2 + 0.12), 0.06, low - 0.3), (0.3, 0.05, height + 0.42), cloth) for k in (-1, 1)]
        room.add(None, prims, pose)
        room.wall_use.append((int(wall), s - width / 2 - 0.3, s + width / 2 + 0.3, low - 0.05, low + height + 0.2))
        room.windows.append((room.along_wall(int(wall), s, 0.1, low + height / 2), width, height))


def cylinder_handle(p: Palette) -> Prim:
    """A door's handle."""
    return box((0.36, 0.085, 1.02), (0.13, 0.02, 0.025), p.metal)


def _dining(room: Room, p: Palette, rng: Rng, corner: np.ndarray) -> None:
    """Dining table with chairs about it, in the corner that is not kept clear."""
    w, d, _ = room.size
    long, across = float(rng.uniform(1.2, 1.7)), float(rng.uniform(0.8, 0.95))
    x, y = corner[0] * (w / 2 - long / 2 - 0.75), corner[1] * (d / 2 - across / 2 - 0.72)
    wood = p.pick(p.wood)
    pose = yaw_pose(float(x), float(y), 0.0, float(rng.choice([0, np.pi])))
    room.add("dining table", furniture.table(long, across, 0.75, wood), pose, long / 2)
    room.solid.append((x - long / 2, y - across / 2, x + long / 2, y + across / 2))
    seat = [p.pick(p.cloth), p.pick(p.cloth)]
    sides = [(-long / 4, -across / 2, np.pi), (long / 4, -across / 2, np.pi), (-long / 4, across / 2, 0.0)]
    sides += [(long / 4, across / 2, 0.0), (-long / 2, 0.0, np.pi / 2), (long / 2, 0.0, -np.pi / 2)]
    order = rng.permutation(len(sides))[: int(rng.integers(3, 6))]
    for k in order:
        cx, cy, yaw = sides[k]
        out = float(rng.uniform(0.02, 0.2))
        at = pose @ yaw_pose(
            cx + out * np.sign(cx) * (k > 3), cy + out * np.sign(cy), 0, yaw + np.pi + rng.uniform(-0.2, 0.2)
        )
        room.add("chair", furniture.chair(p, wood, seat[int(rng.random() < 0.25)]), at, 0.3)
        room.solid.append((at[0, 3] - 0.25, at[1, 3] - 0.25, at[0, 3] + 0.25, at[1, 3] + 0.25))
    spot = Spot(pose @ yaw_pose(0, 0, 0.75), (long / 2 - 0.05, across / 2 - 0.05))
    wanted = ["cup", "cup", "bowl", "bottle", "vase", "wine glass", "book", "apple", "orange", "laptop", "banana"]
    scatter(room, p, rng, spot, [str(c) for c in rng.permutation(wanted)[: int(rng.integers(5, 9))]])


def scatter(room: Room, p: Palette, rng: Rng, spot: Spot, categories: list[str]) -> None:
    """Puts small objects on a surface where there is room; those that find none are left out."""
    for category in categories:
        radius = SMALL[category].radius
        place = free_place(rng, spot, radius)
        if place is None:
            continue
        x, y = place
        yaw = float(rng.uniform(-0.35, 0.35)) if SMALL[category].faces_front else float(rng.uniform(0, 2 * np.pi))
        item = room.add(category, make_small(p, category), spot.pose @ yaw_pose(x, y, 0.0, yaw), radius)
        item.spot, item.at = spot, (x, y)
        spot.items.append(item)


def free_place(rng: Rng, spot: Spot, radius: float) -> tuple[float, float] | None:
    """A place on a surface that is at least the sum of the radii from what lies there, or None."""
    hx, hy = max(spot.half[0] - radius, 0.0), max(spot.half[1] - min(radius, 0.12), 0.0)
    for _ in range(40):
        x, y = float(rng.uniform(-hx, hx)), float(rng.uniform(-hy, hy))
        if all(np.hypot(x - i.at[0], y - i.at[1]) > radius + i.radius for i in spot.items):
            return x, y
    return None


@dataclass(frozen=True, slots=True)
class Kind:
    """A piece of furniture that stands at a wall."""

    build: Callable[[Room, Palette, Rng, FloatArray, float], object]
    width: tuple[float, float]
    depth: float
    height: float
    chance: float


def _place(room: Room, p: Palette, rng: Rng, kind: Kind) -> None:
    """Finds a place at a wall and builds `kind` there; without a place the room does without it."""
    for _ in range(120):
        wall, width = int(rng.integers(4)), float(rng.uniform(*kind.width))
        limit = room.wall_length(wall) / 2 - width / 2 - 0.04
        s = float(rng.uniform(-limit, limit))
        if rng.random() < 0.4:
            s = float(np.sign(s) * limit)  # corners fill first, as in real rooms
        pose = room.along_wall(wall, s, 0.03)
        rect = rect_of(pose, width, kind.depth)
        if any(overlaps(rect, other, 0.05) for other in room.solid) or _disc_overlaps(rect, room.clear, 1.05):
            continue
        if any(
            u[0] == wall and s - width / 2 < u[2] and u[1] < s + width / 2 and kind.height > u[3] for u in room.wall_use
        ):
            continue
        kind.build(room, p, rng, pose, width)
        room.solid.append(rect)
        room.wall_use.append((wall, s - width / 2, s + width / 2, 0.0, kind.height))
        return


def _on_walls(room: Room, p: Palette, rng: Rng) -> None:
    """Pictures and perhaps a clock, where the wall is free."""
    count = int(rng.integers(6, 10))
    for k in range(count + 1):
        is_clock = k == 0
        if is_clock and rng.random() < 0.45:
            continue
        for _ in range(60):
            w, h = (0.36, 0.36) if is_clock else (float(rng.uniform(0.35, 1.0)), float(rng.uniform(0.35, 0.75)))
            wall, z = int(rng.integers(4)), 2.0 if is_clock else float(rng.uniform(1.35, 1.75))
            limit = room.wall_length(wall) / 2 - w / 2 - 0.15
            s = float(rng.uniform(-limit, limit))
            use = (wall, s - w / 2 - 0.1, s + w / 2 + 0.1, z - h / 2 - 0.06, z + h / 2 + 0.06)
            if any(
                u[0] == wall and u[1] < use[2] and use[1] < u[2] and u[3] < use[4] and use[3] < u[4]
                for u in room.wall_use
            ):
                continue
            room.wall_use.append(use)
            pose = room.along_wall(wall, s, 0.0, z)
            made = furniture.clock(p) if is_clock else furniture.picture(p, w, h)
            room.add("clock" if is_clock else None, made, pose).is_picture = not is_clock
            break


def _simple(
    category: str, make: Callable[[Palette], list[Prim]]
) -> Callable[[Room, Palette, Rng, FloatArray, float], None]:
    """Furniture that is one object and bears nothing."""

    def build(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
        room.add(category, make(p), pose, width / 2)

    return build


def _centred(category: str, make: Callable[[Palette], list[Prim]], depth: float) -> Callable[..., None]:
    """As `_simple`, for objects whose origin is their centre; turned a little."""

    def build(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
        turned = pose @ yaw_pose(0, depth / 2, 0, float(rng.uniform(-0.4, 0.4)))
        item = room.add(category, make(p), turned, width / 2)
        item.spot = Spot(pose @ yaw_pose(0, depth / 2, 0), (width / 2, depth / 2))

    return build


def _couch(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    room.add("couch", furniture.couch(p, p.pick(p.cloth), p.pick(p.cloth), width), pose, width / 2)
    if rng.random() < 0.6:
        spot = Spot(pose @ yaw_pose(0, 0.62, 0.43), (width / 2 - 0.3, 0.12))
        scatter(room, p, rng, spot, [str(rng.choice(["teddy bear", "remote", "book"]))])


def _bed(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    room.add("bed", furniture.bed(p, p.pick(p.wood), p.pick(p.cloth), p.white), pose, width / 2)
    if rng.random() < 0.5:
        spot = Spot(pose @ yaw_pose(0, 1.3, 0.53), (0.5, 0.4))
        scatter(room, p, rng, spot, ["teddy bear", "book"])


def _tv_corner(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    front = p.once(lambda r: pictures.panelled(r, textures.cloth_colour(r), 256, 512, 1, 3))
    room.add(None, furniture.cabinet(p, width, 0.42, 0.5, p.pick(p.wood), front), pose)
    spot = Spot(pose @ yaw_pose(0, 0.21, 0.5), (width / 2 - 0.02, 0.18))
    tv = room.add("tv", furniture.tv(p, float(rng.uniform(0.8, 1.05))), spot.pose @ yaw_pose(0, -0.02, 0), 0.45)
    tv.at = (0.0, 0.0)
    spot.items.append(tv)
    scatter(
        room, p, rng, spot, [str(c) for c in rng.choice(["vase", "remote", "cup", "potted plant", "book"], 3, False)]
    )


def _bookcase(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    height, boards = 1.9, int(rng.integers(5, 7))
    room.add(None, furniture.shelf(p, width, height, boards, p.pick(p.wood)), pose)
    for k in range(boards - 1):
        z = 0.08 + k * (height - 0.08) / (boards - 1)
        share = float(rng.uniform(0.2, 0.5))
        left = -width / 2 + 0.04
        for prims, x in furniture.standing_books(p, share * (width - 0.1)):
            at = pose @ yaw_pose(left + x, 0.31 - 2 * prims[0].half[1] - float(rng.uniform(0, 0.03)), z)
            room.add("book", prims, at, 0.05)
        rest = (1 - share) * (width - 0.1)
        spot = Spot(pose @ yaw_pose(width / 2 - 0.05 - rest / 2, 0.17, z), (rest / 2, 0.12))
        wanted = ["vase", "cup", "bowl", "bottle", "teddy bear", "book", "potted plant"]
        scatter(room, p, rng, spot, [str(c) for c in rng.choice(wanted, 2, False) if SMALL[str(c)].height < 0.33])


def _desk(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    wood = p.pick(p.wood)
    room.add(None, furniture.table(width, 0.66, 0.74, wood), pose @ yaw_pose(0, 0.34, 0))
    spot = Spot(pose @ yaw_pose(0, 0.34, 0.74), (width / 2 - 0.03, 0.3))
    if rng.random() < 0.6:
        screen = room.add("tv", furniture.tv(p, 0.56), spot.pose @ yaw_pose(0, -0.16, 0), 0.2)
        board = room.add("keyboard", furniture.keyboard(p), spot.pose @ yaw_pose(0, 0.16, 0, 0.06), 0.18)
        rat = room.add("mouse", furniture.mouse(p), spot.pose @ yaw_pose(0.32, 0.17, 0, 0.2), 0.06)
        for item, at in ((screen, (0.0, -0.16)), (board, (0.0, 0.16)), (rat, (0.32, 0.17))):
            item.at = at
            spot.items.append(item)
    else:
        scatter(room, p, rng, spot, ["laptop", "mouse"])
    wanted = ["cup", "book", "book", "cell phone", "bottle", "potted plant", "remote", "scissors"]
    scatter(room, p, rng, spot, [str(c) for c in rng.permutation(wanted)[:4]])
    place = pose @ yaw_pose(float(rng.uniform(-0.2, 0.2)), 0.86, 0, np.pi + float(rng.uniform(-0.5, 0.5)))
    room.add("chair", furniture.chair(p, wood, p.pick(p.cloth)), place, 0.3)


def _equal_desks(room: Room, p: Palette, rng: Rng, count: int) -> None:
    """Up to `count` workplaces that are alike to the last book: each is the first one, put elsewhere."""
    width = 1.4
    model = Room(room.size, room.clear)
    _desk(model, p, rng, np.eye(4), width)

    def put(target: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
        for item in model.items:
            target.add(item.category, item.prims, pose @ item.pose, item.radius)

    for _ in range(count):
        _place(room, p, rng, Kind(put, (width, width), 1.1, 0.75, 1.0))


def _counter(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    front = p.once(lambda r: pictures.panelled(r, textures.wall_colour(r), 512, 512, 1, 2))
    room.add(None, furniture.cabinet(p, width, 0.58, 0.9, p.white, front), pose)
    spot = Spot(pose @ yaw_pose(0, 0.29, 0.9), (width / 2 - 0.03, 0.24))
    wanted = [c for c in ("microwave", "toaster") if rng.random() < 0.65]
    wanted += [
        str(c) for c in rng.choice(["bottle", "bottle", "cup", "bowl", "wine glass", "banana", "orange"], 4, False)
    ]
    scatter(room, p, rng, spot, wanted)


def _sideboard(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    front = p.once(lambda r: pictures.panelled(r, textures.cloth_colour(r), 512, 512, 2, 2))
    room.add(None, furniture.cabinet(p, width, 0.42, 0.82, p.pick(p.wood), front), pose)
    spot = Spot(pose @ yaw_pose(0, 0.21, 0.82), (width / 2 - 0.02, 0.17))
    wanted = ["vase", "bowl", "bottle", "book", "wine glass", "potted plant", "cup", "teddy bear"]
    scatter(room, p, rng, spot, [str(c) for c in rng.permutation(wanted)[:5]])


def _plant(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    size = float(rng.uniform(0.9, 1.35))
    room.add("potted plant", furniture.plant(p, p.pick(p.pots), size), pose @ yaw_pose(0, 0.27, 0), 0.3)


def _lamp(room: Room, p: Palette, rng: Rng, pose: FloatArray, width: float) -> None:
    room.add(None, furniture.lamp(p, 1.6), pose @ yaw_pose(0, 0.22, 0))


_FURNITURE = (
    Kind(_bed, (1.52, 1.52), 2.1, 0.9, 0.35),
    Kind(_couch, (1.6, 2.1), 0.92, 0.85, 0.75),
    Kind(_bookcase, (0.8, 1.3), 0.33, 1.95, 0.8),
    Kind(_desk, (1.3, 1.5), 1.1, 0.75, 0.6),
    Kind(_simple("refrigerator", furniture.refrigerator), (0.72, 0.72), 0.72, 1.8, 0.45),
    Kind(_simple("oven", furniture.oven), (0.62, 0.62), 0.66, 0.9, 0.4),
    Kind(_counter, (1.1, 1.5), 0.6, 0.9, 0.55),
    Kind(_tv_corner, (1.3, 1.7), 0.45, 1.0, 0.75),
    Kind(_sideboard, (1.0, 1.4), 0.44, 0.84, 0.8),
    Kind(_sideboard, (0.8, 1.1), 0.44, 0.84, 0.35),
    Kind(_plant, (0.55, 0.55), 0.55, 0.9, 0.7),
    Kind(_plant, (0.55, 0.55), 0.55, 0.9, 0.4),
    Kind(
        lambda r, p, g, q, w: r.add("bench", furniture.bench(p, p.pick(p.wood)), q, 0.6), (1.22, 1.22), 0.4, 0.5, 0.35
    ),
    Kind(_lamp, (0.44, 0.44), 0.44, 1.6, 0.5),
    Kind(_centred("suitcase", furniture.suitcase, 0.34), (0.52, 0.52), 0.34, 0.7, 0.5),
    Kind(_centred("backpack", furniture.backpack, 0.36), (0.4, 0.4), 0.36, 0.5, 0.5),
    Kind(_centred("sports ball", furniture.sports_ball, 0.3), (0.3, 0.3), 0.3, 0.3, 0.5),
)
