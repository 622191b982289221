"""What speaks for a pose and what against it, as numbers; and from them the probability that the pose is right."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.spatial import cKDTree

from semdb.geometry import invert_pose, project, transform_points
from semdb.localization.likeness import likeness_about
from semdb.localization.pose import PoseEstimate
from semdb.localization.views import KeyframeView, View
from semdb.types import BoolArray, Float32Array, FloatArray, IntArray

GRID = 4  # cells along each side of the image
LEAST_CELLS = 4  # fewer cells that keyframes show are too few to speak for a pose
CELL_POINTS = 4  # so many points of keyframes must fall into a cell before it counts as one they show
SUPPORTER_PAIRS = 6  # a keyframe with fewer inliers says nothing of its own
NEAR_PX = 12.0  # a projected point and a keypoint this near are on the same thing
SAME_PX = 4.0  # and this near they are at the same place
LEAST_OBJECT_POINTS = 12  # fewer points on objects say nothing about classes
SHARP = 0.3  # share of aligned pairs from which on an image counts as sharp
NEUTRAL = 0.5  # of classes where there is nothing to compare, of patches where there are no images

FEATURES = (
    "first inliers",
    "inliers",
    "agreement",
    "spread",
    "explained",
    "query share",
    "likeness",
    "confirmed",
    "coverage",
    "classes",
    "rival",
    "sigma",
    "sharp but unlike",
)
# Of the logistic model; fitted by ``python -m bench.trust --fit fit``. None is negative.
WEIGHTS = (0.000, 0.000, 5.905, 0.000, 0.000, 0.438, 3.419, 0.000, 0.000, 0.000, 2.773, 0.268, 7.885)
INTERCEPT = -1.324


@dataclass(frozen=True, slots=True)
class Evidence:
    """Numbers about one pose. All but the counts, pixels, metres and degrees are shares from 0 to 1."""

    inliers: int  # distinct keypoints of the query that agree in the end
    first_inliers: int  # pairs that agreed before any was guided, of all keyframes
    first_of_best: int  # those with the keyframe that had most
    agreement: float  # their share of the pairs with that keyframe
    spread: float  # cells of a 4x4 grid over the image that hold inliers
    residual_px: float  # median
    sigma_m: float  # standard deviation of the position along its worst axis
    sigma_deg: float  # the same of the rotation
    rival: int  # first inliers of the best pose elsewhere
    supporters: int  # keyframes with at least six inlier pairs
    second: int  # inlier pairs of the second best keyframe
    explained: float  # of the keyframes' points that should be seen, those that are inliers
    query_share: float  # of the query's keypoints, those that are inliers
    aligned: float  # of the inlier pairs, those whose patches are alike to the pixel
    likeness: float  # of the best keyframe's image about its inliers, the share that looks alike in the query
    confirmed: float  # of the keyframes' points that fall on a keypoint of the query, those that look like it
    coverage: float  # of the cells in which keyframes' points should be seen (at least four), those that hold inliers
    classes: float  # of the objects' points that should be seen, those that lie on an object of their class
    class_points: int  # how many could be compared
    cosine: float  # of the best keyframe's CNN vector with the query's; NaN where it is not known
    cosine_gap: float  # that, less the best cosine of a keyframe that does not support the pose

    def as_mapping(self) -> dict[str, float]:
        """Name to number, for results and files."""
        return {name: float(value) for name, value in asdict(self).items()}


def sigmas(covariance: FloatArray | None) -> tuple[float, float]:
    """Standard deviation of position (m) and rotation (deg) along the worst axis; infinite without covariance."""
    if covariance is None:
        return float("inf"), float("inf")
    position = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0)))
    rotation = float(np.sqrt(max(np.linalg.eigvalsh(covariance[3:, 3:])[-1], 0.0)))
    return position, float(np.degrees(rotation))


def gather_evidence(
    query: View,
    keyframes: Sequence[KeyframeView],
    estimate: PoseEstimate,
    rival_inliers: int,
    cosines: Sequence[float],
) -> Evidence:
    """The evidence on `estimate`. `cosines` are those of `keyframes` (NaN where unknown).

    Keyframes that were matched after the estimate was made (to look for a twin of the place) do not support it.
    """
    pairs = np.array([*estimate.per_keyframe, *[0] * (len(keyframes) - len(estimate.per_keyframe))], int)
    order = np.argsort(-pairs, kind="stable")
    supporters = [int(n) for n in order if pairs[n] >= SUPPORTER_PAIRS] or [int(order[0])]
    explained, confirmed, coverage, classes, class_points = _what_should_be_seen(query, keyframes, estimate, supporters)
    best_slot = supporters[0]
    own = estimate.pairs.take(estimate.pairs.slot == best_slot)
    likeness = likeness_about(query, keyframes[best_slot], estimate.world_from_camera, own.query, own.keypoint)
    known = np.asarray(cosines, float)
    best = known[supporters]
    others = np.delete(known, supporters)
    cosine = float(np.nanmax(best)) if np.isfinite(best).any() else float("nan")
    gap = cosine - float(np.nanmax(others)) if np.isfinite(others).any() else float("nan")
    sigma_m, sigma_deg = sigmas(estimate.covariance)
    return Evidence(
        inliers=estimate.inliers,
        first_inliers=estimate.first_inliers,
        first_of_best=estimate.first_of_best,
        agreement=estimate.agreement,
        spread=estimate.spread,
        residual_px=estimate.residual_px,
        sigma_m=sigma_m,
        sigma_deg=sigma_deg,
        rival=rival_inliers,
        supporters=int((pairs >= SUPPORTER_PAIRS).sum()),
        second=int(pairs[order[1]]) if len(pairs) > 1 else 0,
        explained=explained,
        query_share=estimate.inliers / max(len(query), 1),
        aligned=NEUTRAL if query.grey is None else min(estimate.aligned / max(len(estimate.pairs), 1), 1.0),
        likeness=NEUTRAL if likeness is None else likeness,
        confirmed=confirmed,
        coverage=coverage,
        classes=classes,
        class_points=class_points,
        cosine=cosine,
        cosine_gap=gap,
    )


def _what_should_be_seen(
    query: View, keyframes: Sequence[KeyframeView], estimate: PoseEstimate, supporters: Sequence[int]
) -> tuple[float, float, float, float, int]:
    """The last shares of `Evidence`, from `explained` on: points of the keyframes in the query.

    Under a right pose most of what the keyframes hold is there again; under a wrong one that a single repeated thing
    supports, the rest is missing. In a room of the same shapes the points fall on keypoints that look otherwise.
    """
    size = np.array([query.camera.width, query.camera.height], float)
    tree = cKDTree(query.seen_xy) if len(query) else None
    seen = agreeing = coincident = 0
    expected = np.zeros(GRID * GRID, int)
    same = compared = 0
    for slot in supporters:
        keyframe = keyframes[slot]
        inside, pixels = _seen_points(query, keyframe, estimate)
        seen += len(inside)
        agreeing += estimate.per_keyframe[slot]
        cells = (pixels * GRID / size).astype(int)
        expected += np.bincount(cells[:, 1] * GRID + cells[:, 0], minlength=GRID * GRID)
        if tree is None:
            continue
        distance, nearest = tree.query(pixels, distance_upper_bound=NEAR_PX)
        coincident += int(np.count_nonzero(distance < SAME_PX))
        if (query.classes >= 0).any():
            near = np.isfinite(distance)
            theirs, ours = keyframe.view.classes[inside][near], query.classes[np.asarray(nearest)[near]]
            counts = (theirs >= 0) | (ours >= 0)
            compared += int(counts.sum())
            same += int((counts & (theirs == ours)).sum())
    held = _cells_of(query.seen_xy[estimate.pairs.query], size)
    shown = expected >= CELL_POINTS
    explained, confirmed = min(agreeing / max(seen, 1), 1.0), min(agreeing / max(coincident, 1), 1.0)
    coverage = float((shown & held).sum() / max(shown.sum(), LEAST_CELLS))
    classes = same / compared if compared >= LEAST_OBJECT_POINTS else NEUTRAL
    return explained, confirmed, coverage, classes, compared


def _seen_points(query: View, keyframe: KeyframeView, estimate: PoseEstimate) -> tuple[IntArray, FloatArray]:
    """Which of the keyframe's points the pose puts into the query's image, and where ``[n, 2]``, pixels as seen."""
    local = transform_points(invert_pose(estimate.world_from_camera), keyframe.world_points)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.asarray(project(query.camera, local))
    size = np.array([query.camera.width, query.camera.height], float)
    rows = np.flatnonzero((local[:, 2] > 0.1) & (pixels >= 0).all(axis=1) & (pixels < size).all(axis=1))
    return rows.astype(np.int32), pixels[rows]


def _cells_of(pixels: Float32Array, size: FloatArray) -> BoolArray:
    """Which cells ``[16]`` of the grid hold a pixel."""
    cells = np.clip((pixels * GRID / size).astype(int), 0, GRID - 1)
    held = np.zeros(GRID * GRID, np.bool_)
    held[cells[:, 1] * GRID + cells[:, 0]] = True
    return held


def confidence_features(evidence: Evidence) -> FloatArray:
    """What the confidence is made of ``[13]``, in the order of `FEATURES`; each grows with what speaks for the pose."""
    rival = evidence.rival / max(evidence.first_of_best, 1)
    # what does not look alike says little of a blurred image and much of a sharp one
    sharp_but_unlike = min(evidence.aligned / SHARP, 1.0) * (1 - evidence.likeness)
    return np.array(
        [
            np.log(max(evidence.first_inliers, 1)),
            np.log(max(evidence.inliers, 1)),
            evidence.agreement,
            evidence.spread,
            np.log(max(evidence.explained, 0.003)),
            np.log(max(evidence.query_share, 0.003)),
            evidence.likeness,
            evidence.confirmed,
            evidence.coverage,
            evidence.classes,
            -min(rival, 1.5),
            -np.log(np.clip(evidence.sigma_m, 0.0005, 0.5)),
            -sharp_but_unlike,
        ]
    )


def confidence_of(evidence: Evidence) -> float:
    """Probability 0..1 that the pose is within 0.25 m and 5 degrees of the truth: a logistic function."""
    score = INTERCEPT + float(np.dot(WEIGHTS, confidence_features(evidence)))
    return float(1 / (1 + np.exp(-np.clip(score, -30.0, 30.0))))
