"""Where keypoints do not convince: a query's depth is laid on the surfaces of the map, its edges on the map's edges."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from semdb.localization.confidence import Evidence
from semdb.localization.edge_alignment import measure_edges, search_edges
from semdb.localization.edge_step import EdgeVerdictOptions, weigh_edges
from semdb.localization.edges import image_edges
from semdb.localization.keyframe_cache import KeyframeCache
from semdb.localization.laid_pose import (
    LaidOptions,
    LaidPose,
    estimate_with,
    is_one,
    judge_with,
    may_overrule,
    with_view,
)
from semdb.localization.pose import PoseEstimate
from semdb.localization.predicted_view import Windows, compare_view, small_view
from semdb.localization.rivals import find_rival
from semdb.localization.search import Search, evidence_of
from semdb.localization.surface_search import search_surfaces
from semdb.localization.surface_step import SurfaceVerdictOptions, weigh_surfaces, with_edges
from semdb.localization.surfaces import Surfaces, surfaces_of
from semdb.localization.verdict import Judgement, VerdictOptions
from semdb.types import ConsistentPose, Description, FloatArray, Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Laying:
    """How queries are laid on a map: None of `surfaces` or `edges` leaves that out."""

    cache: KeyframeCache
    surfaces: SurfaceVerdictOptions | None
    edges: EdgeVerdictOptions | None
    verdict: VerdictOptions
    use_query_depth: bool

    def poses(self, search: Search, description: Description) -> Iterator[tuple[LaidPose, LaidOptions]]:
        """That of the surfaces, then that of the edges, each when it is asked for, with the bounds it is judged by."""
        for lay, options in ((self._on_surfaces, self.surfaces), (self._on_edges, self.edges)):
            laid = lay(search, description) if search.keyframes else None
            if laid is not None and options is not None:
                yield laid, options

    def _on_surfaces(self, search: Search, description: Description) -> LaidPose | None:
        """The pose of a query's depth on the surfaces of the map, where it has depth."""
        options = self.surfaces
        surfaces = None if options is None else self._surfaces_of(description)
        if options is None or surfaces is None:
            return None
        starts, fit = _starts(search, options.fit.starts), options.fit
        fits = search_surfaces(surfaces, starts, lambda pose: self.cache.surfaces_near(pose, fit.keyframes), fit)
        limits, accept = self._limits(search), search.accept
        laid = weigh_surfaces(fits, search.query, search.keyframes, search.matches, options, limits, accept)
        if laid is None or not laid.is_sure:
            return laid
        return self._seen(self._seen_with_edges(laid, options, description), options, description, "surfaces")

    def _seen_with_edges(self, laid: LaidPose, options: SurfaceVerdictOptions, description: Description) -> LaidPose:
        """A pose on surfaces with what the edges of the query say of it: one bare room fits another."""
        if description.grey is None:
            return laid
        fit, pose = options.edges, laid.world_from_camera
        edges = image_edges(description.camera, description.grey)
        found = measure_edges(edges, self.cache.edges_near(pose, fit.keyframes), pose, fit.fine[-1])
        return with_edges(laid, found, options)

    def _on_edges(self, search: Search, description: Description) -> LaidPose | None:
        """The pose of a query's edges on those of the map."""
        options = self.edges
        if options is None or description.grey is None:
            return None
        starts, fit = _starts(search, options.fit.starts), options.fit
        edges = image_edges(description.camera, description.grey)
        fits = search_edges(edges, starts, lambda pose: self.cache.edges_near(pose, fit.keyframes), fit)
        own = None
        if search.estimate is not None:
            pose = search.estimate.world_from_camera
            own = measure_edges(edges, self.cache.edges_near(pose, fit.keyframes), pose, fit.fine[-1])
        laid = weigh_edges(
            fits, own, search.query, search.keyframes, search.matches, options, self._limits(search), search.accept
        )
        return laid if laid is None else self._seen(laid, options, description, "edges")

    def _seen(self, laid: LaidPose, options: LaidOptions, description: Description, what: str) -> LaidPose:
        """A sure pose for which few keypoints vouch, with whether the query looks as keyframes predict from there."""
        if description.grey is None or not laid.is_sure or laid.support >= options.few_support:
            return laid
        query = small_view(description.camera, description.grey)

        def look(pose: FloatArray) -> Windows:
            return compare_view(query, pose, self.cache.views_seen_from(pose, query, options.view_keyframes)[0])

        return with_view(laid, look(laid.world_from_camera), options, what, look)

    def _limits(self, search: Search) -> tuple[float, float]:
        """What standard deviations (m, deg) a pose may have that is sure."""
        bounds = self.verdict.accepting(search.accept)
        return bounds.maximum_translation_sigma_m, bounds.maximum_rotation_sigma_deg

    def _surfaces_of(self, description: Description) -> Surfaces | None:
        """Those of a query, where it has depth that may be used."""
        if description.depth is None or description.grey is None or not self.use_query_depth:
            return None
        return surfaces_of(description.camera, description.depth, description.grey)


def with_laid(
    search: Search,
    laid: LaidPose,
    options: LaidOptions,
    convinced: bool,
    judgement: Judgement,
    evidence: Evidence | None,
) -> tuple[Judgement, Evidence | None]:
    """Verdict and evidence after a query was laid on the map; the pose with them."""
    before, overrule, one = search.estimate, False, options.tolerance(search.accept)
    search.laid.append(laid)
    if laid.is_sure:
        found = estimate_with(laid, search.query, search.keyframes, search.matches, options, search.pose)
        rival = rival_of(search, found)
        if rival is not None and not convinced and laid.looks_better_than(rival.world_from_camera, options):
            rival = None  # what is predicted from there is not what the query shows
        anew = evidence_of(search, found, 0 if rival is None else rival.inliers)
        overrule = may_overrule(convinced, anew, laid, options)
        if search.seen is not None:  # what is predicted decides between places
            overrule = is_one(laid.world_from_camera, search.seen, one)
        if overrule:
            if before is None or not is_one(found.world_from_camera, before.world_from_camera, one):
                search.alike = None  # that was of another pose
            search.estimate, evidence = found, anew
            search.others.clear()
    after = judge_with(judgement, before, laid, options, overrule, search.accept)
    if after is not judgement and after.verdict is Verdict.AMBIGUOUS:
        search.others.append(ConsistentPose(laid.world_from_camera, laid.support))
    return after, evidence


def rival_of(search: Search, estimate: PoseEstimate) -> ConsistentPose | None:
    """The best pose elsewhere that the caller would not accept for `estimate`."""
    found = find_rival(search.query, search.keyframes, search.matches, estimate, search.pose)
    if found is None or search.accept is None:
        return found
    return None if is_one(found.world_from_camera, estimate.world_from_camera, search.accept) else found


def _starts(search: Search, keyframes: int) -> list[FloatArray]:
    """Poses from which a query is laid: that of the keypoints, and those of the likeliest keyframes."""
    estimate = search.estimate
    order = list(range(len(search.keyframes)))
    if estimate is not None:
        counts = [*estimate.per_keyframe, *[0] * (len(order) - len(estimate.per_keyframe))]
        order.sort(key=lambda slot: -counts[slot])
    starts = [] if estimate is None else [estimate.world_from_camera]
    return starts + [search.keyframes[slot].world_from_camera for slot in order[:keyframes]]
