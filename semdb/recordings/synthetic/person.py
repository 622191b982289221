"""A person who walks in front of the camera: what moves while a room is recorded, with its exact mask."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from semdb.recordings.synthetic import textures
from semdb.recordings.synthetic.furniture import Palette
from semdb.recordings.synthetic.render import View, render_view
from semdb.recordings.synthetic.room import Room
from semdb.recordings.synthetic.scene import (
    Item,
    Material,
    PackedScene,
    Prim,
    Texture,
    ball,
    box,
    cylinder,
    pack,
    yaw_pose,
)
from semdb.types import Camera, FloatArray

CATEGORY = "person"
_LIGHT = 0.85  # of a person, who is lit evenly: baked light is for what stands still
_AWAY = 1.7  # metres from the camera, on average


@dataclass(frozen=True, slots=True, eq=False)
class Walker:
    """Renders a person, `label` in the masks, into views of a room of the floor plan `size` (metres).

    The person goes to and fro before the camera, 1.2 to 2.2 m from it, wherever it looks: the keypoints on a person
    contradict those of the room in every frame.
    """

    label: int
    size: tuple[float, float]
    shirt: Material
    trousers: Material
    skin: Material
    dark: Material
    phase: float

    def add_to(self, view: View, camera: Camera, camera_pose: FloatArray, frame: int) -> View:
        """`view` with the person where nothing is nearer."""
        person = render_view(self._packed(camera_pose, frame), camera, camera_pose)
        nearer = (person.depth > 0) & ((person.depth < view.depth) | (view.depth <= 0))
        labels: npt.NDArray[np.uint16] = np.where(nearer, np.uint16(self.label), view.labels)
        return View(
            np.where(nearer[..., None], person.rgb, view.rgb), np.where(nearer, person.depth, view.depth), labels
        )

    def position(self, camera_pose: FloatArray, frame: int) -> tuple[float, float, float]:
        """Where the person stands in `frame`: x, y in metres and heading in radians, in the world."""
        forward = camera_pose[:2, 2] / max(float(np.linalg.norm(camera_pose[:2, 2])), 1e-9)
        aside = np.array([forward[1], -forward[0]])
        swing = self.phase + 0.11 * frame
        at = camera_pose[:2, 3] + (_AWAY + 0.5 * np.sin(0.7 * swing)) * forward + 0.7 * np.sin(swing) * aside
        limit = np.array(self.size) / 2 - 0.35
        x, y = np.clip(at, -limit, limit)
        towards = aside * (1 if np.cos(swing) >= 0 else -1)
        return float(x), float(y), float(np.arctan2(-towards[0], towards[1]))

    def _packed(self, camera_pose: FloatArray, frame: int) -> PackedScene:
        x, y, heading = self.position(camera_pose, frame)
        stride = np.sin(2 * np.pi * frame / 24 + self.phase)
        scene = pack([Item(CATEGORY, self._body(float(stride)), yaw_pose(x, y, 0, heading), label=self.label)])
        return replace(scene, light=np.full_like(scene.light, _LIGHT))

    def _body(self, stride: float) -> list[Prim]:
        """A person of 1.74 m facing +y, legs and arms swung by `stride` from -1 to 1; origin between the feet."""
        swing = 0.35 * stride
        prims = [
            box((0, 0, 0.84), (0.4, 0.22, 0.58), self.shirt),
            cylinder((0, 0, 1.4), 0.06, 0.1, self.skin),
            ball((0, 0.01, 1.6), (0.1, 0.12, 0.14), self.skin),
            ball((0, -0.015, 1.64), (0.106, 0.118, 0.115), self.dark),
        ]
        for side in (-1, 1):
            foot, hand = 0.84 * np.sin(side * swing), -0.56 * np.sin(side * swing)
            leg, arm = (0.11 * side, foot, 0.04), (0.25 * side, hand, 0.86)
            prims.append(cylinder(leg, 0.07, 0.84, self.trousers, 0.095, (side * swing, 0, 0)))
            prims.append(box((0.11 * side, foot + 0.05, 0), (0.1, 0.27, 0.08), self.dark))
            prims.append(cylinder(arm, 0.045, 0.54, self.shirt, 0.06, (-side * swing, 0, 0)))
            prims.append(ball((0.25 * side, hand, 0.83), (0.045, 0.05, 0.07), self.skin))
        return prims


def walker_for(room: Room, seed: int) -> Walker:
    """The person of a recording with this `seed`; its label is the first that the room does not use."""
    rng = np.random.default_rng([seed, 7])
    label = 1 + max((item.label for item in room.items), default=0)
    palette = Palette(rng)
    skin = Material(Texture(textures.speckle(rng, (206, 160, 134), 0.03)))
    cloth = (palette.cloth[0], palette.cloth[1])
    phase = float(rng.uniform(0, 2 * np.pi))
    return Walker(label, (room.size[0], room.size[1]), *cloth, skin, palette.dark, phase)
