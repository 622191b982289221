"""Bundle adjustment of one query: equation (5) of the paper, with measured depth as a prior on the points.

Unknown are the query's pose and every matched 3D point; the poses of the keyframes have a prior. A point is held by its
pixel in each image that saw it and by the depth measured there. Every image has three unknowns more: how far the
camera turned while it was read out. A rolling shutter reads the rows of an image one after the other, over up to the
time of a frame, and a turning camera bends the image by many pixels, which a pose alone answers with a sideways
step (Hedborg, Forssén, Felsberg, Ringaby: Rolling shutter bundle adjustment, CVPR 2012; here the rotation alone,
which moves pixels most). The pose is that of the middle row.

Levenberg-Marquardt on the Schur complement, analytic Jacobians, a Cauchy loss on each block of residuals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semdb.geometry import invert_pose, pose_distances
from semdb.geometry.sensor import depth_noise
from semdb.localization.sandwich import angle_between_views, cells_of, sandwich
from semdb.types import Float32Array, FloatArray, IntArray, PoseErrors

CAUCHY_SQUARED = 4.0  # (2 sigma)^2: where the loss leaves the parabola
QUERY = 0  # index of the query among the images
EVIDENCE_ROUNDS = 30
FIRST_ITERATIONS = 4  # before the variances of the priors are known
LEAST_GAIN = 1e-3  # of the cost; smaller ones move the pose by less than a tenth of its error
LEAST_STEP = 2e-5  # m and rad, of the query
NORMAL_MEDIAN = 1.4826  # a normal distribution's standard deviation over its median distance
IGNORED = 1e6  # times the noise: no weight
FIXED = 1e-7  # a standard deviation (m, rad) that nothing moves
MOST_LOOSER = 3.0  # times the usual prior that a keyframe's own standard deviation makes of it, or a third
LEAST_DISTANCE = 0.02  # of a keyframe from the query (`pose_distances`), for the prior on its pose
MOST_EVIDENT = 10.0  # times the prior on a keyframe's pose that recorded poses may show to be off


@dataclass(frozen=True, slots=True)
class MotionPrior:
    """Standard deviations, the greatest that are believed: what the images show decides (see `adjust`).

    `turn_rad`: rotation during the readout, 0.02 rad being 35 degrees a second over 33 ms. `keyframe_m` and
    `keyframe_rad`: error of a keyframe's recorded pose against one at a distance of 1 (`pose_distances`: 0.3 m or 15
    degrees); it grows with the root of the distance. The least are what is left of them when nothing is seen.
    """

    turn_rad: float = 0.02
    keyframe_m: float = 0.006
    keyframe_rad: float = 0.003
    least_turn_rad: float = 0.0003
    least_keyframe_m: float = 0.0002
    least_keyframe_rad: float = 0.0002


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """What was seen, and the images: the query first, then the keyframes.

    Pixels are divided by the focal length: normalised, undistorted coordinates. Sigmas are standard deviations in the
    same units. `rows` run from -0.5 (top of the image) to 0.5.
    """

    points: FloatArray  # [m, 3] world, first guess
    observed_point: IntArray  # [k] ascending
    observed_image: IntArray  # [k] of each point, ascending
    xy: FloatArray  # [k, 2]
    sigma: FloatArray  # [k]
    depth: FloatArray  # [k] metres, NaN where there is none
    rows: FloatArray  # [k]
    keyframe_from_world: FloatArray  # [c - 1, 4, 4]
    looser: FloatArray | None = None  # [k] how many times the sensor's noise a depth has; None: once
    expected_turn: FloatArray | None = None  # [c, 3] of each image, the query first; None: none
    # [c - 1, 2] standard deviations of each keyframe's place (m) and turn (rad), NaN where nobody knows; None: of all
    keyframe_sigma: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """`covariance` is of translation (m, world) and rotation (rad, left perturbation in the world) of the query.

    `image_from_world` and `turn` (rad, over the whole readout) are of the query first, then the keyframes.
    """

    camera_from_world: FloatArray  # [4, 4]
    points: FloatArray  # [m, 3]
    covariance: FloatArray | None  # [6, 6]; None of a rough solution
    image_from_world: FloatArray  # [c, 4, 4]
    turn: FloatArray  # [c, 3]
    shift: FloatArray  # [c, 6] steps that the images have made from their start
    chi2: FloatArray  # [k] squared pixel residual over its variance
    iterations: int
    evident: PoseErrors | None = None  # how far the keyframes' poses are off the images; None of a rough solution
    nearest: tuple[float, float] = (0.0, 0.0)  # how far the nearest keyframe is, for its place and for its turn


@dataclass(slots=True)
class _State:
    """Where the solution stands. `shift` is how far the images have moved from their start."""

    poses: FloatArray  # [c, 4, 4]
    turn: FloatArray  # [c, 3]
    shift: FloatArray  # [c, 6]
    points: FloatArray  # [m, 3]


@dataclass(slots=True)
class _Blocks:
    """Normal equations: images, points, and what couples them; `cost` is the robust cost with the priors."""

    images: FloatArray  # [c, 9, 9]
    image_gradients: FloatArray  # [c, 9]
    coupling: FloatArray  # [k, 9, 3]
    points: FloatArray  # [m, 3, 3]
    point_gradients: FloatArray  # [m, 3]
    chi2: FloatArray  # [k]
    own_gradients: FloatArray  # [k, 9] what each observation adds to its image's gradient
    cost: float = 0.0


class _Solver:
    """One problem with what does not change while it is solved."""

    def __init__(self, problem: BundleProblem) -> None:
        self.problem = problem
        self.looser = np.ones(len(problem.xy)) if problem.looser is None else problem.looser
        self.observed = np.column_stack([problem.xy, problem.sigma, problem.depth, problem.rows, self.looser])
        bounds = np.arange(len(problem.points) + 1)
        self.first = np.searchsorted(problem.observed_point, bounds).astype(np.int32)
        self.images = len(problem.keyframe_from_world) + 1
        self.diagonal = np.arange(9 * self.images)
        self.information = np.zeros((self.images, 9))  # of the priors
        self.drift = np.ones((self.images, 9))  # how many times the priors' sigma each unknown has
        self.expected = np.zeros((self.images, 9))  # by the priors
        self.apart = np.zeros((self.images - 1, 2))  # distances of the keyframes, for place and turn
        if problem.expected_turn is not None:
            self.expected[:, 6:] = problem.expected_turn

    def drifting(self, camera_from_world: FloatArray) -> None:
        """Poses of a trajectory drift apart as in a random walk: a keyframe's variance grows with its distance from
        the query. So the near ones hold the query, and of two with the query between them each as its place is.
        """
        keyframes = np.stack([invert_pose(pose) for pose in self.problem.keyframe_from_world])
        distance = pose_distances(invert_pose(camera_from_world), keyframes)
        self.drift[1:, :6] = np.sqrt(np.maximum(distance, LEAST_DISTANCE))[:, None]
        self.apart[:] = np.maximum(distance, LEAST_DISTANCE)[:, None]

    def doubting(self, prior: MotionPrior) -> None:
        """Takes into account how sure the pose of each keyframe is, where that is known: against others of which it is
        known, or that have the usual prior, it counts for more or less. How far all are off shows itself.
        """
        if self.problem.keyframe_sigma is None or not prior.keyframe_m or not prior.keyframe_rad:
            return
        times = self.problem.keyframe_sigma / [prior.keyframe_m, prior.keyframe_rad]
        known = np.clip(np.where(np.isfinite(times), times, 1.0), 1 / MOST_LOOSER, MOST_LOOSER)
        self.drift[1:, :6] *= np.repeat(known, 3, axis=1)
        self.apart *= known

    def believe(self, sigma: FloatArray) -> None:
        """Makes `sigma` ``[3]`` (shift, rotation, turn of an image) those of the priors. The query's pose has none."""
        self.information = self.information_of(sigma)

    def information_of(self, sigma: FloatArray) -> FloatArray:
        """Information ``[c, 9]`` of priors of `sigma`, as in `believe`."""
        information = 1 / np.maximum(np.repeat(sigma, 3) * self.drift, FIXED) ** 2
        information[QUERY, :6] = 0.0
        return information

    def offset(self, state: _State) -> FloatArray:
        """How far ``[c, 9]`` the images are from what the priors expect."""
        return np.concatenate([state.shift, state.turn], axis=1) - self.expected

    def linearise(self, state: _State) -> _Blocks:
        from semdb.localization.bundle_kernels import normal_equations

        m, c, k = len(state.points), self.images, len(self.observed)
        blocks = _Blocks(
            np.empty((c, 9, 9)), np.empty((c, 9)), np.empty((k, 9, 3)),
            np.empty((m, 3, 3)), np.empty((m, 3)), np.empty(k), np.empty((k, 9)),
        )  # fmt: skip
        poses = state.poses
        blocks.cost = normal_equations(
            state.points, np.ascontiguousarray(poses[:, :3, :3]), np.ascontiguousarray(poses[:, :3, 3]), state.turn,
            self.problem.observed_point, self.problem.observed_image, self.observed, CAUCHY_SQUARED,
            blocks.images, blocks.image_gradients, blocks.coupling, blocks.points, blocks.point_gradients, blocks.chi2,
            blocks.own_gradients,
        )  # fmt: skip
        offset = self.offset(state)
        axis = np.arange(9)
        blocks.images[:, axis, axis] += self.information
        blocks.image_gradients += self.information * offset
        blocks.cost += float((self.information * offset**2).sum())
        return blocks

    def believe_depth(self, state: _State) -> None:
        """Grows the noise of an image's depth where it disagrees with the rest by more than the sensor's noise.

        As where depth and colour were taken at different times. The factor is the square of the excess: such errors
        are larger than the noise, and as they are alike in neighbouring pixels, they do not average out either.
        """
        for image in range(self.images):
            rows = np.flatnonzero((self.problem.observed_image == image) & np.isfinite(self.problem.depth))
            if len(rows):
                pose, depth = state.poses[image], self.problem.depth[rows]
                z = state.points[self.problem.observed_point[rows]] @ pose[2, :3] + pose[2, 3]
                excess = np.median(np.abs(z - depth) / (depth_noise(depth) * self.looser[rows])) * NORMAL_MEDIAN
                self.observed[rows, 5] = self.looser[rows] * max(1.0, float(excess)) ** 2

    def reduced(self, blocks: _Blocks, damping: float) -> tuple[FloatArray, FloatArray]:
        """Equations ``[9c, 9c]`` and gradient ``[9c]`` of the images with the points eliminated."""
        from semdb.localization.bundle_kernels import reduce_to_images

        size = 9 * self.images
        matrix = np.zeros((size, size))
        for c in range(self.images):
            own = slice(9 * c, 9 * c + 9)
            matrix[own, own] = blocks.images[c]
        matrix[self.diagonal, self.diagonal] *= 1 + damping
        gradient = blocks.image_gradients.reshape(-1).copy()
        reduce_to_images(
            blocks.coupling, blocks.points, blocks.point_gradients, self.first, self.problem.observed_image,
            damping, matrix, gradient,
        )  # fmt: skip
        return matrix, gradient

    def moved(self, state: _State, blocks: _Blocks, damping: float) -> tuple[_State, FloatArray]:
        """The state after one step, and the step ``[c, 9]``."""
        from semdb.localization.bundle_kernels import move_images, move_points

        matrix, gradient = self.reduced(blocks, damping)
        step = np.asarray(-np.linalg.solve(matrix, gradient), np.float64).reshape(-1, 9)
        points = move_points(
            state.points, blocks.coupling, blocks.points, blocks.point_gradients, self.first,
            self.problem.observed_image, damping, step,
        )  # fmt: skip
        return _State(move_images(state.poses, step), state.turn + step[:, 6:], state.shift + step[:, :6], points), step

    def minimise(self, state: _State, max_iterations: int) -> tuple[_State, _Blocks, int]:
        blocks, damping, iteration = self.linearise(state), 1e-4, 0
        for iteration in range(1, max_iterations + 1):  # noqa: B007
            proposed, step = self.moved(state, blocks, damping)
            found = self.linearise(proposed)
            if found.cost < blocks.cost:
                gain = blocks.cost - found.cost
                state, blocks = proposed, found
                damping = max(damping / 10, 1e-9)
                if gain < LEAST_GAIN * blocks.cost or np.abs(step[QUERY]).max() < LEAST_STEP:
                    break
            else:
                damping *= 10
                if damping > 1e6:
                    break
        return state, blocks, iteration


def adjust(
    problem: BundleProblem,
    camera_from_world: FloatArray,
    prior: MotionPrior | None = None,
    max_iterations: int = 15,
    *,
    rough: bool = False,
    start: BundleResult | None = None,
    evident: bool = True,
) -> BundleResult:
    """Minimises equation (5) from `camera_from_world` ``[4, 4]``, or from where `start` left the same images.

    It is solved twice. First the images may turn and the keyframes move as far as `prior` believes at most; then
    the variance of each of these priors is what the solution shows it to be (MacKay's evidence approximation, Neural
    Computation 4(3), 1992). So where nothing turned, no freedom is given that noise would use.
    The query's depth joins the second time, as far as it agrees with the first solution. `rough` stops after the first,
    without a covariance. Without `evident` nothing is said of how far the keyframes' poses are off.
    Raises numpy.linalg.LinAlgError when the points do not determine the pose (fewer than three, or in a row).
    """
    prior = prior or MotionPrior()
    solver = _Solver(problem)
    count = solver.images
    poses = np.concatenate([camera_from_world[None], problem.keyframe_from_world])
    state = _State(poses, solver.expected[:, 6:].copy(), np.zeros((count, 6)), problem.points)
    if start is not None:
        state = _State(start.image_from_world, start.turn, start.shift, problem.points)
    greatest = np.array([prior.keyframe_m, prior.keyframe_rad, prior.turn_rad])
    least = np.minimum(greatest, [prior.least_keyframe_m, prior.least_keyframe_rad, prior.least_turn_rad])
    solver.drifting(camera_from_world)
    solver.doubting(prior)
    solver.believe(greatest)
    solver.observed[problem.observed_image == QUERY, 5] = IGNORED
    state, blocks, iterations = solver.minimise(state, FIRST_ITERATIONS)
    if rough:
        return _result(state, blocks, iterations, None)
    solver.believe_depth(state)
    sigma, freedom = _evident_sigma(solver, state, blocks, least, greatest)
    errors = _evident_errors(solver, state, blocks, sigma, freedom, least, greatest) if evident else None
    solver.believe(sigma)
    state, blocks, more = solver.minimise(state, max_iterations)
    shown = 1 - (least / np.maximum(sigma, FIXED)) ** 2  # what is least is not known to be there at all
    covariance = _covariance(solver, blocks, state.poses[QUERY], np.tile(np.repeat(shown, 3), count))
    found = _result(state, blocks, iterations + more, covariance)
    place, turn = solver.apart.min(axis=0)
    return replace(found, evident=errors, nearest=(float(place), float(turn)))


def _result(state: _State, blocks: _Blocks, iterations: int, covariance: FloatArray | None) -> BundleResult:
    return BundleResult(
        camera_from_world=state.poses[QUERY],
        points=state.points,
        covariance=covariance,
        image_from_world=state.poses,
        turn=state.turn,
        shift=state.shift,
        chi2=blocks.chi2,
        iterations=iterations,
    )


def _evident_errors(
    solver: _Solver,
    state: _State,
    blocks: _Blocks,
    sigma: FloatArray,
    freedom: FloatArray,
    least: FloatArray,
    greatest: FloatArray,
) -> PoseErrors:
    """How far the keyframes' recorded poses are off each other's images, over the distances that they have here.

    `sigma` is what was found of it for a distance of 1, of `freedom` numbers, with no more than `greatest` believed.
    """
    if (sigma[:2] >= greatest[:2]).any() and (greatest[:2] > least[:2]).all():
        wide = greatest * [MOST_EVIDENT, MOST_EVIDENT, 1.0]
        sigma, freedom = _evident_sigma(solver, state, blocks, least, wide)
    pairs = np.bincount(solver.problem.observed_image, minlength=solver.images)[1:]
    far = np.average(solver.apart, axis=0, weights=np.maximum(pairs, 1e-9))
    metres, radians = np.sqrt(np.maximum(sigma[:2] ** 2 - least[:2] ** 2, 0.0) * far)
    return PoseErrors(float(metres), float(radians), float(freedom[0]), float(freedom[1]))


def _evident_sigma(
    solver: _Solver, state: _State, blocks: _Blocks, least: FloatArray, greatest: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Standard deviation ``[3]`` of the keyframes' shifts, of their rotations and of all turns, from a solution.

    And of how many numbers each is: what the images determine where so much is believed.
    They are of a keyframe at a distance of 1: the sum of squares over how many of them the images, not the priors,
    determine; iterated on the equations of the solution, which are those of the priors `greatest`.
    """
    reduced, gradient = solver.reduced(blocks, 0.0)
    offset = solver.offset(state).reshape(-1)
    old, drift = solver.information.reshape(-1), solver.drift.reshape(-1)
    data = reduced - np.diag(old)
    pull = data @ offset - (gradient - old * offset)
    kinds = np.tile(np.repeat(np.arange(3), 3), solver.images)
    groups = [np.flatnonzero((kinds == kind) & (old > 0)) for kind in range(3)]
    sigma, freedom = greatest, np.zeros(3)
    for _ in range(EVIDENCE_ROUNDS):
        information = solver.information_of(sigma).reshape(-1)
        inverse = np.linalg.inv(data + np.diag(information))
        mean, variance = inverse @ pull, np.diag(inverse)
        found = np.empty(3)
        for kind, members in enumerate(groups):
            determined = float((1 - variance[members] * information[members]).sum())
            freedom[kind] = freedom[kind] or max(determined, 0.0)
            found[kind] = np.sqrt(((mean[members] / drift[members]) ** 2).sum() / max(determined, 1e-6))
        found = np.clip(found, least, greatest)
        if np.abs(found - sigma).max() < 0.05 * float(np.abs(sigma).max()):
            return found, freedom
        sigma = found
    return sigma, freedom


def _covariance(solver: _Solver, blocks: _Blocks, camera_from_world: FloatArray, shown: FloatArray) -> FloatArray:
    """Covariance of the query's pose in the world, with all else marginalised out (see `sandwich`)."""
    from semdb.localization.bundle_kernels import pulls_of_groups

    problem = solver.problem
    reduced, _ = solver.reduced(blocks, 0.0)
    seen = problem.observed_image == QUERY
    pixels = np.zeros((len(problem.points), 2))
    pixels[problem.observed_point[seen]] = problem.xy[seen]
    group = cells_of(pixels)
    pulls = np.zeros((int(group.max()) + 1, len(reduced)))
    pulls_of_groups(
        blocks.own_gradients, blocks.coupling, blocks.points, blocks.point_gradients, solver.first,
        problem.observed_image, group, pulls,
    )  # fmt: skip
    poses = np.concatenate([camera_from_world[None], problem.keyframe_from_world])
    centres = -np.einsum("cji,cj->ci", poses[:, :3, :3], poses[:, :3, 3])
    theirs = np.flatnonzero(~seen)
    points = problem.points[problem.observed_point[theirs]]
    angle = angle_between_views(centres[QUERY], centres[problem.observed_image[theirs]], points)
    return sandwich(reduced, pulls, solver.information.reshape(-1), shown, angle, camera_from_world)


def pixel_sigma(size: Float32Array, focal: float, base_px: float = 1.0) -> FloatArray:
    """Standard deviation, in normalised coordinates, of a keypoint of diameter `size` pixels.

    The finest keypoints (about 20 pixels wide) are good to `base_px`; coarser ones in proportion to their scale.
    """
    return np.asarray(base_px * np.maximum(size.astype(np.float64) / 20.0, 1.0) / focal)
