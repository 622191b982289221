"""A corridor of plain panels, tiles and doors, seen by a wide lens: hard for keypoints, and much of it is there twice.

``python -m bench.corridor DIR [SEED] [furnished]`` renders it as a recording, out and back, for
``SEMDB_DETECTOR=recorded SEMDB_ENCODER=gist semdb evaluate DIR --keyframes 20 --max-queries 80``. Without more it is
the same but for plates with names when one turns round in it. ``furnished`` has other measures with each seed, doors
that are not opposite each other, two different ends, lamps, some notices, fire extinguishers, a radiator and a bench.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from semdb.geometry import pose_from
from semdb.recordings.synthetic import furniture, pictures, sensor, textures
from semdb.recordings.synthetic.furniture import Palette
from semdb.recordings.synthetic.options import FRAME_RATE_HZ
from semdb.recordings.synthetic.render import Lamp, bake_light, render_view
from semdb.recordings.synthetic.room import Room
from semdb.recordings.synthetic.scene import ROOM, Material, Prim, Texture, box, cylinder, pack, yaw_pose
from semdb.recordings.synthetic.writer import SyntheticFrame, write_frames
from semdb.types import Camera, FloatArray

LENGTH, WIDTH, HEIGHT = 14.0, 2.0, 2.6  # metres
PANEL, TILE, GAP = 1.2, 0.6, 0.012
DOORS = 4  # on each side
FRAMES = 100
WIDE = 0.5  # fx / width: 90 degrees from left to right


def build(seed: int) -> Room:
    """White walls with joints every 1.2 m, a tiled floor, doors that are alike but for a plate with a name."""
    rng = np.random.default_rng([seed, 11])
    palette = Palette(rng)
    room = Room((LENGTH, WIDTH, HEIGHT), (0.0, 0.0))
    wall, floor, door, joint = (
        _paint(colour) for colour in ((226, 226, 222), (148, 146, 142), (170, 130, 92), (120, 120, 118))
    )
    faces = (wall, wall, wall, wall, wall, floor)
    half = (LENGTH / 2, WIDTH / 2, HEIGHT / 2)
    room.add(None, [Prim(ROOM, yaw_pose(0, 0, HEIGHT / 2), half, 0.0, faces)], np.eye(4))
    joints = []
    for x in np.arange(-LENGTH / 2 + TILE, LENGTH / 2, TILE):
        joints.append(box((x, 0, 0), (GAP, WIDTH, 0.002), joint))
        if round((x + LENGTH / 2) / TILE) % round(PANEL / TILE) == 0:
            joints += [box((x, side * WIDTH / 2, 0), (GAP, 0.006, HEIGHT), joint) for side in (-1, 1)]
    joints += [box((0, y, 0), (LENGTH, GAP, 0.002), joint) for y in np.arange(-WIDTH / 2 + TILE, WIDTH / 2, TILE)]
    room.add(None, joints, np.eye(4))
    for side in (2, 3):
        for k in range(DOORS):
            s = (k + 0.5) * LENGTH / DOORS - LENGTH / 2 + float(rng.uniform(-0.9, 0.9))
            pose = room.along_wall(side, s)
            plate = palette.once(lambda r: pictures.label(r, textures.random_colour(r, 30, 150)))
            room.add(
                None,
                [
                    box((0, 0.02, 0), (1.0, 0.04, 2.08), joint),
                    box((0, 0.045, 0), (0.86, 0.02, 2.02), door),
                    box((0.36, 0.085, 1.02), (0.13, 0.02, 0.025), palette.metal),
                    box((0.66, 0.01, 1.5), (0.16, 0.012, 0.12), palette.white, front=plate),
                ],
                pose,
            )
    end = room.along_wall(0, float(rng.uniform(-0.3, 0.3)))
    room.add(
        None, [box((0, 0.02, 0), (0.9, 0.04, 2.08), joint), box((0, 0.045, 0), (0.8, 0.02, 2.0), palette.white)], end
    )
    room.add(None, [box((0, 0.02, 0.9), (1.0, 0.04, 1.2), joint)], room.along_wall(1, 0.0))
    return room


def build_furnished(seed: int) -> Room:
    """The same kind of place as people have it: hardly anything of it is there twice, and yet most of it is plain."""
    rng = np.random.default_rng([seed, 14])
    palette = Palette(rng)
    size = float(rng.uniform(12, 16)), float(rng.uniform(1.8, 2.4)), float(rng.uniform(2.5, 2.7))
    room = Room(size, (0.0, 0.0))
    length, width, height = size
    white = int(rng.integers(214, 236))
    tone = (white, white, white - int(rng.integers(0, 14)))
    wall, floor, door, joint = (_paint(c) for c in (tone, (150, 146, 138), (150, 112, 78), (122, 122, 118)))
    faces = (wall, wall, wall, wall, wall, floor)
    room.add(None, [Prim(ROOM, yaw_pose(0, 0, height / 2), (length / 2, width / 2, height / 2), 0.0, faces)], np.eye(4))
    tile = float(rng.choice([0.5, 0.6]))
    joints = [box((x, 0, 0), (GAP, width, 0.002), joint) for x in np.arange(-length / 2 + tile, length / 2, tile)]
    joints += [box((0, y, 0), (length, GAP, 0.002), joint) for y in np.arange(-width / 2 + tile, width / 2, tile)]
    joints += [
        box((x, side * width / 2, 0), (GAP, 0.006, height), joint)
        for x in np.arange(-length / 2 + PANEL, length / 2, PANEL)
        for side in (-1, 1)
    ]
    joints += [box((0, side * width / 2, 0), (length, 0.03, 0.08), joint) for side in (-1, 1)]  # skirting boards
    room.add(None, joints, np.eye(4))
    lamp = Material(Texture(textures.speckle(rng, (255, 252, 240), 0.0)), emissive=True)
    for x in np.arange(-length / 2 + 1.5, length / 2, 3.0):
        room.add(None, [box((x, 0, height - 0.05), (1.2, 0.3, 0.05), palette.white, bottom=lamp)], np.eye(4))
    for side in (2, 3):
        places = _apart(rng, int(rng.integers(6, 9)), length - 1.2, 1.15)
        doors = set(rng.choice(len(places), int(rng.integers(2, 5)), replace=False).tolist())
        for k, s in enumerate(places):
            pose = room.along_wall(side, s)
            room.add(None, _door(palette, rng, door, joint) if k in doors else _on_wall(palette, rng), pose)
    glass = palette.once(pictures.window, emissive=True)
    pane = box((0, 0.015, 0.9), (width - 0.6, 0.03, 1.3), palette.white, front=glass)
    room.add(None, [pane], room.along_wall(0, 0.0))
    leaf = [box((x, 0.045, 0), (0.6, 0.02, 2.05), door) for x in (-0.31, 0.31)]
    sign = palette.once(lambda r: pictures.label(r, (40, 120, 60)))
    above = box((0, 0.03, 2.2), (0.4, 0.03, 0.18), palette.white, front=sign)
    way_out = [box((0, 0.02, 0), (1.3, 0.04, 2.1), joint), *leaf, above]
    room.add(None, way_out, room.along_wall(1, 0.0))
    return room


def _apart(rng: np.random.Generator, count: int, length: float, gap: float) -> list[float]:
    """Places along a wall, none nearer to another than `gap`, about its middle."""
    free = np.sort(rng.uniform(0, length - gap * (count - 1), count))
    return [float(s + gap * k - length / 2) for k, s in enumerate(free)]


def _door(palette: Palette, rng: np.random.Generator, leaf: Material, frame: Material) -> list[Prim]:
    """One with a plate beside it."""
    wide = float(rng.choice([0.76, 0.86]))
    plate = palette.once(lambda r: pictures.label(r, textures.random_colour(r, 30, 150)))
    side = float(rng.choice([-1, 1]))
    return [
        box((0, 0.02, 0), (wide + 0.14, 0.04, 2.08), frame),
        box((0, 0.045, 0), (wide, 0.02, 2.02), leaf),
        box((side * (wide / 2 - 0.07), 0.085, 1.02), (0.13, 0.02, 0.025), palette.metal),
        box((side * (wide / 2 + 0.17), 0.01, 1.5), (0.16, 0.012, 0.12), palette.white, front=plate),
    ]


def _on_wall(palette: Palette, rng: np.random.Generator) -> list[Prim]:
    """A notice, a fire extinguisher, a radiator, a bench, or nothing."""
    kind = float(rng.random())
    if kind < 0.3:
        tall = float(rng.uniform(0.4, 0.8))
        return [box((0, 0.01, 1.3), (0.7 * tall, 0.015, tall), palette.white, front=palette.once(pictures.poster))]
    if kind < 0.5:
        red = _paint((178, 34, 30))
        sign = palette.once(lambda r: pictures.label(r, (178, 34, 30)))
        return [
            cylinder((0, 0.1, 0.7), 0.08, 0.45, red),
            cylinder((0, 0.1, 1.15), 0.03, 0.08, palette.dark),
            box((0, 0.01, 1.75), (0.2, 0.01, 0.2), palette.white, front=sign),
        ]
    if kind < 0.65:
        return [box((x, 0.06, 0.15), (0.05, 0.1, 0.6), palette.white) for x in np.arange(-0.4, 0.45, 0.08)]
    return furniture.bench(palette, palette.pick(palette.wood)) if kind < 0.75 else []


def walk(seed: int, length: float = LENGTH) -> FloatArray:
    """Poses ``[n, 4, 4]`` there and back along the corridor, looking from wall to wall."""
    rng = np.random.default_rng([seed, 12])
    t = np.arange(FRAMES) / FRAMES
    x = -(length / 2 - 1.2) * np.cos(2 * np.pi * t)
    y = 0.35 * np.sin(2 * np.pi * (5 * t + rng.random()))
    z = 1.4 + 0.06 * np.sin(2 * np.pi * (7 * t + rng.random()))
    heading = np.where(t < 0.5, 0.0, np.pi) + np.radians(38) * np.sin(2 * np.pi * (6 * t + rng.random()))
    pitch = np.radians(-10 + 5 * np.sin(2 * np.pi * (4 * t + rng.random())))
    poses = []
    for at, h, p in zip(np.stack([x, y, z], axis=1), heading, pitch, strict=True):
        forward = np.array([np.cos(p) * np.cos(h), np.cos(p) * np.sin(h), np.sin(p)])
        right = np.array([np.sin(h), -np.cos(h), 0.0])
        poses.append(pose_from(np.stack([right, np.cross(forward, right), forward], axis=1), at))
    return np.array(poses)


class Corridor:
    """Its frames, rendered when asked for, with the noise of a sensor."""

    def __init__(self, seed: int, furnished: bool = False, width: int = 640, height: int = 480) -> None:
        self.options: Any = SimpleNamespace(frames=FRAMES)
        self.camera = Camera(width, height, WIDE * width, WIDE * width, (width - 1) / 2, (height - 1) / 2)
        self.classes: dict[int, str] = {}
        room = build_furnished(seed) if furnished else build(seed)
        self.poses = walk(seed, room.size[0])
        self._seed = seed
        down = np.eye(4)
        down[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
        lamps = [
            Lamp(yaw_pose(x, 0, room.size[2] - 0.05) @ down, 1.2, 0.3, (1.3, 1.3, 1.25), (3, 1))
            for x in (-4.8, -1.6, 1.6, 4.8)
        ]
        self._scene = bake_light(pack(room.items), lamps)

    def timestamp(self, index: int) -> float:
        """Seconds."""
        return 1.0 + index / FRAME_RATE_HZ

    def render(self, index: int) -> SyntheticFrame:
        """Frame `index`."""
        view = render_view(self._scene, self.camera, self.poses[index])
        rng = np.random.default_rng([self._seed, 13, index])
        rgb, depth = sensor.noisy_image(view.rgb, rng), sensor.noisy_depth(view.depth, self.camera, rng)
        return SyntheticFrame(rgb, depth, view.labels, self.poses[index])


def _paint(colour: tuple[int, int, int]) -> Material:
    """One colour."""
    return Material(Texture(np.broadcast_to(np.array(colour, np.uint8), (64, 64, 3)).copy()), metres=1.0)


def main() -> None:
    """Renders into the folder named first."""
    words = sys.argv[1:]
    furnished = "furnished" in words
    folder, *seeds = [word for word in words if word != "furnished"]
    Path(folder).mkdir(parents=True)
    write_frames(Path(folder), Corridor(int(seeds[0]) if seeds else 1, furnished), None)
    print(f"wrote {FRAMES} frames to {folder}")


if __name__ == "__main__":
    main()
