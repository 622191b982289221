"""Poses that keypoints and edges cannot tell apart, told apart by what keyframes with depth predict from each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.geometry import invert_pose, pose_error
from semdb.localization.confidence import Evidence
from semdb.localization.edge_alignment import EdgeOptions, fit_edges
from semdb.localization.edges import ImageEdges, image_edges
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.pairs import join_pairs, world_points_of
from semdb.localization.pose import robust_pnp
from semdb.localization.predicted_view import ALIKE, PlacedView, SmallView, Windows, compare_view, small_view
from semdb.localization.search import Search
from semdb.localization.verdict import Judgement, VerdictOptions, is_precise
from semdb.types import Description, FloatArray, Tolerance, Verdict

LEAST_PAIRS = 8  # of a keyframe alone, for a pose of its own
ITERATIONS = 400
LEAST_SHARE = 0.25  # of the pairs of the best pose of a keyframe alone


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """When what is predicted decides. Windows are counted by their middles, pixels of the small image."""

    edges: EdgeOptions = field(default_factory=EdgeOptions)  # how poses that are compared are made better
    keyframes: int = 6  # of which a view is predicted
    most: int = 12  # poses that are looked at roughly,
    roughly: int = 2  # on so many keyframes,
    looked_at: int = 4  # and those of them that are compared, beside the pose that was found
    worth_laying: float = 0.7  # alike: these are made better by edges
    same: Tolerance = field(default_factory=lambda: Tolerance(0.25, 8.0))  # poses nearer than this are one
    least_windows: int = 1500
    least_known: float = 0.1  # share of the image that is predicted
    least_alike: float = 0.95  # of what is predicted, to be sure: copies of a corridor turned round have up to .94
    least_lead: float = 0.04  # share of the windows that both predict, by which a pose is better than another
    lead_windows: int = 120
    far_less: float = 0.2  # alike: so much less is beaten, whatever both predict
    nearby: Tolerance = field(default_factory=lambda: Tolerance(0.6, 10.0))  # nothing is there twice so near
    weak_agreement: float = 0.45  # keypoints that convince by fewer pairs than these are looked at again,
    weak_first: int = 45
    weak_likeness: float = 0.85  # where what is about them is less alike than this
    more: int = 8  # keyframes that are matched besides
    least_inliers: int = 20
    confidence: float = 0.95  # of a pose that is sure

    def accepting(self, accept: Tolerance | None) -> ViewOptions:
        """The same for a caller who takes poses within `accept` for one."""
        if accept is None:
            return self
        return replace(
            self, same=Tolerance(max(self.same.metres, accept.metres), max(self.same.degrees, accept.degrees))
        )


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """A pose with how the query looks like what is predicted from there."""

    world_from_camera: FloatArray
    windows: Windows

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.windows.compared))

    @property
    def alike(self) -> float:
        return self.windows.alike


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """The best of several poses by what is predicted; those elsewhere that look less like the query are beaten."""

    best: Seen
    unbeaten: tuple[Seen, ...]  # elsewhere, which may be right as well
    unseen: int = 0  # poses of which nothing is predicted, since keyframes there have no depth

    def is_sure(self, options: ViewOptions) -> bool:
        return not self.unbeaten and not self.unseen and is_like(self.best, options)

    def against(self, pose: FloatArray, options: ViewOptions) -> list[FloatArray]:
        """Poses ``[4, 4]`` that may be right as well as `pose`, or are better."""
        found = [seen.world_from_camera for seen in (self.best, *self.unbeaten)]
        return [other for other in found if not is_same(other, pose, options.same)]


def is_like(seen: Seen, options: ViewOptions) -> bool:
    """Whether the query looks like what is predicted, and enough is."""
    enough = seen.count >= options.least_windows and seen.windows.known >= options.least_known
    return enough and seen.alike >= options.least_alike


def beats(one: Seen, other: Seen, options: ViewOptions) -> bool:
    """Whether `one` looks clearly more like the query than `other`, where both predict something."""
    both = one.windows.compared & other.windows.compared
    first, second = one.windows.likeness[both] > ALIKE, other.windows.likeness[both] > ALIKE
    lead = np.count_nonzero(first & ~second) - np.count_nonzero(second & ~first)
    least = max(options.lead_windows, options.least_lead * len(first))
    nearby = is_same(one.world_from_camera, other.world_from_camera, options.nearby)
    return bool(lead >= least or other.alike < one.alike - (0.0 if nearby else options.far_less))


def stand(found: Sequence[Seen], options: ViewOptions) -> Standing:
    """The best of `found`, which is not empty."""
    enough = [seen for seen in found if seen.count >= options.least_windows] or list(found)
    best = max(enough, key=lambda seen: seen.alike)
    others = [seen for seen in found if not is_same(seen.world_from_camera, best.world_from_camera, options.same)]
    return Standing(best, tuple(seen for seen in others if not beats(best, seen, options)))


def is_same(pose: FloatArray, other: FloatArray, tolerance: Tolerance) -> bool:
    metres, degrees = pose_error(pose, other)
    return metres < tolerance.metres and degrees < tolerance.degrees


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

    def _laid(self, query: SmallView, edges: ImageEdges, seen: Seen) -> Seen:
        """The same with the edges of the query laid on those of the keyframes, where it is more alike then."""
        rounds = self.options.edges
        views = self._from(query, seen.world_from_camera)[0][: rounds.keyframes]
        pose = seen.world_from_camera
        fit = fit_edges(edges, self.cache.edges_of(views), pose, (*rounds.coarse[1:], *rounds.fine))
        if fit is None:
            return seen
        found = self.see(query, fit.world_from_camera)
        return found if found.alike > seen.alike else seen

    def of(self, description: Description) -> SmallView | None:
        """The query's own image."""
        return None if description.grey is None else small_view(description.camera, description.grey)

    def standing(self, search: Search, query: SmallView, description: Description) -> Standing | None:
        """Of all poses that pairs with single keyframes give, the rivals and the pose that was found.

        None where there is no pose, or the keyframes about the one that was found have no depth.
        """
        poses, options = hypotheses(search, self.options), self.options
        if not poses or description.grey is None:
            return None
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
        seen = [Seen(poses[n], compare_view(query, poses[n], places[n][0])) for n in chosen]
        if not seen and not own:
            return None
        if any(one.alike >= options.worth_laying for one in seen):
            edges = image_edges(description.camera, description.grey)
            seen = [self._laid(query, edges, one) if one.alike >= options.worth_laying else one for one in seen]
        return replace(stand([*own, *seen], options), unseen=unseen)


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


def is_weak(evidence: Evidence, options: ViewOptions) -> bool:
    """Whether keypoints that convince do so by so few that another place may have as many."""
    few = evidence.agreement < options.weak_agreement and evidence.first_of_best < options.weak_first
    return few and evidence.likeness < options.weak_likeness


def judge_seen(
    judgement: Judgement,
    evidence: Evidence | None,
    standing: Standing,
    own: bool,
    options: ViewOptions,
    bounds: VerdictOptions,
) -> Judgement:
    """What becomes of a verdict of keypoints. `own` is whether the best pose is that of `evidence`."""
    best = standing.best
    enough = evidence is not None and evidence.inliers >= options.least_inliers and is_precise(evidence, bounds)
    if own and evidence is not None and enough and standing.is_sure(options):
        reason = f"{best.alike:.0%} of the image look as the map predicts, {evidence.inliers} keypoints agree"
        return Judgement(Verdict.LOCALIZED, max(judgement.confidence, options.confidence), reason)
    if judgement.verdict is not Verdict.LOCALIZED:
        return judgement
    if own and not standing.unbeaten:
        return judgement
    return Judgement(Verdict.AMBIGUOUS, min(judgement.confidence, 0.5), "a pose elsewhere looks as much like the image")


def view_numbers(standing: Standing) -> dict[str, float]:
    """For the evidence of an answer."""
    best = standing.best
    return {
        "view_alike": best.alike,
        "view_known": best.windows.known,
        "view_rivals": float(len(standing.unbeaten) + standing.unseen),
    }
