"""The calibration of a node of RTAB-Map: its cameras, in the two ways in which versions have written them."""

from __future__ import annotations

import struct
from dataclasses import dataclass

import numpy as np

from semdb.recordings.lens import Lens
from semdb.recordings.poses import rigid_pose
from semdb.shown import number
from semdb.types import FloatArray

MONO = 0


@dataclass(frozen=True, slots=True, eq=False)
class NodeCamera:
    """One camera of a node: its intrinsics, and its pose in the base."""

    lens: Lens
    base_from_camera: FloatArray


def parse_calibration(data: bytes) -> list[NodeCamera]:
    """The cameras of a calibration blob of RTAB-Map 0.11.10 or newer. Raises ValueError with the reason."""
    if not data:
        raise ValueError("has no calibration")
    for parse in (_parse_models, _parse_floats):
        found = parse(data)
        if found:
            return found
    raise ValueError(f"has a calibration of {len(data)} bytes that is not known (stereo is not read)")


def _parse_models(data: bytes) -> list[NodeCamera] | None:
    """Since 0.18: for each camera 11 integers, then K, D, R, P as float64 and the pose in the base as float32."""
    found, at = [], 0
    while at < len(data):
        if len(data) - at < 44:
            return None
        major, _, _, kind, width, height, *counts = struct.unpack_from("<11i", data, at)
        sizes = [count * 8 for count in counts[:4]] + [counts[4] * 4]
        if not 0 <= major <= 1 or kind != MONO or min(counts) < 0 or sum(sizes) > len(data) - at - 44:
            return None
        at += 44
        k, d, _, p = (np.frombuffer(data, "<f8", count, at + sum(sizes[:i])) for i, count in enumerate(counts[:4]))
        local = np.frombuffer(data, "<f4", counts[4], at + sum(sizes[:4])).astype(np.float64)
        at += sum(sizes)
        if k.size != 9 or local.size not in (0, 12):
            return None
        if p.size == 12 and p[0] > 0 and p[5] > 0:  # images are rectified where there is a projection
            lens = Lens(width, height, float(p[0]), float(p[5]), float(p[2]), float(p[6]))
        elif d.size == 6:  # its fisheye: k1, k2, 0, 0, k3, k4
            lens = _lens(width, height, k, "fisheye", (d[0], d[1], d[4], d[5]))
        else:
            lens = _lens(width, height, k, "radial", tuple(d[:8]))
        found.append(NodeCamera(_checked(lens), np.eye(4) if local.size == 0 else rigid_pose(local.reshape(3, 4))))
    return found


def _parse_floats(data: bytes) -> list[NodeCamera] | None:
    """0.11 to 0.17: for each camera fx, fy, cx, cy, perhaps width and height, and the pose in the base, float32."""
    if len(data) % 4:
        return None
    values = np.frombuffer(data, "<f4").astype(np.float64)
    if values.size % 18:
        return None
    found = []
    for row in values.reshape(-1, 18):
        fx, fy, cx, cy, width, height = (float(value) for value in row[:6])
        if width != round(width) or height != round(height):
            return None
        found.append(
            NodeCamera(_checked(Lens(int(width), int(height), fx, fy, cx, cy)), rigid_pose(row[6:].reshape(3, 4)))
        )
    return found


def _lens(width: int, height: int, k: FloatArray, model: str, coefficients: tuple[float, ...]) -> Lens:
    own = tuple(float(value) for value in coefficients)
    return Lens(width, height, float(k[0]), float(k[4]), float(k[2]), float(k[5]), model, own if any(own) else ())


def _checked(lens: Lens) -> Lens:
    numbers = (lens.fx, lens.fy, lens.cx, lens.cy, *lens.coefficients)
    if (
        not np.isfinite(numbers).all()
        or min(lens.fx, lens.fy) <= 0
        or not (0 < lens.width < 32768 and 0 < lens.height < 32768)
    ):
        raise ValueError(
            f"has a calibration that makes no sense: {lens.width}x{lens.height}, fx {number(lens.fx)}, "
            f"fy {number(lens.fy)}"
        )
    return lens
