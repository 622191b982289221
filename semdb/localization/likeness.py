"""Does the query show what a keyframe shows? Patches of the keyframe's points, compared where the pose puts them.

Keypoints that agree say that shapes agree. Of a room of the same shapes, or where a thing stands that stands elsewhere
too, a pose has many; but between them the images differ. (Taira et al., InLoc, CVPR 2018, compare whole views so, with
dense depth; here a hundred points of one keyframe are enough, and take milliseconds.)
"""

from __future__ import annotations

import cv2
import numpy as np

from semdb.geometry import invert_pose
from semdb.localization.alignment import patch_steps, patch_warps
from semdb.localization.views import KeyframeView, View
from semdb.types import FloatArray, ImageArray, IntArray

POINTS = 100
LEAST_POINTS = 5  # fewer patches say nothing
ALIKE = 0.9  # correlation
SHARPER = 1.25  # times as rough: the sharper image is blurred before they are compared
BLURS = (1.0, 2.0, 4.0)  # pixels


def likeness_share(
    query: View, keyframe: KeyframeView, world_from_camera: FloatArray, rows: IntArray, pixels: FloatArray
) -> float | None:
    """Of the keyframe's points `rows`, which the pose puts at `pixels` ``[n, 2]`` of the query, the share (0..1) whose
    patches correlate by 0.9 within 3 pixels; of up to 100 of them, evenly chosen.

    A blurred image looks like a sharp one that is blurred as much; so where one is sharper, it is blurred as makes them
    most alike. None where an image is not at hand, or fewer than five patches can be compared.
    """
    own, other = keyframe.view.grey, query.grey
    if own is None or other is None or len(rows) < LEAST_POINTS:
        return None
    chosen = np.unique(np.linspace(0, len(rows) - 1, min(POINTS, len(rows))).round().astype(int))
    patches = _Patches(query, keyframe, world_from_camera, rows[chosen], pixels[chosen])
    likeness, roughness = patches.compare(own, other)
    known = likeness >= -1
    if known.sum() < LEAST_POINTS:
        return None
    ratio = float(np.sqrt(np.median(roughness[known, 0]) / max(np.median(roughness[known, 1]), 1e-3)))
    if not 1 / SHARPER <= ratio <= SHARPER:
        for sigma in BLURS:
            pair = (_blurred(own, sigma), other) if ratio > 1 else (own, _blurred(other, sigma))
            found, _ = patches.compare(*pair)
            if np.median(found[known]) <= np.median(likeness[known]):
                break
            likeness = found
    return float(np.mean(likeness[known] > ALIKE))


class _Patches:
    """Where the patches of a keyframe's points are, there and in the query."""

    def __init__(
        self, query: View, keyframe: KeyframeView, world_from_camera: FloatArray, rows: IntArray, pixels: FloatArray
    ) -> None:
        view = keyframe.view
        relative = invert_pose(world_from_camera) @ keyframe.world_from_camera
        self.warp, self.step = patch_warps(query, view, rows, relative), patch_steps(view, rows)
        self.at, self.guess = view.seen_xy[rows].astype(np.float64), np.ascontiguousarray(pixels, np.float64)

    def compare(self, own: ImageArray, other: ImageArray) -> tuple[FloatArray, FloatArray]:
        """Likeness ``[n]`` and roughness ``[n, 2]`` of the patches, see `compare_patches`."""
        from semdb.localization.likeness_kernels import compare_patches

        likeness, roughness = np.empty(len(self.at)), np.zeros((len(self.at), 2))
        compare_patches(own, other, self.at, self.warp, self.step, self.guess, likeness, roughness)
        return likeness, roughness


def _blurred(image: ImageArray, sigma: float) -> ImageArray:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
