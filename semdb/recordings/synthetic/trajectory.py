"""A smooth walk through the free part of a room that looks all around."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from semdb.errors import SemdbError
from semdb.geometry import pose_from
from semdb.recordings.synthetic.options import EYE_HEIGHT_M
from semdb.recordings.synthetic.room import Room
from semdb.types import FloatArray

CLEARANCE = 0.38  # metres between the camera and furniture or wall, seen from above
KNOTS = 8  # of the spline, per lap


def _distance_to_solid(room: Room, points: FloatArray) -> FloatArray:
    """Distance ``[n]`` in metres of floor points ``[n, 2]`` to the nearest footprint or wall (0 inside)."""
    w, d, _ = room.size
    nearest = np.minimum(w / 2 - np.abs(points[:, 0]), d / 2 - np.abs(points[:, 1]))
    for x0, y0, x1, y1 in room.solid:
        dx = np.maximum(np.maximum(x0 - points[:, 0], points[:, 0] - x1), 0)
        dy = np.maximum(np.maximum(y0 - points[:, 1], points[:, 1] - y1), 0)
        nearest = np.minimum(nearest, np.hypot(dx, dy))
    return np.maximum(nearest, 0.0)


def _free_radius(room: Room, angle: float) -> float:
    """How far one can walk from the clear centre in a direction, at most 1.3 m."""
    r = np.arange(0.0, 1.3, 0.02)
    points = np.asarray(room.clear) + r[:, None] * np.array([np.cos(angle), np.sin(angle)])
    blocked = np.flatnonzero(_distance_to_solid(room, points) < CLEARANCE)
    return float(r[blocked[0]] if len(blocked) else r[-1])


def walk(
    room: Room,
    frames: int,
    lap_frames: int,
    seed: int,
    second_visit: bool,
    eye_height: float = EYE_HEIGHT_M,
    backwards: bool = False,
) -> FloatArray:
    """Poses ``[frames, 4, 4]`` (world_from_camera).

    In `lap_frames` frames the camera walks once around the clear part of the room and turns by 360 degrees; further
    laps are alike but not equal. It is within 0.15 m of `eye_height`, with pitch and roll of a hand-held camera;
    `backwards` goes the other way round.
    """
    rng = np.random.default_rng([seed, 3, int(second_visit)])
    laps = int(np.ceil(frames / lap_frames)) + 1
    knots = KNOTS * laps + 1
    share = np.tile(rng.uniform(0.5, 0.85, KNOTS), laps + 1)[:knots] + rng.uniform(-0.05, 0.05, knots)
    sense = 1.0 if (rng.random() < 0.5) != backwards else -1.0
    start, look = rng.uniform(0, 2 * np.pi), rng.uniform(0.55 * np.pi, 1.45 * np.pi)  # looks across the room
    angle = start + sense * 2 * np.pi * (np.arange(knots) / KNOTS) + rng.uniform(-0.12, 0.12, knots)
    reach = np.array([_free_radius(room, a) for a in angle])
    height = eye_height + np.tile(rng.uniform(-0.13, 0.13, KNOTS), laps + 1)[:knots]
    times = np.arange(frames) * KNOTS / lap_frames
    for shrink in 0.9 ** np.arange(20):
        radius = shrink * share * reach
        controls = np.stack(
            [room.clear[0] + radius * np.cos(angle), room.clear[1] + radius * np.sin(angle), height], axis=1
        )
        positions = CubicSpline(np.arange(knots), controls)(times)
        if _distance_to_solid(room, positions[:, :2]).min() >= CLEARANCE - 0.03:
            break
    else:
        raise SemdbError("synthetic recording: this room leaves no place to walk; choose another room_seed")
    t = times / KNOTS * 2 * np.pi
    p = rng.uniform(0, 2 * np.pi, 6)
    heading = start + look + sense * t + 0.16 * (np.sin(2 * t + p[0]) + 0.6 * np.sin(3 * t + p[1]))
    pitch = np.radians(-13 + 5 * np.sin(3 * t + p[2]) + 3 * np.sin(5 * t + p[3]))
    roll = np.radians(2.5 * np.sin(4 * t + p[4]) + 1.5 * np.sin(7 * t + p[5]))
    return np.array([_look(at, h, e, r) for at, h, e, r in zip(positions, heading, pitch, roll, strict=True)])


def _look(position: FloatArray, heading: float, pitch: float, roll: float) -> FloatArray:
    """The pose of a camera that looks along `heading` (about z, from x), lifted by `pitch`, turned by `roll`."""
    forward = np.array([np.cos(pitch) * np.cos(heading), np.cos(pitch) * np.sin(heading), np.sin(pitch)])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    return pose_from(np.stack([c * right + s * down, c * down - s * right, forward], axis=1), position)
