"""What can be varied in finding a trajectory."""

from __future__ import annotations

from dataclasses import dataclass, field

from semdb.localization.bundle import MotionPrior
from semdb.localization.matching import MatchingOptions
from semdb.localization.pose_options import PoseOptions
from semdb.localization.surface_alignment import THOROUGH
from semdb.localization.surface_step import SurfaceVerdictOptions
from semdb.localization.verdict import VerdictOptions
from semdb.threads import cores
from semdb.trajectory.consistency import ConsistencyOptions


@dataclass(frozen=True, slots=True)
class FrameOptions:
    """Which frames say nothing: fewer keypoints than `least_keypoints` are too few to be placed by."""

    least_keypoints: int = 30
    dark: float = 30.0  # grey value that 95 of 100 pixels of a dark image stay below
    plain: float = 6.0  # standard deviation of grey values of an image that shows nothing


@dataclass(frozen=True, slots=True)
class TrackingOptions:
    """A frame is placed by the `local` keyframes nearest to where it should be.

    Where the motion is known, points are looked for within `predicted_px` of where it puts them; the pose counts when
    `predicted_share` of the pairs found so agree, and `predicted_inliers` at least. A pose counts with
    `least_inliers` that cover `least_spread` of the image and is sure to `most_sigma_m`; below `many_inliers` the depth
    of both frames must fit it too: `least_agreement` of their points. A step of more than `jump_m`
    and `jump_deg` in a tenth of a second is none.
    """

    local: int = 2
    predicted_px: float = 20.0
    predicted_inliers: int = 60
    predicted_share: float = 0.5
    least_inliers: int = 25
    many_inliers: int = 120
    few_inliers: int = 70  # with fewer, surfaces have a say, too
    least_agreement: float = 0.6
    least_spread: float = 0.19
    most_sigma_m: float = 0.05
    most_sigma_deg: float = 2.0  # of a frame laid on surfaces
    surfaces_gap_s: float = 3.0  # for so long the motion says where to begin
    surfaces: int = 4  # keyframes on whose surfaces a frame is laid that keypoints do not carry
    patience: int = 3  # frames that may be lost before a new piece begins
    relocalize: int = 6  # keyframes that a lost frame is compared with
    jump_m: float = 0.4
    jump_deg: float = 40.0
    motion_gap_s: float = 1.0  # a motion is believed to go on for so long


@dataclass(frozen=True, slots=True)
class KeyframeOptions:
    """A frame becomes a keyframe when no keyframe has `common_view` with it; a blurred one waits until `urgent_view`.

    Blurred is one with fewer than `sharp` of the keypoints that frames about it have.
    """

    common_view: float = 0.9
    urgent_view: float = 0.65
    sharp: float = 0.6
    least_points: int = 80  # with depth
    urgent_inliers: int = 70
    far: float = 0.4  # (`pose_distances`) from all others, where few keypoints agree: what is seen of surfaces changes
    most_frames: int = 30  # between two keyframes of a camera that moves


@dataclass(frozen=True, slots=True)
class ClosureOptions:
    """Which keyframes are compared to close loops: `alike` by place vector, `near` by where they are thought to be.

    They are at least `apart_s` seconds, or `apart_keyframes` keyframes, apart.
    """

    apart_s: float = 5.0
    apart_keyframes: int = 12
    alike: int = 3
    near: int = 3
    enough: int = 1  # closures of a keyframe: near ones are compared where one of both has fewer
    near_view: float = 0.2  # common view that is expected of near ones
    candidates: int = 32  # whose view is compared, of those that look nearest by
    session_confidence: float = 0.95  # of a closure between pieces, which no odometry confirms
    side_pairs: int = 12  # of two joined pieces that have half of their view in common are looked at:
    side_view: float = 0.5
    side_near: float = 2.0  # (`pose_distances`: 0.3 m or 15 degrees) nearly all of those so near
    side_share_near: float = 0.6
    side_farthest: float = 5.0  # and some of those so far must show the same, if there are
    side_share_far: float = 0.2
    side_least: int = 4
    tie_points: int = 20  # that two keyframes share after bundle adjustment, and
    tie_spread: float = 0.25  # of a 4x4 grid over both images that they cover: a closure too
    rounds: int = 2
    least_agreement: float = 0.4  # of both keyframes' depth
    first_inliers: int = 10  # before any is guided, with one keyframe: fewer are not looked at again
    agree_m: float = 0.03  # by which both ways may differ, or
    agree_deg: float = 1.5
    agree_sigmas: float = 4.0  # by so many standard deviations
    most_off_m: float = 0.06  # from where all keyframes together put it
    most_off_deg: float = 2.0
    verdict: VerdictOptions = field(default_factory=VerdictOptions)


@dataclass(frozen=True, slots=True)
class AdjustmentOptions:
    """Bundle adjustment over keyframes: each is compared with the `neighbours` that have most in common with it."""

    neighbours: int = 14
    least_share: float = 0.15
    candidates: int = 64
    radii_px: tuple[float, ...] = (16.0, 8.0)  # of guided matching, one for each round
    pixel_sigma_px: float = 1.0
    aligned_sigma_px: float = 0.35
    least_observations: int = 30  # a keyframe with fewer is left as the pose graph has it
    turn_rad: float = 0.02
    residual_turn_rad: float = 0.003
    noise_rounds: int = 2
    least_turn_rad: float = 0.0003
    max_iterations: int = 20


def _where_motion_leads() -> SurfaceVerdictOptions:
    """Fewer keypoints have to vouch than for a query: it is known where the camera was; more has to fit."""
    return SurfaceVerdictOptions(fit=THOROUGH, least_near=0.7, least_support=4)


@dataclass(frozen=True, slots=True)
class TrajectoryOptions:
    """All of it. `close_loops` and `adjust` can be switched off, to see what they bring."""

    max_keypoints: int = 800
    frames: FrameOptions = field(default_factory=FrameOptions)
    tracking: TrackingOptions = field(default_factory=TrackingOptions)
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)
    closures: ClosureOptions = field(default_factory=ClosureOptions)
    consistency: ConsistencyOptions = field(default_factory=ConsistencyOptions)
    adjustment: AdjustmentOptions = field(default_factory=AdjustmentOptions)
    matching: MatchingOptions = field(default_factory=MatchingOptions)
    surfaces: SurfaceVerdictOptions = field(default_factory=_where_motion_leads)
    motion: MotionPrior = field(default_factory=MotionPrior)
    close_loops: bool = True
    adjust: bool = True
    upright: bool = True  # turn worlds so that z is up, where surfaces tell it
    threads: int = field(default_factory=cores)

    @property
    def pose(self) -> PoseOptions:
        """Those of the fine step, which places frames."""
        return PoseOptions(matching=self.matching, motion=self.motion, threads=self.threads)
