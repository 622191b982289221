"""What can be varied in tracking."""

from __future__ import annotations

from dataclasses import dataclass, field

from semdb.localization.pose_options import PoseOptions
from semdb.localization.verdict import VerdictOptions

CHI2_6_99 = 16.81  # 99 % of the squared distances of six normal numbers lie below


@dataclass(frozen=True, slots=True)
class PlacingOptions:
    """How a frame is placed near a prediction.

    Points of the `keyframes` nearest to it are looked for within a radius that its covariance gives, from `least_px` to
    `most_px`. A pose holds by itself with `strong_inliers` that are `strong_share` of the pairs; with less, down to
    `least_inliers`, all the evidence that the verdict on a single image weighs must speak for it. Depth, pixels and
    `most_pairs` of points take part as in localization.
    """

    keyframes: int = 3
    farthest: float = 8.0  # of `pose_distances` from the prediction: 0.3 m or 15 degrees each
    least_px: float = 16.0
    most_px: float = 60.0
    sampled: int = 250  # pairs that the first pose is looked for among
    iterations: int = 40
    least_inliers: int = 20
    least_first_share: float = 0.15
    strong_inliers: int = 60
    strong_share: float = 0.4
    least_spread: float = 0.19
    most_sigma_m: float = 0.06
    most_sigma_deg: float = 1.5
    pose: PoseOptions = field(default_factory=lambda: PoseOptions(most_pairs=400, rematched=False))
    verdict: VerdictOptions = field(default_factory=VerdictOptions)


@dataclass(frozen=True, slots=True)
class MotionOptions:
    """How a camera moves, and what is known of errors (standard deviations).

    Between frames its velocity changes as by accelerations of `acceleration` (m/s^2) and `turn_acceleration` (rad/s^2),
    those of a hand or a robot. A step seen between two images is uncertain by what its pairs say times `step_factor`,
    by `step_m`, `step_rad`, and by shares of itself: a rolling shutter bends images of a camera that turns. An exact
    step is uncertain by what its pairs say times `exact_factor`, by a share of its way, and by a share of how far the
    images turned while they were read out. Maps whose recorded poses are not quite those of their images are bent, and
    a pose in them moves otherwise than the camera: `recorded` times the variance that keyframes show of that is added,
    and where that and the turns make more than `bent_m` no step is looked at exactly.
    How much of the rest there is shows in how far poses in the map are from where steps put them: that scales this
    noise, from `first_unrest` on, over about `memory` frames.
    Odometry of the robot is uncertain by shares of the way and of the turn. Of the variance of a pose in the map, the
    share `lasting` is common to what is seen from about the same place (errors of keyframes' poses and depth): it goes
    away over `forgotten` of `pose_distances`, not with time.
    """

    acceleration: float = 1.5
    turn_acceleration: float = 4.0
    astray_m_s: float = 0.12  # how far off it gets in the longer run, a second
    astray_rad_s: float = 0.15
    slows_s: float = 0.7  # what is not seen is thought to come to rest in so long
    step_factor: float = 2.0
    step_m: float = 0.0005
    step_rad: float = 0.0003
    step_turn_share: float = 0.01
    step_way_share: float = 0.01
    step_m_per_rad: float = 0.02
    exact_factor: float = 1.4
    exact_m: float = 0.0001
    exact_rad: float = 0.0001
    exact_way_share: float = 0.02
    exact_m_per_rad: float = 0.06
    exact_rad_per_rad: float = 0.05
    recorded: float = 3.0
    bent_m: float = 0.004
    first_unrest: float = 4.0
    least_unrest: float = 0.05
    most_unrest: float = 100.0
    memory: float = 12.0
    odometry_share: float = 0.03
    odometry_m: float = 0.002
    odometry_rad: float = 0.002
    lasting: float = 0.05
    forgotten: float = 1.0


@dataclass(frozen=True, slots=True)
class TrackerOptions:
    """All of it.

    A camera that sees nothing of the map coasts for `coast_s`, or until it may be `coast_m` or `coast_deg` off.
    """

    placing: PlacingOptions = field(default_factory=PlacingOptions)
    motion: MotionOptions = field(default_factory=MotionOptions)
    gate: float = CHI2_6_99
    jump_m: float = 0.3  # a convincing pose so far from the expected one is not a surprise but a contradiction
    jump_deg: float = 15.0
    agree_m: float = 0.1  # two relocalizations so near to each other agree, whatever their covariances
    agree_deg: float = 4.0
    coast_s: float = 5.0
    coast_m: float = 2.0
    coast_deg: float = 65.0
    sure: float = 0.95  # confidence of a first answer that needs no second one
    step: bool = True  # the motion between two images is seen in them
