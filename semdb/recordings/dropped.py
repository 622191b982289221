"""What people are told of frames that cannot be used, and of how a recording is read."""

from __future__ import annotations

import re
from collections.abc import Iterable

from semdb.recordings.base import DroppedFrame, Recording

NAMES_SHOWN = 3


def group_dropped(dropped: Iterable[DroppedFrame]) -> list[str]:
    """One line per reason: how many, why, and the first names. Reasons that differ in numbers only are one."""
    groups: dict[str, list[DroppedFrame]] = {}
    for frame in dropped:
        key = re.sub(r"\d+(\.\d+)?", "#", frame.reason.replace(frame.name, ""))
        groups.setdefault(key, []).append(frame)
    lines = []
    for frames in groups.values():
        names = ", ".join(frame.name for frame in frames[:NAMES_SHOWN])
        more = f" and {len(frames) - NAMES_SHOWN} more" if len(frames) > NAMES_SHOWN else ""
        lines.append(f"{len(frames)} x {frames[0].reason}: {names}{more}")
    return lines


def lines_of_opening(recording: Recording) -> list[str]:
    """What had to be assumed of a recording that was opened, and how many frames cannot be used; its name before."""
    lines = [*recording.said]
    if recording.dropped:
        first = recording.dropped[0]
        lines.append(
            f"{len(recording.dropped)} of {recording.total_frames} frames cannot be used; the first, {first.name}: "
            f"{first.reason}"
        )
    return [f"{recording.name}: {line}" for line in lines]
