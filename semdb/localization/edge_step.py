"""The pose that a query's edges have on those of the map, with what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from semdb.localization.edge_alignment import EdgeFit, EdgeOptions
from semdb.localization.laid_pose import LaidOptions, LaidPose, Standing, compare, covariance_from, shared_doubts
from semdb.localization.matching import Matches
from semdb.localization.views import KeyframeView, View
from semdb.types import FloatArray, Tolerance

POINTS_PER_EDGE = 30.0  # whose errors are alike: the depth of an edge, and keyframes' poses


@dataclass(frozen=True, slots=True)
class EdgeVerdictOptions(LaidOptions):
    """A pose is sure when every bound holds."""

    fit: EdgeOptions = field(default_factory=EdgeOptions)
    least_view: float = 0.59  # of the cabinet from its other side up to .56, at right poses from .62 on
    least_support: int = 8  # a thing that is turned by half a turn has most of its edges again
    convinced_confidence: float = 1.1  # never: where keypoints are many and in doubt, equal things have equal edges
    least_seen: int = 200
    least_hit: float = 0.34
    least_explained: float = 0.75
    contradicting_hit: float = 0.22  # a share that is enough to doubt keypoints,
    contradicting_gain: float = 0.10  # where it is more by that than at their pose


def weigh_edges(
    fits: Sequence[EdgeFit],
    at_keypoints: EdgeFit | None,
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: EdgeVerdictOptions,
    limits: tuple[float, float],
    accept: Tolerance | None = None,
) -> LaidPose | None:
    """The best of `fits`, weighed with the pairs of first matching; `limits` (m, deg) of its standard deviations.

    `at_keypoints` is how the edges agree with the keypoints' own pose.
    """
    if not fits:
        return None
    poses, scores = [fit.world_from_camera for fit in fits], [fit.hit for fit in fits]
    standing = compare(poses, scores, query, keyframes, matches, options, accept)
    fit = fits[standing.best]
    covariance = covariance_of(fit)
    gain = fit.hit - (at_keypoints.hit if at_keypoints is not None else 0.0)
    contradicts = fit.hit >= options.contradicting_hit and gain >= options.contradicting_gain
    return LaidPose(
        world_from_camera=fit.world_from_camera,
        covariance=covariance,
        support=standing.support,
        others=standing.others,
        doubts=tuple(_doubts(fit, covariance, standing, options, limits)),
        fits_well=fit.seen >= options.least_seen and contradicts,
        agrees=f"{fit.hit:.0%} of the map's edges lie where they are seen",
        better="the edges of the image lie better on the map elsewhere",
        numbers={
            "edge_hit": fit.hit,
            "edge_explained": fit.explained,
            "edge_gain": gain,
            "edge_support": float(standing.support),
            "edge_rival": float(standing.rival),
        },
    )


def covariance_of(fit: EdgeFit) -> FloatArray:
    """``[6, 6]`` of translation (m, world) and rotation (rad, left perturbation in the world)."""
    return covariance_from(fit.information, fit.scatter, POINTS_PER_EDGE)


def _doubts(
    fit: EdgeFit,
    covariance: FloatArray,
    standing: Standing,
    options: EdgeVerdictOptions,
    limits: tuple[float, float],
) -> list[str]:
    found = []
    if fit.seen < options.least_seen:
        found.append(f"only {fit.seen} points of edges should be seen")
    if fit.hit < options.least_hit or fit.explained < options.least_explained:
        found.append(f"{fit.hit:.0%} of the map's edges are seen, {fit.explained:.0%} of the image's are in the map")
    return found + shared_doubts(covariance, standing, options, limits, "edges")
