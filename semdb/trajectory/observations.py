"""What a frame saw of keyframes, kept small: enough to place it again once these have moved."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semdb.localization.bundle import pixel_sigma
from semdb.localization.views import View
from semdb.trajectory.tracking import Placed
from semdb.types import BoolArray, Float32Array, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameObservations:
    """Pairs of a frame with keypoints of keyframes. Pixels are normalised; sigma is in the same units."""

    keyframe: IntArray  # [k] number of the keyframe
    keypoint: IntArray  # [k] in its view
    xy: Float32Array  # [k, 2] where the frame shows it
    sigma: Float32Array  # [k] of the keypoint; where it was aligned, the alignment is surer
    aligned: BoolArray  # [k]
    depth: Float32Array  # [k] metres, NaN without
    row: Float32Array  # [k] -0.5 at the top of the image, 0.5 at the bottom

    def __len__(self) -> int:
        return len(self.keyframe)

    def of_keyframe(self, number: int) -> FrameObservations:
        """Those of one keyframe."""
        rows = self.keyframe == number
        return FrameObservations(
            self.keyframe[rows], self.keypoint[rows], self.xy[rows], self.sigma[rows], self.aligned[rows],
            self.depth[rows], self.row[rows],
        )  # fmt: skip


def observations_of(view: View, placed: Placed) -> FrameObservations:
    """The inlier pairs of a placed frame."""
    pairs, seen = placed.estimate.pairs, placed.estimate.seen
    numbers = np.array([keyframe.keyframe_id for keyframe in placed.keyframes], np.int32)
    rows = pairs.query
    return FrameObservations(
        keyframe=numbers[pairs.slot],
        keypoint=pairs.keypoint.astype(np.int32),
        xy=np.asarray(view.xy[rows] if seen is None else seen.xy, np.float32),
        sigma=pixel_sigma(view.size[rows], view.focal).astype(np.float32),
        aligned=np.zeros(len(rows), np.bool_) if seen is None else seen.found,
        depth=view.points[rows, 2],
        row=view.image_row[rows].astype(np.float32),
    )
