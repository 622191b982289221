"""Folders of images with numbers in their names: colour, depth and poses of one frame belong together by number."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from semdb.recordings.base import DroppedFrame, FrameEntry
from semdb.types import FloatArray

IMAGE = (".png", ".jpg", ".jpeg")
_NUMBER = re.compile(r"(\d+)(?=\D*$)")


def numbered_files(folder: Path, suffixes: Iterable[str] = IMAGE) -> dict[int, Path]:
    """Files of `folder` by the last number in their name without suffix; of two the first in order of names."""
    found: dict[int, Path] = {}
    if not folder.is_dir():
        return found
    wanted = tuple(suffixes)
    for file in sorted(folder.iterdir()):
        number = _NUMBER.search(file.stem)
        if file.suffix.lower() in wanted and number:
            found.setdefault(int(number.group(1)), file)
    return found


def entries_of(
    root: Path,
    color: Mapping[int, Path],
    depth: Mapping[int, Path] | None,
    poses: Mapping[int, FloatArray | str] | None,
    times_ns: Mapping[int, int] | None = None,
) -> tuple[list[FrameEntry], list[DroppedFrame]]:
    """Frames of which all is there that the recording has; a pose may be the reason why there is none.

    `depth` and `poses` None say that the recording has none at all. The number is the frame's index.
    """
    entries, dropped = [], []
    for number, path in sorted(color.items()):
        name = path.relative_to(root).as_posix()
        pose = None if poses is None else poses.get(number, "no pose")
        if isinstance(pose, str):
            dropped.append(DroppedFrame(name, pose))
        elif depth is not None and number not in depth:
            dropped.append(DroppedFrame(name, "no depth image"))
        else:
            time = None if times_ns is None else times_ns.get(number)
            entries.append(FrameEntry(number, name, time, path, depth[number] if depth else None, None, pose))
    return entries, dropped
