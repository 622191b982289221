"""Pose graph optimisation on SE(3): the poses that agree best with relative poses between them.

Levenberg-Marquardt with analytic Jacobians on sparse normal equations. The error of an edge is the right perturbation
between measured and present relative pose: translation and rotation vector in the frame of its second pose, weighed by
its information. Edges that may be wrong have a Cauchy loss.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import splu

from semdb.geometry.stacks import differences, inverse_right_jacobians, perturbed, skews
from semdb.trajectory.edges import EdgeArrays
from semdb.types import BoolArray, FloatArray, Int64Array

CAUCHY_SQUARED = 12.0  # of the squared Mahalanobis length of six numbers, whose mean is 6
MAX_ITERATIONS = 50
LEAST_GAIN = 1e-6  # of the cost
HELD = 1e-9  # on the diagonal beside the data: a pose that no edge holds stays where it is
COLUMNS_AT_A_TIME = 384  # of the inverse


@dataclass(frozen=True, slots=True, eq=False)
class GraphSolution:
    """`chi2` is the squared Mahalanobis length of each edge's error, `weights` what the loss left of each edge."""

    poses: FloatArray  # [n, 4, 4]
    chi2: FloatArray  # [m]
    weights: FloatArray  # [m]
    cost: float
    iterations: int


def optimise(poses: FloatArray, edges: EdgeArrays, held: BoolArray) -> GraphSolution:
    """The poses ``[n, 4, 4]`` that `edges` ask for, from `poses` on; those `held` ``[n]`` do not move.

    Raises ValueError where none is held: the graph would float.
    """
    if not held.any():
        raise ValueError("a pose graph needs a pose that is held")
    free = np.cumsum(~held) - 1
    free[held] = -1
    damping, iteration = 1e-6, 0
    error, cost = _errors(poses, edges)
    while iteration < MAX_ITERATIONS and not held.all() and len(edges):
        iteration += 1
        matrix, gradient = _equations(poses, edges, error, free)
        proposed = perturbed(poses, _step(matrix, gradient, damping, free))
        found, less = _errors(proposed, edges)
        if less < cost:
            gain = cost - less
            poses, error, cost = proposed, found, less
            damping = max(damping / 10, 1e-12)
            if gain < LEAST_GAIN * cost:
                break
        else:
            damping *= 10
            if damping > 1e8:
                break
    chi2 = _chi2(error, edges)
    return GraphSolution(poses, chi2, _weights(chi2, edges.robust), cost, iteration)


def marginal_covariances(poses: FloatArray, edges: EdgeArrays, held: BoolArray) -> FloatArray:
    """Covariance ``[n, 6, 6]`` of each pose with all others marginalised out; zero where `held`.

    Of right perturbations, translation first; NaN where no chain of edges leads to a pose that is held.
    """
    free = np.cumsum(~held) - 1
    free[held] = -1
    found = np.zeros((len(poses), 6, 6))
    if held.all():
        return found
    error, _ = _errors(poses, edges)
    matrix, _ = _equations(poses, edges, error, free)
    factor = _factor(matrix + HELD * _identity(matrix.shape[0]))
    size = matrix.shape[0]
    blocks = np.empty((size // 6, 6, 6))
    for start in range(0, size, COLUMNS_AT_A_TIME):
        stop = min(start + COLUMNS_AT_A_TIME, size)
        unit = np.zeros((size, stop - start))
        unit[np.arange(start, stop), np.arange(stop - start)] = 1.0
        columns = factor.solve(unit)
        for block in range(start // 6, stop // 6):
            rows = slice(6 * block, 6 * block + 6)
            blocks[block] = columns[rows, 6 * block - start : 6 * block - start + 6]
    found[~held] = (blocks + np.swapaxes(blocks, 1, 2)) / 2
    found[_unreached(len(poses), edges, held)] = np.nan
    return found


def edge_chi2(poses: FloatArray, edges: EdgeArrays) -> FloatArray:
    """Squared Mahalanobis length ``[m]`` of each edge's error at `poses` ``[n, 4, 4]``."""
    return _chi2(_errors(poses, edges)[0], edges)


def _unreached(count: int, edges: EdgeArrays, held: BoolArray) -> BoolArray:
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(edges)), (edges.first, edges.second)), shape=(count, count))
    _, label = connected_components(links, directed=False)
    return np.asarray(~np.isin(label, label[held]))


def _errors(poses: FloatArray, edges: EdgeArrays) -> tuple[FloatArray, float]:
    """Errors ``[m, 6]`` and the robust cost."""
    relative = _relative(poses, edges)
    error = differences(edges.first_from_second, relative)
    chi2 = _chi2(error, edges)
    robust = CAUCHY_SQUARED * np.log1p(chi2 / CAUCHY_SQUARED)
    return error, float(np.where(edges.robust, robust, chi2).sum())


def _relative(poses: FloatArray, edges: EdgeArrays) -> FloatArray:
    one, two = poses[edges.first], poses[edges.second]
    relative = np.zeros((len(edges), 4, 4))
    back = np.swapaxes(one[:, :3, :3], 1, 2)
    relative[:, :3, :3] = back @ two[:, :3, :3]
    relative[:, :3, 3] = np.einsum("mij,mj->mi", back, two[:, :3, 3] - one[:, :3, 3])
    relative[:, 3, 3] = 1.0
    return relative


def _chi2(error: FloatArray, edges: EdgeArrays) -> FloatArray:
    return np.asarray(np.einsum("mi,mij,mj->m", error, edges.information, error))


def _weights(chi2: FloatArray, robust: BoolArray) -> FloatArray:
    return np.where(robust, 1 / (1 + chi2 / CAUCHY_SQUARED), 1.0)


def _jacobians(poses: FloatArray, edges: EdgeArrays, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How the errors grow with right perturbations of the first and of the second pose, ``[m, 6, 6]`` each.

    With Z measured, D = R1' (t2 - t1) and E = Rz' R1' R2, the error is (Rz' (D - tz), log E).
    """
    relative = _relative(poses, edges)
    measured_back = np.swapaxes(edges.first_from_second[:, :3, :3], 1, 2)
    whole = measured_back @ relative[:, :3, :3]  # E
    growth = inverse_right_jacobians(error[:, 3:])
    by_first, by_second = np.zeros((len(edges), 6, 6)), np.zeros((len(edges), 6, 6))
    by_second[:, :3, :3] = whole
    by_second[:, 3:, 3:] = growth
    by_first[:, :3, :3] = -measured_back
    by_first[:, :3, 3:] = measured_back @ skews(relative[:, :3, 3])
    by_first[:, 3:, 3:] = -growth @ np.swapaxes(relative[:, :3, :3], 1, 2)
    return by_first, by_second


def _equations(
    poses: FloatArray, edges: EdgeArrays, error: FloatArray, free: Int64Array
) -> tuple[csc_array, FloatArray]:
    """Normal matrix and gradient over the poses with a number in `free` ``[n]``, -1 for those that are held."""
    size = 6 * (int(free.max()) + 1)
    weight = _weights(_chi2(error, edges), edges.robust)
    information = edges.information * weight[:, None, None]
    by_first, by_second = _jacobians(poses, edges, error)
    one, two = free[edges.first], free[edges.second]
    gradient = np.zeros(size)
    rows, columns, values = [], [], []
    inner = np.arange(6)
    for owner, own in ((one, by_first), (two, by_second)):
        weighted = np.swapaxes(own, 1, 2) @ information
        pull = np.einsum("mij,mj->mi", weighted, error)
        here = owner >= 0
        np.add.at(gradient.reshape(-1, 6), owner[here], pull[here])
        for other, theirs in ((one, by_first), (two, by_second)):
            both = here & (other >= 0)
            row = 6 * owner[both][:, None, None] + inner[:, None]
            column = 6 * other[both][:, None, None] + inner[None, :]
            block = (weighted @ theirs)[both]
            rows.append(np.broadcast_to(row, block.shape).ravel())
            columns.append(np.broadcast_to(column, block.shape).ravel())
            values.append(block.ravel())
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return coo_array(entries, shape=(size, size)).tocsc(), gradient


def _step(matrix: csc_array, gradient: FloatArray, damping: float, free: Int64Array) -> FloatArray:
    """Right perturbations ``[n, 6]``, zero for what is held."""
    diagonal = matrix.diagonal()
    size = matrix.shape[0]
    grown = matrix + _diagonal(damping * diagonal + HELD, size)
    step = np.zeros((len(free), 6))
    step[free >= 0] = -np.asarray(_factor(grown).solve(gradient)).reshape(-1, 6)
    return step


def _diagonal(values: FloatArray, size: int) -> csc_array:
    place = np.arange(size)
    return coo_array((values, (place, place)), shape=(size, size)).tocsc()


def _identity(size: int) -> csc_array:
    return _diagonal(np.ones(size), size)


def _factor(matrix: csc_array) -> Any:
    """A sparse factorisation of a symmetric positive matrix; pivots stay on the diagonal."""
    options = {"SymmetricMode": True}
    return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
