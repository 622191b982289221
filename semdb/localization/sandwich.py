"""How sure an adjusted pose is: the sandwich covariance of its query, with all else marginalised out."""

from __future__ import annotations

import numpy as np

from semdb.types import FloatArray, IntArray

PARAMETERS_OF_QUERY = 9
# Fitted on half of the rendered rooms with keyframes near and far
CELL = 0.152  # over the focal length: 80 pixels of 525; within it errors are alike
SHARED_FACTOR = 1.3  # by which errors that cells have in common exceed what single cells show; and
SHARED_PER_RAD = 19.0  # so much more per radian between the rays from which query and keyframe see a point
SHARED_VARIANCE = 0.025  # of the assumed variance, believed whatever the residuals
MOST_CORRECTION = 4.0  # of the scatter of few cells


def sandwich(
    reduced: FloatArray,
    pulls: FloatArray,
    prior: FloatArray,
    shown: FloatArray,
    angle: float,
    camera_from_world: FloatArray,
) -> FloatArray:
    """Covariance ``[6, 6]`` of translation (m, world) and rotation (rad, left perturbation) of the first image.

    `reduced` ``[p, p]`` are the equations of the images with the points eliminated, its first six unknowns those of the
    query's pose; `pulls` ``[groups, p]`` what the residuals of each cell of the query's image add to their gradient;
    `prior` ``[p]`` the information of priors, of whose variance the share `shown` ``[p]`` counts; `angle` (rad) lies
    between the rays from which query and keyframes see a point.

    The sandwich of Huber (1967) and White (1982): how large the errors are is read off the residuals, not taken from
    the noise that the weights assume. Neighbours err alike (one surface is slanted, one corner of the lens is bent), so
    residuals add up within cells of the query's image before they are squared (Liang and Zeger, Biometrika 73, 1986).
    What cells have in common is not seen so; it grows with the angle between the views: `SHARED_FACTOR`. The least
    sigma of a prior keeps the numbers at bay and is not believed.
    A step (t, w) of the camera moves its centre by -R t and turns it by -R w, R being world_from_camera.
    Raises numpy.linalg.LinAlgError where the equations do not determine the pose.
    """
    groups = len(pulls)
    factor = SHARED_FACTOR + SHARED_PER_RAD * angle
    scatter = pulls.T @ pulls * (factor * min(groups / max(groups - PARAMETERS_OF_QUERY, 1), MOST_CORRECTION))
    scatter += SHARED_VARIANCE * reduced
    scatter[np.diag_indices_from(scatter)] += prior * (shown - SHARED_VARIANCE)
    inverse = np.linalg.inv(reduced)
    in_camera = (inverse @ scatter @ inverse)[:6, :6]
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = -camera_from_world[:3, :3].T
    covariance: FloatArray = turn @ in_camera @ turn.T
    return (covariance + covariance.T) / 2


def angle_between_views(own: FloatArray, others: FloatArray, points: FloatArray) -> float:
    """The median angle (rad) between rays to `points` ``[n, 3]`` from `own` ``[3]`` and from `others` ``[n, 3]``."""
    one, two = points - own, points - others
    crossed = np.linalg.norm(np.cross(one, two), axis=1)
    return float(np.median(np.arctan2(crossed, (one * two).sum(axis=1)))) if len(points) else 0.0


def cells_of(xy: FloatArray) -> IntArray:
    """The cell ``[m]`` of the query's image in which each point at `xy` ``[m, 2]`` was seen, numbered from 0."""
    return np.unique(np.floor(xy / CELL) @ [1000.0, 1.0], return_inverse=True)[1].astype(np.int32)
