"""What can be varied in the fine step."""

from __future__ import annotations

from dataclasses import dataclass, field

from semdb.localization.bundle import MotionPrior
from semdb.localization.learned_matching import KeypointMatcher
from semdb.localization.matching import MatchingOptions
from semdb.threads import cores


@dataclass(frozen=True, slots=True)
class PoseOptions:
    """Pixels are of the query image."""

    matching: MatchingOptions = field(default_factory=MatchingOptions)
    matcher: KeypointMatcher | None = None  # of the first matching; None: nearest neighbours
    max_reprojection_px: float = 5.0
    inlier_px: float = 4.0
    close_radius_px: float = 6.0  # of guided matching once images' turns are known
    pixel_sigma_px: float = 1.0  # of the finest keypoints
    aligned_sigma_px: float = 0.35  # of one whose patch was aligned
    guided: bool = True
    bundle: bool = True
    use_query_depth: bool = True
    motion: MotionPrior = field(default_factory=MotionPrior)
    threads: int = field(default_factory=cores)  # keyframes are worked on side by side
    rematched: bool = True  # once images' turns are known; else the pairs of before are kept that agree then
    evident: bool = True  # pairs say how far the poses of keyframes are off, for `recorded_covariance`
    most_pairs: int | None = None  # that are adjusted, evenly taken of all; None: every one
