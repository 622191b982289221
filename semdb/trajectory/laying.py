"""Frames that keypoints do not carry: their depth is laid on surfaces of the keyframes near to where they should be.

As `semdb.localization.surface_step` does it with queries. Here it is known where the camera was a moment ago, so it
begins there, and keypoints vouch as they do there: shapes alone do not tell a place.
"""

from __future__ import annotations

from collections.abc import Sequence

from semdb.localization.laid_pose import estimate_with
from semdb.localization.pose import match_views
from semdb.localization.surface_search import search_surfaces
from semdb.localization.surface_step import weigh_surfaces
from semdb.trajectory.frames import SeenFrame
from semdb.trajectory.keyframes import Keyframes
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.tracking import Placed
from semdb.types import FloatArray


def lay(
    frame: SeenFrame,
    keyframes: Keyframes,
    numbers: Sequence[int],
    starts: Sequence[FloatArray],
    options: TrajectoryOptions,
) -> Placed | None:
    """`frame` placed by the surfaces of keyframes `numbers`, from any of `starts` ``[4, 4]``; None where that is not
    sure.
    """
    view = frame.surface_view()
    surfaces = None if view is None else view.surfaces()
    placed = [there for there in (keyframes.surfaces(number) for number in numbers) if there is not None]
    if surfaces is None or not placed or not starts:
        return None
    chosen = options.surfaces
    fits = search_surfaces(surfaces, starts, lambda _pose: placed, chosen.fit)
    views = [keyframes.view_of(number) for number in numbers]
    matches = match_views(frame.view, views, options.pose)
    limits = options.tracking.most_sigma_m, options.tracking.most_sigma_deg
    laid = weigh_surfaces(fits, frame.view, views, matches, chosen, limits)
    if laid is None or not laid.is_sure:
        return None
    estimate = estimate_with(laid, frame.view, views, matches, chosen, options.pose)
    return Placed(estimate, tuple(views), laid=True)
