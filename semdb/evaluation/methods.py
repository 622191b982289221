"""The methods that `semdb evaluate` compares: how each sets the localizer, and which features it needs."""

from __future__ import annotations

from dataclasses import dataclass, field

from semdb.errors import UsageError
from semdb.localization.coarse import CoarseOptions
from semdb.localization.localizer import LocalizerOptions
from semdb.localization.matching import Evidence, MatchingOptions
from semdb.localization.pose import PoseOptions
from semdb.localization.verdict import VerdictOptions

SEMDB = "semdb"
SIFT_REFERENCE = "sift-reference"
ORACLE = "oracle"

# As the papers accept a pose: enough inliers, nothing else is asked.
_COUNT_ONLY = VerdictOptions(
    localized_inliers=12,
    many_first_inliers=12,
    ambiguous_inliers=12,
    ambiguous_first_inliers=12,
    convincing_inliers=12,
    minimum_spread=0.0,
    maximum_translation_sigma_m=float("inf"),
    maximum_rotation_sigma_deg=float("inf"),
    rival_share=float("inf"),
)


@dataclass(frozen=True, slots=True)
class Method:
    """`features` None takes those of the settings."""

    name: str
    summary: str
    options: LocalizerOptions = field(default_factory=LocalizerOptions)
    features: str | None = None


METHODS = {
    method.name: method
    for method in (
        Method(SEMDB, "class filter, cosine, cascade; all keypoints with the objects as evidence"),
        Method(
            "cnn",
            "as semdb with the class filter and the class term off, the same number of keyframes matched",
            LocalizerOptions(coarse=CoarseOptions(use_classes=False)),
        ),
        Method(
            "paper",
            "the paper as written: hard filter, best cosine, keypoints on objects of the same class only",
            LocalizerOptions(
                coarse=CoarseOptions(cascade=False, filtered_batches=(1,)),
                pose=PoseOptions(matching=MatchingOptions(evidence=Evidence.OBJECTS), guided=False),
                verdict=_COUNT_ONLY,
                neighbours=0,
                twins=0,
            ),
        ),
        Method(
            "chen",
            "Chen et al.: best cosine over the whole database, ORB matches over the whole image, PnP",
            LocalizerOptions(
                coarse=CoarseOptions(use_classes=False, filtered_batches=(1,), soft_batches=(), all_batches=()),
                pose=PoseOptions(guided=False, bundle=False),
                verdict=_COUNT_ONLY,
                neighbours=0,
                twins=0,
            ),
            features="orb",
        ),
        Method(SIFT_REFERENCE, "the five keyframes nearest in true pose, SIFT 1500, ratio 0.85, LO-RANSAC"),
        Method(ORACLE, "semdb's fine step on the five keyframes nearest in true pose"),
    )
}


def method_named(name: str) -> Method:
    """Raises UsageError that names the methods there are."""
    if name not in METHODS:
        raise UsageError(f"--method {name}: known are {', '.join(METHODS)}")
    return METHODS[name]
