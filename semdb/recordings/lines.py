"""Lines of the lists that recordings come with, and what is said of one that cannot be used."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from semdb.errors import RecordingError
from semdb.files import UnusableFileError, numbered_lines, read_text
from semdb.geometry import FARTHEST_POSE_M

TOO_FAR = f"is farther than {FARTHEST_POSE_M / 1000:.0f} km from the origin"


@dataclass(frozen=True, slots=True)
class BadLine:
    """A line of a list that cannot be used."""

    line: int
    reason: str


def read_lines(path: Path) -> list[tuple[int, str]]:
    """Numbered (from 1) lines that are neither empty nor a comment; see `semdb.files`. Raises RecordingError."""
    try:
        return numbered_lines(read_text(path, escape=True))
    except UnusableFileError as error:
        raise RecordingError(error.at(path)) from error
