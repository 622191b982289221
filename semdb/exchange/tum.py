"""The keyframes' trajectory in TUM's format, for evo and others: ``time tx ty tz qx qy qz qw``."""

from __future__ import annotations

from pathlib import Path

from semdb.exchange.source import ExportOptions, MapSource, new_file
from semdb.geometry import quat_wxyz_from_rotation


def write_tum(source: MapSource, out: Path, options: ExportOptions) -> str:
    """One line a keyframe in order of recordings and frames; the frame's number where it has no time."""
    untimed = sum(head.timestamp_ns is None for head in source.heads)
    with new_file(out).open("w", encoding="utf-8") as file:
        file.write(
            f"# map {source.name!r}: world_from_camera of the colour camera, metres\n# time tx ty tz qx qy qz qw\n"
        )
        recording = None
        for done, head in enumerate(source.heads, 1):
            if head.recording != recording:
                recording = head.recording
                file.write(f"# recording {recording!r}\n")
            w, x, y, z = quat_wxyz_from_rotation(head.world_from_camera[:3, :3])
            time = f"{head.frame_index}" if head.timestamp_ns is None else _seconds(head.timestamp_ns)
            numbers = " ".join(f"{value:.9f}" for value in (*head.world_from_camera[:3, 3], x, y, z, w))
            file.write(f"{time} {numbers}\n")
            source.tell("exporting", done)
    note = f" ({untimed} by their frame's number, for want of a time)" if untimed else ""
    return f"{len(source.heads)} poses{note}"


def _seconds(time_ns: int) -> str:
    sign, whole = ("-", -time_ns) if time_ns < 0 else ("", time_ns)
    return f"{sign}{whole // 1_000_000_000}.{whole % 1_000_000_000:09d}"
