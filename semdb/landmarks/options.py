"""What the computation of landmarks can be told. All lengths are metres."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class LiftOptions:
    """How masks become points.

    `border`: pixels off at the rim of a mask, `thin_border` for those of less than `thin_area` pixels. `jump_m` and
    `jump_share` (of the depth): neighbours that differ by more lie on two surfaces. `samples`: points kept of a
    sighting to compare it with others, `outline`: to know its shape. `fewest`: sightings of fewer points have no place.
    `same_mask`: masks of one keyframe with at least this intersection over union are one sighting under two names.
    Depths of a mask with a gap of `gap_m` + `gap_share` of the depth between them are of several things; those with
    `gap_kept` as many pixels as the largest stay.
    """

    border: int = 2
    thin_border: int = 1
    thin_area: int = 1500
    jump_m: float = 0.015
    jump_share: float = 0.015
    samples: int = 128
    outline: int = 768
    fewest: int = 12
    same_mask: float = 0.5
    gap_m: float = 0.08
    gap_share: float = 0.03
    gap_kept: float = 0.5


@dataclass(frozen=True, slots=True)
class SeeOptions:
    """What measured depth says of a point: visible within `near_m` + `near_share` of its depth; occluded where the
    measured depth is less; seen through where it is more by `through_m` + `through_share` of the depth.

    `grid`: columns that a keyframe's depth and
    masks are reduced to, at least. `silhouette_m`: a point that far behind a mask may be its back side.
    """

    near_m: float = 0.04
    near_share: float = 0.01
    through_m: float = 0.10
    through_share: float = 0.02
    grid: int = 320
    silhouette_m: float = 0.4


@dataclass(frozen=True, slots=True)
class RegisterOptions:
    """How poses are made to agree: `rounds`, each with `narrower` times the `reach_m` of the one before.

    `columns` of the grid of points, the best `neighbours` of each keyframe that have `least_common` of its points in
    view, within `farthest_m`. Poses are held with the sigmas of position and rotation, points with that of a point,
    and all points of a pair count as `most_points` at most.
    """

    rounds: int = 6
    reach_m: float = 0.12
    narrower: float = 0.8
    columns: int = 80
    neighbours: int = 6
    least_common: float = 0.2
    farthest_m: float = 4.0
    point_sigma_m: float = 0.01
    most_points: float = 300.0
    position_sigma_m: float = 0.01
    rotation_sigma_rad: float = 0.00873


@dataclass(frozen=True, slots=True)
class LinkOptions:
    """Weights, as log odds, of what speaks for and against two sightings being one thing: see `links.py`."""

    bias: float = -2.0
    overlap: float = 8.0
    most_overlap: float = 0.75
    same_class: float = 1.0
    taken_for: float = 0.0
    other_class: float = -2.0
    agree: float = 1.0
    conflict: float = -2.0
    most_views: int = 4
    apart: float = -12.0


@dataclass(frozen=True, slots=True)
class ShapeOptions:
    """`kept_share`: a point stays in a landmark when it lies in its masks in this share of the views that see it, and
    where depth is as good as exact, in `fewest_views`. A point is seen where a surface lies within `near_m` +
    `near_deviations` of its depth (see `VisitOptions`). `trim`: share of the points off at each end of the box,
    `noisy_trim` where depth has noise. `noise_share`: of the noise of depth that points have on which it is that of one
    pixel, `fitted_share` of that where it is that of a plane; sides are shorter by it. `voxel`: one point of each cube
    of this side.
    """

    kept_share: float = 0.5
    fewest_views: int = 2
    near_m: float = 0.01
    near_deviations: float = 3.0
    least_noise: float = 0.25
    trim: float = 0.003
    noisy_trim: float = 0.01
    noise_share: float = 1.0
    fitted_share: float = 0.4
    voxel: float = 0.01
    most_points: int = 3000


@dataclass(frozen=True, slots=True)
class VisitOptions:
    """What a visit says of a thing that it shows no sighting of.

    `points` of the thing are looked up, evenly taken. One is seen within `near_m` + `near_deviations` of its depth, and
    seen through where all that was measured about it is farther by `through_m` + `through_deviations`. A deviation is
    that of depth there and that by which the visit's keyframe disagrees with its neighbours, `least_noise` of what
    structured light has at least. A thing is absent
    where at least `through_share` of its points are seen through, and `through_to_seen` times as many as are seen; or
    where it is `clear_share` and `clear_to_seen`, since the rest is hidden. A
    keyframe that sees `missed_share` of them in no mask missed it.
    """

    points: int = 400
    near_m: float = 0.008
    near_deviations: float = 2.0
    through_m: float = 0.012
    through_deviations: float = 3.5
    least_noise: float = 0.25
    through_share: float = 0.4
    through_to_seen: float = 1.0
    clear_share: float = 0.3
    clear_to_seen: float = 10.0
    missed_share: float = 0.5


@dataclass(frozen=True, slots=True)
class LandmarkOptions:
    """All options. A landmark is confirmed by so many keyframes, which are at least a share of those that should have
    seen it; one counts as far as its highest score under the landmark's name is that of a `sure_score`, and all
    together have to make up for as many sure ones. `gone`: later keyframes that see through it. `one_place`: two that
    no keyframe saw beside each other are one where so much of the smaller box lies in the other.
    """

    lift: LiftOptions = LiftOptions()
    see: SeeOptions = SeeOptions()
    register: RegisterOptions = RegisterOptions()
    link: LinkOptions = LinkOptions()
    shape: ShapeOptions = ShapeOptions()
    visit: VisitOptions = VisitOptions()
    confirmed: int = 3
    sure_score: float = 0.5
    confirmed_share: float = 0.2
    gone: int = 2
    one_place: float = 0.3

    def least(self, keyframes: int, missed: int) -> float:
        """How many keyframes have to show a thing that so many show and missed."""
        return max(self.confirmed, self.confirmed_share * (keyframes + missed))
