"""2D-3D pairs of a query with several keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.localization.matching import Matches, MatchingOptions, match_guided
from semdb.localization.views import KeyframeView, View
from semdb.types import BoolArray, FloatArray, IntArray

NEAREST_M = 0.05  # what is nearer is not in front of the camera


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """2D-3D pairs of a query with several keyframes (`slot` counts them)."""

    query: IntArray  # [n] keypoint of the query
    slot: IntArray  # [n] which keyframe
    keypoint: IntArray  # [n] keypoint of that keyframe
    same_class: BoolArray  # [n]

    def __len__(self) -> int:
        return len(self.query)

    def take(self, keep: BoolArray | IntArray) -> Pairs:
        return Pairs(self.query[keep], self.slot[keep], self.keypoint[keep], self.same_class[keep])


def join_pairs(matches: Sequence[Matches]) -> Pairs:
    """Pairs of one query with several keyframes, in the order of `matches`."""
    if not matches:
        empty = np.zeros(0, np.int32)
        return Pairs(empty, empty, empty, np.zeros(0, np.bool_))
    return Pairs(
        np.concatenate([m.query for m in matches]),
        np.concatenate([np.full(len(m), slot, np.int32) for slot, m in enumerate(matches)]),
        np.concatenate([m.keyframe for m in matches]),
        np.concatenate([m.same_class for m in matches]),
    )


def world_points_of(pairs: Pairs, keyframes: Sequence[KeyframeView]) -> FloatArray:
    """The stored 3D point ``[n, 3]`` of each pair, in the world."""
    points = np.empty((len(pairs), 3))
    for slot, keyframe in enumerate(keyframes):
        rows = pairs.slot == slot
        points[rows] = keyframe.world_points[pairs.keypoint[rows]]
    return points


def reprojection_px(query: View, camera_from_world: FloatArray, rows: IntArray, points: FloatArray) -> FloatArray:
    """Distance ``[n]`` in (undistorted) pixels of the query between keypoints `rows` and world `points`."""
    moved = points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        offset = moved[:, :2] / moved[:, 2:] - query.xy[rows]
    distance = np.hypot(offset[:, 0], offset[:, 1]) * query.focal
    return np.where(moved[:, 2] > NEAREST_M, distance, np.inf)


def guided_pairs(
    query: View, keyframes: Sequence[KeyframeView], projected: Sequence[FloatArray], options: MatchingOptions
) -> Pairs:
    """Second matching: only near the projections ``[n, 2]`` of each keyframe's points, in pixels from the centre."""
    return join_pairs(
        [
            match_guided(
                query.descriptors,
                keyframe.view.descriptors,
                query.xy * query.focal,
                centres,
                query.classes,
                keyframe.view.classes,
                options,
                query_signs=query.signs,
                keyframe_signs=keyframe.view.signs,
            )
            for keyframe, centres in zip(keyframes, projected, strict=True)
        ]
    )
