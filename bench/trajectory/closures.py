"""Are closures right, are they found, and do wrong ones change anything?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semdb.geometry import invert_pose, pose_error
from semdb.ingestion.view_overlap import ViewStack, view_grid
from semdb.recordings.base import FrameEntry, Recording
from semdb.trajectory.consistency import chain_of, consistent
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.result import Trajectory
from semdb.types import FloatArray

RIGHT_M, RIGHT_DEG = 0.1, 3.0
SEEN, APART_S = 0.3, 10.0  # common view, and time, of keyframes that should be tied


@dataclass(frozen=True, slots=True)
class ClosureFigures:
    """`right` of `accepted` closures are within 0.1 m and 3 degrees of the truth; `tied` of `tieable` keyframes have a
    closure, of those that share 30 % of their view with one 10 s or more away. Of as many wrong closures `injected` as
    there are accepted ones `survived` got through, and `lost` right ones did not any more.
    """

    accepted: int
    right: int
    worst_m: float
    worst_deg: float
    tieable: int
    tied: int
    injected: int
    survived: int
    lost: int


def closure_figures(
    trajectory: Trajectory,
    recording: Recording,
    entries: Sequence[FrameEntry],
    true: FloatArray,
    times_s: FloatArray,
) -> ClosureFigures:
    """`true` ``[n, 4, 4]`` and `times_s` ``[n]`` are of all `entries`."""
    accepted = trajectory.closures()
    positions = list(trajectory.keyframes)
    errors = [
        pose_error(invert_pose(true[positions[edge.first]]) @ true[positions[edge.second]], edge.first_from_second)
        for edge in accepted
    ]
    tieable = _tieable(recording, entries, true, times_s, positions)
    have = {number for edge in accepted for number in (edge.first, edge.second)}
    injected, survived, lost = inject(trajectory)
    return ClosureFigures(
        accepted=len(accepted),
        right=sum(metres <= RIGHT_M and degrees <= RIGHT_DEG for metres, degrees in errors),
        worst_m=max((error[0] for error in errors), default=0.0),
        worst_deg=max((error[1] for error in errors), default=0.0),
        tieable=len(tieable),
        tied=len(tieable & have),
        injected=injected,
        survived=survived,
        lost=lost,
    )


def _tieable(
    recording: Recording,
    entries: Sequence[FrameEntry],
    true: FloatArray,
    times_s: FloatArray,
    positions: Sequence[int],
) -> set[int]:
    grids = []
    for position in positions:
        depth = recording.read_depth(entries[position])
        camera = recording.camera
        grids.append(view_grid(camera, np.full((camera.height, camera.width), np.nan) if depth is None else depth))
    stack = ViewStack(grids, [true[position] for position in positions])
    times = times_s[list(positions)]
    found = set()
    for number in range(len(positions)):
        apart = np.abs(times - times[number]) >= APART_S
        if (stack.overlap_with(number)[apart] >= SEEN).any():
            found.add(number)
    return found


def inject(trajectory: Trajectory, seed: int = 0) -> tuple[int, int, int]:
    """As many wrong closures as there are right ones, judged together: injected, survived, right ones lost."""
    odometry = [edge for edge in trajectory.edges if edge.kind is EdgeKind.ODOMETRY]
    before = {frame.keyframe: frame for frame in trajectory.frames if frame.keyframe >= 0}
    if any(number not in before or before[number].piece != 0 for number in range(len(trajectory.keyframes))):
        return 0, 0, 0  # pieces: not measured here
    poses = np.stack([before[n].before_closing for n in range(len(before))])
    steps = np.zeros((len(poses), 6, 6))
    for edge in odometry:
        steps[edge.second] = np.linalg.inv(edge.information)
    chain = chain_of(poses, [0] * len(poses), steps)
    right = list(trajectory.closures())
    rng = np.random.default_rng(seed)
    wrong = []
    for edge in right:
        first, second = sorted(rng.choice(len(poses), 2, replace=False).tolist())
        wrong.append(Edge(first, second, EdgeKind.LOOP, edge.first_from_second, edge.information, edge.inliers))
    wrong = [edge for edge in wrong if _is_wrong(edge, poses)]
    judged = consistent([*right, *wrong], chain, TrajectoryOptions().consistency)
    alone = consistent(right, chain, TrajectoryOptions().consistency)
    survived = sum(edge.state is EdgeState.ACCEPTED for edge in judged[len(right) :])
    lost = sum(
        one.state is EdgeState.ACCEPTED and two.state is not EdgeState.ACCEPTED
        for one, two in zip(alone, judged, strict=False)
    )
    return len(wrong), survived, lost


def _is_wrong(edge: Edge, poses: FloatArray) -> bool:
    metres, degrees = pose_error(invert_pose(poses[edge.first]) @ poses[edge.second], edge.first_from_second)
    return metres > 2 * RIGHT_M or degrees > 2 * RIGHT_DEG
