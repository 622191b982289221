"""A keyframe localized among its neighbours, as a query would be: how far it comes from its recorded pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semdb.geometry import pose_offset
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.matching import Matches
from semdb.localization.pose import estimate_pose, first_pose, match_views
from semdb.localization.pose_options import PoseOptions
from semdb.localization.recorded_errors import LeftOut
from semdb.localization.verdict import convinces
from semdb.localization.views import KeyframeView


def localized_among(own: KeyframeView, others: Sequence[KeyframeView], options: LocalizerOptions) -> LeftOut | None:
    """`own` without its own depth, among `others`; None where it is not found there.

    Damaged points may be anywhere: nothing that is no number comes out.
    """
    return localized_farther(own, others, options, len(others), 1)[0]


def localized_farther(
    own: KeyframeView, others: Sequence[KeyframeView], options: LocalizerOptions, count: int, times: int
) -> list[LeftOut | None]:
    """`own` as in `localized_among`, among the first `count` of `others`, then without the first of these, and so on.

    Each time, of at most `times`, as if the keyframes nearest to it were not there. It is matched with each once.
    """
    pose = replace(options.pose, use_query_depth=False)
    matches = match_views(own.view, others, pose)
    starts = range(min(times, max(len(others), 1)))
    return [_localized(own, others[n : n + count], matches[n : n + count], options, pose) for n in starts]


def _localized(
    own: KeyframeView,
    others: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: LocalizerOptions,
    pose: PoseOptions,
) -> LeftOut | None:
    first = first_pose(own.view, others, matches, pose)
    if first is None or not convinces(first, options.verdict):
        return None
    estimate = estimate_pose(own.view, others, matches, pose, first)
    if estimate is None or estimate.covariance is None or estimate.at is None:
        return None
    found = LeftOut(pose_offset(estimate.world_from_camera, own.world_from_camera), estimate.covariance, estimate.at)
    numbers = (found.error, found.covariance, found.at.turn, found.at.nearest)
    return found if all(np.isfinite(one).all() for one in numbers) else None
