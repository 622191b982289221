"""Another local feature, asked where that of the map does not convince: a learned one sees the same from farther away.

The map does not store its keypoints: they are made of images and depths of keyframes when these are first asked for,
and kept in memory. So every map has them that has images and depth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semdb.database.records import StoredKeyframe
from semdb.database.store import Store
from semdb.geometry import invert_pose, pose_error, transform_points
from semdb.localization.alike import Alike, LearnedVerdictOptions, Seen, WithDepth, alike_of, weigh_learned
from semdb.localization.confidence import Evidence
from semdb.localization.learned_matching import KeypointMatcher, for_learned, is_learned
from semdb.localization.likeness import small_inverse_depth
from semdb.localization.pose import PoseEstimate
from semdb.localization.pose_options import PoseOptions
from semdb.localization.shape_cache import ShapeCache
from semdb.localization.verdict import Judgement, VerdictOptions, is_precise
from semdb.localization.views import ClassNumbers, KeyframeView, View, make_view
from semdb.perception.keypoints import find_keypoints
from semdb.perception.protocols import FeatureExtractor
from semdb.perception.quality import with_contrast
from semdb.types import Description, Float32Array, FloatArray, ImageArray, Tolerance, Verdict

CAPACITY = 128  # keyframes; about 0.7 MiB each
BATCHES = (3, 7)  # keyframes that are asked, those with most pairs first


@dataclass(frozen=True, slots=True)
class FallbackOptions:
    """When both features together are sure. Chosen on the red kitchen with 6 keyframes and one rendered room with its
    copies: there the lesser likeness by depth is at most 0.82 of wrong poses, at least 0.84 of right ones; and judged
    on other rooms (docs/features.md).
    """

    least_alike: float = 0.83  # of what is about the inliers of each feature (`likeness_by_depth`)
    least_alike_in_all: float = 0.55  # of all that the query should see, by the mean of both
    least_confidence: float = 0.5  # of the fallback's pose
    least_own: int = 16  # first inliers of the map's own feature, below which its pose says nothing
    same: Tolerance = field(
        default_factory=lambda: Tolerance(0.15, 5.0)
    )  # how far the poses of two features may differ that are one
    # A keyframe with fewer of the own keypoints is of plain things: that these do not agree says nothing. Those of the
    # plain cabinet have 230 in the mean, of rooms, kitchen and desk 1100 to 1500.
    plain: int = 500
    # What has to look alike then: of the cabinet at least 0.75 of all is, of other plain rooms with its things 0.54
    alone: LearnedVerdictOptions = field(default_factory=lambda: LearnedVerdictOptions(0.8, 0.65))


@dataclass(frozen=True, slots=True, eq=False)
class Fallback:
    """A feature beside that of a map; `dynamic` are the classes on which none of its keypoints lie."""

    extractor: FeatureExtractor
    matcher: KeypointMatcher | None = None
    dynamic: frozenset[str] = field(default_factory=frozenset)

    @property
    def name(self) -> str:
        return self.extractor.info.name

    def pose_options(self, options: PoseOptions) -> PoseOptions:
        """`options` of the map's own feature with the thresholds of this one."""
        matching = for_learned(options.matching) if is_learned([self.extractor.info]) else options.matching
        return replace(options, matching=matching, matcher=self.matcher)

    def view_of(self, description: Description, numbers: ClassNumbers) -> View | None:
        """The view of a query; None where its image is not at hand."""
        if description.grey is None:
            return None
        objects = [(found.category, found.mask) for found in description.detections]
        keypoints = find_keypoints(
            self.extractor, description.camera, description.grey, description.depth, objects, self.dynamic
        )
        names = [category for category, _ in objects]
        return make_view(description.camera, keypoints, names, numbers, grey=description.grey)


def fallback_cache(store: Store, fallback: Fallback, numbers: ClassNumbers) -> ShapeCache[View, KeyframeView]:
    """Of the keypoints that `fallback` finds in keyframes."""

    def made(stored: StoredKeyframe, depth: Float32Array, grey: ImageArray) -> View | None:
        categories = [found.category for found in stored.objects]
        objects = list(zip(categories, store.load_masks(stored.id), strict=True))
        seen, _ = with_contrast(grey)  # as the query is shown
        keypoints = find_keypoints(fallback.extractor, stored.camera, seen, depth, objects, fallback.dynamic)
        view = make_view(stored.camera, keypoints, categories, numbers, with_points_only=True, grey=grey)
        return replace(view, inverse_depth=small_inverse_depth(stored.camera, depth))

    return ShapeCache(store, made, placed_view, CAPACITY)


def placed_view(keyframe_id: int, view: View, world_from_camera: FloatArray) -> KeyframeView:
    """`view` with its points moved to the world."""
    points = transform_points(world_from_camera, view.points)
    return KeyframeView(keyframe_id, view, world_from_camera, invert_pose(world_from_camera), points)


def asked_first(keyframes: Sequence[KeyframeView], pairs: Sequence[int]) -> list[list[int]]:
    """Ids of `keyframes` in the batches in which they are asked: those with most `pairs` ``[n]`` first."""
    order = np.argsort(-np.asarray([*pairs, *[0] * (len(keyframes) - len(pairs))]), kind="stable")
    ids = [keyframes[n].keyframe_id for n in order if keyframes[n].keyframe_id > 0]
    first = BATCHES[0]
    return [batch for batch in (ids[:first], ids[first : first + BATCHES[1]]) if batch]


def alike_by_depth(own: Seen | None, other: Seen | None, with_depth: WithDepth) -> Alike | None:
    """What looks alike about the pairs of the feature where it is less, and the mean of both of all that is seen.

    Of each feature the query, its best keyframe and its pose. None where one has no pose, or cannot be compared.
    """
    if own is None or other is None:
        return None
    first, second = alike_of(own, with_depth), alike_of(other, with_depth)
    if first is None or second is None:
        return None
    return Alike(min(first.about, second.about), (first.in_all + second.in_all) / 2)


def fallback_numbers(
    before: PoseEstimate | None, found: PoseEstimate, evidence: Evidence, confidence: float, alike: Alike | None
) -> dict[str, float]:
    """What a fallback found, beside the evidence: how sure, of how many keypoints, and how far from the own pose."""
    by_depth = (float("nan"), float("nan")) if alike is None else (alike.about, alike.in_all)
    metres, degrees = (float("nan"), float("nan"))
    if before is not None:
        metres, degrees = pose_error(before.world_from_camera, found.world_from_camera)
    names = ("inliers", "first_inliers", "agreement", "likeness")
    numbers = {f"fallback_{name}": float(getattr(evidence, name)) for name in names}
    numbers |= {"fallback_confidence": confidence, "fallback_metres": metres, "fallback_degrees": degrees}
    return numbers | dict(zip(("fallback_alike", "fallback_alike_in_all"), by_depth, strict=True))


def weigh_fallback(
    before: PoseEstimate | None,
    evidence: Evidence | None,
    found: PoseEstimate,
    anew: Evidence,
    alike: Alike | None,
    judgement: Judgement,
    options: FallbackOptions,
    bounds: VerdictOptions,
    accept: Tolerance | None,
) -> Judgement | None:
    """The verdict that both features together give the pose that a fallback `found`; None where it is not sure.

    `judgement` is that of the fallback alone, from its evidence `anew`; `before` and `evidence` are of the map's own
    feature. Learned features match what is of one shape whatever its texture, so that they alone take a room of the
    same shapes for the map's: the own feature has to find the pose too, not surely, and what either sees about its
    pairs has to look `alike`, by the depth of keyframes.
    """
    if before is None or evidence is None or alike is None or evidence.first_inliers < options.least_own:
        return None
    for one in (evidence, anew):  # two places are alike: each feature may take the one for the other
        if one.rival > bounds.rival_share * one.first_of_best:
            return None
    limit = options.same if accept is None else Tolerance(max(options.same.metres, accept.metres), options.same.degrees)
    metres, degrees = pose_error(before.world_from_camera, found.world_from_camera)
    looks_alike = alike.about >= options.least_alike and alike.in_all >= options.least_alike_in_all
    sure = judgement.confidence >= options.least_confidence and looks_alike
    enough = anew.inliers >= bounds.localized_inliers and is_precise(anew, bounds)
    if not (sure and enough and metres <= limit.metres and degrees <= limit.degrees):
        return None
    return Judgement(Verdict.LOCALIZED, max(judgement.confidence, bounds.localized_confidence), judgement.reason)


def weigh_alone(
    before: PoseEstimate | None,
    evidence: Evidence | None,
    found: PoseEstimate,
    anew: Evidence,
    alike: Alike | None,
    judgement: Judgement,
    options: FallbackOptions,
) -> Judgement | None:
    """The verdict on the pose that a fallback `found` where the map's own feature sees too little to deny it.

    `judgement` is that of the fallback alone, from its evidence `anew`: it has to be sure, and the query to look
    `alike`. None where it is not so, or where the own feature has a pose elsewhere.
    """
    if alike is None or judgement.verdict is not Verdict.LOCALIZED:
        return None
    if before is not None and evidence is not None and evidence.first_inliers >= options.least_own:
        metres, degrees = pose_error(before.world_from_camera, found.world_from_camera)
        if metres > options.same.metres or degrees > options.same.degrees:
            return None
    weighed = weigh_learned(judgement, anew, alike, options.alone)
    return weighed if weighed.verdict is Verdict.LOCALIZED else None
