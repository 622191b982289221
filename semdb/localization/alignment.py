"""Matched keypoints to a fraction of a pixel: the keyframe's patch is looked for again in the query's image.

A detector finds a blob in two images independently, each time with an error of its own (half a pixel to one for SURF
on clean images). Where the poses are known roughly, the patch around the keyframe's keypoint can be warped as the query
sees it and aligned there: the pair is then as exact as the alignment, and the detector's errors are gone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, pixels_to_normalized, transform_points
from semdb.localization.bundle import QUERY, BundleResult
from semdb.localization.views import KeyframeView, View
from semdb.threads import each
from semdb.types import BoolArray, FloatArray, IntArray

LEAST_LIKENESS = 0.9  # correlation of the patches
SIZE_PER_SAMPLE = 14.0  # of a keypoint, pixels: its patch of 11 samples is then four fifths of its size wide
MOST_PIXELS_PER_SAMPLE = 3.0  # images are not smoothed for it


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Where the query shows the keyframes' keypoints: normalised undistorted `xy` ``[n, 2]``, where `found` ``[n]``."""

    xy: FloatArray
    found: BoolArray


def align_pairs(
    query: View,
    keyframes: Sequence[KeyframeView],
    rows: IntArray,
    slots: IntArray,
    keypoints: IntArray,
    adjusted: BundleResult,
    threads: int = 1,
) -> Alignment:
    """Aligns pairs of the query's keypoint ``rows[n]`` with keypoint ``keypoints[n]`` of keyframe ``slots[n]``.

    Images without pixels (`View.grey` None) leave their pairs as they are. Surfaces are taken to face the keyframe: a
    slant changes the patch symmetrically about its centre and hardly moves it.
    """
    from semdb.localization.alignment_kernels import align_patches

    seen = query.seen_xy[rows].astype(np.float64)
    found = np.zeros(len(rows), np.bool_)

    def align(slot: int) -> None:  # writes the pairs of this keyframe alone
        view, here = keyframes[slot].view, np.flatnonzero(slots == slot)
        if query.grey is None or view.grey is None or not len(here):
            return
        chosen = keypoints[here]
        relative = adjusted.image_from_world[QUERY] @ invert_pose(adjusted.image_from_world[slot + 1])
        warp, step = patch_warps(query, view, chosen, relative), patch_steps(view, chosen)
        answer, likeness = np.zeros((len(here), 2)), np.empty(len(here))
        at = view.seen_xy[chosen].astype(np.float64)
        align_patches(view.grey, query.grey, at, warp, step, seen[here], answer, likeness)
        good = likeness > LEAST_LIKENESS
        seen[here[good]], found[here[good]] = answer[good], True

    each(align, range(len(keyframes)), threads)
    xy = query.xy[rows].copy()
    xy[found] = pixels_to_normalized(query.camera, seen[found])
    found &= np.isfinite(xy).all(axis=1)
    return Alignment(np.where(found[:, None], xy, query.xy[rows]), found)


def patch_steps(view: View, chosen: IntArray) -> FloatArray:
    """Pixels between the samples of the patches of a view's keypoints ``[n]``."""
    return np.clip(view.size[chosen].astype(np.float64) / SIZE_PER_SAMPLE, 1.0, MOST_PIXELS_PER_SAMPLE)


def patch_warps(query: View, view: View, chosen: IntArray, relative: FloatArray) -> FloatArray:
    """Offsets in the keyframe to offsets in the query ``[n, 2, 2]``, for surfaces that face the keyframe.

    `relative` ``[4, 4]`` moves points from the keyframe's camera frame to the query's.
    """
    points = view.points[chosen].astype(np.float64)
    moved = transform_points(relative, points)
    x, y, z = moved.T
    project = np.zeros((len(chosen), 2, 3))
    project[:, 0, 0], project[:, 1, 1] = 1 / z, 1 / z
    project[:, 0, 2], project[:, 1, 2] = -x / z**2, -y / z**2
    scale = points[:, 2] * query.focal / view.focal
    return np.ascontiguousarray(project @ relative[:3, :2] * scale[:, None, None])
