"""How well boxes of an image agree with landmarks of a map at a pose, and the pose at which they agree best; compiled.

Boxes are x1, y1, x2, y2 in the image plane at unit distance (no lens, no pixels).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from semdb.compiled import kernel

NEAREST_M = 0.1  # a corner nearer to the camera's plane, or behind it, is taken to be this far before it
LEAST_INSIDE = 0.25  # of a landmark's box: less in the image is not expected to be seen
LEAST_SIDE = 0.02  # of a box, at unit distance
EDGE_LEAST = 0.1  # of the share by which edges are off, at unit distance: what boxes without a side are off
SIZES = 3.9  # the logarithms of sides of boxes of anything lie in a range so wide
OUTLIERS = 0.1  # share of boxes of the right thing that are nothing like what is expected
DEPTH_SHARE = 0.2  # of a landmark's size, by which the middle of what depth shows of it is off
DEPTH_LEAST = 0.03
DEPTH_BEFORE = 0.15  # of a landmark's size, by which the surface that is seen lies before its middle
SPREAD = 0.9  # of distances at which a thing is so large, as a share
REPEATED = 1.2  # a row of books says less than as many different things: what each further one of a name says less
STRAY = math.log(0.4)  # a thing that the map does not have is so much rarer where the map is than anywhere
HALF_LOG = 0.5 * math.log(2 * math.pi)
TAIL = 2.0  # degrees of freedom of Student's distribution, of which edges are off: a mask that is cut has one far off
MIDDLE = 1 / (2 * math.sqrt(2.0))  # its density there
MOST_STEPS = 12
PRIOR = 12  # residuals
MOST_PULL = 3.0  # standard deviations from which on a residual pulls no harder (Huber)


@kernel
def predict(corners: Any, centre: Any, pose: Any, frame: Any, box: Any) -> float:
    """The box ``[4]`` of a landmark as seen from `pose` (camera from world), cut at the `frame` ``[4]`` of the image.

    Returns the share of it that lies in the image; 0 behind the camera.
    """
    depth = pose[2, 0] * centre[0] + pose[2, 1] * centre[1] + pose[2, 2] * centre[2] + pose[2, 3]
    if depth < NEAREST_M:
        return 0.0
    box[0] = box[1] = 1e9
    box[2] = box[3] = -1e9
    for k in range(8):
        x = pose[0, 0] * corners[k, 0] + pose[0, 1] * corners[k, 1] + pose[0, 2] * corners[k, 2] + pose[0, 3]
        y = pose[1, 0] * corners[k, 0] + pose[1, 1] * corners[k, 1] + pose[1, 2] * corners[k, 2] + pose[1, 3]
        z = pose[2, 0] * corners[k, 0] + pose[2, 1] * corners[k, 1] + pose[2, 2] * corners[k, 2] + pose[2, 3]
        z = max(z, NEAREST_M)
        box[0], box[1] = min(box[0], x / z), min(box[1], y / z)
        box[2], box[3] = max(box[2], x / z), max(box[3], y / z)
    whole = max(box[2] - box[0], 1e-6) * max(box[3] - box[1], 1e-6)
    for k in range(2):
        box[k] = min(max(box[k], frame[k]), frame[k + 2])
        box[k + 2] = min(max(box[k + 2], frame[k]), frame[k + 2])
    inside: float = (box[2] - box[0]) * (box[3] - box[1]) / whole
    return inside


@kernel
def edge_sigma(box: Any, axis: int, edge: float) -> Any:
    """How far an edge of a box may be off, with `edge` the share of a side."""
    return edge * (max(box[axis + 2] - box[axis], LEAST_SIDE) + EDGE_LEAST)


@kernel
def edges_off(
    corners: Any,
    centres: Any,
    cameras: Any,
    frame: Any,
    landmark: Any,
    camera: Any,
    boxes: Any,
    shrunk: float,
    out: Any,
) -> None:
    """How far edges of `boxes` ``[n, 4]`` are off, as `edge_sigma` has it for a share of one: `out` ``[n, 4]``.

    NaN where one is at the border of the image, or the landmark is not in it. `landmark`, `camera` ``[n]`` are rows;
    boxes of landmarks are those about `corners`, `shrunk`.
    """
    box = np.empty(4)
    for n in range(len(boxes)):
        m = landmark[n]
        small = centres[m] + shrunk * (corners[m] - centres[m])
        out[n] = np.nan
        if predict(small, centres[m], cameras[camera[n]], frame, box) < LEAST_INSIDE:
            continue
        for k in range(4):
            if abs(boxes[n, k] - frame[k]) > 0.01 and abs(box[k] - frame[k]) > 0.01:
                out[n, k] = (boxes[n, k] - box[k]) / edge_sigma(box, k % 2, 1.0)


@kernel
def log_ratio(box: Any, seen: Any, log_area: float, edge: float) -> float:
    """Logarithm of how much likelier a box `seen` is of what is expected at `box` than of anything anywhere."""
    product = 1.0
    for axis in range(2):
        sigma = edge_sigma(box, axis, edge)
        product *= SIZES * max(seen[axis + 2] - seen[axis], LEAST_SIDE)
        for k in (axis, axis + 2):
            off = (seen[k] - box[k]) / sigma
            wide = 1 + off * off / TAIL
            product *= MIDDLE / (sigma * wide * math.sqrt(wide))
    return math.log((1 - OUTLIERS) * product * math.exp(log_area) + OUTLIERS)


@kernel
def depth_ratio(centre: Any, reach: float, pose: Any, point: Any) -> float:
    """The same of the measured distance `point` ``[3]``, against those that a box of such a size has; 0 without."""
    if not point[2] > 0:
        return 0.0
    sigma = DEPTH_LEAST + DEPTH_SHARE * reach
    off = (
        pose[2, 0] * centre[0]
        + pose[2, 1] * centre[1]
        + pose[2, 2] * centre[2]
        + pose[2, 3]
        - DEPTH_BEFORE * reach
        - point[2]
    )
    total = math.log(max(SPREAD * point[2], sigma) / sigma) - HALF_LOG - 0.5 * (off / sigma) ** 2
    return math.log((1 - OUTLIERS) * math.exp(total) + OUTLIERS)


@kernel
def agreement(
    corners: Any,
    centres: Any,
    reach: Any,
    seen: Any,
    names: Any,
    boxes: Any,
    category: Any,
    scores: Any,
    points: Any,
    frame: Any,
    edge: float,
    pose: Any,
    assigned: Any,
    table: Any,
) -> float:
    """How much likelier `boxes` ``[d, 4]`` are at `pose` than anywhere; `assigned` ``[l]``: which box is of a landmark.

    `seen` ``[l]`` is how likely a landmark in the image is found; `names` ``[l, d]`` the logarithm of how much likelier
    the name of a box is of the landmark than of anything; `table` ``[l, d]`` is room to work in.
    """
    count, number = len(centres), len(boxes)
    log_area = math.log((frame[2] - frame[0]) * (frame[3] - frame[1]))
    box = np.empty(4)
    total = 0.0
    for m in range(count):
        assigned[m] = -1
        inside = predict(corners[m], centres[m], pose, frame, box)
        if inside < LEAST_INSIDE or min(box[2] - box[0], box[3] - box[1]) < LEAST_SIDE:
            assigned[m] = -2
            continue
        expected = seen[m] * min(1.0, inside)
        missed = math.log(1 - expected)
        total += missed
        for d in range(number):
            ratio = log_ratio(box, boxes[d], log_area, edge) + depth_ratio(centres[m], reach[m], pose, points[d])
            gain = math.log(expected) + names[m, d] + ratio
            # a detection that the detector is not sure of says as much less
            table[m, d] = math.log(scores[d] * math.exp(min(gain - missed, 300.0)) + 1 - scores[d])
    taken = np.zeros(number, np.bool_)
    alike = np.zeros(number)
    while True:
        best, at, which = 0.0, -1, -1
        for m in range(count):
            if assigned[m] != -1:
                continue
            for d in range(number):
                if not taken[d] and table[m, d] > best:
                    best, at, which = table[m, d], m, d
        if at < 0:
            break
        assigned[at] = which
        taken[which] = True
        total += best / (1 + REPEATED * alike[which])
        for d in range(number):
            alike[d] += category[d] == category[which]
    for d in range(number):
        if not taken[d]:
            total += scores[d] * STRAY
    for m in range(count):
        if assigned[m] == -2:
            assigned[m] = -1
    return total


@kernel
def agreements(
    corners: Any,
    centres: Any,
    reach: Any,
    seen: Any,
    names: Any,
    boxes: Any,
    category: Any,
    scores: Any,
    points: Any,
    frame: Any,
    edge: float,
    poses: Any,
    found: Any,
) -> None:
    """`agreement` at each of `poses` ``[n, 4, 4]``."""
    assigned = np.empty(len(centres), np.int64)
    table = np.empty((len(centres), len(boxes)))
    for n in range(len(poses)):
        found[n] = agreement(
            corners,
            centres,
            reach,
            seen,
            names,
            boxes,
            category,
            scores,
            points,
            frame,
            edge,
            poses[n],
            assigned,
            table,
        )


@kernel
def residuals(
    corners: Any,
    centres: Any,
    reach: Any,
    boxes: Any,
    points: Any,
    frame: Any,
    edge: float,
    pose: Any,
    assigned: Any,
    out: Any,
) -> int:
    """In standard deviations, five of each landmark that has a box: its edges and its distance. Returns how many."""
    box = np.empty(4)
    row = 0
    for m in range(len(centres)):
        d = assigned[m]
        if d < 0:
            continue
        if predict(corners[m], centres[m], pose, frame, box) <= 0:
            out[row : row + 5] = 2 * MOST_PULL
            row += 5
            continue
        for k in range(4):
            sigma = edge_sigma(box, k % 2, edge)
            at_border = abs(boxes[d, k] - frame[k]) < 0.01 and abs(box[k] - frame[k]) < 0.01
            out[row + k] = 0.0 if at_border else (boxes[d, k] - box[k]) / sigma
        out[row + 4] = 0.0
        if points[d, 2] > 0:
            z = pose[2, 0] * centres[m, 0] + pose[2, 1] * centres[m, 1] + pose[2, 2] * centres[m, 2] + pose[2, 3]
            out[row + 4] = (points[d, 2] - z + DEPTH_BEFORE * reach[m]) / (DEPTH_LEAST + DEPTH_SHARE * reach[m])
        row += 5
    return row


@kernel
def moved(pose: Any, step: Any, out: Any) -> None:
    """`pose` (camera from world) turned and shifted in the frame of the camera by `step`: metres, then radians."""
    angle = math.sqrt(step[3] ** 2 + step[4] ** 2 + step[5] ** 2)
    turn = np.eye(3)
    if angle > 1e-12:
        x, y, z = step[3] / angle, step[4] / angle, step[5] / angle
        c, s = math.cos(angle), math.sin(angle)
        turn[0, 0], turn[0, 1], turn[0, 2] = c + x * x * (1 - c), x * y * (1 - c) - z * s, x * z * (1 - c) + y * s
        turn[1, 0], turn[1, 1], turn[1, 2] = y * x * (1 - c) + z * s, c + y * y * (1 - c), y * z * (1 - c) - x * s
        turn[2, 0], turn[2, 1], turn[2, 2] = z * x * (1 - c) - y * s, z * y * (1 - c) + x * s, c + z * z * (1 - c)
    for r in range(3):
        for c_ in range(4):
            value = 0.0
            for k in range(3):
                value += turn[r, k] * pose[k, c_]
            out[r, c_] = value + (step[r] if c_ == 3 else 0.0)
    out[3, 0] = out[3, 1] = out[3, 2] = 0.0
    out[3, 3] = 1.0


@kernel
def prior_residuals(pose: Any, start: Any, level: Any, widths: Any, out: Any) -> None:
    """How far a pose is from `start`, in standard deviations, `PRIOR` numbers: how its camera is held, its place.

    `level` ``[3, 3]``: columns are two level axes and up; `widths`: of up in the camera, of the level axes (rad), of
    the place along the level axes, and of the height (m).
    """
    for axis in range(3):
        width = widths[0] if axis == 2 else widths[1]
        for k in range(3):
            off = 0.0
            for c in range(3):
                off += (pose[k, c] - start[k, c]) * level[c, axis]
            out[3 * axis + k] = off / width
    for axis in range(3):
        off = 0.0
        for c in range(3):
            for r in range(3):
                off -= (pose[r, c] * pose[r, 3] - start[r, c] * start[r, 3]) * level[c, axis]
        out[9 + axis] = off / (widths[3] if axis == 2 else widths[2])


@kernel
def cost(values: Any, count: int, edges: int) -> float:
    """Of residuals: Student's of the first `edges`, half the sum of squares of the others, straight far out."""
    total = 0.0
    for k in range(edges):
        total += 0.5 * (TAIL + 1) * math.log(1 + values[k] * values[k] / TAIL)
    for k in range(edges, count):
        a = abs(values[k])
        total += 0.5 * a * a if a < MOST_PULL else MOST_PULL * (a - 0.5 * MOST_PULL)
    return total


@kernel
def refine(
    corners: Any,
    centres: Any,
    reach: Any,
    boxes: Any,
    points: Any,
    frame: Any,
    edge: float,
    start: Any,
    level: Any,
    widths: Any,
    assigned: Any,
    pose: Any,
    information: Any,
) -> float:
    """Levenberg-Marquardt from `pose` ``[4, 4]`` (camera from world), in place, to where boxes agree best.

    `start` holds it as `prior_residuals` has it.
    `information` ``[6, 6]`` is that of the step in the camera's frame. Returns how far it is from `start`, as a cost.
    """
    number = 0
    for m in range(len(centres)):
        number += assigned[m] >= 0
    size = 5 * number + PRIOR
    here, there = np.empty(size), np.empty(size)
    jacobian = np.empty((size, 6))
    other = np.empty((4, 4))
    step = np.empty(6)
    damping = 1e-3
    residuals(corners, centres, reach, boxes, points, frame, edge, pose, assigned, here)
    prior_residuals(pose, start, level, widths, here[size - PRIOR :])
    value = cost(here, size, size - PRIOR)
    for _ in range(MOST_STEPS):
        for k in range(6):
            step[:] = 0.0
            step[k] = 1e-4
            moved(pose, step, other)
            residuals(corners, centres, reach, boxes, points, frame, edge, other, assigned, there)
            prior_residuals(other, start, level, widths, there[size - PRIOR :])
            for n in range(size):
                jacobian[n, k] = (there[n] - here[n]) / 1e-4
        information[:] = 0.0
        gradient = np.zeros(6)
        for n in range(size):
            if n < size - PRIOR:
                weight = (TAIL + 1) / (TAIL + here[n] * here[n])
            else:
                weight = 1.0 if abs(here[n]) < MOST_PULL else MOST_PULL / abs(here[n])
            for r in range(6):
                gradient[r] += weight * jacobian[n, r] * here[n]
                for c in range(6):
                    information[r, c] += weight * jacobian[n, r] * jacobian[n, c]
        better = False
        for _ in range(4):
            damped = information.copy()
            for k in range(6):
                damped[k, k] += damping * (information[k, k] + 1e-9)
            step[:] = -np.linalg.solve(damped, gradient)
            moved(pose, step, other)
            residuals(corners, centres, reach, boxes, points, frame, edge, other, assigned, there)
            prior_residuals(other, start, level, widths, there[size - PRIOR :])
            found = cost(there, size, size - PRIOR)
            if found < value:
                better = value - found > 1e-4
                pose[:] = other
                here[:] = there
                value = found
                damping = max(damping / 5, 1e-6)
                break
            damping *= 5
        if not better:
            break
    return cost(here[size - PRIOR :], PRIOR, 0)
