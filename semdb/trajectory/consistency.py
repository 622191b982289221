"""Which loop closures can be true together: sets in which every pair agrees along the odometry between them.

Each closure says by how much the trajectory drifted between its two keyframes, as a motion of the world. Two closures
agree when their drifts differ by no more than odometry may have drifted from the one's keyframes to the other's, and
than both are uncertain by (Mangelson, Dominic, Eustice, Vasudevan: Pairwise consistent measurement set maximization,
ICRA 2018). The largest set in which all agree counts; a closure outside of it is named with how many it contradicts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry.stacks import adjoints, invert_poses, so3_logs
from semdb.trajectory.edges import Edge, EdgeState, stack_edges
from semdb.types import BoolArray, FloatArray, Int64Array, IntArray

BLOCK = 256  # closures that are compared with all others at a time


@dataclass(frozen=True, slots=True)
class ConsistencyOptions:
    """`gate` is of the squared Mahalanobis length of six numbers; 22.5 is passed by 999 of 1000 right ones.

    Errors of neighbours are alike and closures are surer of themselves than they should be: standard deviations grow
    by `closure_growth` and `odometry_growth`, and none is believed to be below `least_m` and `least_rad`.
    """

    gate: float = 22.5
    closure_growth: float = 2.0
    odometry_growth: float = 2.0
    least_m: float = 0.01
    least_rad: float = 0.006
    least_pair: int = 2  # closures that must agree before two pieces are one


@dataclass(frozen=True, slots=True, eq=False)
class Chain:
    """Odometry of all keyframes: poses, which piece each belongs to, and the covariance gathered along it.

    `gathered` ``[n, 6, 6]`` is of left perturbations of the world from the first keyframe of the piece on: the
    difference of two is what odometry may have drifted between them.
    """

    poses: FloatArray  # [n, 4, 4]
    piece: IntArray  # [n]
    gathered: FloatArray  # [n, 6, 6]


def chain_of(poses: FloatArray, piece: Sequence[int], steps: FloatArray) -> Chain:
    """The chain of keyframes with `poses` ``[n, 4, 4]``; `steps` ``[n, 6, 6]`` are covariances of each against the
    keyframe before it (right perturbations, translation first); those of the first of a piece do not count.
    """
    numbers = np.asarray(piece, np.int32)
    move = adjoints(poses)
    grown = move @ steps @ np.swapaxes(move, 1, 2)
    first = np.r_[True, numbers[1:] != numbers[:-1]]
    grown[first] = 0.0
    total = np.cumsum(grown, axis=0)
    starts = np.maximum.accumulate(np.where(first, np.arange(len(numbers)), 0))
    return Chain(poses, numbers, total - total[starts])


def consistent(closures: Sequence[Edge], chain: Chain, options: ConsistencyOptions | None = None) -> list[Edge]:
    """`closures` with their state: accepted, or contradicted with the reason. What failed before stays so.

    Closures within a piece must agree with its odometry too. Two pieces are joined by `least_pair` or more that agree.
    """
    options = options or ConsistencyOptions()
    found = list(closures)
    groups: dict[tuple[int, int], list[int]] = {}
    for n, edge in enumerate(closures):
        if edge.state is not EdgeState.FAILED:
            key = (int(chain.piece[edge.first]), int(chain.piece[edge.second]))
            groups.setdefault((min(key), max(key)), []).append(n)
    for (one, two), members in sorted(groups.items()):
        judged = _judge([closures[n] for n in members], chain, options, joined=one == two)
        for n, edge in zip(members, judged, strict=True):
            found[n] = edge
    return found


def largest_agreeing(
    closures: Sequence[Edge], chain: Chain, options: ConsistencyOptions | None = None
) -> tuple[list[int], BoolArray]:
    """Positions, ascending, of those of `closures` between two pieces that all agree, and which pairs do ``[m, m]``.

    Whether they are the majority is not asked.
    """
    options = options or ConsistencyOptions()
    if not closures:
        return [], np.zeros((0, 0), np.bool_)
    agree = _agreement(*_drifts(closures, chain, options), chain, options)
    strength = np.array([edge.inliers for edge in closures], float)
    return _largest_set(agree, np.ones(len(closures), np.bool_), strength), agree


def _judge(closures: Sequence[Edge], chain: Chain, options: ConsistencyOptions, *, joined: bool) -> list[Edge]:
    """The closures of one piece (`joined`) or between two, judged."""
    first, second, drift, noise = _drifts(closures, chain, options)
    agree = _agreement(first, second, drift, noise, chain, options)
    possible = np.ones(len(closures), np.bool_)
    if joined:
        possible = _alone(first, second, drift, noise, chain, options)
    strength = np.array([edge.inliers for edge in closures], float)
    chosen = _largest_set(agree & possible[:, None] & possible[None, :], possible, strength)
    enough = joined or len(chosen) >= options.least_pair
    if not joined and enough and 2 * len(chosen) <= len(closures):
        enough = False  # as many say otherwise
    judged = []
    for n, edge in enumerate(closures):
        if enough and n in chosen:
            judged.append(replace(edge, state=EdgeState.ACCEPTED))
            continue
        against = sum(not agree[n, other] for other in chosen if other != n)
        if not possible[n]:
            reason = "contradicts the odometry"
            if chosen:
                reason += f" and {against} of {len(chosen)}"
        elif not enough:
            reason = f"only {len(chosen)} of {len(closures)} between these pieces agree"
        else:
            reason = f"contradicts {against} of {len(chosen)}"
        judged.append(replace(edge, state=EdgeState.CONTRADICTED, reason=reason))
    return judged


def _drifts(
    closures: Sequence[Edge], chain: Chain, options: ConsistencyOptions
) -> tuple[Int64Array, Int64Array, FloatArray, FloatArray]:
    """Keyframes of each closure, lower piece or number first, the drift each claims ``[m, 4, 4]``, and its noise.

    The drift moves the world of the second keyframe's odometry onto that of the first; covariances ``[m, 6, 6]`` are
    of left perturbations of it.
    """
    edges = stack_edges(closures)
    first, second = edges.first.astype(np.int64), edges.second.astype(np.int64)
    measured, spread = edges.first_from_second.copy(), np.linalg.inv(edges.information)
    floor = np.repeat([options.least_m**2, options.least_rad**2], 3)
    spread = spread * options.closure_growth**2
    spread[:, np.arange(6), np.arange(6)] += floor
    key = np.stack([chain.piece[first], first]), np.stack([chain.piece[second], second])
    swap = (key[0][0] > key[1][0]) | ((key[0][0] == key[1][0]) & (key[0][1] > key[1][1]))
    if swap.any():
        back = adjoints(measured[swap])
        spread[swap] = back @ spread[swap] @ np.swapaxes(back, 1, 2)
        measured[swap] = invert_poses(measured[swap])
        first, second = np.where(swap, second, first), np.where(swap, first, second)
    there = chain.poses[first] @ measured
    move = adjoints(there)
    drift = there @ invert_poses(chain.poses[second])
    return first, second, drift, move @ spread @ np.swapaxes(move, 1, 2)


def _agreement(
    first: Int64Array,
    second: Int64Array,
    drift: FloatArray,
    noise: FloatArray,
    chain: Chain,
    options: ConsistencyOptions,
) -> BoolArray:
    """Which pairs of closures ``[m, m]`` agree. The chains between their keyframes may have drifted."""
    count = len(first)
    agree = np.zeros((count, count), np.bool_)
    back = invert_poses(drift)
    for start in range(0, count, BLOCK):
        rows = np.arange(start, min(start + BLOCK, count))
        i, j = np.repeat(rows, count), np.tile(np.arange(count), len(rows))
        upper = j > i
        i, j = i[upper], j[upper]
        spread = noise[i] + noise[j]
        for ends in (first, second):
            low, high = np.minimum(ends[i], ends[j]), np.maximum(ends[i], ends[j])
            spread = spread + (chain.gathered[high] - chain.gathered[low]) * options.odometry_growth**2
        agree[i, j] = agree[j, i] = _small(drift[i] @ back[j], spread, options)
    np.fill_diagonal(agree, True)
    return agree


def _alone(
    first: Int64Array,
    second: Int64Array,
    drift: FloatArray,
    noise: FloatArray,
    chain: Chain,
    options: ConsistencyOptions,
) -> BoolArray:
    """Which closures ``[m]`` claim no more drift than odometry may have had."""
    spread = noise + (chain.gathered[second] - chain.gathered[first]) * options.odometry_growth**2
    return _small(drift, spread, options)


def _small(difference: FloatArray, spread: FloatArray, options: ConsistencyOptions) -> BoolArray:
    """Whether motions ``[m, 4, 4]`` are none, within `spread` ``[m, 6, 6]``."""
    if not len(difference):
        return np.zeros(0, np.bool_)
    vector = np.concatenate([difference[:, :3, 3], so3_logs(difference[:, :3, :3])], axis=1)
    solved = np.linalg.solve(spread, vector[:, :, None])[:, :, 0]
    return np.asarray((vector * solved).sum(axis=1) < options.gate)


def _largest_set(agree: BoolArray, possible: BoolArray, strength: FloatArray) -> list[int]:
    """A set in which all agree, as large as a greedy search from each of the best finds it, ascending.

    The greatest clique is hard to find; here those with most partners are tried as a start, and each grows by the
    member that most of those left agree with (of equals the one with more inliers).
    """
    degree = (agree & possible[None, :]).sum(axis=1) * possible
    best: list[int] = []
    best_strength = -1.0
    for seed in np.lexsort((-strength, -degree))[:32]:
        if not possible[seed] or degree[seed] < len(best):
            continue
        members, left = [int(seed)], agree[seed] & possible
        left[seed] = False
        while left.any():
            rows = np.flatnonzero(left)
            partners = agree[np.ix_(rows, rows)].sum(axis=1)
            chosen = rows[np.lexsort((-strength[rows], -partners))[0]]
            members.append(int(chosen))
            left &= agree[chosen]
            left[chosen] = False
        total = float(strength[members].sum())
        if len(members) > len(best) or (len(members) == len(best) and total > best_strength):
            best, best_strength = members, total
    return sorted(best)
