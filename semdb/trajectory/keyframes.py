"""Keyframes while a trajectory is found: what each sees, and which of them are near a pose or look like an image."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, pose_distances, transform_points
from semdb.geometry.volumes import Volume
from semdb.localization.surface_alignment import PlacedSurfaces, place
from semdb.localization.surfaces import Surfaces
from semdb.localization.views import KeyframeView, View
from semdb.trajectory.depth_views import DepthView
from semdb.trajectory.surface_views import SurfaceView
from semdb.types import BoolArray, Float32Array, FloatArray

SURFACES_KEPT = 12  # keyframes; about 2 MiB each
SAMPLES = 64  # points by which the common view of two frames is judged


@dataclass(frozen=True, slots=True, eq=False)
class Keyframe:
    """A keyframe: where it is in the recording, what it sees, what it looks like, and to which piece it belongs.

    `view` holds only keypoints with a 3D point. Its pose is kept beside, since it changes.
    """

    number: int
    position: int
    time_s: float
    piece: int
    view: View
    vector: Float32Array  # [d] place vector, L2-normalised
    sample: FloatArray  # [s, 3] some of its points, camera frame
    depth: DepthView | None = None
    surface: SurfaceView | None = None


class Keyframes:
    """All keyframes so far with their poses, each in the world of its piece."""

    def __init__(self) -> None:
        self.all: list[Keyframe] = []
        self.poses: list[FloatArray] = []
        self._surfaces: OrderedDict[int, Surfaces | None] = OrderedDict()

    def __len__(self) -> int:
        return len(self.all)

    def add(self, keyframe: Keyframe, pose: FloatArray) -> None:
        self.all.append(keyframe)
        self.poses.append(pose)

    def move(self, poses: FloatArray) -> None:
        """Puts all keyframes to `poses` ``[n, 4, 4]``."""
        self.poses = list(poses)

    def view_of(self, number: int, pose: FloatArray | None = None) -> KeyframeView:
        """The keyframe as the fine step takes it, at `pose` ``[4, 4]`` or at its own."""
        view = self.all[number].view
        where = self.poses[number] if pose is None else pose
        return KeyframeView(number, view, where, invert_pose(where), transform_points(where, view.points))

    def surfaces(self, number: int) -> PlacedSurfaces | None:
        """The surfaces of a keyframe at its pose, the latest kept in memory; None of one without depth."""
        if number not in self._surfaces:
            view = self.all[number].surface
            self._surfaces[number] = None if view is None else view.surfaces()
        self._surfaces.move_to_end(number)
        while len(self._surfaces) > SURFACES_KEPT:
            self._surfaces.popitem(last=False)
        found = self._surfaces[number]
        return None if found is None else place(number, found, self.poses[number])

    def in_piece(self, piece: int) -> list[int]:
        return [keyframe.number for keyframe in self.all if keyframe.piece == piece]

    def nearest(self, pose: FloatArray, numbers: Collection[int], count: int) -> list[int]:
        """Those of `numbers` whose poses are nearest to `pose` ``[4, 4]``, at most `count`."""
        chosen = sorted(numbers)
        if not chosen:
            return []
        distance = pose_distances(pose, np.stack([self.poses[n] for n in chosen]))
        return [chosen[k] for k in np.argsort(distance, kind="stable")[:count]]

    def alike(self, vector: Float32Array, allowed: BoolArray, count: int) -> list[int]:
        """The `allowed` ``[n]`` whose place vectors are most like `vector` ``[d]``, at most `count`."""
        rows = np.flatnonzero(allowed)
        if not len(rows):
            return []
        cosines = np.stack([self.all[n].vector for n in rows]) @ vector
        return [int(rows[k]) for k in np.argsort(-cosines, kind="stable")[:count]]

    def volume(self, number: int, pose: FloatArray | None = None) -> Volume:
        """What the keyframe sees, in short, at `pose` or at its own."""
        keyframe, where = self.all[number], self.poses[number] if pose is None else pose
        return Volume(keyframe.view.camera, where, transform_points(where, keyframe.sample))


def sample_of(view: View) -> FloatArray:
    """Some of a view's points ``[s, 3]``, spread over its keypoints; empty where none has depth."""
    known = view.points[np.isfinite(view.points[:, 2])].astype(np.float64)
    if not len(known):
        return np.zeros((0, 3))
    return np.asarray(known[np.linspace(0, len(known) - 1, SAMPLES).astype(int)])


def with_points_only(view: View) -> View:
    """The keypoints of a view that have a 3D point."""
    keep = np.flatnonzero(np.isfinite(view.points).all(axis=1))
    return View(
        camera=view.camera,
        seen_xy=view.seen_xy[keep],
        xy=view.xy[keep],
        size=view.size[keep],
        descriptors=view.descriptors[keep],
        classes=view.classes[keep],
        signs=view.signs[keep],
        points=view.points[keep],
        source=view.source[keep],
        grey=view.grey,
        looser=None if view.looser is None else view.looser[keep],
    )
