"""A query compared with what a map predicts from poses: those that keypoints give, and others that look like it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from semdb.geometry import invert_pose
from semdb.localization.edge_alignment import fit_edges
from semdb.localization.edge_step import EdgeVerdictOptions, weigh_edges
from semdb.localization.edges import ImageEdges, image_edges
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.laid_pose import LaidPose
from semdb.localization.pairs import join_pairs, world_points_of
from semdb.localization.pose import robust_pnp
from semdb.localization.predicted_view import PlacedView, SmallView, compare_view, small_view
from semdb.localization.search import Search
from semdb.localization.verdict import VerdictOptions
from semdb.localization.view_search import is_same, search_views
from semdb.localization.view_step import Seen, Standing, ViewOptions, stand
from semdb.perception.quality import motion_blur
from semdb.types import Description, FloatArray

LEAST_PAIRS = 8  # of a keyframe alone, for a pose of its own
ITERATIONS = 400
LEAST_SHARE = 0.25  # of the pairs of the best pose of a keyframe alone
ALIKE_ENOUGH = 0.99  # edges make nothing better then


@dataclass(frozen=True, slots=True, eq=False)
class Viewing:
    """How queries are compared with what a map predicts."""

    cache: KeyframeCache
    options: ViewOptions

    def see(self, query: SmallView, pose: FloatArray) -> Seen:
        """What is predicted from a pose ``[4, 4]``, compared with the query."""
        return Seen(pose, compare_view(query, pose, self._from(query, pose)[0]))

    def _from(self, query: SmallView, pose: FloatArray) -> tuple[list[PlacedView], bool]:
        return self.cache.views_seen_from(pose, query, self.options.keyframes)

    def _laid(self, query: SmallView, edges: Callable[[], ImageEdges], seen: Seen, times: int) -> Seen:
        """The same with the edges of the query laid on those of the keyframes, while it is more alike then."""
        options, rounds = self.options, self.options.edges
        for _ in range(times):
            if not options.worth_laying <= seen.alike < ALIKE_ENOUGH:
                break
            pose = seen.world_from_camera
            views = self._from(query, pose)[0][: rounds.keyframes]
            fit = fit_edges(edges(), self.cache.edges_of(views), pose, (*rounds.coarse[1:], *rounds.fine))
            found = None if fit is None else self.see(query, fit.world_from_camera)
            if found is None or found.alike <= seen.alike:
                break
            seen = found
        return seen

    def laid(
        self,
        search: Search,
        query: SmallView,
        description: Description,
        pose: FloatArray,
        options: EdgeVerdictOptions,
        bounds: VerdictOptions,
    ) -> LaidPose | None:
        """The edges of a query laid on those of the map at a sure `pose` ``[4, 4]``; None where they do not lie."""
        if description.grey is None:
            return None
        views = self._from(query, pose)[0][: options.fit.keyframes]
        fit = fit_edges(
            image_edges(description.camera, description.grey), self.cache.edges_of(views), pose, options.fit.fine
        )
        if fit is None or fit.seen < options.least_seen or fit.hit < options.least_hit:
            return None
        if not is_same(fit.world_from_camera, pose, self.options.same):
            return None
        limits = bounds.maximum_translation_sigma_m, bounds.maximum_rotation_sigma_deg
        return weigh_edges([fit], None, search.query, search.keyframes, search.matches, options, limits, search.accept)

    def of(self, description: Description) -> SmallView | None:
        """The query's own image, as it was seen."""
        if description.grey is None:
            return None
        blur = motion_blur(description.grey)
        return small_view(description.camera, description.grey, stretch=description.stretch, blur=blur)

    def standing(self, search: Search, query: SmallView, description: Description) -> Standing | None:
        """Of all poses that pairs with single keyframes give, the rivals and the pose that was found.

        Where none of these looks much like it, of those too from which matched keyframes look like the query as a
        whole. None where there is no pose, or the keyframes about the one that was found have no depth.
        """
        if description.grey is None:
            return None
        looked_at = self._of_keypoints(search, query)
        if looked_at is None:
            return None
        seen, unseen = looked_at
        edges = functools.cache(functools.partial(image_edges, description.camera, description.grey))
        seen = [self._laid(query, edges, one, 1) for one in seen]
        found = replace(stand(seen, self.options), unseen=unseen) if seen else None
        if found is None or found.best.alike < self.options.worth_trusting:
            seen += [self._laid(query, edges, one, self.options.layings) for one in self._searched(search, query, seen)]
            found = replace(stand(seen, self.options), unseen=unseen) if seen else None
        return found

    def _searched(self, search: Search, query: SmallView, known: Sequence[Seen]) -> list[Seen]:
        """Poses, not `known`, from which matched keyframes look like the query as a whole, and roughly as predicted."""
        options, found = self.options, []
        for pose in search_views(query, self.cache.small_views(search.keyframes), options.search):
            if any(is_same(pose, one.world_from_camera, options.search.same) for one in known):
                continue
            views, _ = self._from(query, pose)
            if compare_view(query, pose, views[: options.roughly], (0,)).alike >= options.worth_seeing:
                found.append(Seen(pose, compare_view(query, pose, views)))
        return found

    def _of_keypoints(self, search: Search, query: SmallView) -> tuple[list[Seen], int] | None:
        """The likeliest of `hypotheses`, the pose that was found first, and of how many nothing can be predicted.

        None where the keyframes about the pose that was found have no depth.
        """
        poses, options = hypotheses(search, self.options), self.options
        places = [self._from(query, pose) for pose in poses]
        own = []
        if search.estimate is not None:  # which keypoints have refined
            pose, (views, lacking) = poses.pop(0), places.pop(0)
            own = [Seen(pose, compare_view(query, pose, views))]
            if lacking and own[0].alike == 0:
                return None
        rough = sorted(
            (-compare_view(query, pose, views[: options.roughly], (0,)).alike, n)
            for n, (pose, (views, _)) in enumerate(zip(poses, places, strict=True))
        )  # about how alike, in a tenth of the time
        unseen = sum(alike == 0 and places[n][1] for alike, n in rough)
        chosen = [n for _, n in rough[: options.looked_at]]
        return own + [Seen(poses[n], compare_view(query, poses[n], places[n][0])) for n in chosen], unseen


def hypotheses(search: Search, options: ViewOptions) -> list[FloatArray]:
    """Poses ``[4, 4]`` that may be right, the one that was found first, no two the same."""
    found = [] if search.estimate is None else [search.estimate.world_from_camera]
    found += [other.world_from_camera for other in search.others]
    alone = []
    for keyframe, matches in zip(search.keyframes, search.matches, strict=True):
        if len(matches) < LEAST_PAIRS:
            continue
        pairs = join_pairs([matches])
        own = robust_pnp(search.query, pairs, world_points_of(pairs, [keyframe]), search.pose, ITERATIONS)
        if own is not None:
            alone.append((int(own[1].sum()), invert_pose(own[0])))
    alone.sort(key=lambda one: -one[0])
    found += [pose for count, pose in alone if count >= LEAST_SHARE * alone[0][0]]
    kept: list[FloatArray] = []
    for pose in found:
        if not any(is_same(pose, other, options.same) for other in kept):
            kept.append(pose)
    return kept[: options.most]
