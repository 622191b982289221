"""The methods that `semdb evaluate` compares: how each sets the localizer, and which features it needs."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from semdb.errors import UsageError
from semdb.localization.coarse import CoarseOptions, Scoring
from semdb.localization.localizer_options import LocalizerOptions
from semdb.localization.matching import Evidence, MatchingOptions
from semdb.localization.pose_options import PoseOptions
from semdb.localization.verdict import VerdictOptions
from semdb.training.pose_options import CNN_LSTM, POSENET, POSENET_4D

SEMDB = "semdb"
SEMDB_FRAMES = "semdb-frames"
SIFT_REFERENCE = "sift-reference"
ORACLE = "oracle"
COLMAP = "colmap"
MIDDLE_KEYFRAME, MEAN_POSE = "middle-keyframe", "mean-pose"
TRIVIAL = (MIDDLE_KEYFRAME, MEAN_POSE)
ON_KEYFRAMES = "-keyframes"  # after a network's name: it is trained on those of the map only
WITH_DEPTH = "+depth"  # after a method's name: its queries come with their depth images
COLOUR_ONLY = (SIFT_REFERENCE, COLMAP, *TRIVIAL)

# As the papers accept a pose: enough inliers, nothing else is asked.
_COUNT_ONLY = VerdictOptions(
    localized_confidence=0.0,
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
    """`features` None takes those of the settings; `query_depth` gives queries their depth images.

    `network` is the kind of a network that is trained in the place to regress poses, on the keyframes of the map only
    with `keyframes_only`, and otherwise on all frames that are not near a query. With `frames` the map has what `semdb
    refine --frames` adds, of frames that are not near a query.
    """

    name: str
    summary: str
    options: LocalizerOptions = field(default_factory=LocalizerOptions)
    features: str | None = None
    query_depth: bool = False
    network: str | None = None
    keyframes_only: bool = False
    frames: bool = False


# The filter as the paper has it: keyframes that share half of the query's objects, by counts, and no others.
_PAPER_FILTER = CoarseOptions(
    scoring=Scoring.COUNTS,
    minimum_share=0.5,
    filtered_share=1.0,
    filtered_at_most=1_000_000_000,
    class_weight=0.0,
    cascade=False,
    filtered_batches=(1,),
)
# The same with the whole budget of the default cascade, 10 keyframes, spent on what passes.
_HARD = replace(_PAPER_FILTER, filtered_batches=(1, 2, 3, 4))
_CLASSLESS = MatchingOptions(contradiction_ratio=MatchingOptions().ratio)  # a pair of two classes is like any other
_ON_OBJECTS = PoseOptions(matching=MatchingOptions(evidence=Evidence.OBJECTS), guided=False)

_LEARNT = {False: "all frames that are not near a query", True: "the keyframes of the map"}

METHODS = {
    method.name: method
    for method in (
        Method(SEMDB, "class filter, cosine, cascade; all keypoints with the objects as evidence"),
        Method(
            SEMDB_FRAMES,
            "as semdb with frames beside the keyframes (refine --frames), none of them near a query",
            frames=True,
        ),
        Method(
            "cnn",
            "as semdb with the class filter and the class term off, the same number of keyframes matched",
            LocalizerOptions(coarse=CoarseOptions(use_classes=False)),
        ),
        Method(
            "paper",
            "the paper as written: hard filter, best cosine, keypoints on objects of the same class only",
            LocalizerOptions(
                coarse=_PAPER_FILTER,
                pose=_ON_OBJECTS,
                verdict=_COUNT_ONLY,
                neighbours=0,
                twins=0,
                refined_points=False,
                surfaces=None,
                edges=None,
                by_depth=None,
                views=None,
                blur=None,
                landmarks=None,
                fallback=False,
            ),
        ),
        Method(
            "chen",
            "Chen et al.: best cosine over the whole database, ORB matches over the whole image, PnP",
            LocalizerOptions(
                coarse=CoarseOptions(use_classes=False, filtered_batches=(1,), soft_batches=(), all_batches=()),
                pose=PoseOptions(matching=_CLASSLESS, guided=False, bundle=False),
                verdict=_COUNT_ONLY,
                neighbours=0,
                twins=0,
                refined_points=False,
                surfaces=None,
                edges=None,
                by_depth=None,
                views=None,
                blur=None,
                landmarks=None,
                fallback=False,
            ),
            features="orb",
        ),
        Method(SIFT_REFERENCE, "the five keyframes nearest in true pose, SIFT 1500, ratio 0.85, LO-RANSAC"),
        Method(ORACLE, "semdb's fine step on the five keyframes nearest in true pose"),
        Method(COLMAP, "COLMAP: SIFT, all keyframes matched, points triangulated with known poses, LO-RANSAC"),
        Method(
            "semdb-counts",
            "as semdb with class scores from counted objects, without scores of detections and without layout",
            LocalizerOptions(coarse=CoarseOptions(scoring=Scoring.COUNTS)),
        ),
        Method(
            "semdb-no-confusion",
            "as semdb with a class standing for itself only, not for those it is taken for",
            LocalizerOptions(coarse=CoarseOptions(confusion=0.0)),
        ),
        Method(
            "semdb-own-points",
            "as semdb with the 3D points that each keyframe measured, without those of semdb refine",
            LocalizerOptions(refined_points=False),
        ),
        Method(
            "semdb-no-surfaces",
            "as semdb without laying the depth of queries on the map's surfaces",
            LocalizerOptions(surfaces=None),
        ),
        Method(
            "semdb-no-edges",
            "as semdb without laying the edges of queries on those of the map",
            LocalizerOptions(edges=None),
        ),
        Method(
            "semdb-no-likeness",
            "as semdb without comparing by measured depth what query and keyframe show where keypoints are not sure",
            LocalizerOptions(by_depth=None),
        ),
        Method(
            "semdb-no-views",
            "as semdb without comparing queries in doubt with what the map predicts from each pose",
            LocalizerOptions(views=None),
        ),
        Method(
            "semdb-no-fallback",
            "as semdb without asking another feature (SEMDB_FEATURES_FALLBACK) where keypoints do not convince",
            LocalizerOptions(fallback=False),
        ),
        Method("hard", "as semdb with the hard class filter alone", LocalizerOptions(coarse=_HARD)),
        Method(
            "cnn-objects",
            "as cnn with keypoints on objects of the same class only",
            LocalizerOptions(coarse=CoarseOptions(use_classes=False), pose=_ON_OBJECTS),
        ),
        Method(
            "hard-objects",
            "as hard with keypoints on objects of the same class only",
            LocalizerOptions(coarse=_HARD, pose=_ON_OBJECTS),
        ),
        Method(
            "semdb-objects",
            "as semdb with keypoints on objects of the same class only",
            LocalizerOptions(pose=_ON_OBJECTS),
        ),
        *(
            Method(
                kind + (ON_KEYFRAMES if keyframes_only else ""),
                f"{what}, trained on {_LEARNT[keyframes_only]}",
                query_depth=kind == POSENET_4D,
                network=kind,
                keyframes_only=keyframes_only,
            )
            for kind, what in (
                (POSENET, "a network that regresses the pose of an image"),
                (POSENET_4D, "the same from an image and its depth"),
                (CNN_LSTM, "PoseNet with an LSTM over the frames before the query"),
            )
            for keyframes_only in (False, True)
        ),
        Method(MIDDLE_KEYFRAME, "the pose of the keyframe in the middle of the map, whatever the query shows"),
        Method(MEAN_POSE, "the mean pose of the map's keyframes, whatever the query shows"),
    )
}
NETWORKS = tuple(name for name, method in METHODS.items() if method.network is not None)


# What each layer brings: (filter, keypoints, method), in the order of the table of `--ablation`.
ABLATION = (
    ("no filter", "all", "cnn"),
    ("hard filter", "all", "hard"),
    ("cascade", "all", SEMDB),
    ("cascade, counts only", "all", "semdb-counts"),
    ("cascade, no confusion", "all", "semdb-no-confusion"),
    ("cascade, own points", "all", "semdb-own-points"),
    ("no filter", "on objects", "cnn-objects"),
    ("hard filter", "on objects", "hard-objects"),
    ("cascade", "on objects", "semdb-objects"),
)


def method_named(name: str) -> Method:
    """The method `name`, or ``NAME+depth``. Raises UsageError that names the methods there are."""
    plain = name.removesuffix(WITH_DEPTH)
    if plain not in METHODS:
        raise UsageError(f"--method {name}: known are {', '.join(METHODS)}, and with query depth NAME{WITH_DEPTH}")
    if name == plain:
        return METHODS[plain]
    if plain in NETWORKS:
        raise UsageError(f"--method {name}: {POSENET_4D} is the network that takes depth, and takes it by itself")
    if plain in COLOUR_ONLY:
        raise UsageError(f"--method {name}: {plain} has no use for the depth of queries")
    return replace(METHODS[plain], name=name, query_depth=True)


def place_of(name: str) -> int:
    """Where a method stands in tables: as in `METHODS`, with depth where it is without."""
    return list(METHODS).index(plain) if (plain := name.removesuffix(WITH_DEPTH)) in METHODS else len(METHODS)
