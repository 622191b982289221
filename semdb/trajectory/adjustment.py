"""Bundle adjustment over all keyframes: their poses, how each turned while it was read out, and the points they share.

The residuals are those of one query's adjustment (`semdb.localization.bundle`): pixels, and measured depth with the
sensor's noise, with a Cauchy loss. What was a prior for one image is known better here: a camera that is read out row
by row turns meanwhile by its angular velocity times one readout time, which all images share, so that time is estimated
and only a small rest is left to each image. The noise of pixels and of each image's depth is what the residuals show.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import bsr_array
from scipy.sparse.linalg import splu

from semdb.geometry.sensor import depth_noise
from semdb.geometry.stacks import invert_poses
from semdb.localization.bundle import CAUCHY_SQUARED, NORMAL_MEDIAN
from semdb.localization.bundle_kernels import move_images, move_points, normal_equations
from semdb.trajectory.adjustment_kernels import mark_shared, reduce_to_blocks, solve_positive
from semdb.trajectory.options import AdjustmentOptions
from semdb.types import BoolArray, FloatArray, IntArray

PARAMETERS = 9
DENSE_SHARE = 0.25  # of blocks that are filled: from there on a dense factorisation is faster
HELD = 1e14  # information of what does not move
PIXEL_MEDIAN = 1.386  # median of a chi-square of two
MOST_PIXEL_NOISE, LEAST_PIXEL_NOISE = 3.0, 0.25  # times the assumed
LEAST_GAIN = 1e-4  # of the cost
LONGEST_READOUT_S = 0.04
MANY = 20  # depths of an image that say how noisy they are


@dataclass(frozen=True, slots=True, eq=False)
class SharedPoints:
    """Points and where keyframes see them. Observations are sorted by point, of each point by keyframe."""

    points: FloatArray  # [m, 3] world, first guess
    point: IntArray  # [k]
    image: IntArray  # [k]
    keypoint: IntArray  # [k] in the keyframe's view
    xy: FloatArray  # [k, 2] normalised
    sigma: FloatArray  # [k] of xy
    aligned: BoolArray  # [k] patches were aligned, or it is the one that the others were aligned to
    depth: FloatArray  # [k] metres, NaN without
    row: FloatArray  # [k] -0.5 at the top of the image, 0.5 at the bottom

    def __len__(self) -> int:
        return len(self.point)


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted:
    """Keyframes after bundle adjustment. `turn` is over the whole readout; `readout_s` 0 where none was seen.

    `noise_px` is by how much pixels are noisier than assumed (aligned, not aligned), `depth_noise` ``[c]`` the same of
    each keyframe's depth.
    """

    poses: FloatArray  # [c, 4, 4]
    turn: FloatArray  # [c, 3] rad
    points: FloatArray  # [m, 3]
    readout_s: float
    residual_turn_rad: float
    noise_px: tuple[float, float]
    depth_noise: FloatArray  # [c]
    chi2: FloatArray  # [k]
    cost: float
    iterations: int


@dataclass(slots=True)
class _State:
    poses: FloatArray  # [c, 4, 4] camera_from_world
    turn: FloatArray  # [c, 3]
    points: FloatArray  # [m, 3]


@dataclass(slots=True)
class _Blocks:
    images: FloatArray  # [c, 9, 9]
    image_gradients: FloatArray  # [c, 9]
    coupling: FloatArray  # [k, 9, 3]
    points: FloatArray  # [m, 3, 3]
    point_gradients: FloatArray  # [m, 3]
    chi2: FloatArray  # [k]
    cost: float = 0.0


class _Solver:
    """One problem with what does not change while it is solved."""

    def __init__(self, shared: SharedPoints, count: int, held: BoolArray) -> None:
        self.shared = shared
        self.count = count
        self.observed = np.column_stack([shared.xy, shared.sigma, shared.depth, shared.row, np.ones(len(shared))])
        bounds = np.arange(len(shared.points) + 1)
        self.first = np.searchsorted(shared.point, bounds).astype(np.int32)
        self.expected_turn = np.zeros((count, 3))
        self.turn_information = 0.0
        self.held = np.flatnonzero(held)
        together = np.eye(count, dtype=np.bool_)
        mark_shared(self.first, shared.image, together)
        self.one, self.two = np.nonzero(together)
        self.place = np.full((count, count), -1, np.int32)
        self.place[self.one, self.two] = np.arange(len(self.one))
        self.diagonal = self.place[np.arange(count), np.arange(count)]
        self.dense = 2 * len(self.one) > DENSE_SHARE * count**2

    def linearise(self, state: _State) -> _Blocks:
        m, c, k = len(state.points), self.count, len(self.observed)
        blocks = _Blocks(
            np.empty((c, 9, 9)), np.empty((c, 9)), np.empty((k, 9, 3)),
            np.empty((m, 3, 3)), np.empty((m, 3)), np.empty(k),
        )  # fmt: skip
        blocks.cost = normal_equations(
            state.points, np.ascontiguousarray(state.poses[:, :3, :3]), np.ascontiguousarray(state.poses[:, :3, 3]),
            state.turn, self.shared.point, self.shared.image, self.observed, CAUCHY_SQUARED,
            blocks.images, blocks.image_gradients, blocks.coupling, blocks.points, blocks.point_gradients, blocks.chi2,
            np.empty((k, 9)),
        )  # fmt: skip
        axis, rest = np.arange(6, 9), state.turn - self.expected_turn
        blocks.images[:, axis, axis] += self.turn_information
        blocks.image_gradients[:, 6:] += self.turn_information * rest
        blocks.cost += self.turn_information * float((rest**2).sum())
        return blocks

    def reduced(self, blocks: _Blocks, damping: float) -> tuple[FloatArray, FloatArray]:
        """Blocks ``[b, 9, 9]`` of the images' equations with the points eliminated, and their gradient ``[c, 9]``."""
        matrix = np.zeros((len(self.one), 9, 9))
        axis = np.arange(9)
        own = blocks.images.copy()
        own[:, axis, axis] *= 1 + damping
        own[:, axis, axis] += 1e-9
        own[np.ix_(self.held, axis[:6], axis[:6])] += HELD * np.eye(6)
        matrix[self.diagonal] = own
        gradient = blocks.image_gradients.copy()
        reduce_to_blocks(
            blocks.coupling, blocks.points, blocks.point_gradients, self.first, self.shared.image, damping,
            self.place, matrix, gradient,
        )  # fmt: skip
        return matrix, gradient

    def step(self, matrix: FloatArray, gradient: FloatArray) -> FloatArray:
        """Steps ``[c, 9]`` of the images."""
        size, off = 9 * self.count, self.one != self.two
        if self.dense:
            whole = np.zeros((self.count, 9, self.count, 9))
            whole[self.one, :, self.two, :] = matrix
            whole[self.two[off], :, self.one[off], :] = np.swapaxes(matrix[off], 1, 2)
            found = -gradient.reshape(-1)
            if not solve_positive(whole.reshape(size, size), found):
                raise np.linalg.LinAlgError("the equations of the images are not positive")
            return found.reshape(-1, 9)
        rows, columns = np.r_[self.one, self.two[off]], np.r_[self.two, self.one[off]]
        data = np.concatenate([matrix, np.swapaxes(matrix[off], 1, 2)])
        order = np.lexsort((columns, rows))
        starts = np.searchsorted(rows[order], np.arange(self.count + 1))
        whole_matrix: Any = bsr_array((data[order], columns[order], starts), shape=(size, size)).tocsc()
        solver = splu(whole_matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        return np.asarray(-solver.solve(gradient.reshape(-1))).reshape(-1, 9)

    def minimise(self, state: _State, max_iterations: int) -> tuple[_State, _Blocks, int]:
        blocks, damping, iteration = self.linearise(state), 1e-5, 0
        for iteration in range(1, max_iterations + 1):  # noqa: B007
            matrix, gradient = self.reduced(blocks, damping)
            try:
                step = self.step(matrix, gradient)
            except np.linalg.LinAlgError:
                damping = max(10 * damping, 1e-6)
                continue
            points = move_points(
                state.points, blocks.coupling, blocks.points, blocks.point_gradients, self.first, self.shared.image,
                damping, step,
            )  # fmt: skip
            proposed = _State(move_images(state.poses, step), state.turn + step[:, 6:], points)
            found = self.linearise(proposed)
            if found.cost < blocks.cost:
                gain = blocks.cost - found.cost
                state, blocks = proposed, found
                damping = max(damping / 10, 1e-10)
                if gain < LEAST_GAIN * blocks.cost:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        return state, blocks, iteration

    def determined_turn(self, blocks: _Blocks) -> float:
        """How many of the turns' numbers the images determine, not the prior, other images held."""
        matrix, _ = self.reduced(blocks, 0.0)
        inverse = np.linalg.inv(matrix[self.diagonal])
        variance = np.einsum("cii->ci", inverse)[:, 6:]
        return float((1 - np.clip(variance * self.turn_information, 0, 1)).sum())


def adjust_keyframes(
    shared: SharedPoints, poses: FloatArray, held: BoolArray, rates: FloatArray, options: AdjustmentOptions
) -> Adjusted:
    """The keyframes ``[c, 4, 4]`` (world_from_camera) and points that agree best with `shared`.

    `held` ``[c]`` are keyframes that do not move; `rates` ``[c, 3]`` how the camera turns in each, in radians a second
    in its own frame.
    """
    solver = _Solver(shared, len(poses), held)
    state = _State(invert_poses(poses), np.zeros((len(poses), 3)), shared.points.copy())
    solver.turn_information = 1 / options.turn_rad**2
    state, blocks, iterations = solver.minimise(state, options.max_iterations)
    residual, readout_s = options.turn_rad, 0.0
    noise_px, depth_noise = (1.0, 1.0), np.ones(len(poses))
    for _ in range(options.noise_rounds):
        noise_px, depth_noise = _believe_residuals(solver, state, blocks)
        readout_s = min(_readout(state.turn, -rates), LONGEST_READOUT_S)
        solver.expected_turn = -readout_s * rates  # what is seen turns the other way
        rest = float(((state.turn - solver.expected_turn) ** 2).sum())
        evident = np.sqrt(rest / max(solver.determined_turn(blocks), 1.0))
        residual = float(np.clip(evident, options.least_turn_rad, options.residual_turn_rad))
        solver.turn_information = 1 / residual**2
        state, blocks, more = solver.minimise(state, options.max_iterations)
        iterations += more
    return Adjusted(
        poses=invert_poses(state.poses),
        turn=state.turn,
        points=state.points,
        readout_s=readout_s,
        residual_turn_rad=residual,
        noise_px=noise_px,
        depth_noise=depth_noise,
        chi2=blocks.chi2,
        cost=blocks.cost,
        iterations=iterations,
    )


def _readout(turn: FloatArray, rates: FloatArray) -> float:
    """The readout time that turns and rates ``[c, 3]`` agree on; a Cauchy loss, since a rate may be quite wrong."""
    square = float((rates**2).sum())
    if square < 1e-12:
        return 0.0
    time = float((turn * rates).sum()) / square
    for _ in range(10):
        rest = ((turn - time * rates) ** 2).sum(axis=1)
        spread = max(float(np.median(rest)), 1e-10)
        weight = 1 / (1 + rest / (4 * spread))
        time = float((weight[:, None] * turn * rates).sum() / max((weight[:, None] * rates**2).sum(), 1e-12))
    return max(time, 0.0)


def _believe_residuals(solver: _Solver, state: _State, blocks: _Blocks) -> tuple[tuple[float, float], FloatArray]:
    """Sets the noise of pixels and of each image's depth to what the residuals show."""
    shared = solver.shared
    scales = []
    for aligned in (True, False):
        rows = shared.aligned == aligned
        assumed = solver.observed[rows, 2] / shared.sigma[rows]
        shown = blocks.chi2[rows] * assumed**2
        scale = float(np.sqrt(np.median(shown) / PIXEL_MEDIAN)) if rows.any() else 1.0
        scale = float(np.clip(scale, LEAST_PIXEL_NOISE, MOST_PIXEL_NOISE))
        solver.observed[rows, 2] = shared.sigma[rows] * scale
        scales.append(scale)
    pose = state.poses[shared.image]
    z = np.einsum("kj,kj->k", pose[:, 2, :3], state.points[shared.point]) + pose[:, 2, 3]
    known = np.isfinite(shared.depth)
    off = np.abs(z - shared.depth) / depth_noise(shared.depth)
    looser = np.ones(solver.count)
    for image in range(solver.count):
        rows = known & (shared.image == image)
        if np.count_nonzero(rows) >= MANY:
            looser[image] = max(1.0, float(np.median(off[rows])) * NORMAL_MEDIAN) ** 2
    solver.observed[:, 5] = looser[shared.image]
    return (scales[0], scales[1]), looser
