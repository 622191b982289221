"""Poses elsewhere that agree with pairs that the best pose leaves over."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semdb.geometry import invert_pose, pose_error
from semdb.localization.matching import Matches
from semdb.localization.pairs import join_pairs, reprojection_px, world_points_of
from semdb.localization.pose import PoseEstimate, robust_pnp
from semdb.localization.pose_options import PoseOptions
from semdb.localization.views import KeyframeView, View
from semdb.types import ConsistentPose

RIVAL_SHARE = 0.2  # of the first inliers with the best keyframe: a rival with fewer says nothing and may be missed
LEAST_RIVAL_ITERATIONS = 50
MOST_RIVAL_ITERATIONS = 1000


def rival_pose(
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    best: PoseEstimate,
    options: PoseOptions,
) -> int:
    """Inliers of `find_rival`; 0 when there is none."""
    found = find_rival(query, keyframes, matches, best, options)
    return 0 if found is None else found.inliers


def find_rival(
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    best: PoseEstimate,
    options: PoseOptions,
) -> ConsistentPose | None:
    """The best pose elsewhere, among the pairs that `best` leaves over; inliers are distinct keypoints of the query.

    Elsewhere is more than 0.5 m or 15 degrees away; None when there is none. It is looked for as long as it takes to
    find one that counts.
    """
    pairs = join_pairs(matches)
    points = world_points_of(pairs, keyframes)
    camera_from_world = invert_pose(best.world_from_camera)
    left = reprojection_px(query, camera_from_world, pairs.query, points) >= 2 * options.max_reprojection_px
    iterations = _iterations_for(RIVAL_SHARE * best.first_of_best / max(int(left.sum()), 1))
    found = robust_pnp(query, pairs.take(left), points[left], options, iterations)
    if found is None:
        return None
    world_from_camera = invert_pose(found[0])
    distance, angle = pose_error(world_from_camera, best.world_from_camera)
    if distance < 0.5 and angle < 15:
        return None
    return ConsistentPose(world_from_camera, len(np.unique(pairs.take(left).query[found[1]])))


def _iterations_for(share: float) -> int:
    """Random samples of three until one has none but right pairs, of which there is a `share`: all but 1 in 1000 times.

    Fischler and Bolles, Random sample consensus, CACM 24(6), 1981.
    """
    success = min(max(share, 0.0), 0.99) ** 3
    needed = np.log(0.001) / np.log1p(-success) if success > 0 else np.inf
    return int(np.ceil(np.clip(needed, LEAST_RIVAL_ITERATIONS, MOST_RIVAL_ITERATIONS)))
