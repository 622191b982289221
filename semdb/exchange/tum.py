"""The keyframes' trajectory in TUM's format, for evo and others: ``time tx ty tz qx qy qz qw``."""

from __future__ import annotations

from pathlib import Path

from semdb.exchange.source import ExportOptions, MapSource, new_file
from semdb.geometry.tum import TUM_COLUMNS, tum_line


def write_tum(source: MapSource, out: Path, options: ExportOptions) -> str:
    """One line a keyframe in order of recordings and frames; the frame's number where it has no time."""
    untimed = sum(head.timestamp_ns is None for head in source.heads)
    with new_file(out).open("w", encoding="utf-8") as file:
        file.write(f"# map {source.name!r}: world_from_camera of the colour camera, metres\n{TUM_COLUMNS}\n")
        recording = None
        for done, head in enumerate(source.heads, 1):
            if head.recording != recording:
                recording = head.recording
                file.write(f"# recording {recording!r}\n")
            time_ns = head.frame_index * 10**9 if head.timestamp_ns is None else head.timestamp_ns
            file.write(tum_line(time_ns, head.world_from_camera) + "\n")
            source.tell("exporting", done)
    note = f" ({untimed} by their frame's number, for want of a time)" if untimed else ""
    return f"{len(source.heads)} poses{note}"
