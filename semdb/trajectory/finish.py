"""All frames from adjusted keyframes, with covariances; pieces, drifts and what is told of a trajectory."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from semdb.geometry import invert_pose, pose_error
from semdb.geometry.stacks import adjoints
from semdb.trajectory.edges import Edge, EdgeKind, EdgeState, stack_edges
from semdb.trajectory.odometry import FrameTrack, Odometry
from semdb.trajectory.options import TrajectoryOptions
from semdb.trajectory.pieces import held_of
from semdb.trajectory.placing import place_again
from semdb.trajectory.pose_graph import edge_chi2, marginal_covariances
from semdb.trajectory.result import Drift, FramePose, PieceSummary, Trajectory
from semdb.trajectory.solving import Solution
from semdb.trajectory.upright import Up, find_up, level_world
from semdb.types import FloatArray

CHI2_MEDIAN = 5.348  # of six numbers
# Errors of neighbours are alike, so squares of errors exceed what pairs of keyframes say of them by so much; fitted on
# four rendered rooms and on red kitchen
SHARED_VARIANCE = 6.0

Progress = Callable[[str, int, int], None]


def finish(
    odometry: Odometry,
    edges: Sequence[Edge],
    solution: Solution,
    options: TrajectoryOptions,
    timing_s: Mapping[str, float],
    progress: Progress | None = None,
) -> Trajectory:
    """The trajectory of what was tracked and solved."""
    numbers = _piece_numbers(odometry.tracks, solution.components)
    spread = keyframe_covariances(solution, edges)
    before = np.array(odometry.odometry_poses).reshape(-1, 4, 4)
    frames = []
    rates = odometry.frame_rates(solution.poses)
    for done, track in enumerate(odometry.tracks, start=1):
        frames.append(_frame_of(odometry, track, solution, numbers, spread, before, rates, options))
        if progress is not None:
            progress("placing frames", done, len(odometry.tracks))
    frames, ups = _upright(odometry, frames) if options.upright else (frames, {})
    return Trajectory(
        frames=tuple(frames),
        keyframes=tuple(keyframe.position for keyframe in odometry.keyframes.all),
        edges=tuple(edges),
        pieces=_pieces(frames, numbers, ups),
        drifts=tuple(_drift(edge, before) for edge in edges if _closes(edge)),
        readout_s=solution.readout_s,
        timing_s=dict(timing_s),
    )


def keyframe_covariances(solution: Solution, edges: Sequence[Edge]) -> FloatArray:
    """Covariance ``[n, 6, 6]`` of each keyframe against the first of its component, as right perturbations.

    Marginals of the pose graph, grown by as much as its edges disagree with the solution more than they should.
    """
    accepted = stack_edges([edge for edge in edges if edge.state is EdgeState.ACCEPTED])
    found = marginal_covariances(solution.poses, accepted, held_of(solution.components))
    if not len(accepted):
        return found
    chi2 = edge_chi2(solution.poses, accepted)
    return found * max(1.0, float(np.median(chi2)) / CHI2_MEDIAN)


def _piece_numbers(tracks: Sequence[FrameTrack], components: Sequence[int]) -> dict[int, int]:
    """Component to piece, the one with most frames first."""
    counts = dict.fromkeys(components, 0)
    for track in tracks:
        if track.reference >= 0:
            counts[components[track.reference]] += 1
    return {component: n for n, component in enumerate(sorted(counts, key=lambda c: (-counts[c], c)))}


def _frame_of(
    odometry: Odometry,
    track: FrameTrack,
    solution: Solution,
    numbers: Mapping[int, int],
    spread: FloatArray,
    before: FloatArray,
    rates: FloatArray,
    options: TrajectoryOptions,
) -> FramePose:
    if track.reference < 0:
        return FramePose(track.position, track.state, track.reason)
    reference = solution.poses[track.reference]
    pose = reference @ track.reference_from_frame
    relative = track.covariance
    if track.observations is not None and track.keyframe < 0 and solution.turns is not None:
        at = {int(number): solution.poses[number] for number in np.unique(track.observations.keyframe)}
        turn = -solution.readout_s * rates[track.position]
        again = place_again(track.observations, odometry.keyframes, at, solution, pose, turn, options.adjustment)
        if again is not None:
            pose, in_world = again
            relative = _rotated(in_world, pose[:3, :3].T)
    carried = adjoints((invert_pose(pose) @ reference)[None])[0]
    covariance = carried @ spread[track.reference] @ carried.T
    if relative is not None:
        covariance = covariance + relative
    return FramePose(
        position=track.position,
        state=track.state,
        piece=numbers[solution.components[track.reference]],
        world_from_camera=pose,
        covariance=SHARED_VARIANCE * _rotated(covariance, pose[:3, :3]),
        before_closing=before[track.reference] @ track.reference_from_frame,
        keyframe=track.keyframe,
    )


def _rotated(covariance: FloatArray, rotation: FloatArray) -> FloatArray:
    """A covariance ``[6, 6]`` of translation and rotation, both turned by `rotation`."""
    turn = np.zeros((6, 6))
    turn[:3, :3] = turn[3:, 3:] = rotation
    turned: FloatArray = turn @ covariance @ turn.T
    return (turned + turned.T) / 2


def _upright(odometry: Odometry, frames: Sequence[FramePose]) -> tuple[list[FramePose], dict[int, Up]]:
    """`frames` in worlds whose z is up, of pieces whose surfaces tell it, and up of these."""
    members: dict[int, list[FramePose]] = {}
    for frame in frames:
        if frame.keyframe >= 0:
            members.setdefault(frame.piece, []).append(frame)
    turns: dict[int, FloatArray] = {}
    ups: dict[int, Up] = {}
    for piece, keyframes in members.items():
        poses = np.stack([frame.world_from_camera for frame in keyframes if frame.world_from_camera is not None])
        up = find_up([odometry.keyframes.all[frame.keyframe].depth for frame in keyframes], poses)
        if up is not None:
            turns[piece] = level_world(poses[0], up.direction)
            ups[piece] = replace(up, direction=np.array([0.0, 0.0, 1.0]))
    return [_turned(frame, turns[frame.piece]) if frame.piece in turns else frame for frame in frames], ups


def _turned(frame: FramePose, turn: FloatArray) -> FramePose:
    pose, before, covariance = frame.world_from_camera, frame.before_closing, frame.covariance
    return replace(
        frame,
        world_from_camera=None if pose is None else turn @ pose,
        before_closing=None if before is None else turn @ before,
        covariance=None if covariance is None else _rotated(covariance, turn[:3, :3]),
    )


def _pieces(frames: Sequence[FramePose], numbers: Mapping[int, int], ups: Mapping[int, Up]) -> tuple[PieceSummary, ...]:
    found = []
    for number in sorted(numbers.values()):
        members = [frame for frame in frames if frame.piece == number]
        positions = [frame.position for frame in members]
        keyframes = sum(frame.keyframe >= 0 for frame in members)
        found.append(PieceSummary(number, len(members), keyframes, min(positions), max(positions), ups.get(number)))
    return tuple(found)


def _closes(edge: Edge) -> bool:
    return edge.kind is EdgeKind.LOOP and edge.state is EdgeState.ACCEPTED


def _drift(edge: Edge, before: FloatArray) -> Drift:
    """By how much odometry and a closure differ."""
    by_odometry = invert_pose(before[edge.first]) @ before[edge.second]
    metres, degrees = pose_error(by_odometry, edge.first_from_second)
    low, high = sorted((edge.first, edge.second))
    steps = np.diff(before[low : high + 1, :3, 3], axis=0)
    return Drift(edge.first, edge.second, metres, degrees, float(np.linalg.norm(steps, axis=1).sum()))
