"""The motion between two images: roughly before a frame is placed, exactly after."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose, pixels_to_normalized, project_to_so3, so3_log, transform_points
from semdb.geometry.sensor import depth_noise
from semdb.localization.alignment import LEAST_LIKENESS, patch_steps, patch_warps
from semdb.localization.bundle import pixel_sigma
from semdb.localization.matching import match_keypoints
from semdb.localization.pairs import Pairs, guided_pairs, reprojection_px, world_points_of
from semdb.localization.pose import robust_pnp
from semdb.localization.views import KeyframeView, View
from semdb.tracking.options import PlacingOptions
from semdb.tracking.placing import Placed, fitted_pose, project_all
from semdb.tracking.pose_filter import Step
from semdb.types import BoolArray, FloatArray, IntArray

LEAST_STEP_PAIRS = 25
MOST_STEP_PAIRS = 400
RELIEF_SHARE, RELIEF_PX = 0.7, 35.0  # what else is shown so near to a keypoint may mislead its patch
STEP_PX = 3.0  # of pairs of two images that agree on a step
CAUCHY_PX = 1.0
STEP_RADIUS_PX = 40.0  # around where the motion before puts a point
STRONGEST = (300, 700)  # keypoints of the frame before and of this one, for a first look anywhere
ALIGNED_PX = 0.15  # how exact a patch of the image before is found
UNALIGNED = 0.7  # of the noise of keypoints: two images of one camera at about the same place
TURN_SHARE, TURN_RAD = 0.15, 0.0005  # how far turns during the readout, as seen in the map, may be off
DEPTH_FACTOR = 2.0  # of the sensor's noise: points are seen from elsewhere
ROUNDS = 8
STILL = 1e-6  # m and rad: the next round would change nothing


@dataclass(frozen=True, slots=True, eq=False)
class SeenStep:
    """A step with the pairs that agree on it: keypoints `before` ``[n]`` of the frame before, `after` ``[n]`` of it."""

    step: Step
    before: IntArray
    after: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameBefore:
    """The last frame as a keyframe in its own camera; `turn` ``[3]`` (rad) is how it turned while it was read out.

    None where that is not known: nothing near has placed it.
    """

    keyframe: KeyframeView
    turn: FloatArray | None


def frame_before(view: View, placed: Placed | None) -> FrameBefore | None:
    """A frame as a keyframe in its own camera: with measured depth, and where that is none with that of the map."""
    depth = view.points[:, 2].astype(np.float64)
    if placed is not None:
        pairs, camera_from_world = placed.estimate.pairs, invert_pose(placed.pose)
        for slot, keyframe in enumerate(placed.keyframes):
            here = np.flatnonzero(pairs.slot == slot)
            rows = pairs.query[here]
            z = transform_points(camera_from_world, keyframe.world_points[pairs.keypoint[here]])[:, 2]
            depth[rows] = np.where(np.isfinite(depth[rows]), depth[rows], z)
    kept = np.flatnonzero(np.isfinite(depth) & (depth > 0)).astype(np.int32)
    if not len(kept):
        return None
    points = np.column_stack([view.xy[kept] * depth[kept, None], depth[kept]])
    own = replace(
        view, seen_xy=view.seen_xy[kept], xy=view.xy[kept], size=view.size[kept],
        descriptors=view.descriptors[kept], classes=view.classes[kept], signs=view.signs[kept],
        points=points.astype(np.float32), source=view.source[kept],
        looser=None if view.looser is None else view.looser[kept],
    )  # fmt: skip
    known = KeyframeView(-1, own, np.eye(4), np.eye(4), points)
    return FrameBefore(known, None if placed is None else placed.estimate.turn)


def refined_step(before: FrameBefore, view: View, seen: SeenStep, turn: FloatArray) -> Step | None:
    """The step by patches of the frame before that are aligned in `view`, which turned by `turn` ``[3]`` (rad) while
    it was read out. None where what is seen does not determine it.
    """
    from semdb.tracking.step_kernels import solve_step

    own, chosen = before.keyframe.view, seen.before
    after_from_before = invert_pose(seen.step.before_from_after)
    xy, found = _aligned(own, view, seen, after_from_before)
    points = own.points[chosen].astype(np.float64)
    if before.turn is not None:
        points -= np.cross(before.turn * own.image_row[chosen, None], points)
    sigma = UNALIGNED * pixel_sigma(view.size[seen.after], view.focal)
    sigma = np.where(found, ALIGNED_PX / view.focal, sigma)
    way = float(np.linalg.norm(after_from_before[:3, 3]))
    sigma = np.hypot(sigma, DEPTH_FACTOR * way * depth_noise(points[:, 2]) / points[:, 2] ** 2)
    relief = _relief(own, chosen)
    sigma = np.hypot(sigma, RELIEF_SHARE * way * relief)
    observed = np.column_stack([xy, sigma, view.image_row[seen.after]])
    prior = 1 / (TURN_RAD**2 + (TURN_SHARE * np.abs(turn)) ** 2)
    pose, turned, chi2 = after_from_before.copy(), turn.copy(), np.empty(len(points))
    equations, gradient = np.empty((9, 9)), np.empty(9)
    if not solve_step(points, observed, prior, turn, ROUNDS, STILL, pose, turned, equations, gradient, chi2):
        return None
    pose[:3, :3] = project_to_so3(pose[:3, :3])
    scale = max(float(np.median(chi2)) / (2 * np.log(2)), 0.2)  # Rayleigh
    try:
        covariance = np.linalg.inv(equations)[:6, :6] * scale
    except np.linalg.LinAlgError:
        return None
    return Step(invert_pose(pose), _of_inverse(covariance, pose)) if np.isfinite(covariance).all() else None


def _aligned(own: View, view: View, seen: SeenStep, after_from_before: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Where `view` shows the keypoints ``[n, 2]``, normalised, and which of them by their patches ``[n]``."""
    from semdb.localization.alignment_kernels import align_patches

    found = np.zeros(len(seen.before), np.bool_)
    if own.grey is None or view.grey is None:
        return view.xy[seen.after], found
    warp, step = patch_warps(view, own, seen.before, after_from_before), patch_steps(own, seen.before)
    guess = view.seen_xy[seen.after].astype(np.float64)
    answer, likeness = np.zeros((len(guess), 2)), np.empty(len(guess))
    align_patches(own.grey, view.grey, own.seen_xy[seen.before].astype(np.float64), warp, step, guess, answer, likeness)
    found = likeness > LEAST_LIKENESS
    xy = view.xy[seen.after].copy()
    xy[found] = pixels_to_normalized(view.camera, answer[found])
    found &= np.isfinite(xy).all(axis=1)
    return np.where(found[:, None], xy, view.xy[seen.after]), found


def _relief(own: View, chosen: IntArray) -> FloatArray:
    """How much the inverse depth (1/m) of other keypoints near each of `chosen` differs from its own, at most ``[n]``.

    A patch over the edge of something shows what is behind it, too, which moves otherwise.
    """
    from semdb.tracking.step_kernels import largest_difference

    found = np.zeros(len(chosen))
    at, inverse = own.seen_xy.astype(np.float64), 1 / own.points[:, 2].astype(np.float64)
    largest_difference(at, inverse, np.argsort(at[:, 0], kind="stable"), chosen, RELIEF_PX, found)
    return found


def _of_inverse(covariance: FloatArray, pose: FloatArray) -> FloatArray:
    """The covariance ``[6, 6]`` of the inverse of `pose`: its error, on the left, turned by the inverse's rotation."""
    adjoint = np.zeros((6, 6))
    adjoint[:3, :3] = adjoint[3:, 3:] = pose[:3, :3].T
    found: FloatArray = adjoint @ covariance @ adjoint.T
    return found


def step_between(
    before: KeyframeView, view: View, expected: FloatArray, options: PlacingOptions, *, steady: bool = True
) -> SeenStep | None:
    """The motion from the image `before`, whose world is its own camera, to `view`; `expected` ``[4, 4]`` is a guess.

    Pairs are looked for where the guess puts them, then everywhere; where the camera is not `steady`, so that guesses
    are wrong anyway, the other way round. None where too few agree.
    """

    def guided() -> SeenStep | None:
        near = replace(options.pose.matching, guided_radius_px=STEP_RADIUS_PX)
        pairs = guided_pairs(view, [before], project_all(view, [before], expected), near)
        return _step(before, view, pairs, options, expected)

    def anywhere() -> SeenStep | None:
        few = _step(before, view, _all_pairs(before, view, options, *STRONGEST), options)
        return few or _step(before, view, _all_pairs(before, view, options), options)

    first, second = (guided, anywhere) if steady else (anywhere, guided)
    return first() or second()


def is_steady(view: View, expected: FloatArray, found: FloatArray) -> bool:
    """Whether a step ``[4, 4]`` was one that `expected` lets pairs of it be found."""
    turn = so3_log(expected[:3, :3].T @ found[:3, :3])
    return float(np.linalg.norm(turn)) * view.focal < STEP_RADIUS_PX / 2


def _all_pairs(
    before: KeyframeView, view: View, options: PlacingOptions, most_before: int | None = None, most: int | None = None
) -> Pairs:
    """Pairs of the strongest keypoints of both images, wherever they are; of all without numbers."""
    own = before.view
    matches = match_keypoints(
        view.descriptors[:most], own.descriptors[:most_before], view.classes[:most], own.classes[:most_before],
        options.pose.matching, query_signs=view.signs[:most], keyframe_signs=own.signs[:most_before],
    )  # fmt: skip
    return Pairs(matches.query, np.zeros(len(matches), np.int32), matches.keyframe, matches.same_class)


def _step(
    before: KeyframeView, view: View, pairs: Pairs, options: PlacingOptions, expected: FloatArray | None = None
) -> SeenStep | None:
    if len(pairs) < LEAST_STEP_PAIRS:
        return None
    points = world_points_of(pairs, [before])
    sample = np.linspace(0, len(pairs) - 1, min(MOST_STEP_PAIRS, len(pairs))).astype(np.int32)
    pairs, points = pairs.take(sample), points[sample]
    if expected is None:
        found = robust_pnp(view, pairs, points, options.pose, options.iterations)
        start = None if found is None else found[0]
    else:
        start = fitted_pose(view, invert_pose(expected), pairs, points, options.pose.max_reprojection_px)
    if start is None:
        return None
    near = reprojection_px(view, start, pairs.query, points) < STEP_PX
    if near.sum() < LEAST_STEP_PAIRS or near.mean() < options.strong_share:
        return None
    pairs, points = pairs.take(near), points[near]
    after_from_before = fitted_pose(view, start, pairs, points, CAUCHY_PX)
    if after_from_before is None:
        return None
    covariance = _covariance_of(view, after_from_before, view.xy[pairs.query] * view.focal, points)
    if covariance is None:
        return None
    return SeenStep(Step(invert_pose(after_from_before), covariance), pairs.keypoint, pairs.query)


def _covariance_of(view: View, pose: FloatArray, pixels: FloatArray, points: FloatArray) -> FloatArray | None:
    """``[6, 6]`` of a step in the frame before it (m, left rad), from how far pixels ``[n, 2]`` are off."""
    local = transform_points(pose, points)
    x, y, z = local.T
    error = (local[:, :2] / z[:, None]) * view.focal - pixels
    variance = float(np.median((error**2).sum(axis=1)) / (2 * np.log(2)))  # Rayleigh
    weight = 1 / (1 + (error**2).sum(axis=1) / CAUCHY_PX**2)
    jacobian = np.zeros((len(points), 2, 6))  # of a translation and a left rotation of the camera's frame
    jacobian[:, 0, 0] = jacobian[:, 1, 1] = view.focal / z
    jacobian[:, 0, 2], jacobian[:, 1, 2] = -view.focal * x / z**2, -view.focal * y / z**2
    turned = np.zeros((len(points), 3, 3))  # d(exp(w) p) / dw
    turned[:, 0, 1], turned[:, 0, 2], turned[:, 1, 2] = z, -y, x
    turned -= turned.transpose(0, 2, 1)
    jacobian[:, :, 3:] = jacobian[:, :, :3] @ turned
    information = np.einsum("n,nij,nik->jk", weight, jacobian, jacobian) / max(variance, 0.05)
    try:
        inverse = np.linalg.inv(information)
    except np.linalg.LinAlgError:
        return None
    covariance = _of_inverse(inverse, pose)
    return covariance if np.isfinite(covariance).all() else None
