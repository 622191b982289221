"""What each visit (recording) of a map says of its landmarks: there, not there, or not looked at.

Points that other visits saw of a landmark are looked up in the depth of all keyframes of a visit. A point is *seen*
where a surface was measured, *seen through* where one farther away was, *occluded* where only nearer ones were. Only
what was seen through is evidence that a thing is not there.
"""

# compiled functions take what numba infers
# mypy: disable-error-code="no-untyped-call"
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from semdb.compiled import kernel
from semdb.geometry import invert_pose
from semdb.geometry.sensor import AT_LEAST_M, GROWTH_PER_M, NEAREST_M
from semdb.landmarks.boxes import Box
from semdb.landmarks.lift import LiftedKeyframe
from semdb.landmarks.memo import Arrays, Memo, name_of, remembered
from semdb.landmarks.options import ShapeOptions, VisitOptions
from semdb.landmarks.shape import thing_box, thing_points
from semdb.types import FloatArray, Int64Array, IntArray

Members = Mapping[int, Sequence[int]]  # numbers of sightings by keyframe
SEEN, THROUGH, OCCLUDED = range(3)
VISIT = "visit"  # kind of what is remembered
PLANE = 0.001  # 1/m, by which inverse depth may be off a plane at least


class Presence(StrEnum):
    """Whether a visit shows a landmark. `unobserved`: too little of its place was looked at to say that it is not."""

    PRESENT = "present"
    ABSENT = "absent"
    UNOBSERVED = "unobserved"


@dataclass(frozen=True, slots=True, eq=False)
class Visit:
    """What one recording says of a landmark.

    Of the `points` that other visits saw of it (0: no other did) so many were `seen`, `seen_through` and `occluded`;
    the rest was out of view. `missed`: keyframes in which most of them are in sight, in no mask of it.
    """

    recording: int
    presence: Presence
    keyframes: int  # that show it
    points: int
    seen: int
    seen_through: int
    occluded: int
    missed: int
    box: Box | None  # of what this visit saw of it


def visits_of(
    lifted: Sequence[LiftedKeyframe],
    recordings: Sequence[int],
    members: Members,
    candidates: Int64Array,
    whole: tuple[FloatArray, Box],
    up: FloatArray,
    options: tuple[ShapeOptions, VisitOptions],
    memo: Memo | None = None,
) -> tuple[Visit, ...]:
    """The visits of a landmark by number of recording, without those that never had it in view.

    `recordings` are those of all keyframes, `members` the sightings of the landmark, `candidates` the keyframes that
    may have it in view, `whole` the landmark's points ``[n, 3]`` and box.
    """
    shape, visit = options
    by_visit: dict[int, dict[int, Sequence[int]]] = {}
    for keyframe, numbers in sorted(members.items()):
        by_visit.setdefault(recordings[keyframe], {})[keyframe] = numbers
    there = set(by_visit) | {recordings[k] for k in candidates.tolist()}
    if len(there) == 1:
        (only,) = there
        return (Visit(only, Presence.PRESENT, len(members), 0, 0, 0, 0, 0, whole[1]),)
    alone = len(by_visit) == 1
    own: dict[int, FloatArray] = {}

    def of_visit(number: int) -> FloatArray:
        if number not in own:
            own[number] = whole[0] if alone else thing_points(lifted, by_visit[number], shape, memo)
        return own[number]

    def compute() -> Arrays:
        rows = []
        for number in sorted(there):
            others = [of_visit(other) for other in sorted(by_visit) if other != number]
            known = np.concatenate(others) if others else np.empty((0, 3))
            count = min(len(known), visit.points)
            known = known[np.arange(count) * len(known) // max(count, 1)]
            frames = [k for k in candidates.tolist() if recordings[k] == number]
            counts, missed = _looked(lifted, frames, members, known, visit)
            rows.append((*counts.tolist(), missed, count))
        return {"counts": np.array(rows, np.int32)}

    if memo is None or not all(lifted[k].key for k in (*members, *candidates.tolist())):
        looked = compute()
    else:
        rank = {number: row for row, number in enumerate(sorted(there))}
        of_members = [(rank[recordings[k]], lifted[k].key, sorted(numbers)) for k, numbers in sorted(members.items())]
        of_candidates = " ".join(f"{rank[recordings[k]]} {lifted[k].key}" for k in candidates.tolist())
        looked = remembered(memo, VISIT, name_of(shape, visit, of_members, of_candidates), compute)
    found = []
    for number, (seen, through, occluded, missed, points) in zip(sorted(there), looked["counts"].tolist(), strict=True):
        mine = by_visit.get(number, {})
        counts = np.array([seen, through, occluded], np.int32)
        presence = Presence.PRESENT if mine else _without(counts, points, visit)
        if not mine and not seen + through + occluded:
            continue
        shown = None if not mine else whole[1] if alone else thing_box(lifted, mine, of_visit(number), up, shape, memo)
        found.append(Visit(number, presence, len(mine), points, seen, through, occluded, missed, shown))
    return tuple(found)


def _without(counts: IntArray, points: int, visit: VisitOptions) -> Presence:
    """Of a visit that shows no sighting."""
    shares = ((visit.through_share, visit.through_to_seen), (visit.clear_share, visit.clear_to_seen))
    if any(counts[THROUGH] >= max(share * points, to_seen * counts[SEEN], 1) for share, to_seen in shares):
        return Presence.ABSENT
    return Presence.UNOBSERVED


def _looked(
    lifted: Sequence[LiftedKeyframe], frames: Sequence[int], members: Members, points: FloatArray, visit: VisitOptions
) -> tuple[IntArray, int]:
    """How many of the `points` ``[n, 3]`` are seen, seen through, occluded, and how many keyframes missed them."""
    votes = np.zeros((len(points), 3), np.int32)
    missed = 0
    for k in frames:
        frame, camera = lifted[k], lifted[k].camera
        distortion = np.array((*camera.distortion, 0.0, 0.0, 0.0, 0.0, 0.0)[:5], np.float64)
        lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], np.float64)
        before = int(votes[:, SEEN].sum())
        pose = invert_pose(frame.world_from_camera)
        limits = _limits(frame, visit)
        witness(points, pose, lens, distortion, frame.grid_depth, float(frame.step), limits, votes)
        if k not in members and int(votes[:, SEEN].sum()) - before >= visit.missed_share * max(len(points), 1):
            missed += 1
    through = votes[:, THROUGH] > votes[:, SEEN]
    seen = ~through & (votes[:, SEEN] > 0)
    occluded = ~through & ~seen & (votes[:, OCCLUDED] > 0)
    return np.array([seen.sum(), through.sum(), occluded.sum()], np.int32), missed


def _limits(frame: LiftedKeyframe, visit: VisitOptions) -> FloatArray:
    """How near a point is seen, and how far behind it it is seen through: see `witness`."""
    noise = max(frame.noise, visit.least_noise)
    near = [visit.near_m, visit.near_deviations * frame.apart, visit.near_deviations * noise]
    through = [visit.through_m, visit.through_deviations * frame.apart, visit.through_deviations * noise]
    return np.array([near[0] + near[1], near[2], through[0] + through[1], through[2], noise], np.float64)


@kernel
def off_plane(grid_depth, row, column, u, v, x, y, z, fx, fy, noise):  # type: ignore[no-untyped-def]  # pragma: no cover
    """How far a point lies before the plane through the nine cells about it, and the share of its depth that counts.

    `u`, `v` are its pixel in cells, `x`, `y` its ray, `fx`, `fy` cells for each unit of these, `noise` that of depth in
    metres. A plane has an inverse depth that is linear in pixels. The share is 0 where the cells are no plane.
    """
    rows, columns = grid_depth.shape
    if row < 1 or column < 1 or row + 1 >= rows or column + 1 >= columns:
        return 0.0, 0.0
    total, right, down = 0.0, 0.0, 0.0
    for b in range(-1, 2):
        for a in range(-1, 2):
            measured = grid_depth[row + b, column + a]
            if not measured > 0:
                return 0.0, 0.0
            total += 1.0 / measured
            right += a / measured
            down += b / measured
    mean, right, down = total / 9.0, right / 6.0, down / 6.0
    limit = PLANE + 3.0 * noise * mean * mean
    for b in range(-1, 2):
        for a in range(-1, 2):
            if abs(1.0 / grid_depth[row + b, column + a] - mean - a * right - b * down) > limit:
                return 0.0, 0.0
    inverse = mean + (u - column - 0.5) * right + (v - row - 0.5) * down
    across, upright = right * fx, down * fy  # normal of the plane, as long as its distance is near
    length = np.sqrt(across * across + upright * upright + (inverse - across * x - upright * y) ** 2)
    if not inverse > 0:
        return 0.0, 0.0
    return (1.0 - z * inverse) / length, inverse / length


@kernel
def witness(points, camera_from_world, lens, distortion, grid_depth, scale, limits, votes):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Adds to `votes` int32 ``[n, 3]`` whether a keyframe sees each point float64 ``[n, 3]``, sees through it, or not.

    `limits`: near, through, each in metres and as a multiple of `depth_noise`, and the keyframe's own noise as one; the
    others as in `kernels.look_up`.
    """
    fx, fy, cx, cy, width, height = lens
    k1, k2, p1, p2, k3 = distortion
    rows, columns = grid_depth.shape
    r = camera_from_world
    corner = np.sqrt((max(cx, width - cx) / fx) ** 2 + (max(cy, height - cy) / fy) ** 2)
    for k in range(len(points)):
        px, py, pz = points[k, 0], points[k, 1], points[k, 2]
        z = r[2, 0] * px + r[2, 1] * py + r[2, 2] * pz + r[2, 3]
        if z < 0.05:
            continue
        x = (r[0, 0] * px + r[0, 1] * py + r[0, 2] * pz + r[0, 3]) / z
        y = (r[1, 0] * px + r[1, 1] * py + r[1, 2] * pz + r[1, 3]) / z
        if abs(x) > 2 * corner or abs(y) > 2 * corner:
            continue
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + cx
        v = fy * (y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y) + cy
        if u < -0.5 or v < -0.5 or u >= width - 0.5 or v >= height - 0.5:
            continue
        column = min(int((u + 0.5) / scale), columns - 1)
        row = min(int((v + 0.5) / scale), rows - 1)
        if not grid_depth[row, column] > 0:
            continue
        noise = AT_LEAST_M + GROWTH_PER_M * (z - NEAREST_M) ** 2
        above, along = off_plane(
            grid_depth, row, column, u / scale, v / scale, x, y, z, fx / scale, fy / scale, limits[4] * noise
        )
        if along > 0:
            if abs(above) <= limits[0] + limits[1] * noise * along:
                votes[k, 0] += 1
            elif above > limits[2] + limits[3] * noise * along:
                votes[k, 1] += 1
            elif above < 0:
                votes[k, 2] += 1
            continue
        # of the cells around: a surface near the point anywhere speaks for it, farther ones have to be everywhere
        nearest, farthest, least = 1e9, -1e9, 1e9
        for b in range(max(row - 1, 0), min(row + 2, rows)):
            for a in range(max(column - 1, 0), min(column + 2, columns)):
                measured = grid_depth[b, a]
                if measured > 0:
                    away = measured - z
                    farthest = max(farthest, away)
                    least = min(least, away)
                    nearest = min(nearest, abs(away))
        if nearest <= limits[0] + limits[1] * noise:
            votes[k, 0] += 1
        elif least > limits[2] + limits[3] * noise:
            votes[k, 1] += 1
        elif farthest < 0 or grid_depth[row, column] < z:
            votes[k, 2] += 1
