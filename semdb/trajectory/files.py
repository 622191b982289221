"""A trajectory as files: TUM's text format, and a summary as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from semdb.geometry import quat_wxyz_from_rotation
from semdb.geometry.tum import INDEX_NOTE, TUM_COLUMNS, tum_line
from semdb.recordings.base import FrameEntry
from semdb.trajectory.edges import Edge, EdgeState
from semdb.trajectory.odometry import FrameState
from semdb.trajectory.recording import RecordedTrajectory
from semdb.trajectory.result import FramePose
from semdb.trajectory.upright import Up
from semdb.types import FloatArray


def trajectory_text(found: RecordedTrajectory) -> str:
    """The frames of the largest piece in TUM's format, with the recording's own times.

    Frames without times have their index instead, in seconds, and a line says so.
    """
    lines = ["# estimated poses, world from camera, metres", *([] if found.timed else [f"# {INDEX_NOTE}"]), TUM_COLUMNS]
    for frame in found.trajectory.used:
        entry = found.entries[frame.position]
        if frame.world_from_camera is not None:
            timed = found.timed and entry.timestamp_ns is not None
            lines.append(
                tum_line(int(entry.timestamp_ns or 0) if timed else entry.index * 10**9, frame.world_from_camera)
            )
    return "\n".join(lines) + "\n"


def summary(found: RecordedTrajectory, seconds: float) -> dict[str, Any]:
    """What is told of a trajectory, as JSON: counts, pieces, closures with the drift they show, frames left out."""
    trajectory = found.trajectory
    frames = len(trajectory.frames)
    placed = [frame for frame in trajectory.frames if frame.placed]
    used = [frame.world_from_camera for frame in trajectory.used if frame.world_from_camera is not None]
    return {
        "frames": frames,
        "tracked": len(placed),
        "used": len(used),
        "laid": trajectory.count(FrameState.LAID),
        "relocalized": trajectory.count(FrameState.RELOCALIZED),
        "lost": trajectory.count(FrameState.LOST),
        "left_out": trajectory.count(FrameState.LEFT_OUT),
        "keyframes": len(trajectory.keyframes),
        "length_m": path_length(used),
        "upright": None if trajectory.up is None else _up(trajectory.up),
        "readout_s": trajectory.readout_s,
        "seconds": seconds,
        "seconds_per_frame": seconds / max(frames, 1),
        "timed": found.timed,
        "pieces": [
            {
                "frames": piece.frames,
                "keyframes": piece.keyframes,
                "first": _index(found.entries, piece.first_position),
                "last": _index(found.entries, piece.last_position),
                "upright": None if piece.up is None else _up(piece.up),
            }
            for piece in trajectory.pieces
        ],
        "closures": {str(state): len(trajectory.closures(state)) for state in EdgeState},
        "edges": [_edge(edge, found) for edge in trajectory.edges],
        "drifts": [
            {
                "first": _index(found.entries, trajectory.keyframes[drift.first]),
                "second": _index(found.entries, trajectory.keyframes[drift.second]),
                "metres": drift.metres,
                "degrees": drift.degrees,
                "path_m": drift.path_m,
            }
            for drift in trajectory.drifts
        ],
        "without_pose": [
            {"frame": _index(found.entries, frame.position), "state": str(frame.state), "reason": frame.reason}
            for frame in trajectory.frames
            if not frame.placed
        ],
        "poses": [_pose(frame, found) for frame in placed],
    }


def path_length(poses: Sequence[FloatArray]) -> float:
    """Metres travelled along poses ``[4, 4]``."""
    if len(poses) < 2:
        return 0.0
    positions = np.stack([pose[:3, 3] for pose in poses])
    return float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())


def _index(entries: Sequence[FrameEntry], position: int) -> int:
    return entries[position].index


def _up(up: Up) -> dict[str, float]:
    return {"sigma_deg": up.sigma_deg, "share": up.share}


def _edge(edge: Edge, found: RecordedTrajectory) -> dict[str, Any]:
    keyframes = found.trajectory.keyframes
    return {
        "first": _index(found.entries, keyframes[edge.first]),
        "second": _index(found.entries, keyframes[edge.second]),
        "kind": str(edge.kind),
        "state": str(edge.state),
        "reason": edge.reason,
        "inliers": edge.inliers,
        "first_from_second": edge.first_from_second,
        "information": edge.information,
    }


def _pose(frame: FramePose, found: RecordedTrajectory) -> dict[str, Any]:
    pose = frame.world_from_camera
    assert pose is not None
    return {
        "frame": _index(found.entries, frame.position),
        "state": str(frame.state),
        "piece": frame.piece,
        "keyframe": frame.keyframe >= 0,
        "position": pose[:3, 3],
        "quat_wxyz": quat_wxyz_from_rotation(pose[:3, :3]),
        "covariance": frame.covariance,
    }
