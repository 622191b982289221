"""What can be varied of a localizer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from semdb.localization.alike import LearnedVerdictOptions
from semdb.localization.blurred import BlurOptions
from semdb.localization.coarse import CoarseOptions
from semdb.localization.depth_step import DepthVerdictOptions
from semdb.localization.edge_step import EdgeVerdictOptions
from semdb.localization.landmark_pose import LandmarkPoseOptions
from semdb.localization.learned_matching import for_learned, is_learned
from semdb.localization.pose_options import PoseOptions
from semdb.localization.surface_step import SurfaceVerdictOptions
from semdb.localization.verdict import VerdictOptions
from semdb.localization.view_step import ViewOptions
from semdb.types import ModelInfo, Tolerance


@dataclass(frozen=True, slots=True)
class LocalizerOptions:
    """Everything that a method of `semdb evaluate` can vary."""

    coarse: CoarseOptions = field(default_factory=CoarseOptions)
    pose: PoseOptions = field(default_factory=PoseOptions)
    verdict: VerdictOptions = field(default_factory=VerdictOptions)
    neighbours: int = 2  # keyframes near the first pose that join once it convinces
    twins: int = 1  # keyframes far from the pose that are asked when they look as much like the query
    refined_points: bool = True  # those of `semdb refine`, where the map has not changed since
    frames: int = 2  # beside keyframes (`semdb refine --frames`), near the first pose, that join
    surfaces: SurfaceVerdictOptions | None = field(default_factory=SurfaceVerdictOptions)  # of a query with depth
    edges: EdgeVerdictOptions | None = field(default_factory=EdgeVerdictOptions)  # where neither convinces
    by_depth: DepthVerdictOptions | None = field(default_factory=DepthVerdictOptions)  # where keypoints are not sure
    views: ViewOptions | None = field(default_factory=ViewOptions)  # where poses elsewhere may be right as well
    blur: BlurOptions | None = field(default_factory=BlurOptions)  # of a query that motion has blurred
    landmarks: LandmarkPoseOptions | None = field(default_factory=LandmarkPoseOptions)  # where keypoints fail
    learned: LearnedVerdictOptions | None = None  # of a map of learned features; `for_models` sets it
    fallback: bool = True  # whether the other feature is asked that settings name, where keypoints do not convince
    recorded_errors: bool = True  # whether covariances count by how far recorded poses are off
    accept: Tolerance | None = None  # how far poses may differ that are one, where a query does not say
    twin_cosine: float = 0.05  # how much less than the best keyframe's cosine is "as much"

    def with_threads(self, threads: int) -> LocalizerOptions:
        """The same with so many threads for a query."""
        return replace(self, pose=replace(self.pose, threads=threads))

    def for_models(self, models: Sequence[ModelInfo]) -> LocalizerOptions:
        """The same with the thresholds that the local feature among `models` needs."""
        if not is_learned(models):
            return self
        pose = replace(self.pose, matching=for_learned(self.pose.matching))
        # they find a room of the same shapes as well: what they are unsure of stays in doubt
        return replace(self, pose=pose, learned=self.learned or LearnedVerdictOptions(), by_depth=None)
