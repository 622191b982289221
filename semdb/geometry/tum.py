"""Poses as lines of TUM's trajectory format, which evo and most others read."""

from __future__ import annotations

from semdb.geometry.se3 import quat_wxyz_from_rotation
from semdb.types import FloatArray

TUM_COLUMNS = "# timestamp tx ty tz qx qy qz qw"
INDEX_NOTE = "frames have no time stamps: the first column is the frame index, in seconds"


def tum_line(timestamp_ns: int, world_from_camera: FloatArray) -> str:
    """``time tx ty tz qx qy qz qw`` (s, m, unit quaternion) of a pose ``[4, 4]``, the time to the nanosecond."""
    sign = "-" if timestamp_ns < 0 else ""
    seconds, rest = divmod(abs(timestamp_ns), 10**9)
    w, x, y, z = quat_wxyz_from_rotation(world_from_camera[:3, :3])
    return f"{sign}{seconds}.{rest:09d} " + " ".join(
        f"{value:.9f}" for value in (*world_from_camera[:3, 3], x, y, z, w)
    )
