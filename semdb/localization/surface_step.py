"""The pose that a query's depth has on the surfaces of the map, with what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from semdb.localization.edge_alignment import EdgeFit, EdgeOptions
from semdb.localization.laid_pose import LaidOptions, LaidPose, Standing, compare, covariance_from, shared_doubts
from semdb.localization.matching import Matches
from semdb.localization.surface_alignment import SurfaceFit, SurfaceOptions
from semdb.localization.views import KeyframeView, View
from semdb.types import FloatArray, Tolerance

POINTS_PER_CELL = 60.0  # whose errors are alike: the depth's own, and of keyframes' poses


@dataclass(frozen=True, slots=True)
class SurfaceVerdictOptions(LaidOptions):
    """A pose is sure when every bound holds."""

    fit: SurfaceOptions = field(default_factory=SurfaceOptions)
    least_near: float = 0.55
    least_alike: float = 0.55
    most_through: float = 0.10
    least_correlation: float = 0.6
    edges: EdgeOptions = field(default_factory=EdgeOptions)
    least_edges: int = 200  # of the map that should be seen, so that the query's edges tell something
    least_explained: float = (
        0.68  # of the query's edges: on the cabinet 0.74 to 1, of bare rooms on others 0.42 to 0.63
    )
    least_view: float = 0.53  # of the cabinet from its other side up to .49, at right poses from .55 on but for one


def weigh_surfaces(
    fits: Sequence[SurfaceFit],
    query: View,
    keyframes: Sequence[KeyframeView],
    matches: Sequence[Matches],
    options: SurfaceVerdictOptions,
    limits: tuple[float, float],
    accept: Tolerance | None = None,
) -> LaidPose | None:
    """The best of `fits`, weighed with the pairs of first matching; `limits` (m, deg) of its standard deviations."""
    if not fits:
        return None
    poses, scores = [fit.world_from_camera for fit in fits], [fit.score for fit in fits]
    standing = compare(poses, scores, query, keyframes, matches, options, accept)
    fit = fits[standing.best]
    covariance = covariance_of(fit)
    return LaidPose(
        world_from_camera=fit.world_from_camera,
        covariance=covariance,
        support=standing.support,
        others=standing.others,
        doubts=tuple(_doubts(fit, covariance, standing, options, limits)),
        fits_well=fit.near >= options.least_near and fit.through <= options.most_through,
        agrees=f"{fit.near:.0%} of the surfaces lie where they were measured",
        better="the depth of the image lies better on the map elsewhere",
        numbers={
            "surface_near": fit.near,
            "surface_alike": fit.alike,
            "surface_through": fit.through,
            "surface_correlation": fit.correlation,
            "surface_support": float(standing.support),
            "surface_rival": float(standing.rival),
        },
    )


def with_edges(laid: LaidPose, found: EdgeFit | None, options: SurfaceVerdictOptions) -> LaidPose:
    """`laid` in doubt where the query has edges that the map has not, at that pose (`found`)."""
    if found is None:
        return laid
    numbers = {**laid.numbers, "surface_explained": found.explained}
    if found.seen < options.least_edges or found.explained >= options.least_explained:
        return replace(laid, numbers=numbers)
    doubt = f"only {found.explained:.0%} of the image's edges are in the map where the surfaces fit"
    return replace(laid, doubts=(*laid.doubts, doubt), numbers=numbers)


def covariance_of(fit: SurfaceFit) -> FloatArray:
    """``[6, 6]`` of translation (m, world) and rotation (rad, left perturbation in the world)."""
    return covariance_from(fit.information, fit.scatter, POINTS_PER_CELL)


def _doubts(
    fit: SurfaceFit,
    covariance: FloatArray,
    standing: Standing,
    options: SurfaceVerdictOptions,
    limits: tuple[float, float],
) -> list[str]:
    found = []
    if fit.near < options.least_near or fit.through > options.most_through:
        found.append(
            f"of the surfaces {fit.near:.0%} lie where they were measured, {fit.through:.0%} were seen through"
        )
    if fit.alike < options.least_alike or fit.correlation < options.least_correlation:
        found.append(f"{fit.alike:.0%} of them look as they do in the map")
    return found + shared_doubts(covariance, standing, options, limits, "surfaces")
