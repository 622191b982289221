"""Where keyframes that should show a landmark, and have no object there, would show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, project, transform_points
from semdb.landmarks.lift import LiftedKeyframe
from semdb.types import FloatArray

MOST = 300  # points of a thing that are projected


@dataclass(frozen=True, slots=True)
class ExpectedView:
    """A keyframe that sees a landmark's surface and has no object there.

    `share` of the landmark's points are seen, 0..1; `height` is where the middle of its box would be in the image, 0 at
    the top to 1 at the bottom; `size` how much of the image's diagonal that of the box is.
    """

    keyframe: int
    share: float
    height: float
    size: float


def expected_views(
    lifted: Sequence[LiftedKeyframe], points: FloatArray, shares: Mapping[int, float]
) -> tuple[ExpectedView, ...]:
    """The views of a thing of `points` ``[n, 3]`` (map) by keyframes that see so large a share of it.

    One is left out where none of the points lies in its image.
    """
    found = []
    points = points[np.arange(min(len(points), MOST)) * len(points) // max(min(len(points), MOST), 1)]
    for keyframe, share in sorted(shares.items()):
        frame = lifted[keyframe]
        local = transform_points(invert_pose(frame.world_from_camera), points)
        local = local[local[:, 2] > 0.05]
        pixels = project(frame.camera, local)
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -0.5).all(axis=1)
            inside &= (pixels[:, 0] < frame.camera.width - 0.5) & (pixels[:, 1] < frame.camera.height - 0.5)
        if not inside.any():
            continue
        low, high = pixels[inside].min(axis=0), pixels[inside].max(axis=0)
        height = (low[1] + high[1] + 1) / (2 * frame.camera.height)
        size = np.linalg.norm(high - low) / np.hypot(frame.camera.width, frame.camera.height)
        found.append(ExpectedView(keyframe, round(min(share, 1.0), 6), round(float(height), 6), round(float(size), 6)))
    return tuple(found)
